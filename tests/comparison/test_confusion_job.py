"""The confusion matrix as a job: the same whatever the workers, and however often cut off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.companion_search.search import search
from amibayes.comparison.compare import compare_sky_models
from amibayes.comparison.confusion import measure_confusion
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.parallel import Journal, open_executor
from amibayes.posterior.priors import Prior


@pytest.mark.slow
def test_confusion_does_not_depend_on_workers_or_interruptions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amibayes.comparison.confusion.PIECE", 2)
    sheet = simulated(niriss(0.003, 0.1), [120.0, 60.0, 0.02], np.random.default_rng(1))
    found = search(Likelihood(sheet, BinaryModel(1)), (94.0, 300.0))
    compared = compare_sky_models(
        found,
        Prior(94.0, 300.0),
        np.random.default_rng(2),
        models=("star", "companion"),
        confusion_draws=0,
    )
    fits = [m.fit for m in compared.models]

    def measured(**options: object) -> np.ndarray:
        rng = np.random.default_rng(3)
        made = measure_confusion(fits, 3, rng, log_prior=compared.log_prior, **options)  # type: ignore[arg-type]
        return made.log_z

    here = measured()
    assert here.shape == (2, 3, 2)
    with open_executor(2) as executor:
        assert np.array_equal(measured(executor=executor), here)
    journal = Journal(tmp_path, "key", resume=False)
    assert np.array_equal(measured(journal=journal), here)
    pieces = sorted(journal.path.iterdir())
    assert len(pieces) == 4  # 2 and 1 data sets of each model
    pieces[1].unlink()
    assert np.array_equal(measured(journal=Journal(tmp_path, "key", resume=True)), here)

"""A companion that one night shows by itself, and all nights together do not."""

from __future__ import annotations

import numpy as np
import pytest
from epochs import epoch, noisy

from amibayes.data.observables import join
from amibayes.detection.verdict import Verdict
from amibayes.pipeline.false_alarm import false_alarm, verdict_of
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions

OPTIONS = SearchOptions(observables=("cp",), separation_mas=(60.0, 300.0), null_draws=3000)
PLACES = [(150.0, 0.0), (-60.0, 140.0), (-80.0, -150.0)]


def verdict_on(
    companions: list[tuple[float, float, float]], days: float, rng: np.random.Generator
) -> Verdict:
    """The verdict on files that follow each other by so many days, each with its companion."""
    files = [
        noisy(
            epoch(mjd=60000.0 + days * k, source=f"{k}.oifits", turn_deg=50.0 * k), companion, rng
        )
        for k, companion in enumerate(companions)
    ]
    found = search_field(join(files), OPTIONS)
    tested = false_alarm(found.result, OPTIONS, rng)
    return verdict_of(found, tested, OPTIONS, rng)[0]


def stated(contrast: float) -> Verdict:
    """The verdict on three nights of a companion that is elsewhere in each."""
    rng = np.random.default_rng(3)
    return verdict_on([(*place, contrast) for place in PLACES], 100.0, rng)


@pytest.mark.slow
def test_a_companion_that_moves_is_not_denied() -> None:
    """All nights together show nothing that is unlikely for noise; each has a clear companion."""
    said = stated(0.02)
    assert said.statement == "inconsistent data"
    assert "the night of MJD 60000.000 shows a companion by itself" in said.because
    assert "PA 90 deg" in said.because
    assert "--motion" in said.because


def test_nights_without_a_companion_have_none() -> None:
    assert stated(0.0).statement == "no companion"


def of_two_files(contrasts: tuple[float, float]) -> Verdict:
    """The verdict on two files of one night, whose companions have these contrasts."""
    rng = np.random.default_rng(5)
    return verdict_on([(150.0, 0.0, contrast) for contrast in contrasts], 0.02, rng)


def test_a_companion_that_one_file_of_a_night_shows_is_not_denied() -> None:
    """Of another star, say: noise was fitted until neither file showed anything."""
    said = of_two_files((0.05, 0.0))
    assert said.statement == "inconsistent data"
    assert said.because.startswith("0.oifits shows a companion by itself")
    assert "PA 90 deg" in said.because
    assert of_two_files((0.0, 0.0)).statement == "no companion"

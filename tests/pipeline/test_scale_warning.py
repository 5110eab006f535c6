"""What is said of separations that are known better than the wavelengths of the data."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import simulated

from amibayes.companion_search.search import search
from amibayes.data.point_source import point_source
from amibayes.detection.false_alarm import significance
from amibayes.detection.statistic import statistic_of
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.pipeline.warnings import search_warnings

STATIONS = np.array([[0.0, 0.0], [30.0, 10.0], [-20.0, 45.0], [60.0, -30.0]])


@pytest.mark.parametrize(
    ("contrast", "precision", "words"),
    [(0.5, 0.001, "the separation is off by 0.01 mas"), (0.02, 0.01, ""), (0.0, 0.001, "")],
)
def test_scale_of_wavelengths_is_told_where_it_matters(contrast, precision, words, rng) -> None:
    """A bright companion at 10 mas, one that is known to some percent, and none."""
    sheet = point_source(
        STATIONS, np.linspace(1.55e-6, 1.75e-6, 4), 0.04e-6,
        vis2_error=precision, closure_error_rad=precision,
    )  # fmt: skip
    result = search(Likelihood(simulated(sheet, [8.0, 6.0, contrast], rng)), (3.0, 14.0))
    tested = significance(statistic_of(result), 1000, rng, 0.01)
    assert tested.detected is (contrast > 0.0)
    said = [w for w in search_warnings(sheet, result, ExtraNoise(), tested, None) if "off by" in w]
    assert len(said) == bool(words)
    assert all(words in one for one in said)

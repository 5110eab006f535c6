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
from amibayes.models.binary import BinaryModel
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


@pytest.mark.parametrize(
    ("star_mas", "disc", "told"), [(1.5, 0.0, True), (1.5, 0.8, False), (0.0, 0.0, False)]
)
def test_a_disc_of_the_companion_that_would_matter_is_told(star_mas, disc, told, rng) -> None:
    """ι Peg by V² alone: 0.166 ± 0.008 as a point, and 0.23 with its disc, without a word."""
    sheet = point_source(
        STATIONS, np.linspace(1.55e-6, 1.75e-6, 4), 0.04e-6,
        vis2_error=0.003, closure_error_rad=0.003,
    )  # fmt: skip
    model = BinaryModel(diameter_mas=star_mas, companion_diameter_mas=disc)
    clean = Likelihood(sheet, model)
    noise = sheet.covariance.draw(rng, 1)[:, 0]
    data = sheet.with_data(clean.predict([[8.0, 6.0, 0.3]])[:, 0] + noise)
    result = search(Likelihood(data, model), (3.0, 14.0))
    tested = significance(statistic_of(result), 1000, rng, 0.01)
    for stated in (True, False):
        said = search_warnings(data, result, ExtraNoise(), tested, None, stated=stated)
        assert any("taken for a point: as a disc of 0.82 mas" in w for w in said) is (
            told and stated
        )
        assert stated or not any("off by" in w for w in said)

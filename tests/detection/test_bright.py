"""Bright companions, whose data are far from linear in the contrast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.companion_search.search import search
from amibayes.detection.false_alarm import beside_bright, bright_probability, significance
from amibayes.detection.statistic import statistic_of
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood

FIELD = (80.0, 670.0)
DRAWS = 3000


@pytest.mark.parametrize("place", [(-415.0, 426.0), (126.0, -62.0), (-304.0, -350.0)])
def test_an_equal_binary_is_detected(place: tuple[float, float], rng) -> None:
    """Its closure phases are nearly 0 and 180°: linear templates are blind to most of them."""
    result = search(Likelihood(simulated(niriss(), (*place, 0.96), rng)), FIELD)
    assert result.chi2_binary < 1e-2 * result.chi2_single
    drawn = significance(statistic_of(result), DRAWS, rng)
    found = beside_bright(drawn, result, ExtraNoise())
    assert found.detected
    if drawn.detected:
        assert found is drawn
    else:
        assert found.bright == found.probability < 1e-6
        assert found.threshold() == drawn.threshold()


def test_noise_beside_the_errors_is_no_reason_to_deny_an_equal_binary(rng) -> None:
    """Errors that are a little too small, while the companion explains nearly all of the data."""
    result = search(Likelihood(simulated(niriss(), (6.8, -129.8, 0.9), rng)), FIELD)
    drawn = significance(statistic_of(result), DRAWS, rng)
    blind = replace(drawn, probability=0.5, interval=(0.48, 0.52), tail=None)
    added = ExtraNoise(vis2=0.001)
    assert blind.detected is False
    assert beside_bright(blind, result, added).detected
    # A twentieth of the squared residuals, that noise is taken for, is another matter.
    worse = replace(result, chi2_binary=0.05 * result.chi2_single)
    assert beside_bright(blind, worse, added) is blind
    assert beside_bright(blind, worse, ExtraNoise()).detected


def test_noise_of_any_size_never_looks_like_a_bright_companion(rng) -> None:
    """Of stars whose data scatter up to hundreds of times as much as their errors say."""
    sheet = niriss()
    for size in np.geomspace(1.0, 300.0, 12):
        noise = size * sheet.covariance.draw(rng, 1)[:, 0]
        data = sheet.with_data(sheet.data + noise)
        result = search(Likelihood(data), FIELD)
        bound = bright_probability(result, statistic_of(result))
        assert bound is None or bound > 1e-2

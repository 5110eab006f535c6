"""Limits by injection and recovery: their rate of success is the one they state."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import stats

from amibayes.inference.bank import TemplateBank
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.limits import detection_limit, recover
from amibayes.inference.search import search
from amibayes.inference.significance import null_maxima, significance
from amibayes.units import offset


@pytest.fixture(scope="module")
def setting():
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1))
    result = search(Likelihood(data), (50.0, 400.0))
    bank = TemplateBank(result.likelihood, result.grid, result.single_theta)
    rng = np.random.default_rng(2)
    weight = significance(bank, 0.0, 20_000, rng, alpha=0.01)
    limit = detection_limit(result, weight, rng, n_separations=6, trials_per_cell=200)
    return result, bank, weight, limit


def test_completeness_at_the_limit_is_the_stated_one(setting) -> None:
    """1000 fresh companions at c50 and at c95, each found by an independent full search.

    The bounds add the binomial error of the count to what the fit's own error of c50 moves
    (its slope is near 6 per unit of ln c); 4.5 sigma.
    """
    _, _, weight, limit = setting
    rng = np.random.default_rng(3)
    n = 60
    k = 3
    for contrast, expected in ((limit.contrast_50[k], 0.5), (limit.contrast[k], 0.95)):
        found = 0
        for angle in rng.uniform(0, 360, n):
            east, north = offset(limit.separation_mas[k], angle)
            data = simulated(niriss(), [float(east), float(north), contrast], rng)
            again = search(Likelihood(data), (50.0, 400.0))
            position = int(again.bank_delta_chi2.argmax())
            away = np.hypot(
                again.grid.east_mas[position] - east, again.grid.north_mas[position] - north
            )
            found += again.bank_delta_chi2.max() > weight.threshold() and away < 94.0
        spread = np.sqrt(n * expected * (1 - expected)) + 6 * 0.25 * limit.log_error_50[k] * n
        assert abs(found - n * expected) < 4.5 * spread


def test_false_positive_rate_is_alpha(setting) -> None:
    _, bank, weight, limit = setting
    n = 40_000
    rate = (null_maxima(bank, n, np.random.default_rng(9)) > weight.threshold()).mean()
    # Both the threshold (20 000 draws) and the count (40 000) scatter.
    sigma = np.sqrt(0.01 * 0.99 * (1 / n + 1 / 20_000))
    assert abs(rate - limit.false_positive_rate) < 4.5 * sigma


def test_completeness_rises_with_contrast(setting) -> None:
    *_, limit = setting
    share = limit.recovered / limit.trials
    assert (share[:, -1] > 0.95).all()
    assert (share[:, 0] < 0.2).all()
    assert (limit.contrast > limit.contrast_50).all()
    low, high = limit.jeffreys()
    assert ((low <= share + 1e-12) | (share == 0)).all()
    assert ((high >= share - 1e-12) | (share == 1)).all()
    found, tried = limit.recovered[0, 4], limit.trials[0, 4]
    expected = stats.beta.ppf([0.16, 0.84], found + 0.5, tried + 0.5 - found)
    np.testing.assert_allclose([low[0, 4], high[0, 4]], expected)


def test_bright_companions_are_recovered_and_absent_ones_are_not(setting) -> None:
    result, bank, weight, _ = setting
    rng = np.random.default_rng(6)
    east, north = offset(200.0, rng.uniform(0, 360, 500))
    for contrast, low, high in ((0.05, 500, 500), (0.0, 0, 15)):
        theta = np.column_stack([east, north, np.full(500, contrast)])
        found = recover(
            result.likelihood, bank, result.single_theta, theta, weight.threshold(), rng
        )
        assert low <= found.located.sum() <= high


def test_same_seed_same_limit(setting) -> None:
    result, _, weight, _ = setting
    first = detection_limit(result, weight, np.random.default_rng(5), trials_per_cell=10)
    again = detection_limit(result, weight, np.random.default_rng(5), trials_per_cell=10)
    np.testing.assert_array_equal(first.contrast, again.contrast)

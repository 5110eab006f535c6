"""False alarms of a survey against the definitions, by brute force, and simulated nulls."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from amibayes.errors import UsageError
from amibayes.survey.false_alarms import expected_quantiles, false_alarms, survey_wide


def listed(probability: np.ndarray, level: float) -> np.ndarray:
    """Benjamini and Hochberg's step-up procedure as their paper words it."""
    m = len(probability)
    ordered = np.sort(probability)
    passing = [k for k in range(1, m + 1) if ordered[k - 1] <= k / m * level]
    return probability <= (ordered[passing[-1] - 1] if passing else -1.0)


@pytest.mark.parametrize("m", [1, 2, 30])
def test_rates_are_the_smallest_levels_that_list_a_target(m: int) -> None:
    p = np.random.default_rng(m).uniform(size=m) ** 2
    p[0] = 1e-4
    rate = false_alarms(p).false_discovery_rate
    for k in range(m):
        assert listed(p, rate[k] * (1 + 1e-9))[k]
        assert not listed(p, rate[k] * (1 - 1e-9))[k]


@pytest.mark.parametrize("level", [0.05, 0.2])
def test_the_stated_rate_is_realised(level: float) -> None:
    """60 stars, 20 with companions: the rate is level × the share of nulls, exactly."""
    rng = np.random.default_rng(8)
    n = 2000
    share = []
    for _ in range(n):
        p = stats.norm.sf(rng.standard_normal(60) + np.repeat([2.5, 0.0], [20, 40]))
        found = false_alarms(p, level).discovered
        share.append(found[20:].sum() / max(found.sum(), 1))
    error = np.std(share) / np.sqrt(n)
    assert abs(np.mean(share) - level * 40 / 60) < 4 * error


def counted(statistic: np.ndarray, null: np.ndarray) -> np.ndarray:
    """Probabilities of statistics (m,) by the same null draws."""
    null = np.sort(null)
    return (1 + len(null) - np.searchsorted(null, statistic)) / (1 + len(null))


def test_null_draws_in_common_keep_the_rate() -> None:
    """60 stars, 20 with companions; such probabilities depend positively (Bates et al. 2023)."""
    rng, level, n = np.random.default_rng(12), 0.1, 1500
    signal, share = np.repeat([5.0, 0.0], [20, 40]), np.zeros(n)
    for k in range(n):
        p = counted(rng.exponential(size=60) + signal, rng.exponential(size=600))
        found = false_alarms(p, level).discovered
        share[k] = found[20:].sum() / max(found.sum(), 1)
    error = share.std() / np.sqrt(n)
    assert abs(share.mean() - level * 40 / 60) < 4 * error


def test_null_draws_in_common_widen_the_number_of_false_alarms() -> None:
    """It follows the beta-binomial law: with B draws 1 + m/B times the variance of m targets."""
    rng, m, draws, below = np.random.default_rng(13), 200, 99, 5
    alpha, n = below / (1 + draws), 3000
    number = [
        (counted(rng.exponential(size=m), rng.exponential(size=draws)) <= alpha).sum()
        for _ in range(n)
    ]
    law = stats.betabinom(m, below, 1 + draws - below)
    assert abs(np.mean(number) - law.mean()) < 4 * law.std() / np.sqrt(n)
    assert abs(np.var(number) / law.var() - 1.0) < 6 * np.sqrt(2.0 / n)
    assert law.var() / stats.binom(m, alpha).var() == pytest.approx(1.0 + m / draws, rel=0.05)


def test_survey_wide_is_how_often_noise_gives_one_as_small() -> None:
    rng = np.random.default_rng(3)
    m, n = 40, 20000
    smallest = rng.uniform(size=(n, m)).min(axis=1)
    p = np.full(m, 0.5)
    p[0] = 0.01
    expected = float((smallest <= 0.01).mean())
    assert abs(survey_wide(p)[0] - expected) < 4 * np.sqrt(expected * (1 - expected) / n)
    assert survey_wide(np.array([1.0, 0.0])).tolist() == [1.0, 0.0]
    assert survey_wide(np.array([1e-12] * 10))[0] == pytest.approx(1e-11)


def test_the_band_holds_its_share_of_order_statistics() -> None:
    rng = np.random.default_rng(5)
    m, n = 25, 8000
    ordered = np.sort(rng.uniform(size=(n, m)), axis=1)
    middle, low, high = expected_quantiles(m, 0.9)
    inside = ((ordered > low) & (ordered < high)).mean(axis=0)
    assert np.abs(inside - 0.9).max() < 4.5 * np.sqrt(0.09 / n)
    assert np.abs((ordered < middle).mean(axis=0) - 0.5).max() < 4.5 * np.sqrt(0.25 / n)


def test_uniformity_is_of_the_nulls_alone() -> None:
    rng = np.random.default_rng(6)
    companions = 10.0 ** -rng.uniform(2, 8, 50)
    values = [
        false_alarms(np.append(companions, rng.uniform(size=200))).uniformity()[1]
        for _ in range(300)
    ]
    assert stats.kstest(values, "uniform").pvalue > 1e-4
    wrong = np.append(companions, rng.uniform(size=1000) ** 2)
    n, p = false_alarms(wrong).uniformity()
    assert n < 700
    assert p < 1e-4
    assert false_alarms(companions).uniformity() is None


def test_draws_that_list_a_single_companion() -> None:
    m = 1000
    p = np.random.default_rng(1).uniform(0.2, 1.0, m)
    n = false_alarms(p).draws_needed()
    for draws, found in ((n, True), (n - 1, False)):
        p[0] = 1.0 / (1.0 + draws)
        assert false_alarms(p).discovered[0] == found


def test_of_no_target_and_of_what_is_no_probability() -> None:
    none = false_alarms(np.empty(0))
    assert len(none.discovered) == none.draws_needed() == 0
    assert none.uniformity() is None
    with pytest.raises(UsageError, match="between 0 and 1"):
        false_alarms(np.array([0.5, np.nan]))

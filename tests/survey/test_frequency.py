"""Companion frequency: the textbook's beta distribution, a direct integral, and coverage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from amibayes.errors import UsageError
from amibayes.survey.completeness import Crossings, DetectionProbability
from amibayes.survey.frequency import Box, frequency_posterior
from amibayes.units import delta_mag_to_contrast


@pytest.mark.parametrize(("k", "n"), [(0, 12), (3, 20), (20, 20), (400, 10000)])
def test_a_perfect_survey_has_the_beta_distribution(k: int, n: int) -> None:
    found = frequency_posterior(np.arange(n) < k, np.ones(n))
    beta = stats.beta(k + 0.5, n - k + 0.5)
    for level in (0.16, 0.5, 0.84, 0.975):
        assert found.quantile(level) == pytest.approx(beta.ppf(level), rel=3e-3, abs=1e-6)
    assert np.trapezoid(found.density[1:-1], found.frequency[1:-1]) == pytest.approx(1.0, abs=0.05)
    assert (found.n_detected, found.n_targets) == (k, n)


def test_unequal_targets_against_a_direct_integral() -> None:
    rng = np.random.default_rng(4)
    p, alarm = rng.uniform(0.1, 0.95, 15), rng.uniform(0.0, 0.02, 15)
    hit = np.arange(15) % 4 == 0
    found = frequency_posterior(hit, p, alarm)

    def density(f: float) -> float:
        q = f * p + (1 - f) * alarm
        fisher = ((p - alarm) ** 2 / (q * (1 - q))).sum()
        return float(np.prod(np.where(hit, q, 1 - q)) * np.sqrt(fisher)) * 1e8

    whole = integrate.quad(density, 0, 1, limit=200)[0]
    for f in (0.1, 0.3, 0.6):
        part = integrate.quad(density, 0, f, limit=200)[0] / whole
        assert np.interp(f, found.frequency, found.cumulative) == pytest.approx(part, abs=1e-3)


@pytest.mark.parametrize("truth", [0.05, 0.3])
def test_intervals_cover_the_frequency_that_was_simulated(truth: float) -> None:
    rng = np.random.default_rng(11)
    n, surveys = 80, 400
    p, alarm = rng.choice([0.2, 0.5, 0.7, 0.9], n), np.full(n, 0.002)
    inside = {0.68: 0, 0.95: 0}
    for _ in range(surveys):
        companion = rng.uniform(size=n) < truth
        hit = rng.uniform(size=n) < np.where(companion, p, alarm)
        found = frequency_posterior(hit, p, alarm)
        for level in inside:
            low, high = found.interval(level)
            inside[level] += low <= truth <= high
    # A count is discrete: an interval that is right on average is off by up to 5 % at one truth.
    for level, count in inside.items():
        error = np.sqrt(level * (1 - level) / surveys)
        assert abs(count / surveys - level) < 4 * error + 0.05


def test_the_completeness_of_a_box_is_that_of_drawn_companions() -> None:
    rng = np.random.default_rng(3)
    rho = np.linspace(50.0, 400.0, 9)
    middle = np.log(delta_mag_to_contrast(np.linspace(4.5, 6.0, 9)))
    target = DetectionProbability(rho, tuple(Crossings(m, 5.0) for m in middle))
    box = Box((30.0, 300.0), (2.0, 7.0))
    n = 4000
    places, mags = np.exp(rng.uniform(*np.log([30, 300]), n)), rng.uniform(2, 7, n)
    p = target.at(places, delta_mag_to_contrast(mags)[:, None])[:, 0]
    assert abs(box.completeness(target) - p.mean()) < 4 * p.std() / np.sqrt(n)
    inside = [box.holds(*place) for place in ((100.0, 3.0), (100.0, 8.0), (20.0, 3.0))]
    assert inside == [True, False, False]


def test_a_survey_that_could_see_nothing_tells_nothing() -> None:
    with pytest.raises(UsageError, match="no target could have shown"):
        frequency_posterior(np.zeros(3, bool), np.zeros(3))

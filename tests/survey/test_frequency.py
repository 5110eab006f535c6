"""Companion frequency: the textbook's beta distribution, a direct integral, and coverage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from amibayes.errors import UsageError
from amibayes.survey.completeness import Crossings, DetectionProbability
from amibayes.survey.frequency import Box, frequency_posterior
from amibayes.survey.rows import Outcome
from amibayes.survey.together import statistics, suggested_box
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


FIELD, FAINTEST, ALPHA = (70.0, 400.0), 9.0, 0.005


def drawn_survey(rng: np.random.Generator, n: int) -> tuple[float, dict]:
    """The true share in the survey's box, and what the survey says: no search, but its limits.

    The share is drawn from the prior; companions in the box are uniform in ln separation and
    magnitude, found with each star's own completeness; of the other stars some have fainter
    ones, which may be found and do not count, and some raise a false alarm.
    """
    rings, outcomes = np.geomspace(*FIELD, 6), []
    for k in range(n):
        half = 5.5 + rng.normal(0.0, 0.6) + 0.4 * np.sin(np.arange(6))
        middles = np.log(delta_mag_to_contrast(half)).tolist()
        target = DetectionProbability(rings, tuple(Crossings(m, 4.0) for m in middles))
        row = {"alpha": ALPHA, "limit_delta_mag_best": float(half.max())}
        outcomes.append(Outcome(f"t{k}", "done", row=row, detection=target))
    box = suggested_box(outcomes)
    truth = drawn_share(rng, np.array([box.completeness(o.detection) for o in outcomes]))
    for outcome in outcomes:
        inside = rng.uniform() < truth
        mags = box.delta_mag if inside else (box.delta_mag[1], FAINTEST)
        rho, mag = np.exp(rng.uniform(*np.log(box.separation_mas))), rng.uniform(*mags)
        seen = outcome.detection.at(np.array([rho]), delta_mag_to_contrast(np.array([[mag]])))
        hit = (inside or rng.uniform() < 0.2) and rng.uniform() < seen[0, 0]
        if not inside and rng.uniform() < ALPHA:
            hit, mag = True, rng.uniform(*box.delta_mag)
        outcome.row.update(detected=bool(hit), separation_mas=float(rho), delta_mag=float(mag))
    return truth, statistics(outcomes)[1]["companion_frequency"]


def drawn_share(rng: np.random.Generator, p: np.ndarray) -> float:
    """From Jeffreys' prior, the root of the Fisher information."""
    theta = (np.arange(2000) + 0.5) * np.pi / 4000.0
    f = np.sin(theta)[:, None] ** 2
    q = f * p + (1.0 - f) * ALPHA
    prior = np.sqrt(((p - ALPHA) ** 2 / (q * (1.0 - q))).sum(axis=1)) * np.sin(2.0 * theta)
    return float(rng.choice(f[:, 0], p=prior / prior.sum()))


@pytest.mark.slow
def test_whole_surveys_cover_the_frequency_of_their_box() -> None:
    """Over shares of the prior the levels are those of a posterior: exact."""
    rng, surveys = np.random.default_rng(8), 2000
    inside, ranks = np.zeros(2), []
    for _ in range(surveys):
        truth, told = drawn_survey(rng, 12)
        edges = told["interval_68"], told["interval_95"]
        inside += [low <= truth <= high for low, high in edges]
        ranks.append(truth < told["median"])
    levels = np.array([0.68, 0.95])
    assert (
        np.abs(inside / surveys - levels) < 4.0 * np.sqrt(levels * (1 - levels) / surveys)
    ).all()
    assert abs(np.mean(ranks) - 0.5) < 4.0 * 0.5 / np.sqrt(surveys)


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


def test_the_stack_reaches_to_the_outermost_ring_of_any_target() -> None:
    rings = tuple(Crossings(-6.0, 5.0) for _ in range(2))
    outcomes = [
        Outcome(str(k), "done", detection=DetectionProbability(np.array([60.0, outer]), rings))
        for k, outer in enumerate((200.0, 500.0, 300.0))
    ]
    found = statistics(outcomes)[1]["completeness"]
    assert (found["separation_mas"][0], found["separation_mas"][-1]) == pytest.approx((60.0, 500.0))
    assert (found["n_covering"][0], found["n_covering"][-2]) == (3, 1)

"""The logistic fit: maximum likelihood, honest errors, and data that are all or nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, special, stats

from amibayes.limits.logistic import LOOSENESS, TYPICAL, fit_logistic

X = np.log(np.geomspace(0.4, 4.0, 14))


def test_fit_is_that_of_a_general_optimiser() -> None:
    rng = np.random.default_rng(1)
    trials = rng.integers(100, 1000, len(X)).astype(float)
    found = rng.binomial(trials.astype(int), special.expit(5.0 * (X - 0.2) - 2.0 * X**2)) * 1.0
    fit = fit_logistic(X, found, trials)

    def loss(beta: np.ndarray) -> float:
        p = special.expit(np.polynomial.Polynomial(beta)(X - fit.centre))
        return -float(stats.binom.logpmf(found, trials, p).sum())

    best = optimize.minimize(loss, fit.beta, method="Nelder-Mead", options={"xatol": 1e-6}).x
    # The wide prior moves it by a small part of its error.
    assert np.abs(fit.beta - best).max() < 0.15 * np.sqrt(np.diag(fit.covariance)).min()


def test_beyond_the_fitted_range_the_logit_goes_on_as_its_tangent() -> None:
    trials = np.full(len(X), 1e4)
    fit = fit_logistic(X, special.expit(5.0 * X - X**2) * trials, trials)
    for end, away in ((fit.low, -1.0), (fit.high, 1.0)):
        step = 1e-5 * away
        logit = special.logit(fit(np.array([end - step, end, end + away, end + 3 * away])))
        slope = (logit[1] - logit[0]) / step
        np.testing.assert_allclose(logit[2:] - logit[1], slope * away * np.array([1, 3]), rtol=1e-3)
    falling = fit_logistic(X, trials * special.expit(-4.0 * X - 10.0 * X**2), trials)
    assert falling(falling.high + 5.0) == falling(falling.high)


def test_errors_of_both_crossings_are_what_the_crossings_scatter() -> None:
    """400 sets of binomial counts: mean of the pulls within 4.5/√400, their variance of χ²."""
    rng = np.random.default_rng(2)
    truth = special.expit(5.0 * X - 0.5 * X**2)
    trials = np.full(len(X), 200.0)
    n = 400
    for probability in (0.5, 0.95):
        level = special.logit(probability)
        at = optimize.brentq(lambda x, a=level: 5.0 * x - 0.5 * x * x - a, -1.0, 2.0)
        found = rng.binomial(200, truth, (n, len(X))).astype(float)
        pulls = [
            (x - at) / error
            for x, error in (fit_logistic(X, f, trials).crossing(probability) for f in found)
        ]
        assert abs(np.mean(pulls)) < 4.5 / np.sqrt(n) + 0.1  # curvature: second order in the error
        low, high = stats.chi2.ppf([1e-5, 1 - 1e-5], n - 1) / (n - 1)
        assert low * 0.9 < np.var(pulls, ddof=1) < high * 1.1


@pytest.mark.parametrize("unequal", [0.0, 0.15, 0.3])
def test_normal_law_of_the_contrast_is_followed(unequal: float) -> None:
    """A statistic that scatters normally is no logistic curve in ln c; 95 % must still be 95 %.

    Expected counts, more where they tell more, of directions whose sensitivities differ.
    """
    sigma = np.exp(unequal * stats.norm.ppf((np.arange(50) + 0.5) / 50))

    def share(x: np.ndarray) -> np.ndarray:
        return stats.norm.cdf(4.7 * np.exp(x)[..., None] / sigma - 4.7).mean(axis=-1)

    p = share(X)
    trials = 3360.0 * np.sqrt(p * (1 - p)) / np.sqrt(p * (1 - p)).sum()
    fit = fit_logistic(X, p * trials, trials)
    for probability, off in ((0.5, 0.005), (0.95, 0.004)):
        x, _ = fit.crossing(probability)
        assert share(np.array(x)) == pytest.approx(probability, abs=off)


def test_all_or_nothing() -> None:
    trials = np.full(len(X), 40.0)
    step = np.where(X > 0.0, 40.0, 0.0)
    x, error = fit_logistic(X, step, trials).crossing(0.5)
    assert abs(x) < 0.12
    assert 0.0 < error < 0.2
    assert fit_logistic(X, 0.0 * step, trials).crossing(0.95)[0] == np.inf
    assert fit_logistic(X, trials, trials).crossing(0.5)[0] == -np.inf


@pytest.mark.parametrize("seed", [*range(8), 291, 306, 735, 1017])
def test_the_fit_is_where_the_posterior_is_flat(seed: int) -> None:
    """Also of data that are all or nothing, rise late, or fall: steps of both signs lead there."""
    rng = np.random.default_rng(seed)
    trials = rng.integers(1, 400, len(X)).astype(float)
    beta = rng.normal([0.0, 4.0, 0.0, 0.0], [6.0, 5.0, 3.0, 3.0])
    p = special.expit(np.polynomial.Polynomial(beta)(X))
    found = {0: 0.0 * trials, 1: trials.copy()}.get(seed, rng.binomial(trials.astype(int), p) * 1.0)
    fit = fit_logistic(X, found, trials)
    design = np.vander(X - fit.centre, 4, increasing=True)
    left = design.T @ (found - trials * special.expit(design @ fit.beta))
    left -= (fit.beta - TYPICAL) / LOOSENESS**2
    assert np.abs(left * np.sqrt(np.diag(fit.covariance))).max() < 1e-5

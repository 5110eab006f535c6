"""Share of recovered companions against contrast: a logistic fit of binomial counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from amibayes.units import FloatArray

MAX_STEPS, CONVERGED, ROUNDING = 100, 1e-10, 1e-13


TYPICAL = np.array([0.0, 6.0, 0.0, 0.0])


LOOSENESS = np.array([1e3, 20.0, 20.0, 20.0])
"""A wide Gaussian prior of the coefficients, which keeps all-or-nothing data finite."""


NODES = 401
"""Between which a crossing is bracketed."""


@dataclass(frozen=True, eq=False)
class Logistic:
    """logit P = Σ βₖ (x − x₀)ᵏ, k = 0 to 3, fitted; its tangent outside of the fitted range.

    Parameters
    ----------
    low, high : float
        Range of x that was fitted; x₀ is its middle.
    beta : (4,) float array
    covariance : (4, 4) float array
    """

    low: float
    high: float
    beta: FloatArray
    covariance: FloatArray

    @property
    def centre(self) -> float:
        """x₀."""
        return 0.5 * (self.low + self.high)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Probability at x."""
        return np.asarray(special.expit(self._logit(x)))

    def _logit(self, x: FloatArray | float) -> FloatArray:
        inside = np.clip(x, self.low, self.high)
        beyond = np.maximum(self._slope(inside), 0.0) * (x - inside)
        return np.asarray(_design(inside - self.centre) @ self.beta + beyond)

    def _slope(self, x: FloatArray | float) -> FloatArray:
        """Slope of the logit inside of the fitted range."""
        powers = np.arange(1, len(self.beta))
        return np.asarray(_design(x - self.centre)[..., :-1] @ (powers * self.beta[1:]))

    def crossing(self, probability: float) -> tuple[float, float]:
        """Find x above which the probability is exceeded, and its 1σ error.

        Infinite, with NaN for its error, where that is outside the fitted range.
        """
        goal = special.logit(probability)
        nodes = np.linspace(self.low, self.high, NODES)
        below = np.flatnonzero(self._logit(nodes) < goal)
        if not len(below):
            return -np.inf, np.nan
        if below[-1] == NODES - 1:
            return np.inf, np.nan
        between = nodes[below[-1]], nodes[below[-1] + 1]
        x = float(optimize.brentq(lambda at: float(self._logit(at)) - goal, *between))
        row = _design(x - self.centre)
        return x, float(np.sqrt(row @ self.covariance @ row) / self._slope(x))


def fit_logistic(x: FloatArray, successes: FloatArray, trials: FloatArray) -> Logistic:
    """Fit binomial counts by Newton's method.

    A statistic that scatters normally about the contrast, averaged over directions of unequal
    sensitivity, is no straight line in ln contrast: with the square and the cube the
    fit follows it to 0.5 % of probability, without them to 3 %.

    Parameters
    ----------
    x, successes, trials : (n,) float array
    """
    low, high = float(np.min(x)), float(np.max(x))
    design = _design(x - 0.5 * (low + high))
    precision = np.diag(LOOSENESS**-2.0)
    share = np.clip(successes.sum() / trials.sum(), 0.01, 0.99)
    beta = TYPICAL + np.array([special.logit(share), 0.0, 0.0, 0.0])

    def log_posterior(beta: FloatArray) -> float:
        logit, off = design @ beta, beta - TYPICAL
        likelihood = successes @ logit - trials @ np.logaddexp(0.0, logit)
        return float(likelihood - 0.5 * off @ precision @ off)

    best = log_posterior(beta)
    for _ in range(MAX_STEPS):
        p = special.expit(design @ beta)
        information = (design.T * (trials * p * (1.0 - p))) @ design + precision
        gradient = design.T @ (successes - trials * p) - precision @ (beta - TYPICAL)
        step = np.linalg.solve(information, gradient)
        # Far from the answer the curvature is that of another place: there is one maximum, and
        # a step towards it that is short enough gains.
        least = -ROUNDING * abs(best)
        while (gain := log_posterior(beta + step) - best) < least:
            step *= 0.5
        beta, best = beta + step, best + gain
        if np.abs(step).max() < CONVERGED:
            break
    return Logistic(low, high, beta, np.linalg.inv(information))


def _design(x: FloatArray | float) -> FloatArray:
    return np.stack([np.ones_like(x), x, np.square(x), np.power(x, 3)], axis=-1)

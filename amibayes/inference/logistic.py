"""Logistic regression: the contrast at which a given share of companions is recovered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from amibayes.units import FloatArray

MOST_STEPS, SETTLED = 100, 1e-10

TYPICAL = np.array([0.0, 6.0, 0.0])
LOOSENESS = np.array([1e3, 6.0, 3.0])
"""A wide Gaussian prior of the coefficients, which keeps all-or-nothing data finite."""


@dataclass(frozen=True, eq=False)
class Logistic:
    """logit P = β₀ + β₁ (x − x₀) + β₂ (x − x₀)², fitted.

    Parameters
    ----------
    centre : float
        x₀.
    beta : (3,) float array
    covariance : (3, 3) float array
    """

    centre: float
    beta: FloatArray
    covariance: FloatArray

    def __call__(self, x: FloatArray) -> FloatArray:
        """Probability at x."""
        return np.asarray(special.expit(_design(x - self.centre) @ self.beta))

    def crossing(self, probability: float) -> tuple[float, float]:
        """Find x at which the probability is reached on the rising side, and its 1σ error.

        Infinite, with NaN for its error, where it never is.
        """
        a, b, c = self.beta
        rest = a - special.logit(probability)
        inside = b * b - 4.0 * c * rest
        if inside <= 0.0 or b + np.sqrt(inside) <= 0.0:
            return np.inf, np.nan
        x = -2.0 * rest / (b + np.sqrt(inside))
        slope = b + 2.0 * c * x
        row = np.array([1.0, x, x * x])
        error = np.sqrt(row @ self.covariance @ row) / slope
        return float(self.centre + x), float(error)


def fit_logistic(x: FloatArray, successes: FloatArray, trials: FloatArray) -> Logistic:
    """Fit binomial counts by Newton's method.

    The square in x is what a probit, or the mean over directions of unequal sensitivity,
    needs beyond a straight line.

    Parameters
    ----------
    x, successes, trials : (n,) float array
    """
    centre = float(np.mean(x))
    design = _design(x - centre)
    precision = np.diag(LOOSENESS**-2.0)
    share = np.clip(successes.sum() / trials.sum(), 0.01, 0.99)
    beta = np.array([special.logit(share), TYPICAL[1], 0.0])
    for _ in range(MOST_STEPS):
        p = special.expit(design @ beta)
        information = (design.T * (trials * p * (1.0 - p))) @ design + precision
        gradient = design.T @ (successes - trials * p) - precision @ (beta - TYPICAL)
        step = np.linalg.solve(information, gradient)
        # Far from the answer the curvature is that of another place.
        step *= min(1.0, 3.0 / max(np.abs(step).max(), 1e-300))
        beta = beta + step
        if np.abs(step).max() < SETTLED:
            break
    return Logistic(centre, beta, np.linalg.inv(information))


def _design(x: FloatArray) -> FloatArray:
    return np.stack([np.ones_like(x), x, x * x], axis=-1)

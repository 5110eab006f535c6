"""Laplace's approximation: a Gaussian at every mode, in the coordinates that are sampled."""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial

import numpy as np
from scipy import stats
from scipy.special import gammaln, logsumexp

from amibayes.companion_search.result import Mode
from amibayes.likelihood.chi2 import LOG_TWO_PI
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.parameters import Parameters
from amibayes.posterior.priors import Prior
from amibayes.units import FloatArray, IntArray

TAILS = 5.0
"""Degrees of freedom of the t distributions that are drawn from."""


def log_evidence_laplace(likelihood: Likelihood, modes: Sequence[Mode], prior: Prior) -> float:
    """ln Z as the sum over the modes; every order of the companions counts.

    Right where companions are strong: at a contrast of few errors the posterior in ln
    contrast is no Gaussian.
    """
    parts = log_masses(likelihood, modes, prior)
    return float(logsumexp(parts) + np.log(factorial(likelihood.model.companions)))


def log_masses(likelihood: Likelihood, modes: Sequence[Mode], prior: Prior) -> FloatArray:
    """Logarithm of what each mode adds to the evidence, (n_modes,)."""
    return np.array([_log_mass(likelihood, np.array(m.theta), prior) for m in modes])


def _log_mass(likelihood: Likelihood, theta: FloatArray, prior: Prior) -> float:
    """Mass of one mode's Gaussian, cut off at the ranges of rates and nuisance parameters."""
    centre, scatter = gaussian_of(likelihood, theta, prior)
    bounded, ranges = _bounded(likelihood, prior)
    sigma = np.sqrt(np.diag(scatter @ scatter.T))[bounded]
    pull = (ranges - centre[bounded, None]) / sigma[:, None]
    inside = np.prod(stats.norm.cdf(pull[:, 1]) - stats.norm.cdf(pull[:, 0]))
    volume = np.linalg.slogdet(scatter)[1] + 0.5 * len(centre) * LOG_TWO_PI
    parameters = likelihood.parameters
    at_peak = likelihood.log_prob(physical(centre[None], parameters))[0]
    return float(at_peak + _log_prior(centre, parameters, prior) + volume + np.log(inside))


def _bounded(likelihood: Likelihood, prior: Prior) -> tuple[IntArray, FloatArray]:
    """Columns of rates, shapes and nuisance parameters, and their ranges (n, 2)."""
    parameters, rate = likelihood.parameters, prior.fastest_mas_yr
    columns = np.concatenate([parameters.rates, parameters.columns("shape"), parameters.nuisance])
    ranges = [(-rate, rate)] * len(parameters.rates)
    ranges += list(prior.shapes) * parameters.companions + list(prior.nuisance)
    return columns, np.array(ranges).reshape(-1, 2)


def _log_prior(centre: FloatArray, parameters: Parameters, prior: Prior) -> float:
    """Density of the prior at a mode, which may stand on the edge of the field."""
    density = float(prior.log_density(centre[None])[0])
    if np.isfinite(density):
        return density
    moved = centre.copy()
    for place in (parameters.place(k + 1) for k in range(parameters.companions)):
        rho = max(float(np.hypot(*centre[place])), 1e-300)
        slack = 1e-6 * (prior.outer_mas - prior.inner_mas)
        moved[place] *= np.clip(rho, prior.inner_mas + slack, prior.outer_mas - slack) / rho
    return float(prior.log_density(moved[None])[0])


SHORTEST = 1e-4
"""Least length of an axis of a mode, in errors of the parameters along it."""


def gaussian_of(
    likelihood: Likelihood, theta: FloatArray, prior: Prior, widest: float = 0.5
) -> tuple[FloatArray, FloatArray]:
    """Centre and scatter matrix of a mode in the sampled coordinates (ln contrast).

    Contrasts below their error are moved up to it: there the posterior in ln contrast ends.
    No axis is longer than ``widest`` times the field.
    """
    bright = likelihood.parameters.contrasts
    sigma = np.sqrt(np.diag(likelihood.errors(theta)))
    theta = np.array(theta)
    least = np.maximum(np.minimum(sigma[bright], 0.1), 1.01 * prior.contrast_min)
    theta[bright] = np.clip(theta[bright], least, prior.contrast_max)
    bounded, ranges = _bounded(likelihood, prior)
    theta[bounded] = np.clip(theta[bounded], ranges[:, 0], ranges[:, 1])
    stretch, errors = np.ones(len(theta)), likelihood.errors(theta)
    # Data that say nothing of a contrast leave it as wide as the prior.
    known = np.log(prior.contrast_max / prior.contrast_min) / np.sqrt(np.diag(errors)[bright])
    stretch[bright] = np.minimum(1.0 / theta[bright], known)
    covariance = errors * np.outer(stretch, stretch)
    # A closure phase at a null of the visibility turns at once: no axis is as short as it says.
    covariance += SHORTEST**2 * np.diag(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance)
    theta[bright] = np.log(theta[bright])
    limit = max(widest * prior.outer_mas, 1.0)
    return theta, vectors * np.sqrt(np.clip(values, 1e-20, limit**2))


def physical(x: FloatArray, parameters: Parameters) -> FloatArray:
    """From the sampled coordinates to the model's."""
    theta = x.copy()
    theta[..., parameters.contrasts] = np.exp(theta[..., parameters.contrasts])
    return theta


def sampled(theta: FloatArray, parameters: Parameters) -> FloatArray:
    """From the model's coordinates to the sampled ones."""
    x = theta.copy()
    x[..., parameters.contrasts] = np.log(x[..., parameters.contrasts])
    return x


class HeavyTailed:
    """A multivariate t distribution of `TAILS` degrees of freedom."""

    def __init__(self, centre: FloatArray, scatter: FloatArray) -> None:
        self.centre, self.scatter = centre, scatter
        n = len(centre)
        self._log_norm = (
            gammaln(0.5 * (TAILS + n))
            - gammaln(0.5 * TAILS)
            - 0.5 * n * np.log(TAILS * np.pi)
            - np.linalg.slogdet(scatter)[1]
        )

    def draw(self, rng: np.random.Generator | np.random.RandomState, n: int) -> FloatArray:
        """Draws (n, n_dim)."""
        normal = rng.standard_normal((n, len(self.centre)))
        stretch = np.sqrt(TAILS / rng.chisquare(TAILS, (n, 1)))
        return np.asarray(self.centre + (normal * stretch) @ self.scatter.T)

    def log_density(self, x: FloatArray) -> FloatArray:
        """ln of the density at x (n, n_dim), (n,)."""
        z = np.linalg.solve(self.scatter, (x - self.centre).T)
        square = (z * z).sum(axis=0)
        power = 0.5 * (TAILS + len(self.centre))
        return np.asarray(self._log_norm - power * np.log1p(square / TAILS))

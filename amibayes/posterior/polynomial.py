"""ln L of many data near one mode: a polynomial, held against ln L itself.

Thousands of data leave a companion and its star little room: over all of the posterior ln L is a
polynomial of low degree in the sampled coordinates. It is fitted to draws around the mode and
compared with ln L at others; farther away ln L itself is formed. A chain then costs as much as
its first steps did.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations_with_replacement
from math import comb

import numpy as np
from scipy import stats

from amibayes.models.parameters import Parameters
from amibayes.posterior.laplace import HeavyTailed, physical, sampled
from amibayes.posterior.sampler import LogProb, ModelPrior, tempered
from amibayes.units import FloatArray, IntArray

DEGREES = (3, 4)
"""Degrees tried in turn."""

DRAWS_PER_TERM = 2.5
"""Draws to which the polynomial is fitted, for each of its coefficients."""

FIRST_DRAWS = 40
"""Draws per parameter from which the posterior's own centre and covariance are estimated."""

TAIL_DRAWS = 200
"""Draws per parameter that make a proposal for evidences of it."""

LEAST_EFFECTIVE = 4.0
"""Effective number of those draws per parameter, without which their weights are tempered."""

ROUNDS = 12
"""Such estimates in turn: Laplace's covariance is of one noise and may be far from the mean's."""

WIDER, TESTED = 1.6, 1.2
"""Scatter of the draws of the fit and of the comparison, in units of the posterior's."""

N_TESTS = 300

OUTSIDE = 1e-6
"""Share of a Gaussian posterior that lies where ln L itself is formed."""

GOOD = 0.03
"""Largest root mean square error of ln L at the draws of the comparison, weighted by the square
root of L: quantiles then move by a few hundredths of a standard error at most."""


@dataclass(frozen=True, eq=False)
class PolynomialLogProb:
    """ln L as a polynomial near a mode, and as it is elsewhere.

    Parameters
    ----------
    exact : callable
        ln L (n,) of parameter sets (n, n_dim).
    parameters : Parameters
    centre : (n_dim,) float array
        In the sampled coordinates (ln contrast).
    unit : (n_dim, n_dim) float array
        Makes differences from it uncorrelated, of variance 1.
    radius : float
        Where the polynomial ends, in those units.
    coefficients : (n_terms,) float array
    error : float
        Root mean square difference from ln L at draws that were not fitted.
    """

    exact: LogProb
    parameters: Parameters
    centre: FloatArray
    unit: FloatArray
    radius: float
    coefficients: FloatArray
    error: float

    def __call__(self, theta: FloatArray) -> FloatArray:
        """ln L (n,) of parameter sets (n, n_dim), contrast as a flux ratio."""
        z = (sampled(theta, self.parameters) - self.centre) @ self.unit.T
        near = (z * z).sum(axis=1) < self.radius**2
        out = np.empty(len(theta))
        out[near] = _terms(z[near] / self.radius, len(self.coefficients)) @ self.coefficients
        if not near.all():
            out[~near] = self.exact(theta[~near])
        return out

    @cached_property
    def around(self) -> HeavyTailed:
        """A t distribution of the posterior's mean and covariance, to draw from."""
        return HeavyTailed(self.centre, np.asarray(np.linalg.inv(self.unit), dtype=float))


def polynomial_log_prob(
    log_prob: LogProb,
    prior: ModelPrior,
    centre: FloatArray,
    scatter: FloatArray,
    rng: np.random.Generator,
) -> PolynomialLogProb | None:
    """Fit a polynomial to ln L around a mode.

    Parameters
    ----------
    log_prob : callable
        ln L (n,) of parameter sets (n, n_dim).
    prior : ModelPrior
        Draws are made where it has density.
    centre : (n_dim,) float array
        The mode in the sampled coordinates.
    scatter : (n_dim, n_dim) float array
        Its covariance is about ``scatter @ scatter.T``.
    rng : numpy.random.Generator

    Returns
    -------
    PolynomialLogProb or None
        None where ln L is no polynomial: its errors at draws for comparison are too large.
    """
    work = Around(log_prob, prior, rng)
    own = work.own(centre, scatter)
    if own is None:
        return None
    centre, scatter = own
    unit, n_dim = np.asarray(np.linalg.inv(scatter), dtype=float), len(centre)
    radius = float(np.sqrt(stats.chi2.isf(OUTSIDE, n_dim)))
    tests = work.drawn(centre, scatter, TESTED, N_TESTS, radius)
    fitted: tuple[FloatArray, FloatArray] = np.empty((0, n_dim)), np.empty(0)
    for degree in DEGREES:
        n_terms = comb(n_dim + degree, degree)
        more = int(DRAWS_PER_TERM * n_terms) - len(fitted[0])
        new = work.drawn(centre, scatter, WIDER, more, radius)
        fitted = np.concatenate([fitted[0], new[0]]), np.concatenate([fitted[1], new[1]])
        coefficients = _fitted(*fitted, radius, n_terms)
        difference = _terms(tests[0] / radius, n_terms) @ coefficients - tests[1]
        # What is improbable counts less, but is seen.
        weight = np.exp(0.5 * (tests[1] - tests[1].max()))
        error = float(np.sqrt(weight @ difference**2 / weight.sum()))
        if error < GOOD:
            parameters = prior.parameters
            return PolynomialLogProb(
                log_prob, parameters, centre, unit, radius, coefficients, error
            )
    return None


@dataclass(frozen=True, eq=False)
class Around:
    """Draws around a mode, with ln L.

    Parameters
    ----------
    log_prob : callable
        ln L (n,) of parameter sets (n, n_dim).
    prior : ModelPrior
        Draws are made where it has density.
    rng : numpy.random.Generator
    """

    log_prob: LogProb
    prior: ModelPrior
    rng: np.random.Generator

    def own(self, centre: FloatArray, scatter: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Mean and scatter matrix of the posterior by weighted draws; None if not found."""
        n_dim = len(centre)
        for _ in range(ROUNDS):
            z, value = self.drawn(centre, scatter, WIDER, FIRST_DRAWS * n_dim, np.inf)
            x = centre + z @ scatter.T
            if len(x) < LEAST_EFFECTIVE * n_dim:  # far wider than the prior
                return None
            log_weight = value + self.prior.prior.log_density(x) + 0.5 * (z * z).sum(1) / WIDER**2
            weight, power = tempered(log_weight, LEAST_EFFECTIVE * n_dim)
            centre, scatter = _moments(x, weight)
            if power == 1.0:
                return centre, scatter
        return None

    def heavy_tailed(self, centre: FloatArray, scatter: FloatArray) -> HeavyTailed | None:
        """A t distribution like the posterior around a mode, to draw from; None if not found.

        Draws from a first one, of `own`, reach the tails that its few narrow draws did not.
        """
        own = self.own(centre, scatter)
        if own is None:
            return None
        first, n_dim = HeavyTailed(*own), len(centre)
        x = first.draw(self.rng, TAIL_DRAWS * n_dim)
        log_prior = self.prior.prior.log_density(x)
        x, log_prior = x[np.isfinite(log_prior)], log_prior[np.isfinite(log_prior)]
        if len(x) < LEAST_EFFECTIVE * n_dim:
            return first
        value = self.log_prob(physical(x, self.prior.parameters))
        log_weight = value + log_prior - first.log_density(x)
        weight, _ = tempered(log_weight, LEAST_EFFECTIVE * n_dim)
        return HeavyTailed(*_moments(x, weight))

    def drawn(
        self, centre: FloatArray, scatter: FloatArray, wider: float, n: int, radius: float
    ) -> tuple[FloatArray, FloatArray]:
        """Draws (n, n_dim) in units of the scatter inside radius and prior, and ln L (n,)."""
        z = wider * self.rng.standard_normal((4 * n, len(centre)))
        x = centre + z @ scatter.T
        inside = np.isfinite(self.prior.prior.log_density(x)) & ((z * z).sum(axis=1) < radius**2)
        z, x = z[inside][:n], x[inside][:n]
        return z, self.log_prob(physical(x, self.prior.parameters))


def _moments(x: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and scatter matrix of weighted draws (n, n_dim)."""
    centre = np.asarray(weight @ x)
    away = np.sqrt(weight)[:, None] * (x - centre)
    return centre, np.asarray(np.linalg.cholesky(away.T @ away), dtype=float)


def _fitted(z: FloatArray, value: FloatArray, radius: float, n_terms: int) -> FloatArray:
    """Coefficients by least squares; what is improbable counts less."""
    weight = np.exp((value - value.max()) / 8.0)
    terms = _terms(z / radius, n_terms)
    return np.asarray(np.linalg.lstsq(weight[:, None] * terms, weight * value, rcond=None)[0])


@cache
def _products(n_dim: int, degree: int) -> tuple[IntArray, IntArray]:
    """Of each product of a degree: which of the degree below it is made of, and the last factor."""
    below = list(combinations_with_replacement(range(n_dim), degree - 1))
    place = {factors: k for k, factors in enumerate(below)}
    these = list(combinations_with_replacement(range(n_dim), degree))
    return np.array([place[f[:-1]] for f in these]), np.array([f[-1] for f in these])


def _terms(x: FloatArray, n_terms: int) -> FloatArray:
    """Products of coordinates (n, n_dim), degree by degree, (n, n_terms)."""
    blocks, found = [np.ones((len(x), 1))], 1
    while found < n_terms:
        parent, factor = _products(x.shape[1], len(blocks))
        blocks.append(blocks[-1][:, parent] * x[:, factor])
        found += len(parent)
    return np.hstack(blocks)

"""Quadrature of the nuisance parameters of a grid posterior, and the evidence of a star alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from amibayes.companion_search.optimise import fit_single
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.posterior.priors import Prior
from amibayes.units import FloatArray, IntArray

NUISANCE_REACH, NODES_PER_SIGMA = 5.0, 1.0
"""Errors to each side that nodes reach, and nodes in each error that is left where everything else
is known."""


MIN_NODES, MAX_NODES = 10, 64
"""Nodes of one parameter: half of a Gaussian, at a bound of the prior, needs the fewest. With the
most they may be too far apart: the companion moves the parameter by many of its errors."""


MAX_LAYOUTS, SAME_LOG_Z = 8, 0.002
"""How often nodes are laid for the evidence of a star alone, until ln Z changes by less."""


@dataclass(frozen=True, eq=False)
class Nuisance:
    """Quadrature of the nuisance parameters.

    Parameters
    ----------
    value : (n_nodes, n_nuisance) float array
    log_weight : (n_nodes,) float array
        Logarithm of the prior probability that a node stands for.
    low, high : (n_nodes, n_nuisance) float array
        Range that it stands for.
    shape : tuple of int
        Number of nodes of each parameter.
    """

    value: FloatArray
    log_weight: FloatArray
    low: FloatArray
    high: FloatArray
    shape: tuple[int, ...] = ()

    @property
    def close(self) -> bool:
        """Whether nodes are as close as they have to be."""
        return max(self.shape, default=0) < MAX_NODES

    @property
    def outer(self) -> FloatArray:
        """Nodes at the ends and in the middle of each parameter, (n, n_nuisance)."""
        if not self.shape:
            return self.value
        three = np.ix_(*([0, n // 2, n - 1] for n in self.shape))
        return self.value[np.arange(len(self.value)).reshape(self.shape)[three].ravel()]


def nuisance_nodes(
    prior: Prior,
    centres: FloatArray,
    errors: FloatArray,
    reach: float = NUISANCE_REACH,
    at_companion: FloatArray | None = None,
) -> Nuisance:
    """Gauss–Legendre nodes around fits, each parameter given the ones before it.

    Parameters
    ----------
    prior : Prior
    centres : (n_fits, n_nuisance) float array
        Best values; nodes reach beyond all of them, as far as the prior goes.
    errors : (n_nuisance, n_nuisance) float array
        Their covariance: correlated parameters are followed along their ridge.
    reach : float
        Errors that nodes reach.
    at_companion : (n_nuisance, n_nuisance) float array, optional
        Their covariance where place and contrast of the companion are known; ``errors`` by
        default. The integrand is as narrow as that in every cell, and nodes are as close.
    """
    narrow = errors if at_companion is None else at_companion
    value, low, high = (np.empty((1, 0)) for _ in range(3))
    log_weight, shape = np.zeros(1), []
    for k, one in enumerate(prior.ranges):
        bounds = one.low, one.high
        turn, sigma = _given_before(errors, k)
        if not 0.0 < sigma < bounds[1] - bounds[0]:
            sigma, turn = bounds[1] - bounds[0], 0.0 * turn
        finest = _given_before(narrow, k)[1]
        finest = min(finest, sigma) if finest > 0.0 else sigma  # NaN where data say nothing
        middle = centres[:, k] + (value[:, None] - centres[:, :k]) @ turn
        x, w, a, b = _axis(middle, reach * sigma, finest, bounds)
        n = x.shape[1]
        shape.append(n)
        value, low, high = (
            np.hstack([np.repeat(old, n, axis=0), new.reshape(-1, 1)])
            for old, new in ((value, x), (low, a), (high, b))
        )
        log_weight = np.repeat(log_weight, n) + (np.log(w) + one.log_density(x)).ravel()
    return Nuisance(value, log_weight, low, high, tuple(shape))


def given_rest(errors: FloatArray, columns: IntArray) -> FloatArray:
    """Covariance of some parameters where all others are known, of the covariance of all."""
    sigma = np.sqrt(np.diag(errors))
    sigma[sigma == 0.0] = 1.0
    precision = np.linalg.pinv(errors / np.outer(sigma, sigma), hermitian=True)
    block = np.linalg.pinv(precision[np.ix_(columns, columns)], hermitian=True)
    return np.asarray(block * np.outer(sigma[columns], sigma[columns]))


def _given_before(errors: FloatArray, k: int) -> tuple[FloatArray, float]:
    """Regression of parameter k on those before it (k,), and its error where they are known."""
    turn = np.linalg.pinv(errors[:k, :k]) @ errors[:k, k]
    return turn, float(np.sqrt(max(errors[k, k] - errors[k, :k] @ turn, 0.0)))


def _axis(
    middle: FloatArray, reach: float, sigma: float, bounds: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Nodes, widths and ranges (n, n_nodes) of one parameter around its centres (n, n_fits)."""
    centres = np.clip(middle, *bounds)
    begin = np.maximum(centres.min(axis=1) - reach, bounds[0])[:, None]
    length = np.minimum(centres.max(axis=1) + reach, bounds[1])[:, None] - begin
    wanted = int(np.ceil(NODES_PER_SIGMA * length.max() / sigma))
    x, w = np.polynomial.legendre.leggauss(int(np.clip(wanted, MIN_NODES, MAX_NODES)))
    edges = begin + 0.5 * length * np.concatenate([[0.0], np.cumsum(w)])
    weight = 0.5 * w * length
    return begin + 0.5 * length * (1.0 + x), weight, edges[:, :-1], edges[:, 1:]


@dataclass(frozen=True, eq=False)
class StarAlone:
    """The posterior of the nuisance parameters without a companion.

    Parameters
    ----------
    log_z : float
        Logarithm of the evidence.
    mean : (n_nuisance,) float array
    covariance : (n_nuisance, n_nuisance) float array
    """

    log_z: float
    mean: FloatArray
    covariance: FloatArray


def star_alone(likelihood: Likelihood, prior: Prior, single: FloatArray | None = None) -> StarAlone:
    """Integrate the nuisance parameters without a companion.

    Parameters
    ----------
    likelihood : Likelihood
        With any number of companions in its model.
    prior : Prior
    single : (n_nuisance,) float array, optional
        The best fit without a companion, if it is known.
    """
    alone = single_likelihood(likelihood)
    best = fit_single(likelihood)[0] if single is None else single
    if not len(best):
        return StarAlone(float(alone.log_prob(best[None])[0]), best, np.empty((0, 0)))
    centre, errors, found = best, alone.errors(best), np.inf
    # Where a star alone does not fit, more noise than in the errors makes the posterior wider than
    # they are, many times: nodes are laid again by its own mean and covariance.
    for _ in range(MAX_LAYOUTS):
        nodes = nuisance_nodes(prior, centre[None], errors, 2.0 * NUISANCE_REACH)
        log = alone.log_prob(nodes.value) + nodes.log_weight
        before, found = found, float(logsumexp(log))
        weight = np.exp(log - found)
        centre = weight @ nodes.value
        away = nodes.value - centre
        errors = (weight[:, None] * away).T @ away
        # One node may have all the weight: closure phases that turn where a fringe vanishes make
        # the posterior narrower than its errors, by many times. It stands for its range.
        within = weight @ (nodes.high - nodes.low) ** 2 / 12.0
        if (np.diag(errors) < within).any():
            errors = errors + np.diag(within)
        if abs(found - before) < SAME_LOG_Z:
            break
    return StarAlone(found, centre, errors)


def log_evidence_none(
    likelihood: Likelihood, prior: Prior, single: FloatArray | None = None
) -> float:
    """Logarithm of the evidence without a companion, as `star_alone` has it."""
    return star_alone(likelihood, prior, single).log_z

"""What every sampler takes and gives: a likelihood, a prior, and weighted draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.quadrature import log_sum
from amibayes.models.parameters import Parameters
from amibayes.posterior.priors import Prior
from amibayes.support.options import SAMPLERS, entry
from amibayes.units import FloatArray, read_only

LogProb = Callable[[FloatArray], FloatArray]
"""Log-likelihood (n,) of parameter sets (n, n_dim), contrast as a flux ratio."""


@dataclass(frozen=True)
class ModelPrior:
    """The prior of all parameters of a model, as a sampler sees it.

    Parameters
    ----------
    prior : Prior
    parameters : Parameters
        Of the model.
    """

    prior: Prior
    parameters: Parameters

    @property
    def n_dim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    def from_cube(self, cube: FloatArray) -> FloatArray:
        """Turn uniform numbers (n, n_dim) into parameter sets.

        Both orders of two companions are one solution: the brighter one comes first, at the
        same evidence.
        """
        theta = self.prior.from_cube(cube)
        if self.parameters.companions == 2:
            first, second = (self.parameters.columns("flux", component=k)[0] for k in (1, 2))
            swap = theta[:, second] > theta[:, first]
            theta[swap] = theta[swap][:, self.parameters.swapped]
        return theta

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Parameter sets (n, n_dim) of the prior."""
        return self.from_cube(rng.random((n, self.n_dim)))


@dataclass(frozen=True, eq=False)
class Draws:
    """Weighted draws from a posterior.

    Parameters
    ----------
    samples : (n, n_dim) float array
        Contrast as a flux ratio.
    log_prob : (n,) float array
        Log-likelihood of each.
    weights : (n,) float array
        They sum to 1.
    diagnostics : mapping of str to float
        ``log_z`` and ``log_z_error`` where the sampler measures the evidence.
    """

    samples: FloatArray
    log_prob: FloatArray
    weights: FloatArray
    diagnostics: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        read_only(self, "samples", "log_prob", "weights")

    @property
    def n_effective(self) -> float:
        """Number of equally weighted draws that have the same variance (Kish 1965)."""
        return float(self.weights.sum() ** 2 / (self.weights**2).sum())

    def resampled(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw samples (n, n_dim) of equal weight."""
        share = self.weights / self.weights.sum()
        return self.samples[rng.choice(len(share), n, p=share)]


def log_mean(log_weight: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Give ln of the mean of weights of draws, the evidence, and its error.

    Parameters
    ----------
    log_weight : (k,) or (k, m) float array
        Of draws inside the prior, for one data set or m.
    n : int
        All draws; those outside the prior count as 0.

    Returns
    -------
    log_z, error : float array
        () or (m,).
    """
    log_z = log_sum(log_weight) - np.log(n)
    square = (np.exp(log_weight - log_z) ** 2).sum(axis=0) / n
    return log_z, np.sqrt(np.maximum(square - 1.0, 0.0) / n)


def tempered(
    log_weight: FloatArray, least: float, least_power: float = 0.0
) -> tuple[FloatArray, float]:
    """Raise weights to the largest power up to 1 at which enough draws count for a fit.

    Proposals that are too narrow give a few draws nearly all of the weight; fitted to these they
    would become narrower still.

    Parameters
    ----------
    log_weight : (n,) float array
    least : float
        Effective number of draws that is enough.
    least_power : float
        Where to stop in any case.

    Returns
    -------
    weight : (n,) float array
        They sum to 1.
    power : float
    """
    power = 1.0
    while True:
        weight = np.exp(power * (log_weight - log_weight.max()))
        weight /= weight.sum()
        if 1.0 / (weight**2).sum() >= least or 0.7 * power <= least_power:
            return weight, power
        power *= 0.7


class Sampler(Protocol):
    """Draws from likelihood times prior."""

    def sample(self, log_prob: LogProb, prior: ModelPrior, rng: np.random.Generator) -> Draws:
        """Sample, with all randomness from ``rng``."""
        ...


def draw_posterior(
    likelihood: Likelihood, prior: Prior, rng: np.random.Generator, sampler: str | Sampler
) -> Draws:
    """Sample the posterior of a model with a sampler, or one of `SAMPLERS` by its name.

    Parameters
    ----------
    likelihood : Likelihood
    prior : Prior
    rng : numpy.random.Generator
    sampler : str or Sampler
    """
    chosen: Sampler = entry(SAMPLERS[sampler])() if isinstance(sampler, str) else sampler
    return chosen.sample(likelihood.log_prob, ModelPrior(prior, likelihood.parameters), rng)

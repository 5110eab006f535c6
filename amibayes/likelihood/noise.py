"""What the data scatter by: the protocol of noise models, and the two that have one covariance.

A fit, a template bank and the inverse of the Fisher matrix need one covariance; every noise
model has one (`covariance`, with `whiten` and `solve`), and χ² means its quadratic form. What
a residual is worth, `log_prob`, is the model's own: a Gaussian, the t distribution of an
estimated covariance, Student residuals, or an average over unknown amounts of noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from scipy.sparse import csr_array

from amibayes.data.covariance import Covariance
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables
from amibayes.likelihood.channel_rows import ChannelRows
from amibayes.likelihood.chi2 import deviance, log_peak
from amibayes.units import BoolArray, FloatArray

MAX_EXPONENT = 50.0
"""Gains in ln L are cut where their Δχ² would overflow; nothing is decided so far out."""


class NoiseModel(Protocol):
    """What the rest of the package asks of the noise."""

    @property
    def covariance(self) -> Covariance:
        """The one covariance that stands for the noise in fits."""
        ...

    @property
    def freedom(self) -> Freedom | None:
        """Degrees of freedom of an estimated covariance; None where it counts as known."""
        ...

    @property
    def scatter(self) -> csr_array | None:
        """The covariance as measured scatter alone has it, where it was estimated."""
        ...

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        ...

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the distribution of the data; infinite for a Gaussian."""
        ...

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the unknown amounts that `log_prob` averages over."""
        ...

    @property
    def floor(self) -> bool:
        """Whether the errors hold a floor: they are not smaller, whatever residuals are."""
        ...

    @property
    def rows(self) -> ChannelRows | None:
        """How whitened data are turned; None where channels of an exposure share nothing."""
        ...

    @property
    def log_norm(self) -> float:
        """Logarithm of the likelihood of data without residuals, with the one covariance."""
        ...

    def whiten(self, residual: FloatArray) -> FloatArray:
        """Independent, unit-variance combinations (n_independent, …) of residuals (n_data, …)."""
        ...

    def solve(self, residual: FloatArray) -> FloatArray:
        """Inverse of the covariance times residuals (n_data, …)."""
        ...

    def log_prob(self, residual: FloatArray) -> FloatArray:
        """Log-likelihood (n,) of residuals (n_data, n)."""
        ...

    def log_prob_of_sums(self, a: FloatArray, b: FloatArray, pairs: BoolArray) -> FloatArray:
        """Log-likelihoods (n, m) of sums of residuals (n_data, n) and (n_data, m).

        Those of ``pairs`` (n, m); of others it is −∞.
        """
        ...

    def deviance(self, chi2: FloatArray) -> FloatArray:
        """−2 ln L of χ² (any shape) with the one covariance, 0 without residuals."""
        ...

    def inflation(self, chi2: FloatArray) -> FloatArray:
        """dχ²/d(deviance): variance of what is left, in units of the covariance's."""
        ...

    def delta_chi2(self, log_gain: FloatArray) -> FloatArray:
        """Δχ² that goes with a gain in ln L over no companion, (n,)."""
        ...

    def log_loss(self, delta_chi2: FloatArray) -> FloatArray:
        """What a Δχ² from the best fit costs in ln L, (n,)."""
        ...

    def fisher(self, slopes: FloatArray, difference: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fisher matrices (n, d, d) at n amounts of noise, and logarithms of their weights (n,).

        Of slopes of the data (n_data, d) and data minus model (n_data, 1).
        """
        ...

    def without_companion(self) -> NoiseModel:
        """The noise that a test of no companion may use: nothing in it rests on one."""
        ...

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Noise (n_data, n)."""
        ...

    def posterior(self, residual: FloatArray) -> Mapping[str, Any]:
        """Posterior of every unknown amount, given residuals (n_data, n) of equal weight."""
        ...


@dataclass(frozen=True, eq=False)
class GaussianNoise:
    """Gaussian noise of known covariance.

    Parameters
    ----------
    covariance : Covariance
    freedom, scatter
        None: they belong to an `EstimatedNoise`.
    rows : ChannelRows, optional
        How whitened data are turned where channels of an exposure share some noise.
    floor : bool
        The errors hold a floor that residuals of few data need not show: they are not smaller.
    """

    covariance: Covariance
    freedom: Freedom | None = None
    scatter: csr_array | None = None
    rows: ChannelRows | None = None
    floor: bool = False

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return self.covariance.rank

    @property
    def degrees(self) -> float:
        """Infinite: a Gaussian."""
        return np.inf

    @property
    def parameters(self) -> tuple[str, ...]:
        """None: the covariance is one."""
        return ()

    @cached_property
    def log_norm(self) -> float:
        """Logarithm of the likelihood of data without residuals."""
        return log_peak(self.n_independent, self.degrees) - 0.5 * self.covariance.logdet()

    def whiten(self, residual: FloatArray) -> FloatArray:
        """Independent, unit-variance combinations (n_independent, …) of residuals (n_data, …)."""
        return self.covariance.whiten(residual)

    def solve(self, residual: FloatArray) -> FloatArray:
        """Inverse of the covariance times residuals (n_data, …)."""
        return self.covariance.solve(residual)

    def log_prob(self, residual: FloatArray) -> FloatArray:
        """Log-likelihood (n,) of residuals (n_data, n)."""
        white = self.whiten(residual)
        return self.log_norm - 0.5 * self.deviance(np.einsum("dn,dn->n", white, white))

    def log_prob_of_sums(self, a: FloatArray, b: FloatArray, pairs: BoolArray) -> FloatArray:
        """Log-likelihoods (n, m) of sums of residuals (n_data, n) and (n_data, m)."""
        return one_by_one(self, a, b, pairs)

    def deviance(self, chi2: FloatArray) -> FloatArray:
        """χ² itself."""
        return chi2

    def inflation(self, chi2: FloatArray) -> FloatArray:
        """One: the covariance is known."""
        return np.ones_like(chi2)

    def delta_chi2(self, log_gain: FloatArray) -> FloatArray:
        """Twice the gain in ln L."""
        return np.asarray(2.0 * log_gain)

    def log_loss(self, delta_chi2: FloatArray) -> FloatArray:
        """Half of Δχ²."""
        return np.asarray(0.5 * delta_chi2)

    def fisher(self, slopes: FloatArray, difference: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fisher matrix (1, d, d) of the one covariance."""
        white = self.whiten(slopes)
        return (white.T @ white)[None], np.zeros(1)

    def without_companion(self) -> GaussianNoise:
        """The same."""
        return self

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Noise (n_data, n)."""
        return self.covariance.draw(rng, n)

    def posterior(self, residual: FloatArray) -> Mapping[str, Any]:
        """Nothing is unknown."""
        return {}


@dataclass(frozen=True, eq=False)
class EstimatedNoise(GaussianNoise):
    """Noise whose covariance was estimated: the data follow a t distribution.

    L ∝ [1 + χ²/(ν − 2)]^{−(ν + n)/2} of n independent data (Sellentin & Heavens 2016).

    Parameters
    ----------
    covariance : Covariance
    freedom : Freedom
        ν, and the degrees of freedom of the measured scatter.
    scatter : sparse array, optional
        The covariance as the measured scatter alone has it.
    """

    @property
    def degrees(self) -> float:
        """ν of the t distribution."""
        return np.inf if self.freedom is None else self.freedom.degrees

    def deviance(self, chi2: FloatArray) -> FloatArray:
        """(ν + n) ln[1 + χ²/(ν − 2)]."""
        return deviance(chi2, self.n_independent, self.degrees)

    def inflation(self, chi2: FloatArray) -> FloatArray:
        """(ν − 2 + χ²)/(ν + n)."""
        return np.asarray((self.degrees - 2.0 + chi2) / (self.degrees + self.n_independent))

    def delta_chi2(self, log_gain: FloatArray) -> FloatArray:
        """In units of the variance that is left with the companion."""
        count = self.degrees + self.n_independent
        return np.asarray(count * np.expm1(np.minimum(2.0 * log_gain / count, MAX_EXPONENT)))

    def log_loss(self, delta_chi2: FloatArray) -> FloatArray:
        """The inverse of `delta_chi2`."""
        count = self.degrees + self.n_independent
        return np.asarray(0.5 * count * np.log1p(delta_chi2 / count))

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Noise (n_data, n): normal vectors, each divided by the root of its own χ²_ν/(ν − 2)."""
        stretch = np.sqrt((self.degrees - 2.0) / rng.chisquare(self.degrees, n))
        return np.asarray(self.covariance.draw(rng, n) * stretch)


@dataclass(frozen=True, eq=False)
class FittedNoise:
    """Noise that has its one covariance from another model, and differs where it says so.

    Parameters
    ----------
    fit : NoiseModel
        The noise of a fit.
    """

    fit: NoiseModel

    @property
    def covariance(self) -> Covariance:
        """That of the fit."""
        return self.fit.covariance

    @property
    def freedom(self) -> Freedom | None:
        """That of the fit."""
        return self.fit.freedom

    @property
    def scatter(self) -> csr_array | None:
        """That of the fit."""
        return self.fit.scatter

    @property
    def floor(self) -> bool:
        """That of the fit."""
        return self.fit.floor

    @property
    def rows(self) -> ChannelRows | None:
        """Those of the fit."""
        return self.fit.rows

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return self.fit.n_independent

    @property
    def degrees(self) -> float:
        """Those of the fit."""
        return self.fit.degrees

    @property
    def parameters(self) -> tuple[str, ...]:
        """Those of the fit."""
        return self.fit.parameters

    @property
    def log_norm(self) -> float:
        """That of the fit."""
        return self.fit.log_norm

    def whiten(self, residual: FloatArray) -> FloatArray:
        """Independent, unit-variance combinations (n_independent, …) of residuals (n_data, …)."""
        return self.fit.whiten(residual)

    def solve(self, residual: FloatArray) -> FloatArray:
        """Inverse of the covariance times residuals (n_data, …)."""
        return self.fit.solve(residual)

    def log_prob(self, residual: FloatArray) -> FloatArray:
        """Log-likelihood (n,) of residuals (n_data, n)."""
        return self.fit.log_prob(residual)

    def log_prob_of_sums(self, a: FloatArray, b: FloatArray, pairs: BoolArray) -> FloatArray:
        """Log-likelihoods (n, m) of sums of residuals (n_data, n) and (n_data, m)."""
        return one_by_one(self, a, b, pairs)

    def deviance(self, chi2: FloatArray) -> FloatArray:
        """−2 ln L of χ² (any shape) with the one covariance."""
        return self.fit.deviance(chi2)

    def inflation(self, chi2: FloatArray) -> FloatArray:
        """dχ²/d(deviance)."""
        return self.fit.inflation(chi2)

    def delta_chi2(self, log_gain: FloatArray) -> FloatArray:
        """Δχ² that goes with a gain in ln L over no companion, (n,)."""
        return self.fit.delta_chi2(log_gain)

    def log_loss(self, delta_chi2: FloatArray) -> FloatArray:
        """What a Δχ² from the best fit costs in ln L, (n,)."""
        return self.fit.log_loss(delta_chi2)

    def fisher(self, slopes: FloatArray, difference: FloatArray) -> tuple[FloatArray, FloatArray]:
        """That of the fit."""
        return self.fit.fisher(slopes, difference)

    def without_companion(self) -> NoiseModel:
        """That of the fit."""
        return self.fit.without_companion()

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Noise (n_data, n)."""
        return self.fit.draw(n, rng)

    def posterior(self, residual: FloatArray) -> Mapping[str, Any]:
        """Posterior of every unknown amount."""
        return self.fit.posterior(residual)


def one_by_one(noise: NoiseModel, a: FloatArray, b: FloatArray, pairs: BoolArray) -> FloatArray:
    """`NoiseModel.log_prob_of_sums` by `NoiseModel.log_prob`, one of the second at a time."""
    out = np.full(pairs.shape, -np.inf)
    for k in np.flatnonzero(pairs.any(axis=0)):
        which = pairs[:, k]
        out[which, k] = noise.log_prob(a[:, which] + b[:, k, None])
    return out


def noise_of(observables: Observables) -> NoiseModel:
    """The noise that unflagged observables state: of known covariance, or of an estimated one."""
    data = observables
    if data.freedom is None:
        return GaussianNoise(data.covariance)
    return EstimatedNoise(data.covariance, data.freedom, data.scatter)

"""One χ² for everything: residuals, likelihood and gradient of a model on a data set."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln

from amibayes.data.observables import Observables
from amibayes.models.bands import band_numbers
from amibayes.models.components import BinaryModel
from amibayes.models.uv_points import UVPoints, uv_points_of
from amibayes.units import ComplexArray, FloatArray

LOG_TWO_PI = float(np.log(2.0 * np.pi))


NEVER_ZERO = 1e-30
"""Keeps the phase derivative finite at an exact null of the visibility."""


def log_peak(n: int, degrees: float) -> float:
    """Logarithm of the density of n data of unit covariance where they have no residuals."""
    gaussian = -0.5 * n * LOG_TWO_PI
    if not np.isfinite(degrees):
        return gaussian
    half = 0.5 * degrees
    ratio = gammaln(half + 0.5 * n) - gammaln(half) - 0.5 * n * np.log(half - 1.0)
    return float(gaussian + ratio)


def deviance(chi2: FloatArray, n: int, degrees: float) -> FloatArray:
    """−2 ln L of χ² (any shape) of n data, 0 without residuals.

    χ² where the data are Gaussian, (ν + n) ln[1 + χ²/(ν − 2)] where they follow a t
    distribution of ν ``degrees`` of freedom.
    """
    if not np.isfinite(degrees):
        return chi2
    return np.asarray((degrees + n) * np.log1p(chi2 / (degrees - 2.0)))


def _samples(observables: Observables, model: BinaryModel) -> UVPoints:
    """Points of the data, kept apart by what the model tells apart."""
    bands = band_numbers(observables, model.bands) if model.bands else None
    return uv_points_of(observables, bands, dated=model.moves)


class Likelihood:
    """Likelihood of a binary model, vectorised over parameter sets.

    Gaussian; where the covariance was estimated, the t distribution of its degrees of
    freedom ν, L ∝ [1 + χ²/(ν − 2)]^{−(ν + n)/2} of n independent data.

    Parameters
    ----------
    observables : Observables
    model : BinaryModel

    Notes
    -----
    Parameters are those of `BinaryModel.parameters`: east and north offset in mas,
    contrast as a flux ratio, uniform-disc diameter in mas, background flux.
    """

    def __init__(self, observables: Observables, model: BinaryModel | None = None) -> None:
        self.observables = observables.unflagged()
        self.model = model or BinaryModel()
        self.samples: UVPoints = _samples(self.observables, self.model)
        self._n2 = len(self.observables.vis2)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.model.parameters

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return self.observables.n_independent

    def with_model(self, model: BinaryModel) -> Likelihood:
        """Make the likelihood of another model on the same data."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__, model=model)
        if (model.bands, model.moves) != (self.model.bands, self.model.moves):
            other.samples = _samples(self.observables, model)
        return other

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the distribution of the data; infinite for a Gaussian."""
        return self.observables.degrees_of_freedom

    @cached_property
    def log_norm(self) -> float:
        """Logarithm of the likelihood of data without residuals."""
        peak = log_peak(self.n_independent, self.degrees)
        return peak - 0.5 * self.observables.covariance.logdet()

    def deviance(self, chi2: ArrayLike) -> FloatArray:
        """−2 ln L of χ² (any shape), 0 without residuals: χ² itself where L is Gaussian."""
        return deviance(np.asarray(chi2, dtype=float), self.n_independent, self.degrees)

    def inflation(self, chi2: FloatArray) -> FloatArray:
        """dχ²/d(deviance): variance of what is left, in units of the covariance's (any shape)."""
        nu = self.degrees
        if not np.isfinite(nu):
            return np.ones_like(chi2)
        return np.asarray((nu - 2.0 + chi2) / (nu + self.n_independent))

    def predict(self, theta: ArrayLike) -> FloatArray:
        """Model of the data: V², then closure phases in radians, (n_data, n)."""
        visibility = self.model.visibility(self.samples, self._sets(theta))
        return self._observe(visibility)

    def residuals(self, theta: ArrayLike) -> FloatArray:
        """Whitened residuals data − model, (n_independent, n)."""
        return self.observables.covariance.whiten(self._difference(self.predict(theta)))

    def chi2(self, theta: ArrayLike) -> FloatArray:
        """χ² of parameter sets (n, n_dim), (n,)."""
        return np.asarray((self.residuals(theta) ** 2).sum(axis=0))

    def log_prob(self, theta: ArrayLike) -> FloatArray:
        """Log-likelihood of parameter sets (n, n_dim), (n,)."""
        return self.log_norm - 0.5 * self.deviance(self.chi2(theta))

    def delta_chi2(self, log_gain: FloatArray) -> FloatArray:
        """Δχ² that goes with a gain in ln L over no companion, (n,).

        In units of the variance that is left with the companion, if data follow a t.
        """
        count = self.degrees + self.n_independent
        if not np.isfinite(count):
            return np.asarray(2.0 * log_gain)
        return np.asarray(count * np.expm1(np.minimum(2.0 * log_gain / count, 50.0)))

    def log_loss(self, delta_chi2: FloatArray) -> FloatArray:
        """What a Δχ² from the best fit costs in ln L, (n,)."""
        count = self.degrees + self.n_independent
        if not np.isfinite(count):
            return np.asarray(0.5 * delta_chi2)
        return np.asarray(0.5 * count * np.log1p(delta_chi2 / count))

    def log_prob_and_gradient(self, theta: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood (n,) and its gradient (n, n_dim)."""
        value, slopes = self.model.gradient(self.samples, self._sets(theta))
        difference = self._difference(self._observe(value))
        weighted = self.observables.covariance.solve(difference)
        chi2 = (difference * weighted).sum(axis=0)
        # Reverse mode: fold the data's weights back onto the samples once, so that the
        # gradient costs one product per parameter and no Jacobian of the data.
        pull = 2.0 * (self.samples.from_squares @ weighted[: self._n2]) * value.conj()
        pull -= 1j * (self.samples.from_legs @ weighted[self._n2 :]) / (value + NEVER_ZERO)
        gradient = np.einsum("sn,psn->np", pull, slopes).real / self.inflation(chi2)[:, None]
        return self.log_norm - 0.5 * self.deviance(chi2), np.asarray(gradient)

    def jacobian(self, theta: ArrayLike) -> FloatArray:
        """Whitened derivatives of the model at one parameter set, (n_independent, n_dim)."""
        value, slopes = self.model.gradient(self.samples, self._sets(theta))
        by_phase = (slopes[:, :, 0] / (value[:, 0] + NEVER_ZERO)).imag.T
        by_vis2 = 2.0 * (slopes[:, :, 0] * value[:, 0].conj()).real.T
        rows = np.concatenate([self.samples.squares @ by_vis2, self.samples.legs @ by_phase])
        return self.observables.covariance.whiten(rows)

    def errors(self, theta: ArrayLike) -> FloatArray:
        """Covariance (n_dim, n_dim) of the parameters from the inverse of the Fisher matrix.

        With an estimated covariance that of the t distribution which parameters of a linear
        model have: (ν − 2 + χ²)/(ν + n − n_dim − 2) times as large.
        """
        jacobian = self.jacobian(theta)
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0.0] = 1.0
        fisher = (jacobian / scale).T @ (jacobian / scale)
        inverse = np.linalg.pinv(fisher, hermitian=True) / np.outer(scale, scale)
        if not np.isfinite(self.degrees):
            return np.asarray(inverse)
        rest = self.degrees - 2.0 + self.n_independent - len(scale)
        return np.asarray(inverse * (self.degrees - 2.0 + self.chi2(theta)[0]) / rest)

    def _sets(self, theta: ArrayLike) -> FloatArray:
        sets = np.atleast_2d(np.asarray(theta, dtype=float))
        if sets.shape[1] != len(self.parameters):
            raise ValueError(f"theta needs {len(self.parameters)} columns: {self.parameters}")
        return sets

    def _observe(self, visibility: ComplexArray) -> FloatArray:
        power = self.samples.squares @ (visibility.real**2 + visibility.imag**2)
        if not self.samples.legs.shape[0]:
            return np.asarray(power)
        return np.concatenate([power, self.samples.legs @ np.angle(visibility)])

    def _difference(self, model: FloatArray) -> FloatArray:
        difference = self.observables.data[:, None] - model
        closure = difference[self._n2 :]
        closure -= 2.0 * np.pi * np.rint(closure / (2.0 * np.pi))
        return difference


def single_likelihood(likelihood: Likelihood) -> Likelihood:
    """Make the likelihood without a companion, other parameters as they are."""
    return likelihood.with_model(replace(likelihood.model, companions=0))

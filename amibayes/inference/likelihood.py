"""One χ² for everything: residuals, likelihood and gradient of a model on a data set."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from amibayes.inference.model import BinaryModel, ComplexArray
from amibayes.inference.samples import Samples, samples_of
from amibayes.observables import Observables
from amibayes.units import FloatArray

LOG_TWO_PI = float(np.log(2.0 * np.pi))

NEVER_ZERO = 1e-30
"""Keeps the phase derivative finite at an exact null of the visibility."""


class Likelihood:
    """Gaussian likelihood of a binary model, vectorised over parameter sets.

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
        self.samples: Samples = samples_of(self.observables)
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
        return other

    @cached_property
    def log_norm(self) -> float:
        """Logarithm of the normalisation of the Gaussian."""
        return -0.5 * (self.observables.covariance.logdet() + self.n_independent * LOG_TWO_PI)

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
        return self.log_norm - 0.5 * self.chi2(theta)

    def delta_chi2(self, log_gain: FloatArray) -> FloatArray:
        """Δχ² that goes with a gain in ln L over no companion, (n,)."""
        return np.asarray(2.0 * log_gain)

    def log_loss(self, delta_chi2: FloatArray) -> FloatArray:
        """What a Δχ² from the best fit costs in ln L, (n,)."""
        return np.asarray(0.5 * delta_chi2)

    def log_prob_and_gradient(self, theta: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood (n,) and its gradient (n, n_dim)."""
        value, slopes = self.model.gradient(self.samples, self._sets(theta))
        difference = self._difference(self._observe(value))
        weighted = self.observables.covariance.solve(difference)
        chi2 = (difference * weighted).sum(axis=0)
        # Reverse mode: fold the data's weights back onto the samples once, so that the
        # gradient costs one product per parameter and no Jacobian of the data.
        pull = 2.0 * (self.samples.squares.T @ weighted[: self._n2]) * value.conj()
        pull -= 1j * (self.samples.legs.T @ weighted[self._n2 :]) / (value + NEVER_ZERO)
        gradient = np.einsum("sn,psn->np", pull, slopes).real
        return self.log_norm - 0.5 * chi2, np.asarray(gradient)

    def jacobian(self, theta: ArrayLike) -> FloatArray:
        """Whitened derivatives of the model at one parameter set, (n_independent, n_dim)."""
        value, slopes = self.model.gradient(self.samples, self._sets(theta))
        by_phase = (slopes[:, :, 0] / (value[:, 0] + NEVER_ZERO)).imag.T
        by_vis2 = 2.0 * (slopes[:, :, 0] * value[:, 0].conj()).real.T
        rows = np.concatenate([self.samples.squares @ by_vis2, self.samples.legs @ by_phase])
        return self.observables.covariance.whiten(rows)

    def errors(self, theta: ArrayLike) -> FloatArray:
        """Covariance (n_dim, n_dim) of the parameters from the inverse of the Fisher matrix."""
        jacobian = self.jacobian(theta)
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0.0] = 1.0
        fisher = (jacobian / scale).T @ (jacobian / scale)
        return np.asarray(np.linalg.pinv(fisher, hermitian=True) / np.outer(scale, scale))

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

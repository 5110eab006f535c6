"""χ² of visibilities against V² and phases with their covariance, and its gradient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from amibayes.data.kernel_model import stands_alone
from amibayes.data.observables import Observables
from amibayes.likelihood.noise import NoiseModel, noise_of
from amibayes.models.uv_points import UVPoints
from amibayes.units import BoolArray, ComplexArray, FloatArray

NEVER_ZERO = 1e-30
"""Keeps the phase's derivative finite at an exact null."""


@dataclass(frozen=True, eq=False)
class DataTerm:
    """A part of the data, as sums over the points of the whole.

    Parameters
    ----------
    value : (n_data,) float array
        V², then phases in radians.
    squares, legs : sparse array
        As those of `UVPoints`.
    periodic : (n_phases,) bool array
        Closure phases; kernel phases have no period.
    noise : NoiseModel
    """

    value: FloatArray
    squares: csr_array
    legs: csr_array
    periodic: BoolArray
    noise: NoiseModel

    @classmethod
    def of(
        cls,
        observables: Observables,
        samples: UVPoints,
        chosen: tuple[BoolArray, BoolArray] | None = None,
    ) -> DataTerm:
        """The term of unflagged data, or of those V² and phases that are chosen."""
        vis2, phase = chosen or (
            np.ones(len(observables.vis2), dtype=bool),
            np.ones(len(observables.closure_phase), dtype=bool),
        )
        part = observables.select(vis2, phase)
        return cls(
            part.data,
            csr_array(samples.squares[np.flatnonzero(vis2)]),
            csr_array(samples.legs[np.flatnonzero(phase)]),
            ~stands_alone(part.closure_phase.stations),
            noise_of(part),
        )

    @property
    def n_vis2(self) -> int:
        """Number of V²."""
        return int(self.squares.shape[0])

    def residual(self, visibility: ComplexArray) -> FloatArray:
        """Data − model (n_data,), closure phases the short way round."""
        model = self.squares @ np.abs(visibility) ** 2
        left = self.value[: self.n_vis2] - model
        phase = self.value[self.n_vis2 :] - self.legs @ np.angle(visibility)
        turns = np.where(self.periodic, np.rint(phase / (2.0 * np.pi)), 0.0)
        return np.concatenate([left, phase - 2.0 * np.pi * turns])

    def chi2(self, visibility: ComplexArray) -> float:
        """χ² of visibilities."""
        white = self.noise.whiten(self.residual(visibility)[:, None])
        return float((white**2).sum())

    def deviance(self, visibility: ComplexArray) -> float:
        """−2 ln L, 0 without residuals: χ² itself where the covariance is known."""
        return float(self.noise.deviance(np.array([self.chi2(visibility)]))[0])

    def with_pull(self, visibility: ComplexArray) -> tuple[float, ComplexArray]:
        """The deviance, and w (n_points,) such that its change is Re Σ w dV."""
        left = self.residual(visibility)[:, None]
        chi2 = float((self.noise.whiten(left) ** 2).sum())
        weighted = self.noise.solve(left)[:, 0]
        n = self.n_vis2
        pull = -4.0 * (self.squares.T @ weighted[:n]) * visibility.conj()
        if self.legs.shape[0]:
            pull = pull + 2j * (self.legs.T @ weighted[n:]) / (visibility + NEVER_ZERO)
        both = np.array([chi2])
        inflation = float(np.ravel(self.noise.inflation(both))[0])
        return float(self.noise.deviance(both)[0]), np.asarray(pull / inflation)

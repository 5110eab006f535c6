"""What data with an estimated covariance could have been, were there no companion.

Noise of N integrations looks the same after any rotation among the integrations (Langsrud
2005): given T = S + d dᵀ, the scatter and the mean together, every split of T into a mean d
and a scatter S is as likely as what its rotation says, whatever the true covariance is, and
however wrong the expected noise that S was shrunk towards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.likelihood.noise import NoiseModel
from amibayes.units import FloatArray, read_only

NEGLIGIBLE = 1e-9
"""Share of the largest variance of the scatter below which a direction was not measured."""

LEAST_SCATTER = 4.0
"""Degrees of freedom of scatter from which rotations tell noise from a companion: with two (a pair
of integrations, and of a calibrator) one in 160 is the residuals nearly as they are, however large
these are; with four one in 10 000."""


@dataclass(frozen=True, eq=False)
class RotationNull:
    """A scatter S = FFᵀ and the residuals beside it, in data whitened by the estimate.

    Parameters
    ----------
    degrees : float
        ν of the t distribution of the data: the estimate is (prior + S)/(ν − 2).
    rows : float
        Integrations: degrees of freedom of scatter and mean together.
    factor : (n_data, k) float array
        F.
    residual : (n_data,) float array
        Of the fit without a companion, nuisance directions taken out: it was noise too.
    """

    degrees: float
    rows: float
    factor: FloatArray
    residual: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "factor", "residual")

    @cached_property
    def _axes(self) -> FloatArray:
        """Orthonormal directions (n_data, k) of the columns of the factor, which are orthogonal."""
        return np.asarray(self.factor / np.linalg.norm(self.factor, axis=0))

    def draw(self, noise: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Means d of other rotations, (n_data, n); their scatter is S + residual² − ddᵀ.

        Parameters
        ----------
        noise : (n_data, n) float array
            Independent unit normals.
        rng : numpy.random.Generator
            For the directions that are no datum.
        """
        k, along = self.factor.shape[1], rng.standard_normal(noise.shape[1])
        # Turned along the factor, which eigenvectors of whatever sign and order make up: the
        # products are then the same on every machine.
        normal = self._axes.T @ noise
        left = self.rows - k - 1.0
        rest = rng.chisquare(left, noise.shape[1]) if left > 0.0 else 0.0
        length = np.sqrt((normal**2).sum(axis=0) + along**2 + rest)
        return np.asarray((self.factor @ normal + np.outer(self.residual, along)) / length)


def rotation_null(noise: NoiseModel, residual: FloatArray) -> RotationNull | None:
    """Lay out what an estimated covariance rests on.

    None where the covariance is known, or rests on so little scatter that it is as good as that
    of the expected noise: on less than `LEAST_SCATTER`.

    Parameters
    ----------
    noise : NoiseModel
        Where its covariance by scatter alone is not known, the prior counts as
        scatter: there are then as many integrations as the t distribution is worth.
    residual : (n_data,) float array
        Whitened, of the fit without a companion.
    """
    if noise.freedom is None:
        return None
    degrees, p = noise.freedom.degrees, len(residual)
    if noise.scatter is None:
        return RotationNull(degrees, degrees + p, np.sqrt(degrees - 2.0) * np.eye(p), residual)
    whitening = noise.covariance.whitening
    variance, axes = np.linalg.eigh((whitening @ noise.scatter @ whitening.T).toarray())
    measured = variance > NEGLIGIBLE * variance[-1]
    # A target and its calibrators, few integrations of each, scatter in more directions than they
    # have degrees of freedom together: what is drawn must have the variance of the estimate still.
    freedom = max(noise.freedom.scatter, float(measured.sum()))
    if freedom < min(LEAST_SCATTER, p):
        return None
    factor = axes[:, measured] * np.sqrt(freedom * variance[measured])
    # Counted with more degrees of freedom than it has, the scatter varies less: it gets a larger
    # share of the estimate (whose prior grows by less), which then varies as that of the data.
    # No drawn mean may take more from the estimate than is in it.
    estimate = (degrees - 2.0) * np.sqrt(freedom / noise.freedom.scatter)
    grown = 2.0 + max(float(estimate), freedom * float(variance[-1]))
    return RotationNull(grown, freedom + 1.0, factor, residual)

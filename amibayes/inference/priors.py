"""Priors, stated in full: uniform in area, log-uniform in contrast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.inference.likelihood import Likelihood
from amibayes.inference.refine import nuisance_bounds
from amibayes.units import FloatArray


@dataclass(frozen=True)
class Prior:
    """Prior of one companion and the nuisance parameters.

    Parameters
    ----------
    inner_mas, outer_mas : float
        The position is uniform in area between these separations.
    contrast_min, contrast_max : float
        The contrast is log-uniform between these flux ratios.
    nuisance : tuple of (low, high)
        Uniform ranges of the free diameter (mas) and background.
    """

    inner_mas: float
    outer_mas: float
    contrast_min: float = 1e-5
    contrast_max: float = 1.0
    nuisance: tuple[tuple[float, float], ...] = ()

    @property
    def log_volume(self) -> float:
        """Logarithm of the volume in (east, north, ln contrast, nuisance)."""
        area = np.pi * (self.outer_mas**2 - self.inner_mas**2)
        widths = [high - low for low, high in self.nuisance]
        return float(np.log(area * np.log(self.contrast_max / self.contrast_min) * np.prod(widths)))

    def log_density(self, x: FloatArray) -> FloatArray:
        """Log-density of (east_mas, north_mas, ln contrast, nuisance…), (n, n_dim) → (n,)."""
        rho = np.hypot(x[:, 0], x[:, 1])
        inside = (rho >= self.inner_mas) & (rho <= self.outer_mas)
        inside &= (x[:, 2] >= np.log(self.contrast_min)) & (x[:, 2] <= np.log(self.contrast_max))
        for k, (low, high) in enumerate(self.nuisance):
            inside &= (x[:, 3 + k] >= low) & (x[:, 3 + k] <= high)
        return np.where(inside, -self.log_volume, -np.inf)


def default_prior(likelihood: Likelihood, inner_mas: float, outer_mas: float) -> Prior:
    """The prior of the field that was searched."""
    return Prior(inner_mas, outer_mas, nuisance=tuple(nuisance_bounds(likelihood)))

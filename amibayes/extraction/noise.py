"""How noisy each pixel is: one model of the mean image, shared by all integrations.

Variances taken from the noisy pixels themselves favour those that happen to be low, and
bias fluxes and V² (Neyman's χ²). The model is a + b·mean: read noise, background and
photons, whatever the unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import nnls

from amibayes.extraction.fourier.sampling import PixelArray
from amibayes.units import BoolArray, FloatArray, read_only

_ROUNDS = 4

ROUNDING = 1e-20
"""Least variance, in units of the square of the brightest pixel: equal images have none."""

RIDGE = 1e-13
"""Added to normal matrices of rows of unit length: no image has to have every kind of slope."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Variance of a pixel of one integration.

    Parameters
    ----------
    variance : (n_y, n_x) array
        In the square of the images' unit.
    constant, per_signal : float
        Of variance = constant + per_signal · mean.
    """

    variance: FloatArray
    constant: float
    per_signal: float

    def __post_init__(self) -> None:
        read_only(self, "variance")

    @property
    def skewness(self) -> FloatArray:
        """Third cumulant (n_y, n_x): that of photons, of which each is ``per_signal`` units."""
        return self.per_signal * np.maximum(self.variance - self.constant, 0.0)


def noise_model(mean: FloatArray, measured: FloatArray, good: BoolArray) -> NoiseModel:
    """Fit the variance that was measured at each pixel.

    Parameters
    ----------
    mean : (n_y, n_x) array
        Mean image.
    measured : (n_y, n_x) array
        Mean of the squared errors, or scatter between integrations. What moves with the
        pointing is told apart by the image's slopes.
    good : (n_y, n_x) bool array
        Pixels to use.
    """
    signal = np.maximum(gaussian_filter(np.where(good, mean, 0.0), 0.5), 0.0)
    slope_y, slope_x = np.gradient(np.where(good, mean, 0.0))
    rows = np.stack([np.ones_like(signal), signal, slope_x**2, slope_y**2])[:, good]
    data = measured[good]
    least = max(ROUNDING * float(signal.max(initial=0.0)) ** 2, 1e-300)
    weight = np.full(len(data), 1.0 / max(float(np.median(data)), least))
    found = np.zeros(4)
    for _ in range(_ROUNDS):
        found = _not_negative(rows * weight, data * weight)
        model = found @ rows
        # Every relative deviation counts alike; outliers count for little.
        level = np.maximum(model, max(1e-6 * float(model.max()), least))
        weight = 1.0 / level / np.maximum(1.0, np.abs(data - model) / (4.0 * level))
    constant, per_signal = float(found[0]), float(found[1])
    variance = constant + per_signal * np.maximum(mean, 0.0)
    floor = max(1e-6 * float(variance.max()), least)
    return NoiseModel(np.maximum(variance, floor), constant, per_signal)


def _not_negative(rows: FloatArray, data: FloatArray) -> FloatArray:
    """Least squares of data (n,) by rows (k, n) with no coefficient below 0."""
    scale = np.sqrt(np.einsum("kn,kn->k", rows, rows))
    scale[scale == 0.0] = 1.0
    normal = rows @ rows.T / np.outer(scale, scale) + RIDGE * np.eye(len(rows))
    root = np.linalg.cholesky(normal)
    return np.asarray(nnls(root.T, np.linalg.solve(root, rows @ data / scale))[0] / scale)


def scatter_about_pointing(residual: PixelArray, shift_px: FloatArray) -> FloatArray:
    """Variance of every pixel between integrations, what goes with the pointing taken out.

    Parameters
    ----------
    residual : (n, n_pixels) array
    shift_px : (n, 2) array
        Pointing of each integration.

    Returns
    -------
    (n_pixels,) array
    """
    n, (x, y) = len(residual), shift_px.T
    terms = [np.ones(n), x, y, x * x, x * y, y * y]
    # Never more terms than half of what there is to fit.
    kept = 6 if n >= 12 else 3 if n >= 6 else 1
    basis = np.linalg.qr(np.stack(terms[:kept], axis=1))[0]
    basis = basis.astype(residual.dtype)
    rest = residual - basis @ (basis.T @ residual)
    return np.asarray(np.einsum("np,np->p", rest, rest).astype(float) / (n - kept))


def cropped(noise: NoiseModel, part: tuple[slice, slice]) -> NoiseModel:
    """Part of the detector."""
    return NoiseModel(noise.variance[part], noise.constant, noise.per_signal)


def misfit_level(residual: FloatArray, variance: FloatArray, good: BoolArray) -> float:
    """Mean square of what the fringe model cannot follow, beyond the noise.

    Errors of the optics are the same in every integration. As an even variance on top of
    the noise they keep a few faint or bright pixels from deciding alone.

    Parameters
    ----------
    residual, variance : (n_y, n_x) arrays
        What a fit leaves of a mean image, and the variance that noise gives it there.
    good : (n_y, n_x) bool array
    """
    return max(float(np.mean(residual[good] ** 2 - variance[good])), 0.0)

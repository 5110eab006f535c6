"""CANDID's nσ, and what a Δχ² is worth, without overflow however strong the companion."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats
from scipy.special import gammaincc, gammaln, ndtri_exp

from amibayes.data.covariance import Covariance
from amibayes.units import BoolArray, FloatArray, IntArray

LOG_TWO_PI = float(np.log(2.0 * np.pi))

CONTINUED_FRACTION_TERMS = 500

REJECTED = 1e-3
"""Probability of a χ² below which a model, or an image, does not fit."""


def log_chi2_survival(x: ArrayLike, dof: float) -> FloatArray:
    """Logarithm of the probability that χ² of ``dof`` degrees exceeds ``x`` (any shape).

    Where the probability itself would underflow, the continued fraction of the upper
    incomplete gamma function (Abramowitz & Stegun 6.5.31) is summed in logarithms.
    """
    a, z = 0.5 * dof, 0.5 * np.asarray(x, dtype=float)
    plain = gammaincc(a, z)
    out = np.log(np.maximum(plain, 1e-300))
    far = plain <= 1e-200
    if np.any(far):
        out = np.where(far, _log_far_tail(a, np.where(far, z, a + 1.0)), out)
    return np.asarray(out)


def _log_far_tail(a: float, z: FloatArray) -> FloatArray:
    fraction = np.zeros_like(z)
    for k in range(CONTINUED_FRACTION_TERMS, 0, -1):
        fraction = k * (a - k) / (z + 2 * k + 1 - a + fraction)
    return np.asarray(a * np.log(z) - z - gammaln(a) - np.log(z + 1 - a + fraction))


def chi2_survival(chi2: ArrayLike, dof: float, degrees: float = np.inf) -> FloatArray:
    """Probabilities of a χ² as large (...), of ``dof`` independent data.

    With a covariance of ``degrees`` degrees of freedom the data follow a t distribution, and
    χ²/dof, in units of its scale matrix, follows F.
    """
    if not np.isfinite(degrees):
        return np.asarray(stats.chi2.sf(chi2, dof))
    by_f = np.asarray(chi2) / dof * degrees / (degrees - 2.0)
    return np.asarray(stats.f.sf(by_f, dof, degrees))


def candid_n_sigma(chi2_single: ArrayLike, chi2_binary: ArrayLike, dof: float) -> FloatArray:
    """CANDID's number of sigma (Gallenne et al. 2015, eq. 8).

    x = dof · χ²(single)/χ²(binary), p = P(χ²_dof > x), nσ = Φ⁻¹(1 − p/2). It compares the
    two reduced χ² at one position and is not a false-alarm rate.

    Parameters
    ----------
    chi2_single, chi2_binary : float or float array
        χ² without and with the companion.
    dof : float
        Independent data minus free parameters; must be positive.
    """
    ratio = dof * np.asarray(chi2_single) / np.maximum(chi2_binary, 1e-300)
    log_p = log_chi2_survival(ratio, dof)
    return np.asarray(np.maximum(0.0, -ndtri_exp(log_p - np.log(2.0))))


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


def touched(covariance: Covariance, at: IntArray | BoolArray) -> tuple[BoolArray, BoolArray]:
    """Which whitened data (rank,) some data touch, by index or mask, and which ones all others."""
    outside = np.ones(covariance.size)
    outside[at] = 0.0
    size = abs(covariance.whitening)
    return size @ (1.0 - outside) > 0.0, size @ outside > 0.0


def chi2_of_part(covariance: Covariance, at: IntArray, difference: FloatArray) -> tuple[float, int]:
    """χ² of the data ``at`` some places, and the number of independent ones among them.

    Where they share no error with other data this is a part of the whitened data: a covariance
    of their own, whose cost goes with the cube of the data that share errors, is not made.
    """
    inside, beyond = touched(covariance, at)
    if not (inside & beyond).any():
        # No error is shared with other data: their part of the whitened data is all of it.
        return float((covariance.whiten(difference)[inside] ** 2).sum()), int(inside.sum())
    part = covariance.select(at)
    return float((part.whiten(difference[at]) ** 2).sum()), part.rank


def restricted_loss(product: FloatArray, n: int, logdet: FloatArray) -> FloatArray:
    """−2 ln of the restricted likelihood of n data, the scale of their errors at its best.

    0 where a linear fit passes through all of them: they say nothing of their noise then.

    Parameters
    ----------
    product : (..., 1 + n_dim, 1 + n_dim) float array
        Products of whitened residual and slopes.
    n : int
    logdet : (...) float array
        Of their covariances.
    """
    chi2, n_fitted, information = _linear_fit(product)
    count = n - n_fitted
    loss = count * np.log(np.maximum(chi2, 1e-300) / np.maximum(count, 1)) + logdet + information
    return np.where(count > 0, loss, 0.0)


def _linear_fit(product: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """χ² after linear fits, numbers of parameters that they tell, and ln of their information."""
    slopes = product[..., 1:, 1:]
    scale = np.sqrt(np.maximum(np.diagonal(slopes, axis1=-2, axis2=-1), 1e-300))
    values, vectors = np.linalg.eigh(slopes / (scale[..., :, None] * scale[..., None, :]))
    told = values > 1e-10
    known = np.where(told, values, 1.0)
    pull = (vectors.swapaxes(-2, -1) @ (product[..., 1:, 0] / scale)[..., None])[..., 0]
    chi2 = product[..., 0, 0] - (told * pull**2 / known).sum(axis=-1)
    length = np.where(scale > 1e-140, scale, 1.0)
    information = np.log(known).sum(axis=-1) + 2.0 * np.log(length).sum(axis=-1)
    return chi2, told.sum(axis=-1), information

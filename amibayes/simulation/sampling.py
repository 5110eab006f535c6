"""From light on the focal plane to pixels, anywhere between two pixels.

The image behind a mask holds no spatial frequency beyond the longest baseline, so samples
a few times finer than that demands give it everywhere: a sinc under a Kaiser window
(Kaiser & Schafer 1980) interpolates them to 1e-8. Interpolation, the average over a pixel
and the pixel's own response are then one matrix per axis, and a shift of the image is
another such matrix.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amibayes.units import FloatArray, read_only

IntArray = NDArray[np.intp]

HALF_WIDTH = 8
"""Samples on either side that an interpolated value is made of."""

LARGEST_FREQUENCY = 0.15
"""Cycles per sample that the interpolation is made for."""

_KAISER_BETA = 17.7
"""Errors below 1e-8 up to the largest frequency, for this width."""

_NODES = 8
"""Gauss–Legendre nodes across a pixel; the mask's fringes turn by 1.5 rad at most."""


@dataclass(frozen=True, eq=False)
class FineImage:
    """Light on the focal plane, at points finer than pixels.

    Parameters
    ----------
    rate_e_s : (n_fine, n_fine) array
        Electrons per second in each fine cell, as the density at its centre has it.
    oversample : int
        Cells per detector pixel and axis; the middle of the array is that of the detector.
    """

    rate_e_s: FloatArray
    oversample: int

    def __post_init__(self) -> None:
        read_only(self, "rate_e_s")


def fine_sampling(pixel_rad: float, band_limit_per_rad: float) -> int:
    """Cells per pixel that the interpolation needs for a band limit (cycles per radian)."""
    return max(1, math.ceil(pixel_rad * band_limit_per_rad / LARGEST_FREQUENCY))


def fine_size(n_pixels: int, oversample: int, reach_px: float) -> int:
    """Side, in detector pixels, of a fine image that serves shifts up to ``reach_px``."""
    margin = math.ceil(reach_px + HALF_WIDTH / oversample + 1.0)
    return n_pixels + 2 * margin


def pixel_operator(
    n_pixels: int, fine: FineImage, shift_px: float, pixel_response: float = 0.0
) -> FloatArray:
    """Matrix from the fine cells along one axis to the signal of pixels.

    Parameters
    ----------
    n_pixels : int
        Pixels of the detector along the axis, about the middle of the fine image.
    fine : FineImage
        What it will act on.
    shift_px : float
        The image moves by so many pixels.
    pixel_response : float
        Relative loss of sensitivity from the middle of a pixel to its edges; the mean
        over a pixel stays 1, as a flat field has it.

    Returns
    -------
    (n_pixels, n_fine) array
    """
    nodes, weight = np.polynomial.legendre.leggauss(_NODES)
    response = weight * (1.0 - pixel_response * nodes**2)
    response *= fine.oversample / response.sum()
    size = len(fine.rate_e_s)
    pixel = np.arange(n_pixels) - 0.5 * (n_pixels - 1)
    place = (pixel[:, None] + 0.5 * nodes - shift_px) * fine.oversample + 0.5 * (size - 1)
    sample, weight = _interpolator(place)
    operator = np.zeros((n_pixels, size))
    row = np.arange(n_pixels)[:, None, None]
    np.add.at(operator, (row, sample), response[:, None] * weight)
    return operator


def _interpolator(place: FloatArray) -> tuple[IntArray, FloatArray]:
    """Samples, and their weights, that give the values at ``place``; both (…, n_taps)."""
    sample = np.ceil(place - HALF_WIDTH).astype(np.intp)[..., None] + np.arange(2 * HALF_WIDTH)
    distance = place[..., None] - sample
    inside = np.maximum(1.0 - (distance / HALF_WIDTH) ** 2, 0.0)
    weight = np.sinc(distance) * np.i0(_KAISER_BETA * np.sqrt(inside))
    return sample, np.asarray(weight / weight.sum(axis=-1, keepdims=True))

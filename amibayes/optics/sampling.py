"""From light on the focal plane to pixels, anywhere between two pixels.

The image behind a mask holds no spatial frequency beyond the longest baseline, so samples
a few times finer than that demands give it everywhere: a sinc under a Kaiser window
(Kaiser & Schafer 1980) interpolates them to 1e-8. Interpolation, the average over a pixel
and the pixel's own response are then one matrix per axis, and a shift of the image is
another such matrix.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.fft import irfft, next_fast_len, rfft

from amibayes.units import FloatArray, IntArray, SingleArray

HALF_WIDTH = 8
"""Samples on either side that an interpolated value is made of."""

MAX_FREQUENCY = 0.15
"""Cycles per sample that the interpolation is made for."""

_KAISER_BETA = 17.7
"""Errors below 1e-8 up to the largest frequency, for this width."""

_NODES = 8
"""Gauss–Legendre nodes across a pixel; the mask's fringes turn by 1.5 rad at most."""


def fine_sampling(band_limit_per_px: float) -> int:
    """Cells per pixel and axis that a band limit (cycles per pixel) needs."""
    return max(1, math.ceil(band_limit_per_px / MAX_FREQUENCY))


def fine_size(n_pixels: int, oversample: int, reach_px: float) -> int:
    """Side, in detector pixels, of a fine image that serves shifts up to ``reach_px``."""
    margin = math.ceil(reach_px + HALF_WIDTH / oversample + 1.0)
    return n_pixels + 2 * margin


def pixel_operator(
    n_pixels: int, n_fine: int, oversample: int, shift_px: float, pixel_response: float = 0.0
) -> FloatArray:
    """Matrix from fine cells along one axis to the signal of pixels.

    Parameters
    ----------
    n_pixels : int
        Pixels of the detector along the axis, about the middle of the fine cells.
    n_fine, oversample : int
        Fine cells, and how many to a pixel; each holds its centre's density times its width.
    shift_px : float
        The image moves by so many pixels.
    pixel_response : float
        Relative loss of sensitivity from the middle of a pixel to its edges; the mean
        over a pixel stays 1, as a flat field has it.

    Returns
    -------
    (n_pixels, n_fine) array
    """
    nodes, response = pixel_weights(pixel_response)
    pixel = np.arange(n_pixels) - 0.5 * (n_pixels - 1)
    place = (pixel[:, None] + nodes - shift_px) * oversample + 0.5 * (n_fine - 1)
    sample, weight = interpolator(place)
    operator = np.zeros((n_pixels, n_fine))
    row = np.arange(n_pixels)[:, None, None]
    np.add.at(operator, (row, sample), oversample * response[:, None] * weight)
    return operator


def shifted_images(
    fine: SingleArray, oversample: int, shape: tuple[int, int], shift_px: FloatArray
) -> SingleArray:
    """Images (n, n_y, n_x) of fine cells displaced by (x, y), pixels.

    As `pixel_operator` along both axes. Pixels are whole numbers of cells apart, so that
    one short kernel along an axis serves all of them.
    """
    out = np.empty((len(shift_px), *shape), np.float32)
    (first, up), (left, across) = (
        _kernels(n, size, oversample, s)
        for n, size, s in zip(shape, fine.shape, shift_px.T[::-1], strict=True)
    )
    high = sliding_window_view(fine, up.shape[1], axis=0)
    for k, image in enumerate(out):
        rows = high[first[k] :: oversample][: shape[0]] @ up[k]
        wide = sliding_window_view(np.ascontiguousarray(rows.T), across.shape[1], axis=0)
        image[:] = (wide[left[k] :: oversample][: shape[1]] @ across[k]).T
    return out


def lattice_products(
    fine: SingleArray,
    oversample: int,
    operator: SingleArray,
    centre_px: tuple[float, float],
    step: int,
    half: int,
) -> SingleArray:
    """Products of an operator and images of fine cells displaced to a square lattice of places.

    The places are ``centre_px`` (x, y) and up to ``half`` times ``step`` cells to either side.
    Displacements by whole cells share one interpolation; those a whole number of pixels apart
    are a correlation, along x by the Fourier transform.

    Parameters
    ----------
    fine : (n, n) array
    oversample : int
        Cells per pixel and axis.
    operator : (m, n_y, n_x) array
        Images times this, summed over their pixels, are the products.
    centre_px : (x, y)
    step, half : int

    Returns
    -------
    (m, 2·half + 1, 2·half + 1) array
        The place along x, then along y.
    """
    _, n_y, n_x = operator.shape
    (first_y, up), (first_x, across) = (
        _kernels(n, size, oversample, np.array([c]))
        for n, size, c in zip((n_y, n_x), fine.shape, centre_px[::-1], strict=True)
    )
    pixels = fine
    for kernel in (up, across):
        along_first = sliding_window_view(pixels, kernel.shape[1], axis=0) @ kernel[0]
        pixels = np.ascontiguousarray(along_first.T)
    to_side = step * np.arange(half, -half - 1, -1)
    rows = first_y + to_side + oversample * np.arange(n_y)[:, None]
    (place, phase), n = np.divmod(first_x + to_side, oversample), len(to_side)
    size = next_fast_len(int(place.max()) + n_x, real=True)
    waves = rfft(operator, size, axis=2).conj().transpose(2, 0, 1)
    out = np.empty((len(operator), n, n), np.float32)
    for own in np.unique(phase):
        there = phase == own
        light = rfft(pixels[:, own::oversample], size, axis=1)
        products = irfft(waves @ light.T[:, rows], size, axis=0)
        out[:, there] = products[place[there]].transpose(1, 0, 2)
    return out


def _kernels(
    n_pixels: int, n_fine: int, oversample: int, shift_px: FloatArray
) -> tuple[IntArray, SingleArray]:
    """First cell (n,) of the first pixel along an axis, and the weights (n, k) from there on."""
    nodes, response = pixel_weights()
    place = -0.5 * (n_pixels - 1) - shift_px[:, None] + nodes
    sample, weight = interpolator(place * oversample + 0.5 * (n_fine - 1))
    start = sample.min(axis=(1, 2))
    at = sample - start[:, None, None]
    kernel = np.zeros((len(start), int(at.max()) + 1))
    row = np.arange(len(start))[:, None, None]
    np.add.at(kernel, (row, at), oversample * response[:, None] * weight)
    return start, kernel.astype(np.float32)


def pixel_transform(frequency_per_px: FloatArray, pixel_response: float = 0.0) -> FloatArray:
    """Fourier transform of a pixel, 1 at zero frequency (cycles per pixel)."""
    nodes, response = pixel_weights(pixel_response)
    return np.asarray(np.cos(2.0 * np.pi * np.multiply.outer(frequency_per_px, nodes)) @ response)


@lru_cache(maxsize=16)
def pixel_weights(pixel_response: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Quadrature nodes across a pixel, −½ to ½, and weights that sum to 1."""
    nodes, weight = np.polynomial.legendre.leggauss(_NODES)
    response = weight * (1.0 - pixel_response * nodes**2)
    return 0.5 * nodes, np.asarray(response / response.sum())


def interpolator(place: FloatArray) -> tuple[IntArray, FloatArray]:
    """Samples, and their weights, that give the values at ``place``; both (…, n_nodes_used)."""
    sample = np.ceil(place - HALF_WIDTH).astype(np.intp)[..., None] + np.arange(2 * HALF_WIDTH)
    distance = place[..., None] - sample
    inside = np.maximum(1.0 - (distance / HALF_WIDTH) ** 2, 0.0)
    weight = np.sinc(distance) * np.i0(_KAISER_BETA * np.sqrt(inside))
    return sample, np.asarray(weight / weight.sum(axis=-1, keepdims=True))

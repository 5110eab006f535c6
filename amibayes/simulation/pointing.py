"""Where the telescope points, and the images of all pointings by one matrix product.

Over the few tens of mas of the jitter an image is a polynomial of the pointing: a
Chebyshev series in each direction gives it to 1e-6. Its coefficients come from the
detector's matrices at the Chebyshev nodes, and the images of any number of integrations
are then one product of two matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from amibayes.simulation.sampling import FineImage, pixel_operator
from amibayes.units import FloatArray

TOLERANCE = 1e-6
"""Largest error of an image, relative to the fringes it is made of."""


@dataclass(frozen=True, eq=False)
class ShiftTable:
    """Images as a polynomial of the pointing.

    Parameters
    ----------
    coefficients : (n_y · n_x, ny · nx) array
        Of the products of Chebyshev polynomials in y and x, electrons per second.
    shape : (int, int)
        Shape of an image.
    order : (int, int)
        Highest degree in y and in x.
    centre_px, reach_px : (2,) arrays
        The box of pointings (x, y) in which the polynomial holds.
    """

    coefficients: FloatArray
    shape: tuple[int, int]
    order: tuple[int, int]
    centre_px: FloatArray
    reach_px: FloatArray

    def images(self, offsets_px: FloatArray) -> FloatArray:
        """(n, ny, nx) images at offsets (n, 2), never negative."""
        images = np.maximum(self._basis(offsets_px) @ self.coefficients, 0.0)
        return np.asarray(images.reshape(-1, *self.shape))

    def mean_image(self, offsets_px: FloatArray) -> FloatArray:
        """(ny, nx) mean of the images at offsets (n, 2)."""
        mean = self._basis(offsets_px).mean(axis=0) @ self.coefficients
        return np.asarray(np.maximum(mean, 0.0).reshape(self.shape))

    def _basis(self, offsets_px: FloatArray) -> FloatArray:
        scaled = (offsets_px - self.centre_px) / self.reach_px
        x = chebyshev.chebvander(scaled[:, 0], self.order[1])
        y = chebyshev.chebvander(scaled[:, 1], self.order[0])
        return np.asarray((y[:, :, None] * x[:, None, :]).reshape(len(scaled), -1))


def shift_table(
    fine: FineImage,
    n_pixels: int,
    offsets_px: FloatArray,
    band_limit_per_px: float,
    pixel_response: float = 0.0,
) -> ShiftTable:
    """Tabulate images for a set of pointings.

    Parameters
    ----------
    fine : FineImage
        The light, at pointing zero.
    n_pixels : int
        Side of the detector.
    offsets_px : (n, 2) array
        All pointings (x, y) that will be asked for, in pixels.
    band_limit_per_px : float
        Highest spatial frequency of the image, cycles per pixel.
    pixel_response : float
        See `pixel_operator`.

    Returns
    -------
    ShiftTable
    """
    low, high = offsets_px.min(axis=0), offsets_px.max(axis=0)
    centre, reach = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1e-9)
    x, y = (
        _operator_series(fine, n_pixels, c, r, band_limit_per_px, pixel_response)
        for c, r in zip(centre, reach, strict=True)
    )
    halfway = y @ fine.rate_e_s
    series = np.tensordot(halfway, x, axes=(2, 2)).transpose(0, 2, 1, 3)
    coefficients = series.reshape(len(y) * len(x), n_pixels * n_pixels)
    shape, order = (n_pixels, n_pixels), (len(y) - 1, len(x) - 1)
    return ShiftTable(coefficients, shape, order, centre, reach)


def _operator_series(
    fine: FineImage,
    n_pixels: int,
    centre_px: float,
    reach_px: float,
    band_limit_per_px: float,
    pixel_response: float,
) -> FloatArray:
    """Chebyshev coefficients (n, n_pixels, n_fine) of the pixel operator in the shift."""
    n = chebyshev_order(2.0 * math.pi * band_limit_per_px * reach_px)
    nodes = np.cos(np.pi * (np.arange(n + 1) + 0.5) / (n + 1))
    exact = np.stack(
        [
            pixel_operator(n_pixels, fine, centre_px + reach_px * node, pixel_response)
            for node in nodes
        ]
    )
    return np.tensordot(np.linalg.inv(chebyshev.chebvander(nodes, n)), exact, axes=1)


def chebyshev_order(phase_rad: float) -> int:
    """Degree that gives e^{iφx} on [−1, 1] to the tolerance: its terms fall as 2 J_n(φ)."""
    n = 0
    while 2.0 * (phase_rad / 2.0) ** (n + 1) / math.factorial(n + 1) > TOLERANCE:
        n += 1
    return n

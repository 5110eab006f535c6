"""Where the telescope points, and the images of all pointings by one matrix product.

An image is a smooth function of where it falls on the pixels: the mask passes no spatial
frequency beyond B_max/λ. Over the few tens of mas of the jitter a Chebyshev polynomial in
each direction gives it to 1e-6; its coefficients come from exact images at the nodes, and
the images of any number of integrations are then one product of two matrices.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from amibayes.units import FloatArray

ImageOf = Callable[[FloatArray], FloatArray]
"""Gives the (ny, nx) image of a pointing offset (x, y) in radians."""

TOLERANCE = 1e-6
"""Largest error of an image, relative to the fringes it is made of."""


@dataclass(frozen=True, eq=False)
class ShiftTable:
    """Images as a polynomial of the pointing.

    Parameters
    ----------
    coefficients : (n_x · n_y, ny · nx) array
        Of the products of Chebyshev polynomials in x and y.
    shape : (int, int)
        Shape of an image.
    order : (int, int)
        Highest degree in x and in y.
    centre_rad, reach_rad : (2,) arrays
        The box of pointings in which the polynomial holds.
    """

    coefficients: FloatArray
    shape: tuple[int, int]
    order: tuple[int, int]
    centre_rad: FloatArray
    reach_rad: FloatArray

    def images(self, offsets_rad: FloatArray) -> FloatArray:
        """(n, ny, nx) images at offsets (n, 2), never negative."""
        scaled = (offsets_rad - self.centre_rad) / self.reach_rad
        x = chebyshev.chebvander(scaled[:, 0], self.order[0])
        y = chebyshev.chebvander(scaled[:, 1], self.order[1])
        basis = (x[:, :, None] * y[:, None, :]).reshape(len(scaled), -1)
        images = np.maximum(basis @ self.coefficients, 0.0)
        return np.asarray(images.reshape(len(scaled), *self.shape))


def shift_table(
    image_of: ImageOf, offsets_rad: FloatArray, band_limit_per_rad: float
) -> ShiftTable:
    """Tabulate images for a set of pointings.

    Parameters
    ----------
    image_of : callable
        Gives the exact (ny, nx) image of an offset (x, y).
    offsets_rad : (n, 2) array
        All pointings that will be asked for.
    band_limit_per_rad : float
        Highest spatial frequency of the image, cycles per radian (longest baseline plus a
        hole's width over the shortest wavelength).

    Returns
    -------
    ShiftTable
    """
    low, high = offsets_rad.min(axis=0), offsets_rad.max(axis=0)
    centre, reach = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1e-15)
    order = [chebyshev_order(2.0 * math.pi * band_limit_per_rad * r) for r in reach]
    nodes = [_nodes(n) for n in order]
    grid = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    exact = np.stack([image_of(centre + reach * node) for node in grid])
    to_coefficients = np.kron(
        *(np.linalg.inv(chebyshev.chebvander(x, n)) for x, n in zip(nodes, order, strict=True))
    )
    flat = exact.reshape(len(grid), -1)
    return ShiftTable(to_coefficients @ flat, exact.shape[1:], (order[0], order[1]), centre, reach)


def chebyshev_order(phase_rad: float) -> int:
    """Degree that gives e^{iφx} on [−1, 1] to the tolerance: its terms fall as 2 J_n(φ)."""
    n = 0
    while 2.0 * (phase_rad / 2.0) ** (n + 1) / math.factorial(n + 1) > TOLERANCE:
        n += 1
    return n


def _nodes(order: int) -> FloatArray:
    """Chebyshev nodes of the first kind."""
    return np.asarray(np.cos(np.pi * (np.arange(order + 1) + 0.5) / (order + 1)))


def draw_jitter(rms_rad: float, n: int, rng: np.random.Generator) -> FloatArray:
    """(n, 2) pointing offsets, Gaussian with ``rms_rad`` in each axis."""
    return rms_rad * rng.standard_normal((n, 2))

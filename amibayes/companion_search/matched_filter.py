"""The best contrast at one place after the other, as an optimiser asks for them.

Off the lattice places come singly, and what a template bank does for thousands of them at a time
would be overhead. With few data a template is M·(cosine, sine, 1), M a dense matrix; of it only
the product with the data and a triangular factor are needed, which are made once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from amibayes.companion_search.templates import floored
from amibayes.likelihood.linear_response import Part
from amibayes.units import FloatArray

MatchedFilter = Callable[[FloatArray], tuple[FloatArray, float]]
"""From a place (east, north in mas) to contrasts and rates, and the gain in χ²."""

MAX_NUMBERS = 200_000
"""Numbers of M up to which its products take less time than the calls of sparse ones: 50 µs."""


def positive(signed: float, sigma: float) -> tuple[FloatArray, float]:
    """Contrast (1,) and gain of a product with a template of unit length; none below zero."""
    return np.array([signed * sigma]), max(signed, 0.0) ** 2


def few(n_rows: int, n_samples: int) -> bool:
    """Whether `dense_filter` is the faster one."""
    return n_rows * (2 * n_samples + 1) <= MAX_NUMBERS


Waves = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], None]
"""Puts cosine and sine (n_samples, m) of east and north (m,) into its first arguments."""


def fill_one(waves_into: Waves, out: FloatArray, place: FloatArray) -> None:
    """Put cosines, then sines of one place (2,) into one array (2 n_samples,)."""
    n = len(out) // 2
    waves_into(out[:n, None], out[n:, None], place[:1], place[1:])


def dense_filter(
    even: Part,
    odd: Part,
    offset: FloatArray,
    basis: FloatArray,
    data: FloatArray,
    fill: Callable[[FloatArray, FloatArray], None],
) -> MatchedFilter:
    """Make the filter of companions at rest, alike in every band.

    Parameters
    ----------
    even, odd, offset
        As in `amibayes.likelihood.linear_response.WhitenedResponse`.
    basis : (n_rows, k) float array
        Nuisance directions, orthonormal.
    data : (n_rows,) float array
        Whitened residuals without their nuisance part.
    fill : callable
        Puts cosines, then sines (2 n_samples,) of a place (2,) into its first argument.
    """
    n = even.matrix.shape[1]
    whole = np.zeros((len(data), 2 * n + 1))
    for part, columns in ((even, slice(0, n)), (odd, slice(n, 2 * n))):
        matrix = part.matrix
        whole[part.rows, columns] += matrix if isinstance(matrix, np.ndarray) else matrix.toarray()
    whole[even.rows, 2 * n] -= offset
    along = basis.T @ whole
    left = np.linalg.qr(whole - basis @ along, mode="r")
    # One product gives all: with the data, what is left of the template, what was taken out.
    factor, last = np.vstack([whole.T @ data, left, along]), 1 + len(left)
    waves = np.ones(2 * n + 1)
    fringes = waves[: 2 * n]

    def best(place: FloatArray) -> tuple[FloatArray, float]:
        fill(fringes, place)
        product = factor @ waves
        kept, taken = product[1:last], product[last:]
        square = kept @ kept
        sigma = float(floored(square, square + taken @ taken)) ** -0.5
        return positive(float(product[0]) * sigma, sigma)

    return best

"""The best contrast at one place after the other, as an optimiser asks for them.

Off the lattice places come singly, and what a template bank does for thousands of them at a time
would be overhead. With few data a template is M·(cosine, sine, 1), M a dense matrix; of it only
the product with the data and a triangular factor are needed, which are made once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.templates import floored
from amibayes.likelihood.linear_response import Part, WhitenedResponse
from amibayes.models.companion import fringes_into, fringes_of_one
from amibayes.models.uv_points import UVPoints
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


@dataclass(frozen=True, eq=False)
class CompanionFringes:
    """What light at a place of the field does to the visibility, cosine and sine.

    Fringes, the companion's disc, the response off the axis.

    Parameters
    ----------
    samples : UVPoints
    smearing : bool
    disc : (n_samples, 1) float array or None
    star : (n_samples,) float array
        The star's visibility.
    """

    samples: UVPoints
    smearing: bool
    disc: FloatArray | None
    star: FloatArray

    @classmethod
    def of(
        cls, samples: UVPoints, response: WhitenedResponse, *, smearing: bool
    ) -> CompanionFringes:
        """Make those that a response is to be multiplied with."""
        disc = None if (response.disc == 1.0).all() else response.disc[:, None]
        return cls(samples, smearing, disc, response.star)

    def at(self, east_mas: FloatArray, north_mas: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine, (n_samples, m), of places (m,) or of moving ones (n_samples, m)."""
        cosine, sine = np.empty((2, len(self.samples), np.shape(east_mas)[-1]))
        self._into(cosine, sine, east_mas, north_mas)
        return cosine, sine

    def of_one(self) -> Callable[[FloatArray, FloatArray], None]:
        """Make what puts cosines, then sines of a place (2,) into an array (2 n_samples,)."""
        if self.disc is None and self.samples.off_axis is None:
            return fringes_of_one(self.samples, self.smearing)
        n = len(self.samples)

        def fill(out: FloatArray, place: FloatArray) -> None:
            self._into(out[:n, None], out[n:, None], place[:1], place[1:])

        return fill

    def _into(
        self, cosine: FloatArray, sine: FloatArray, east_mas: FloatArray, north_mas: FloatArray
    ) -> None:
        """Fill what `at` gives: dV/dc is ρDE − ρ_F V₀, not E − V₀, the flux in the cosine."""
        fringes_into(cosine, sine, self.samples, east_mas, north_mas, self.smearing)
        if self.disc is not None:
            cosine *= self.disc
            sine *= self.disc
        if self.samples.off_axis is None:
            return
        fringe, flux = self.samples.off_axis.symmetrised.at((east_mas, north_mas))
        turned = (cosine - 1j * sine) * fringe
        cosine[...] = turned.real - (flux - 1.0) * self.star[:, None]
        sine[...] = -turned.imag


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

"""What the extraction let through of a companion's light, where the data say it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.observables import IntArray, Observables
from amibayes.response import EXPONENTS, REVERSED, ComplexArray, powers_at, slopes_at
from amibayes.units import MAS, FloatArray


@dataclass(frozen=True, eq=False)
class OffAxis:
    """Response at the points of a data set.

    Parameters
    ----------
    fringe, flux : (n_samples, n_coefficients) array
        Logarithm of the response of the visibility and of the flux that it is divided by,
        as `amibayes.response` has it, of east and north in radians.
    """

    fringe: FloatArray
    flux: FloatArray

    def at(self, east_mas: FloatArray, north_mas: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Response of visibility and flux, (n_samples, n) each."""
        powers = powers_at(east_mas * MAS, north_mas * MAS)
        return np.exp(self.fringe @ powers), np.exp((self.flux @ powers).real)

    def slopes(
        self, east_mas: FloatArray, north_mas: FloatArray
    ) -> tuple[tuple[ComplexArray, ComplexArray], tuple[FloatArray, FloatArray]]:
        """Derivatives of both logarithms by east and north, per mas, (n_samples, n) each."""
        east, north = slopes_at(east_mas * MAS, north_mas * MAS)
        return (
            (self.fringe @ east * MAS, self.fringe @ north * MAS),
            ((self.flux @ east).real * MAS, (self.flux @ north).real * MAS),
        )


def off_axis_of(data: Observables, first: IntArray, sign: FloatArray) -> OffAxis | None:
    """Response at points ``first`` of a list of all V² and then all legs of the triangles.

    ``sign`` (n,) is −1 where the point is the opposite of the baseline's own.
    """
    if all(s.response is None for s in data.setups):
        return None
    v2, cp = data.vis2, data.closure_phase
    # The third leg closes the triangle: from its last station back to its first.
    legs = np.concatenate([v2.stations, cp.stations[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)])[first]
    setup = np.concatenate([v2.setup, np.repeat(cp.setup, 3)])[first]
    fringe = np.zeros((len(first), len(EXPONENTS)))
    flux = np.zeros_like(fringe)
    for number, described in enumerate(data.setups):
        if described.response is not None:
            here = setup == number
            a, b = legs[here].T
            fringe[here], flux[here] = described.response[a, b], described.response[a, a]
    fringe = np.where(sign[:, None] < 0.0, fringe * REVERSED, fringe)
    return OffAxis(fringe, flux)

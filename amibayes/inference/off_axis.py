"""What the extraction let through of a companion's light, where the data say it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.observables import IntArray, Observables
from amibayes.response import EXPONENTS, even_powers, even_slopes
from amibayes.units import MAS, FloatArray

Slopes = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class OffAxis:
    """Response at the points of a data set.

    Parameters
    ----------
    fringe, flux : (n_samples, n_coefficients) array
        Logarithm of the response of the visibility and of the flux that it is divided by,
        in even powers of east and north (radians).
    """

    fringe: FloatArray
    flux: FloatArray

    def at(self, east_mas: FloatArray, north_mas: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Response of visibility and flux, (n_samples, n) each."""
        powers = even_powers(east_mas * MAS, north_mas * MAS)
        return np.exp(self.fringe @ powers), np.exp(self.flux @ powers)

    def slopes(self, east_mas: FloatArray, north_mas: FloatArray) -> tuple[Slopes, Slopes]:
        """Derivatives of both logarithms by east and north, per mas, (n_samples, n) each."""
        east, north = even_slopes(east_mas * MAS, north_mas * MAS)
        return (
            (self.fringe @ east * MAS, self.fringe @ north * MAS),
            (self.flux @ east * MAS, self.flux @ north * MAS),
        )


def off_axis_of(data: Observables, first: IntArray) -> OffAxis | None:
    """Response at points ``first`` of a list of all V² and then all legs of the triangles."""
    if all(s.response is None for s in data.setups):
        return None
    v2, cp = data.vis2, data.closure_phase
    legs = np.concatenate([v2.stations, cp.stations[:, [0, 1, 1, 2, 0, 2]].reshape(-1, 2)])[first]
    setup = np.concatenate([v2.setup, np.repeat(cp.setup, 3)])[first]
    fringe = np.zeros((len(first), len(EXPONENTS)))
    flux = np.zeros_like(fringe)
    for number, described in enumerate(data.setups):
        if described.response is not None:
            here = setup == number
            a, b = legs[here].T
            fringe[here], flux[here] = described.response[a, b], described.response[a, a]
    return OffAxis(fringe, flux)

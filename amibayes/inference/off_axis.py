"""What the extraction let through of a companion's light, where the data say it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.observables import IntArray, Observables
from amibayes.response import (
    EXPONENTS,
    MODULUS,
    PHASE,
    REVERSED,
    ComplexArray,
    monomials_at,
    slopes_at,
)
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
        """Response of visibility and flux, (n_samples, n) each, at places (n,).

        Moving places are (n_samples, n), here and below.
        """
        terms = monomials_at(*_radians(east_mas, north_mas))
        modulus, phase = (_sum(self.fringe, terms, p, east_mas) for p in (MODULUS, PHASE))
        flux = np.exp(_sum(self.flux, terms, MODULUS, east_mas))
        fringe = np.empty(phase.shape, dtype=complex)
        np.cos(phase, out=fringe.real)
        np.sin(phase, out=fringe.imag)
        fringe *= np.exp(modulus)
        return fringe, flux

    def slopes(
        self, east_mas: FloatArray, north_mas: FloatArray
    ) -> tuple[tuple[ComplexArray, ComplexArray], tuple[FloatArray, FloatArray]]:
        """Derivatives of both logarithms by east and north, per mas, (n_samples, n) each."""
        slopes = slopes_at(*_radians(east_mas, north_mas))
        modulus = [_sum(self.fringe, s, MODULUS, east_mas) * MAS for s in slopes]
        phase = [_sum(self.fringe, s, PHASE, east_mas) * MAS for s in slopes]
        flux = [_sum(self.flux, s, MODULUS, east_mas) * MAS for s in slopes]
        east, north = (m + 1j * p for m, p in zip(modulus, phase, strict=True))
        return (east, north), (flux[0], flux[1])


def _radians(east_mas: FloatArray, north_mas: FloatArray) -> tuple[FloatArray, FloatArray]:
    return (east_mas * MAS).ravel(), (north_mas * MAS).ravel()


def _sum(
    coefficients: FloatArray, monomials: FloatArray, part: slice, like: FloatArray
) -> FloatArray:
    """Polynomials of each sample, (n_samples, n), at places shaped like (n,) or (n_samples, n)."""
    if like.ndim == 1:
        return np.asarray(coefficients[:, part] @ monomials[part])
    at_own = monomials[part].reshape(-1, *like.shape)
    return np.asarray(np.einsum("sk,ksn->sn", coefficients[:, part], at_own))


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

"""What the extraction let through of a companion's light, where the data say it.

An image has its centre where the phases of its fringes say that the light is. A companion
pulls that place towards itself, and is itself seen from there: nearer than it is to the star.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from amibayes.observables import IntArray, Observables
from amibayes.response import ComplexArray, Taps, taps
from amibayes.units import MAS, FloatArray, read_only

Place = tuple[FloatArray, FloatArray]
"""East and north, mas: (n,), or (n_samples, n) where points of the (u, v) plane differ."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """Points of one exposure, which share a response, a date and a centre.

    Parameters
    ----------
    rows : (m,) int array
        Which of the samples.
    uv : (m, 2) array
        Their spatial frequencies, cycles per mas.
    coefficients : (n_nodes², 2·m + 1) array
        Splines of the real parts, the imaginary parts, and the flux, in units of what a
        lone star is seen with, whose pointing has been allowed for.
    n_nodes : int
    to_node : (2, 2) array
        Times east and north in mas: steps of the lattice.
    pointing : (2,) array
        East and north of the centre of light from the axis, mas.
    """

    rows: IntArray
    uv: FloatArray
    coefficients: FloatArray
    n_nodes: int
    to_node: FloatArray
    pointing: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "uv", "coefficients", "to_node", "pointing")

    def taps(self, place: Place) -> Taps:
        """What the values at places are made of."""
        here = [c[self.rows[0]] if c.ndim == 2 else c for c in place]
        return taps(self.to_node @ np.stack(here), self.n_nodes)

    def sum(self, index: IntArray, weight: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Fringes (m, n) and flux (n,) of taps."""
        n, k = index.shape
        start = np.arange(0, n * k + 1, k)
        operator = csr_array((weight.ravel(), index.ravel(), start), (n, len(self.coefficients)))
        values = (operator @ self.coefficients).T
        m = len(self.rows)
        return np.asarray(values[:m] + 1j * values[m : 2 * m]), np.asarray(values[2 * m])


@dataclass(frozen=True, eq=False)
class OffAxis:
    """Response at the points of a data set; 1 at those that come from no extraction.

    Parameters
    ----------
    n_samples : int
    exposures : tuple of Exposure
    """

    n_samples: int
    exposures: tuple[Exposure, ...]

    @cached_property
    def start(self) -> Place:
        """Where the axis is from a lone star, (n_samples, 1) each: where it was pointed at."""
        found = np.zeros((2, self.n_samples, 1))
        for exposure in self.exposures:
            found[:, exposure.rows] = -exposure.pointing[:, None, None]
        return found[0], found[1]

    def at(self, place: Place) -> tuple[ComplexArray, FloatArray]:
        """Response of visibility and flux, (n_samples, n) each."""
        shape = (self.n_samples, place[0].shape[-1])
        fringe, flux = np.ones(shape, dtype=complex), np.ones(shape)
        for exposure in self.exposures:
            t = exposure.taps(place)
            fringe[exposure.rows], flux[exposure.rows] = exposure.sum(t.index, t.value)
        return fringe, flux

    def slopes(
        self, place: Place
    ) -> tuple[tuple[ComplexArray, ComplexArray], tuple[FloatArray, FloatArray]]:
        """Derivatives of both by east and north, per mas, (n_samples, n) each."""
        shape = (2, self.n_samples, place[0].shape[-1])
        fringe, flux = np.zeros(shape, dtype=complex), np.zeros(shape)
        for exposure in self.exposures:
            t = exposure.taps(place)
            for by_node, weight in zip(exposure.to_node, (t.by_first, t.by_second), strict=True):
                of_fringe, of_flux = exposure.sum(t.index, weight)
                fringe[:, exposure.rows] += by_node[:, None, None] * of_fringe
                flux[:, exposure.rows] += by_node[:, None, None] * of_flux
        return (fringe[0], fringe[1]), (flux[0], flux[1])

    def centre(self, visibility: ComplexArray) -> Place:
        """Where the axis is, from the star, in an image of these visibilities (n_samples, n).

        East and north, mas, (n_samples, n) each. The centre of the light follows from least
        squares on the phases, weighted with the amplitudes, as in
        `amibayes.extraction.image_plane.shift_of`.
        """
        found = np.zeros((2, *visibility.shape))
        for exposure, weight, phase, inverse in self._phases(visibility):
            found[:, exposure.rows] = _solved(exposure, inverse, weight * phase)[:, None]
        return self.start[0] + found[0], self.start[1] + found[1]

    def centre_slopes(self, visibility: ComplexArray, slopes: ComplexArray) -> FloatArray:
        """Derivatives (k, 2, n_samples, n) of `centre`, of those of the visibilities.

        ``slopes`` are (k, n_samples, n).
        """
        found = np.zeros((len(slopes), 2, *visibility.shape))
        for exposure, weight, phase, inverse in self._phases(visibility):
            turned = _solved(exposure, inverse, weight * phase)
            left = phase + 2.0 * np.pi * exposure.uv @ turned
            for k, slope in enumerate(slopes):
                log = slope[exposure.rows] / visibility[exposure.rows]
                change = weight * (log.imag + 2.0 * log.real * left)
                found[k][:, exposure.rows] = _solved(exposure, inverse, change)[:, None]
        return found

    def _phases(
        self, visibility: ComplexArray
    ) -> Iterator[tuple[Exposure, FloatArray, FloatArray, FloatArray]]:
        """Yield exposures, weights and phases (m, n), and inverse normal matrices (n, 2, 2)."""
        for exposure in self.exposures:
            seen = visibility[exposure.rows]
            weight = seen.real**2 + seen.imag**2
            outer = exposure.uv[:, :, None] * exposure.uv[:, None, :]
            normal = np.tensordot(weight.T, outer, axes=1)
            inverse = np.asarray(np.linalg.pinv(normal, hermitian=True), dtype=float)
            yield exposure, weight, np.angle(seen), inverse


def _solved(exposure: Exposure, inverse: FloatArray, phase: FloatArray) -> FloatArray:
    """Displacement (2, n) that weighted phases (m, n) tell of, mas."""
    turns = exposure.uv.T @ phase / (-2.0 * np.pi)
    return np.asarray(np.einsum("nij,jn->in", inverse, turns))


def off_axis_of(
    data: Observables, first: IntArray, sign: FloatArray, uv: FloatArray
) -> OffAxis | None:
    """Response at points ``first`` of a list of all V² and then all legs of the triangles.

    ``sign`` (n,) is −1 where the point is the opposite of the baseline's own; ``uv`` (n, 2)
    are the points, cycles per radian.
    """
    if all(s.response is None for s in data.setups):
        return None
    v2, cp = data.vis2, data.closure_phase
    # The third leg closes the triangle: from its last station back to its first.
    legs = np.concatenate([v2.stations, cp.stations[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)])[first]
    label = np.concatenate(
        [_exposure(v2.setup, v2.mjd), np.repeat(_exposure(cp.setup, cp.mjd), 3, axis=0)]
    )
    exposures = []
    for setup, mjd in np.unique(label[first], axis=0):
        response = data.setups[int(setup)].response
        if response is None:
            continue
        rows = np.flatnonzero((label[first] == (setup, mjd)).all(axis=1))
        a, b = legs[rows].T
        fringe = response.coefficients[a, b].astype(complex)
        fringe = np.where(sign[rows, None, None] < 0.0, fringe.conj(), fringe)
        seen = taps((response.to_node @ response.pointing)[:, None], response.n_nodes)
        whole = np.stack([*fringe, response.coefficients[a[0], a[0]]]).reshape(len(rows) + 1, -1)
        whole /= whole[:, seen.index[0]] @ seen.value[0][:, None]
        exposures.append(
            Exposure(
                rows,
                uv[rows] * MAS,
                np.vstack([whole[:-1].real, whole[:-1].imag, whole[-1:].real]).T,
                response.n_nodes,
                response.to_node * MAS,
                response.pointing / MAS,
            )
        )
    return OffAxis(len(first), tuple(exposures))


def _exposure(setup: IntArray, mjd: FloatArray) -> FloatArray:
    """Labels (n, 2) of exposures."""
    return np.column_stack([setup, mjd])

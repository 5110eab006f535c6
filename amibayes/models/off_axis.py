"""What the extraction let through of a companion's light, where the data say it.

An image has its centre where the phases of its fringes say that the light is. A companion
pulls that place towards itself, and is itself seen from there: nearer than it is to the star.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from amibayes.data.kernel_model import stands_alone
from amibayes.data.observables import Observables
from amibayes.data.off_axis_response import bspline_weights
from amibayes.units import MAS, ComplexArray, FloatArray, IntArray, read_only

Place = tuple[FloatArray, FloatArray]
"""East and north, mas: (n,), or (n_samples, n) where points of the (u, v) plane differ."""

CHUNK = 512
"""Places that are worked on together."""

NEGLIGIBLE = 1e-9


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
    symmetric : bool
        Whether opposite places have conjugate responses.
    """

    rows: IntArray
    uv: FloatArray
    coefficients: FloatArray
    n_nodes: int
    to_node: FloatArray
    pointing: FloatArray
    symmetric: bool = True

    def __post_init__(self) -> None:
        read_only(self, "uv", "coefficients", "to_node", "pointing")

    def symmetrised(self) -> Exposure:
        """The same with the part of the response that is conjugate at opposite places."""
        if self.symmetric:
            return self
        m, opposite = len(self.rows), self.coefficients[::-1].copy()
        opposite[:, m : 2 * m] *= -1.0
        return replace(self, coefficients=0.5 * (self.coefficients + opposite), symmetric=True)

    def seen(self, place: Place, *, slopes: bool = False) -> FloatArray:
        """Real parts, imaginary parts and flux at places, (1, 2·m + 1, n).

        With ``slopes``, (3, 2·m + 1, n): their derivatives by east and north too, per mas.
        """
        here = [c[self.rows[0]] if c.ndim == 2 else c for c in place]
        index, weight = bspline_weights(self.to_node @ np.stack(here), self.n_nodes)
        if slopes:
            weight[:, 1:] = self.to_node.T @ weight[:, 1:]
        kept = weight if slopes else weight[:, :1]
        parts = [slice(k, k + CHUNK) for k in range(0, max(len(index), 1), CHUNK)]
        found = [kept[p] @ self.coefficients[index[p]] for p in parts]
        return np.asarray(np.concatenate(found).transpose(1, 2, 0))


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
    def symmetrised(self) -> OffAxis:
        """What templates take for the response, which opposite places share."""
        return replace(self, exposures=tuple(e.symmetrised() for e in self.exposures))

    @cached_property
    def start(self) -> Place:
        """Where the axis is from a lone star, (n_samples, 1) each: where it was pointed at."""
        found = np.zeros((2, self.n_samples, 1))
        for exposure in self.exposures:
            found[:, exposure.rows] = -exposure.pointing[:, None, None]
        return found[0], found[1]

    def at(self, place: Place) -> tuple[ComplexArray, FloatArray]:
        """Response of visibility and flux, (n_samples, n) each."""
        fringe, flux = self._seen(place, slopes=False)
        return fringe[0], flux[0]

    def with_slopes(self, place: Place) -> tuple[ComplexArray, FloatArray]:
        """Response of visibility and flux, (3, n_samples, n) each: values and derivatives.

        The derivatives are by east and north, per mas.
        """
        return self._seen(place, slopes=True)

    def _seen(self, place: Place, *, slopes: bool) -> tuple[ComplexArray, FloatArray]:
        shape = (1 + 2 * slopes, self.n_samples, place[0].shape[-1])
        fringe, flux = np.zeros(shape, dtype=complex), np.zeros(shape)
        fringe[0] = flux[0] = 1.0
        for exposure in self.exposures:
            found, m = exposure.seen(place, slopes=slopes), len(exposure.rows)
            fringe[:, exposure.rows] = found[:, :m] + 1j * found[:, m : 2 * m]
            flux[:, exposure.rows] = found[:, 2 * m :]
        return fringe, flux

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
                along = slope[exposure.rows] * visibility[exposure.rows].conj()
                change = along.imag + 2.0 * along.real * left
                found[k][:, exposure.rows] = _solved(exposure, inverse, change)[:, None]
        return found

    def _phases(
        self, visibility: ComplexArray
    ) -> Iterator[tuple[Exposure, FloatArray, FloatArray, FloatArray]]:
        """Yield exposures, weights and phases (m, n), and inverse normal matrices (2, 2, n)."""
        for exposure in self.exposures:
            seen = visibility[exposure.rows]
            weight = seen.real**2 + seen.imag**2
            u, v = exposure.uv.T
            uu, uv, vv = np.stack([u * u, u * v, v * v]) @ weight
            # Baselines on one line say nothing of the other direction: of that nothing moves.
            uu, vv = uu + NEGLIGIBLE * (uu + vv), vv + NEGLIGIBLE * (uu + vv)
            inverse = np.array([[vv, -uv], [-uv, uu]]) / (uu * vv - uv * uv)
            yield exposure, weight, np.angle(seen), inverse


def _solved(exposure: Exposure, inverse: FloatArray, phase: FloatArray) -> FloatArray:
    """Displacement (2, n) that weighted phases (m, n) tell of, mas."""
    turns = exposure.uv.T @ phase / (-2.0 * np.pi)
    return np.asarray(np.einsum("ijn,jn->in", inverse, turns))


def off_axis_of(
    data: Observables, first: IntArray, sign: FloatArray, uv: FloatArray, exposure: FloatArray
) -> OffAxis | None:
    """Response at points ``first`` of a list of all V² and then all legs of the triangles.

    ``sign`` (n,) is −1 where the point is the opposite of the baseline's own; ``uv`` (n, 2)
    are the points, cycles per radian, and ``exposure`` (n, 2) their setup and date.
    """
    if all(s.response is None for s in data.setups):
        return None
    v2, cp = data.vis2, data.closure_phase
    cp = cp.select(~stands_alone(cp.stations))
    # The third leg closes the triangle: from its last station back to its first.
    legs = np.concatenate([v2.stations, cp.stations[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)])
    # Kernel phases, whose points come last, have no stations and no such response.
    legs = np.pad(legs, ((0, max(int(first.max()) + 1 - len(legs), 0)), (0, 0)))[first]
    exposures = []
    for setup, mjd in np.unique(exposure, axis=0):
        response = data.setups[int(setup)].response
        if response is None:
            continue
        rows = np.flatnonzero((exposure == (setup, mjd)).all(axis=1))
        a, b = legs[rows].T
        fringe = response.coefficients[a, b].astype(complex)
        fringe = np.where(sign[rows, None, None] < 0.0, fringe.conj(), fringe)
        index, weight = bspline_weights(
            (response.to_node @ response.pointing)[:, None], response.n_nodes
        )
        whole = np.stack([*fringe, response.coefficients[a[0], a[0]]]).reshape(len(rows) + 1, -1)
        whole /= whole[:, index[0]] @ weight[0, 0][:, None]
        exposures.append(
            Exposure(
                rows,
                uv[rows] * MAS,
                np.vstack([whole[:-1].real, whole[:-1].imag, whole[-1:].real]).T,
                response.n_nodes,
                response.to_node * MAS,
                response.pointing / MAS,
                response.symmetric,
            )
        )
    return OffAxis(len(first), tuple(exposures))

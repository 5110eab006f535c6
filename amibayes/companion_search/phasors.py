"""exp(−2πi(uα + vδ)) over a lattice: products of factors made once per axis."""

from __future__ import annotations

import numpy as np

from amibayes.models.uv_points import UVPoints
from amibayes.units import MAS, FloatArray

WIDTH = 128
"""Most positions that are worked on at once: what fits a processor's cache."""


NUDGE = 1e-7
"""Radians; keeps sin(x)/x away from 0/0 at a relative cost below 1e-8."""


class LatticePhasors:
    """Cosine and sine of 2π(uα + vδ) over rows of the lattice, damped by the channel's width.

    Sums of angles become products of factors made once per axis. The half angles are moved
    off zero by `NUDGE`, so that sin(x)/x needs no special case.

    Parameters
    ----------
    samples : UVPoints
    axis : (n,) float array
        Coordinates of the lattice along east and along north, mas.
    smearing : bool
    turn : (n_samples,) float array, optional
        Angle added to every position's, such as that of a motion since a date.
    """

    def __init__(
        self,
        samples: UVPoints,
        axis: FloatArray,
        smearing: bool,
        turn: FloatArray | None = None,
    ) -> None:
        self._smearing = smearing
        angles = [2.0 * np.pi * MAS * np.outer(f, axis) for f in (samples.u, samples.v)]
        if turn is not None:
            angles[1] += turn[:, None]
        self._east, self._north = [(np.cos(a), np.sin(a)) for a in angles]
        half = [0.5 * samples.relative_band[:, None] * a for a in angles]
        half[1] += NUDGE
        self._half_east, self._half_north = [(h, np.cos(h), np.sin(h)) for h in half]
        self._work = np.empty((4, len(samples) * min(WIDTH, len(axis))))

    def __call__(self, columns: slice, row: int) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine, (n_samples, n_columns) each; overwritten by the next call."""
        width = columns.stop - columns.start
        shape = (4, len(self._half_east[0]), width)
        cosine, sine, damping, spare = self._work[:, : shape[1] * width].reshape(shape)
        (ca, sa), (cb, sb) = self._east, self._north
        _cosine_of_sum(ca[:, columns], sa[:, columns], cb[:, [row]], sb[:, [row]], cosine, spare)
        _sine_of_sum(ca[:, columns], sa[:, columns], cb[:, [row]], sb[:, [row]], sine, spare)
        if self._smearing:
            (xa, ca, sa), (xb, cb, sb) = self._half_east, self._half_north
            _sine_of_sum(ca[:, columns], sa[:, columns], cb[:, [row]], sb[:, [row]], damping, spare)
            np.add(xa[:, columns], xb[:, [row]], out=spare)
            damping /= spare
            cosine *= damping
            sine *= damping
        return cosine, sine


def _cosine_of_sum(
    ca: FloatArray,
    sa: FloatArray,
    cb: FloatArray,
    sb: FloatArray,
    out: FloatArray,
    spare: FloatArray,
) -> None:
    np.multiply(ca, cb, out=out)
    np.multiply(sa, sb, out=spare)
    out -= spare


def _sine_of_sum(
    ca: FloatArray,
    sa: FloatArray,
    cb: FloatArray,
    sb: FloatArray,
    out: FloatArray,
    spare: FloatArray,
) -> None:
    np.multiply(sa, cb, out=out)
    np.multiply(ca, sb, out=spare)
    out += spare

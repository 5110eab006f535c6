"""How closure phases and kernel phases are sums of phases at points of the (u, v) plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.data.kernel_model import stands_alone
from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.units import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class PhaseSums:
    """Points that phases are needed at, and the sums that the data are: rows, points, weights.

    Parameters
    ----------
    u_m, v_m : (n,) float array
        Metres.
    owner : (n,) int array
        An entry of the table that has the point's wavelength, setup and date.
    row, column : (m,) int array
        Entry of the table, and point, of every term of the sums.
    weight : (m,) float array
    """

    u_m: FloatArray
    v_m: FloatArray
    owner: IntArray
    row: IntArray
    column: IntArray
    weight: FloatArray


def phase_sums(data: Observables) -> PhaseSums:
    """Sums that the unflagged closure and kernel phases are; points of the triangles first."""
    table = data.closure_phase
    alone = stands_alone(table.stations)
    parts = [_of_triangles(table, np.flatnonzero(~alone))]
    key = np.stack([table.setup, table.channel], axis=1)
    for setup, channel, mjd in sorted(
        {(*k, d) for k, d in zip(key[alone].tolist(), table.mjd[alone].tolist(), strict=True)}
    ):
        same = alone & (table.setup == setup) & (table.channel == channel) & (table.mjd == mjd)
        parts.append(_of_kernels(data, np.flatnonzero(same)))
    starts = np.cumsum([0, *(len(p.u_m) for p in parts)])
    shifted = [p.column + start for p, start in zip(parts, starts, strict=False)]
    return PhaseSums(
        np.concatenate([p.u_m for p in parts]),
        np.concatenate([p.v_m for p in parts]),
        np.concatenate([p.owner for p in parts]),
        np.concatenate([p.row for p in parts]),
        np.concatenate(shifted),
        np.concatenate([p.weight for p in parts]),
    )


def _of_triangles(table: Measurements, entries: IntArray) -> PhaseSums:
    """The three legs of each triangle, the third back to where the first begins."""
    u, v = table.u_m[entries], table.v_m[entries]
    u3 = np.concatenate([u, -u.sum(axis=1, keepdims=True)], axis=1)
    v3 = np.concatenate([v, -v.sum(axis=1, keepdims=True)], axis=1)
    owner = np.repeat(entries, 3)
    return PhaseSums(
        u3.ravel(), v3.ravel(), owner, owner, np.arange(len(owner)), np.ones(len(owner))
    )


def _of_kernels(data: Observables, entries: IntArray) -> PhaseSums:
    """All points of the pupil at one wavelength and date, for kernel phases of one setup."""
    table = data.closure_phase
    model = data.setups[int(table.setup[entries[0]])].kernel
    if model is None:
        raise ValueError("kernel phases need the kernel model of their setup")
    weight = model.matrix[table.stations[entries, 0]]
    n = len(model.u_m)
    return PhaseSums(
        model.u_m,
        model.v_m,
        np.full(n, entries[0]),
        np.repeat(entries, n),
        np.tile(np.arange(n), len(entries)),
        weight.ravel(),
    )

"""Numbers of one kind, squared visibilities or closure phases, and the exposures they are of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from amibayes.data.closure import closure_matrix
from amibayes.units import BoolArray, FloatArray, IntArray, freeze

SIMULTANEOUS_S = 17.0
"""Rows of one setup nearer in time than this, or than they were integrated, go together."""

DAY_S = 86400.0


@dataclass(frozen=True, eq=False)
class Measurements:
    """Numbers of one kind, squared visibilities or closure phases, one entry per number.

    Parameters
    ----------
    value : (n,) float array
        V² (dimensionless) or closure phase (radians).
    u_m, v_m : (n, k) float array
        Metres; k = 1 for V², 2 for closure phases (first two baselines of the triangle,
        the third closes it: V(1)·V(2)·V*(1+2)).
    wavelength_m, band_m : (n,) float array
    mjd, integration_s : (n,) float array
    stations : (n, k + 1) int array
        Positions in `Setup.stations`.
    setup, row, channel : (n,) int array
        Which `Setup`, which table row and which spectral channel each entry comes from.
    flag : (n,) bool array
        True where the number must not be used.
    expected : (n,) float array, optional
        The same numbers as a fit has them. A gain that channels share is in proportion to these:
        measured ones have noise, and would draw fits towards zero (Peelle's puzzle).
    coherent_slope : (n,) float array, optional
        Root-mean-square change by an error of 1 in the complex visibility of each point:
        2|V| of V², √Σ 1/|V|² (radians) of closure phases, V as a fit has it.
    """

    value: FloatArray
    u_m: FloatArray
    v_m: FloatArray
    wavelength_m: FloatArray
    band_m: FloatArray
    mjd: FloatArray
    integration_s: FloatArray
    stations: IntArray
    setup: IntArray
    row: IntArray
    channel: IntArray
    flag: BoolArray
    expected: FloatArray | None = None
    coherent_slope: FloatArray | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            column = getattr(self, field.name)
            if column is not None and len(column) != len(self.value):
                raise ValueError(f"{field.name} has another length than value")
        freeze(self)

    def __len__(self) -> int:
        return len(self.value)

    def select(self, keep: IntArray | BoolArray) -> Measurements:
        """The entries ``keep``, in that order."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        present = {name: column[keep] for name, column in columns.items() if column is not None}
        return Measurements(**present)

    @property
    def baseline_m(self) -> FloatArray:
        """Lengths (n,) of baselines; of closure phases those of the first one."""
        return np.hypot(self.u_m[:, 0], self.v_m[:, 0])

    @property
    def frequency(self) -> FloatArray:
        """The same in cycles per radian, (n,)."""
        return np.asarray(self.baseline_m / self.wavelength_m)

    @cached_property
    def sets(self) -> tuple[IntArray, ...]:
        """Of closure phases: the entries of each exposure and channel, which share baselines."""
        if not len(self):
            return ()
        key = np.stack([exposure_labels(self), self.channel], axis=1)
        order = np.lexsort((self.row, key[:, 1], key[:, 0]))
        cuts = np.flatnonzero(np.any(np.diff(key[order], axis=0) != 0, axis=1)) + 1
        return tuple(np.split(order, cuts))

    @cached_property
    def shared_noise(self) -> csr_array:
        """Covariance K Kᵀ/3 of closure phases whose baseline phases have variance 1/3 each."""
        rows, columns, values = [np.empty(0, np.intp)], [np.empty(0, np.intp)], [np.empty(0)]
        for entries in self.sets:
            matrix, _ = closure_matrix(self.stations[entries])
            rows.append(np.repeat(entries, len(entries)))
            columns.append(np.tile(entries, len(entries)))
            values.append((matrix @ matrix.T / 3.0).ravel())
        where = np.concatenate(rows), np.concatenate(columns)
        return csr_array((np.concatenate(values), where), shape=(len(self), len(self)))

    @classmethod
    def joined(cls, parts: Sequence[Measurements], shifts: IntArray) -> Measurements:
        """Lay parts together, the setups of each counted from ``shifts`` on."""
        every = [f.name for f in fields(parts[0])]
        names = [name for name in every if all(getattr(p, name) is not None for p in parts)]
        columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        columns["setup"] = columns["setup"] + np.repeat(
            shifts[: len(parts)], [len(p) for p in parts]
        )
        return cls(**columns)


def exposure_labels(closure_phase: Measurements) -> IntArray:
    """Number the exposure each closure phase belongs to: one set of triangles at one time.

    Rows of one setup within `SIMULTANEOUS_S` (or their integration time) of each other are
    simultaneous, unless a triangle comes back, which starts the next exposure.
    """
    m = closure_phase
    if not len(m):
        return np.empty(0, dtype=np.intp)
    key = np.stack([m.setup, m.row], axis=1)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    in_time = np.lexsort((m.row[first], m.mjd[first], m.setup[first]))
    label = np.empty(len(first), dtype=np.intp)
    label[in_time] = _count_exposures(m.select(first[in_time]))
    return np.asarray(label[inverse.ravel()])


def _count_exposures(rows: Measurements) -> list[int]:
    label: list[int] = []
    seen: set[tuple[int, ...]] = set()
    for i in range(len(rows)):
        triangle = tuple(sorted(rows.stations[i].tolist()))
        apart = i and (rows.setup[i] != rows.setup[i - 1] or _far_in_time(rows, i))
        if apart or triangle in seen:
            seen = set()
        label.append(label[-1] + (not seen) if label else 0)
        seen.add(triangle)
    return label


def _far_in_time(rows: Measurements, i: int) -> bool:
    """Whether a row begins after the one before it can have ended."""
    overlap = 0.5 * float(np.nan_to_num(rows.integration_s[[i - 1, i]]).sum())
    gap = DAY_S * (rows.mjd[i] - rows.mjd[i - 1])
    return bool(gap > max(SIMULTANEOUS_S, overlap))

"""Fewer numbers of the same data: channels, polarisations and exposures averaged.

Every average is linear, so the covariance of the result is exact. Squared visibilities are
weighted by inverse variance. The closure phases of one exposure and channel share one weight:
averages then still close, whatever the errors of the single triangles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_diag, coo_array, csr_array, triu

from amibayes.calibration.transfer import wrapped
from amibayes.data.closure import canonical, canonical_uv
from amibayes.data.measurements import DAY_S, SIMULTANEOUS_S, Measurements
from amibayes.data.observables import Observables
from amibayes.data.setup import Setup, without_polarisation
from amibayes.data.shared_errors import SharedErrors
from amibayes.errors import UsageError
from amibayes.oifits.correlations import Pairs, given_covariance
from amibayes.units import FloatArray, IntArray

MOVED = 0.02
"""Exposures are merged while (u, v) stays within this part of the baseline."""


def bin_channels(observables: Observables, size: int) -> Observables:
    """Average ``size`` adjacent channels; a rest at the end makes a narrower bin.

    Raises
    ------
    UsageError
        Where ``size`` is below 1.
    """
    if size < 1:
        raise UsageError(f"bins of {size} channels", remedy="give 1 or more")
    setups = tuple(_binned(setup, size) for setup in observables.setups)
    parts = [
        _Groups(m, m.setup, m.row, m.channel // size)
        for m in (observables.vis2, observables.closure_phase)
    ]
    return _averaged(observables, parts, setups, summed_time=False)


def _binned(setup: Setup, size: int) -> Setup:
    starts = np.arange(0, len(setup.wavelength_m), size)
    low = np.minimum.reduceat(setup.wavelength_m - setup.band_m / 2, starts)
    high = np.maximum.reduceat(setup.wavelength_m + setup.band_m / 2, starts)
    count = np.diff([*starts, len(setup.wavelength_m)])
    mean = np.add.reduceat(setup.wavelength_m, starts) / count
    single = count == 1
    band = np.where(single, setup.band_m[starts], high - low)
    return replace(setup, wavelength_m=mean, band_m=band)


def average_polarisations(observables: Observables) -> Observables:
    """Average setups whose INSNAME differs only in a last P1/P2 (``GRAVITY_SC_P1``).

    Raises
    ------
    UsageError
        Where there are no two such setups.
    """
    names = [without_polarisation(s.insname) for s in observables.setups]
    first: dict[tuple[object, ...], int] = {}
    home = np.empty(len(names), dtype=np.intp)
    for i, (name, setup) in enumerate(zip(names, observables.setups, strict=True)):
        key = (name, setup.target, setup.stations, setup.wavelength_m.tobytes())
        home[i] = first.setdefault(key, len(first))
    if len(first) == len(names):
        raise UsageError(
            "has no two polarisations of one instrument",
            source=observables.source,
            remedy="leave --average-polarisations out",
        )
    kept = [home.tolist().index(k) for k in range(len(first))]
    setups = tuple(replace(observables.setups[i], insname=names[i]) for i in kept)
    parts = []
    for m in (observables.vis2, observables.closure_phase):
        ours = home[m.setup]
        parts.append(_Groups(m, ours, _rows(m, ours, SIMULTANEOUS_S / DAY_S), m.channel))
    return _averaged(observables, parts, setups, summed_time=False)


def merge_epochs(observables: Observables, window_days: float) -> Observables:
    """Average the exposures of each baseline and triangle within a time, while (u, v) stays.

    Raises
    ------
    UsageError
        Where the time is not positive.
    """
    if not window_days > 0:
        raise UsageError(f"a time window of {window_days} days", remedy="give a positive one")
    parts = [
        _Groups(m, m.setup, _rows(m, m.setup, window_days, MOVED), m.channel)
        for m in (observables.vis2, observables.closure_phase)
    ]
    return _averaged(observables, parts, observables.setups, summed_time=True)


def _rows(m: Measurements, setup: IntArray, window_days: float, moved: float = np.inf) -> IntArray:
    """Number the rows that belong together: one baseline or triangle, near in time and place."""
    if not len(m):
        return np.empty(0, dtype=np.intp)
    key = np.column_stack([setup, canonical(m.stations)[0]])
    order = np.lexsort((m.mjd, *key.T))
    uv = canonical_uv(m.stations, m.u_m, m.v_m)[order]
    length = np.abs(uv).max(axis=1)
    number, label, begin = 0, np.empty(len(m), dtype=np.intp), 0
    for i in range(len(order)):
        apart = (
            (key[order[i]] != key[order[begin]]).any()
            or m.mjd[order[i]] - m.mjd[order[begin]] > window_days
            or np.abs(uv[i] - uv[begin]).max() > moved * length[begin]
        )
        if apart:
            number, begin = number + 1, i
        label[order[i]] = number
    return label


@dataclass(frozen=True, eq=False)
class _Groups:
    """Which entries are averaged: those of one new setup, row and channel.

    ``setup``, ``row`` and ``channel`` are given by entry; rows of different setups may have
    the same number.
    """

    measurements: Measurements
    setup: IntArray
    row: IntArray
    channel: IntArray

    def rows(self) -> tuple[IntArray, IntArray]:
        """(new row of each entry, numbered through all setups in table order; first entries)."""
        pair = np.stack([self.setup, self.row])
        _, first, row = np.unique(pair, axis=1, return_index=True, return_inverse=True)
        order = np.lexsort((first, self.setup[first]))
        rank = np.empty(len(order), dtype=np.intp)
        rank[order] = np.arange(len(order))
        return rank[row.ravel()], first[order]


def _averaged(
    observables: Observables, parts: list[_Groups], setups: tuple[Setup, ...], *, summed_time: bool
) -> Observables:
    averages = [
        _average_one(groups, weight, setups, summed_time=summed_time)
        for groups, weight in zip(parts, _weights(observables), strict=True)
    ]
    made = [new for new, _ in averages]
    combine = _stacked([matrix for _, matrix in averages])
    covariance = combine @ observables.covariance.sparse @ combine.T
    scatter, shared = observables.scatter, observables.shared
    upper = triu(covariance, 1).tocoo()
    pairs = Pairs(upper.row.astype(np.intp), upper.col.astype(np.intp), upper.data)
    closure = made[1].select(~made[1].flag)
    everywhere = np.ones(covariance.shape[0], dtype=bool)
    return replace(
        observables,
        vis2=made[0],
        closure_phase=made[1],
        setups=setups,
        covariance=given_covariance(
            covariance.diagonal(),
            pairs,
            closure,
            covered=everywhere,
            independent=everywhere & (observables.covariance_kind == "diagonal"),
        ),
        scatter=None if scatter is None else csr_array(combine @ scatter @ combine.T),
        shared=None if shared is None else SharedErrors(shared.names, combine @ shared.changes),
    )


def _weights(observables: Observables) -> tuple[FloatArray, FloatArray]:
    """Weights of V², and of closure phases (one for each exposure and channel); 0 if flagged."""
    vis2, closure = (np.nan_to_num(sigma, nan=np.inf) for sigma in observables.errors)
    shared = np.zeros(len(closure))
    used = np.flatnonzero(~observables.closure_phase.flag)
    for entries in observables.closure_phase.select(used).sets:
        shared[used[entries]] = 1.0 / (closure[used[entries]] ** 2).mean()
    return 1.0 / vis2**2, shared


def _average_one(
    groups: _Groups, weight: FloatArray, setups: tuple[Setup, ...], *, summed_time: bool
) -> tuple[Measurements, csr_array]:
    """The averaged measurements, and the matrix that makes the unflagged ones."""
    m = groups.measurements
    if not len(m):
        return m, csr_array((0, 0))
    row, row_first = groups.rows()
    cell, group = np.unique(np.stack([row, groups.channel]), axis=1, return_inverse=True)
    group, n = group.ravel(), cell.shape[1]
    sign = np.ones(len(m), dtype=np.intp)
    if m.stations.shape[1] == 3:
        sign = canonical(m.stations)[1]
        sign = sign * sign[row_first][row]
    total = np.bincount(group, weight, n)
    share = np.divide(weight, total[group], out=np.zeros(len(m)), where=total[group] > 0)
    value = _on_one_branch(np.where(m.flag, 0.0, m.value) * sign, weight, group, n, m)
    flag = total == 0
    matrix = coo_array(
        (
            (share * sign)[~m.flag],
            ((np.cumsum(~flag) - 1)[group[~m.flag]], np.arange(int((~m.flag).sum()))),
        ),
        shape=(int((~flag).sum()), int((~m.flag).sum())),
    )
    new = _places(groups, row, row_first, cell, setups, summed_time=summed_time)
    mean = np.where(flag, np.nan, np.bincount(group, share * value, n))
    return replace(new, value=mean, flag=flag), csr_array(matrix)


def _on_one_branch(
    value: FloatArray, weight: FloatArray, group: IntArray, n: int, m: Measurements
) -> FloatArray:
    """Closure phases of a group within half a turn of its first; V² as they are."""
    if m.stations.shape[1] == 2:
        return value
    first = np.zeros(n)
    used = np.flatnonzero(weight > 0)[::-1]
    first[group[used]] = value[used]
    return np.where(weight > 0, first[group] + wrapped(value - first[group]), 0.0)


def _places(
    groups: _Groups,
    row: IntArray,
    row_first: IntArray,
    cell: IntArray,
    setups: tuple[Setup, ...],
    *,
    summed_time: bool,
) -> Measurements:
    """New entries, one for each cell (row, channel), at the mean place and time of their rows.

    Their values and flags are still those of some entry of the row.
    """
    m = groups.measurements
    _, old = np.unique(np.stack([m.setup, m.row]), axis=1, return_index=True)
    home = row[old]
    same_way = (m.stations[old] == m.stations[row_first][home]).all(axis=1)
    count = np.bincount(home, same_way)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(home, np.where(same_way, values[old], 0.0)) / count)

    seconds = np.bincount(home, m.integration_s[old]).astype(float)
    if not summed_time:
        seconds /= np.bincount(home)
    of_row, channel = cell
    setup = groups.setup[row_first]
    begin = np.searchsorted(setup, setup)
    like = m.select(row_first[of_row])
    waves, bands = ([getattr(s, n) for s in setups] for n in ("wavelength_m", "band_m"))
    pairs = list(zip(setup[of_row].tolist(), channel.tolist(), strict=True))
    return replace(
        like,
        setup=setup[of_row],
        row=(np.arange(len(setup)) - begin)[of_row],
        channel=channel,
        wavelength_m=np.array([waves[s][c] for s, c in pairs]),
        band_m=np.array([bands[s][c] for s, c in pairs]),
        u_m=np.stack([mean(x) for x in m.u_m.T], axis=1)[of_row],
        v_m=np.stack([mean(x) for x in m.v_m.T], axis=1)[of_row],
        mjd=mean(m.mjd)[of_row],
        integration_s=seconds[of_row],
    )


def _stacked(blocks: list[csr_array]) -> csr_array:
    """The two matrices along the diagonal of one."""
    present = [b for b in blocks if b.shape[0]]
    return csr_array(block_diag(present)) if present else csr_array((0, 0))

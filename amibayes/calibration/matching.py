"""Which number of a calibrator belongs to which number of a target.

Both are reduced to *keys*: one per baseline or triangle, channel and epoch of the target.
A baseline or triangle is the set of its stations, so that their order in a file does not
matter; turning a triangle round turns the sign of its closure phase.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amibayes.data.closure import canonical
from amibayes.data.kernel_model import stands_alone
from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.setup import Setup
from amibayes.units import BoolArray, FloatArray, IntArray

SAME_CHANNEL = 0.1
"""Channels are one where their wavelengths differ by less than this part of their width."""

SAME_WAVELENGTH = 1e-3
"""… or, where a file gives no width, by less than this part of the wavelength."""

SAME_PLACE = 0.02
"""Stations are one where they are nearer than this part of the shortest baseline."""


@dataclass(frozen=True, eq=False)
class Configuration:
    """An instrument configuration of the target and the setups that share it."""

    setup: Setup
    members: tuple[int, ...]
    position: FloatArray


@dataclass(frozen=True, eq=False)
class Keys:
    """The keys of a target: V² keys first, then closure-phase keys.

    Parameters
    ----------
    configurations : tuple of Configuration
    epochs : (n_epochs, 2) float array
        First and last date at which calibrators may serve each epoch.
    n_vis2 : int
        Number of V² keys.
    table : (n_keys, 6) int array
        Configuration, epoch, channel and the stations in rising order (−1 for V²'s third).
    key, sign : (n,) int array
        Of each unflagged number of the target.
    independent : bool
        Every closure phase stands alone (independent errors were asked for).
    """

    configurations: tuple[Configuration, ...]
    epochs: FloatArray
    n_vis2: int
    table: IntArray
    key: IntArray
    sign: IntArray
    independent: bool

    def __len__(self) -> int:
        return len(self.table)

    @property
    def periodic(self) -> BoolArray:
        """Which keys are phases with a period of 2π: closure phases, not kernel phases."""
        stations = self.table[:, 3:]
        return np.asarray((stations[:, 2] >= 0) & ~stands_alone(stations))

    def closure_sets(self) -> list[IntArray]:
        """Keys of closure phases that share baselines: of one configuration, epoch and channel."""
        closures = np.arange(self.n_vis2, len(self))
        if self.independent or not len(closures):
            return [closures[i : i + 1] for i in range(len(closures))]
        _, label = np.unique(self.table[closures, :3], axis=0, return_inverse=True)
        order = np.argsort(label.ravel(), kind="stable")
        cuts = np.flatnonzero(np.diff(label.ravel()[order])) + 1
        return list(np.split(closures[order], cuts))


@dataclass(frozen=True, eq=False)
class Match:
    """Which unflagged numbers of a calibrator serve which keys, with which sign."""

    entry: IntArray
    key: IntArray
    sign: IntArray


def keys_of(target: Observables, window_days: float | None = None) -> Keys:
    """Reduce a target to its keys.

    Parameters
    ----------
    window_days : float, optional
        Observations further apart are epochs of their own, served by the calibrators within
        that time of them; without it one epoch is served by all calibrators.
    """
    configurations = _configurations(target)
    of_setup = np.empty(len(target.setups), dtype=np.intp)
    for number, configuration in enumerate(configurations):
        of_setup[list(configuration.members)] = number
    parts = [m.select(~m.flag) for m in (target.vis2, target.closure_phase)]
    epochs = _epochs(np.concatenate([m.mjd for m in parts]), window_days)
    tables: list[IntArray] = []
    keys, signs = [], []
    for m in parts:
        epoch = np.searchsorted(epochs[:, 0], m.mjd, side="right") - 1
        rows, sign = _rows(m, of_setup[m.setup], epoch, m.channel, m.stations)
        table, key = np.unique(rows, axis=0, return_inverse=True)
        keys.append(key.ravel() + (len(tables[0]) if tables else 0))
        tables.append(table)
        signs.append(sign)
    return Keys(
        configurations,
        epochs,
        len(tables[0]),
        np.concatenate(tables),
        np.concatenate(keys),
        np.concatenate(signs),
        target.covariance_kind == "diagonal",
    )


def _rows(
    m: Measurements,
    configuration: IntArray,
    epoch: IntArray,
    channel: IntArray,
    stations: IntArray,
) -> tuple[IntArray, IntArray]:
    ordered, sign = canonical(stations)
    third = np.full((len(m), 3 - ordered.shape[1]), -1)
    columns = [configuration[:, None], epoch[:, None], channel[:, None], ordered, third]
    return np.concatenate(columns, axis=1).astype(np.intp), sign


def _epochs(mjd: FloatArray, window_days: float | None) -> FloatArray:
    """First and last date of service of each epoch, (n_epochs, 2)."""
    if window_days is None:
        return np.array([[-np.inf, np.inf]])
    dates = np.unique(mjd)
    cuts = np.flatnonzero(np.diff(dates) > window_days) + 1
    spans = [(part[0], part[-1]) for part in np.split(dates, cuts)]
    return np.asarray(np.array(spans) + np.array([-window_days, window_days]))


def _configurations(target: Observables) -> tuple[Configuration, ...]:
    """Setups of one instrument, one set of stations and one set of channels are one."""
    found: dict[tuple[object, ...], list[int]] = {}
    for number, setup in enumerate(target.setups):
        channels = tuple(np.round(setup.wavelength_m * 1e12).astype(int))
        found.setdefault((setup.insname, setup.stations, channels), []).append(number)
    return tuple(
        Configuration(target.setups[m[0]], tuple(m), station_positions(target, m[0]))
        for m in found.values()
    )


def match(calibrator: Observables, keys: Keys) -> Match:
    """Find the unflagged numbers of a calibrator that serve the keys of a target."""
    found = [
        _match_setup(calibrator, keys, number, setup)
        for number in range(len(keys.configurations))
        for setup in _serving_setups(calibrator, keys.configurations[number].setup)
    ]
    empty = np.empty(0, dtype=np.intp)
    entry, key, sign = (
        np.concatenate([empty, *(np.concatenate(m[i]) for m in found)]) for i in range(3)
    )
    return Match(entry, key, sign)


def sharing(observations: Sequence[Observables]) -> BoolArray:
    """Whether each (column) can serve as a calibrator of each other (row), (n, n)."""
    keys = [keys_of(o) for o in observations]
    return np.array([[len(match(o, k).key) > 0 for o in observations] for k in keys], dtype=bool)


def _serving_setups(calibrator: Observables, setup: Setup) -> list[int]:
    """Setups of a calibrator that may serve: those of the same INSNAME, or all."""
    names = [s.insname for s in calibrator.setups]
    return [
        i for i, name in enumerate(names) if name == setup.insname or setup.insname not in names
    ]


def foreign(calibrator: Observables, keys: Keys) -> str:
    """Say so where a calibrator of another INSNAME serves a target, else an empty text."""
    names = {s.insname for s in calibrator.setups}
    wanted = {c.setup.insname for c in keys.configurations}
    if names & wanted:
        return ""
    return (
        f"calibrator {calibrator.source} is of INSNAME {', '.join(sorted(names))} and not of "
        f"{', '.join(sorted(wanted))}: it was matched by stations and wavelength"
    )


def _match_setup(
    calibrator: Observables, keys: Keys, number: int, setup: int
) -> tuple[list[IntArray], list[IntArray], list[IntArray]]:
    configuration = keys.configurations[number]
    station = _station_map(configuration, calibrator, setup)
    channel = _channel_map(configuration.setup, calibrator.setups[setup])
    entries, served, signs = [], [], []
    start = 0
    for m in (calibrator.vis2, calibrator.closure_phase):
        m = m.select(~m.flag)
        usable = (m.setup == setup) & (channel[np.where(m.setup == setup, m.channel, 0)] >= 0)
        usable &= (station[np.where((m.setup == setup)[:, None], m.stations, 0)] >= 0).all(axis=1)
        for epoch, (first, last) in enumerate(keys.epochs):
            chosen = np.flatnonzero(usable & (m.mjd >= first) & (m.mjd <= last))
            few = m.select(chosen)
            constant = np.full(len(few), number), np.full(len(few), epoch)
            rows, sign = _rows(few, *constant, channel[few.channel], station[few.stations])
            key = _lookup(keys.table, rows)
            entries.append(start + chosen[key >= 0])
            served.append(key[key >= 0])
            signs.append(sign[key >= 0])
        start += len(m)
    return entries, served, signs


def _lookup(table: IntArray, rows: IntArray) -> IntArray:
    """Place of each row in the table, −1 where it is not there."""
    if not len(rows) or not len(table):
        return np.full(len(rows), -1)
    limits = np.maximum(table.max(axis=0), rows.max(axis=0)) + 2
    place = np.concatenate([np.cumprod(limits[:0:-1])[::-1], [1]])
    codes, wanted = (table + 1) @ place, (rows + 1) @ place
    order = np.argsort(codes)
    found = order[np.minimum(np.searchsorted(codes[order], wanted), len(codes) - 1)]
    return np.where(codes[found] == wanted, found, -1)


def _channel_map(target: Setup, calibrator: Setup) -> IntArray:
    """The target's channel of each channel of the calibrator, −1 for none."""
    apart = np.abs(calibrator.wavelength_m[:, None] - target.wavelength_m)
    near = np.argmin(apart, axis=1)
    width = np.maximum(
        SAME_CHANNEL * target.band_m[near], SAME_WAVELENGTH * target.wavelength_m[near]
    )
    return np.where(apart.min(axis=1) <= width, near, -1)


def _station_map(configuration: Configuration, calibrator: Observables, setup: int) -> IntArray:
    """The target's station of each station of the calibrator, −1 for none.

    Stations are known by name; where no two names are shared, by their positions in the
    mask or array, and last by the (u, v) coordinates of their baselines. Kernel phases are
    one where they have one name, which depends on the kernel matrix.
    """
    other = calibrator.setups[setup]
    names = {name.casefold(): i for i, name in enumerate(configuration.setup.stations)}
    by_name = np.array([names.get(s.casefold(), -1) for s in other.stations], dtype=np.intp)
    kernels = configuration.setup.kernel is not None or other.kernel is not None
    if kernels or (by_name >= 0).sum() >= 2:
        return by_name
    if configuration.setup.station_xyz_m is not None and other.station_xyz_m is not None:
        found = _nearest(configuration.setup.station_xyz_m, other.station_xyz_m)
        if (found >= 0).sum() >= 2:
            return found
    return _nearest(configuration.position, station_positions(calibrator, setup))


def station_positions(observables: Observables, setup: int) -> FloatArray:
    """Positions (n_stations, 2) that the (u, v) of the baselines imply; NaN where unknown.

    Their common shift is free; every baseline (a, b) is the position of b less that of a.
    """
    m, n = observables.vis2, len(observables.setups[setup].stations)
    pairs, first = np.unique(m.stations[m.setup == setup], axis=0, return_index=True)
    out = np.full((n, 2), np.nan)
    if not len(pairs):
        return out
    ours = np.flatnonzero(m.setup == setup)[first]
    incidence = np.zeros((len(pairs), n))
    incidence[np.arange(len(pairs)), pairs[:, 1]] = 1.0
    incidence[np.arange(len(pairs)), pairs[:, 0]] = -1.0
    baselines = np.concatenate([m.u_m[ours], m.v_m[ours]], axis=1)
    used = np.unique(pairs)
    out[used] = np.linalg.lstsq(incidence[:, used], baselines, rcond=None)[0]
    return out


def _nearest(target: FloatArray, calibrator: FloatArray) -> IntArray:
    """Match two constellations that may be shifted, by the vectors between their stations."""
    between, other = (p[None] - p[:, None] for p in (target, calibrator))
    length = np.linalg.norm(between, axis=2)
    shortest = np.nanmin(np.where(length > 0, length, np.nan), initial=np.inf)
    agree = np.zeros((len(calibrator), len(target)), dtype=np.intp)
    for j in range(len(calibrator)):
        for i in range(len(target)):
            apart = np.linalg.norm(other[j][:, None] - between[i][None], axis=2)
            agree[j, i] = (np.nan_to_num(apart, nan=np.inf) < SAME_PLACE * shortest).sum()
    best = np.argmax(agree, axis=1)
    # A station always agrees with itself; one more that agrees makes a baseline.
    certain = (agree.max(axis=1) >= 2) & ((agree == agree.max(axis=1)[:, None]).sum(axis=1) == 1)
    return np.where(certain, best, -1)

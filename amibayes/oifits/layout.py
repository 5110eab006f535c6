"""Where each entry of a data set goes in the tables of a file, and what the tables are called."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.setup import Setup
from amibayes.oifits.rows import T3, VIS2, Kind
from amibayes.units import IntArray

UNKNOWN = "UNKNOWN"


@dataclass(frozen=True, eq=False)
class Layout:
    """Which targets, arrays and wavelength tables the setups share, and what they are called.

    ``target``, ``array`` and ``channel`` give the number of each setup's entry in ``targets``,
    ``arrays`` and ``channels``, which hold one setup each that shows it.
    """

    setups: tuple[Setup, ...]
    target: list[int]
    array: list[int]
    channel: list[int]
    targets: list[Setup]
    arrays: list[Setup]
    channels: list[Setup]
    arrnames: list[str]
    insnames: list[str]

    @classmethod
    def of(cls, observables: Observables) -> Layout:
        """Compare the setups of a data set."""
        setups = observables.setups
        target, targets = _shared(setups, ["target", "right_ascension_deg", "declination_deg"])
        array, arrays = _shared(
            setups,
            [
                "arrname",
                "stations",
                "station_index",
                "station_xyz_m",
                "station_diameter_m",
                "array_frame",
                "array_centre_m",
            ],
        )
        channel, channels = _shared(setups, ["insname", "wavelength_m", "band_m"])
        arrnames = _distinct([printable(s.arrname) or UNKNOWN for s in arrays])
        insnames = _distinct([printable(s.insname) or UNKNOWN for s in channels])
        return cls(setups, target, array, channel, targets, arrays, channels, arrnames, insnames)

    def station_index(self, setup: int) -> IntArray:
        """STA_INDEX of a setup's stations: its own, or from 1 on where they begin below 1."""
        index = self.setups[setup].station_index
        return index if index.min(initial=1) >= 1 else np.arange(1, len(index) + 1)


def printable(text: str) -> str:
    """The text in the characters that FITS has, others as Python's escapes."""
    return "".join(c if " " <= c <= "~" else c.encode("unicode_escape").decode() for c in text)


def _shared(setups: tuple[Setup, ...], names: list[str]) -> tuple[list[int], list[Setup]]:
    """Number the setups by what they have in common."""
    numbers: dict[Any, int] = {}
    found: list[Setup] = []
    out = []
    for setup in setups:
        values = [getattr(setup, name) for name in names]
        key = tuple(v.tobytes() if isinstance(v, np.ndarray) else v for v in values)
        if key not in numbers:
            numbers[key] = len(found)
            found.append(setup)
        out.append(numbers[key])
    return out, found


def _distinct(names: list[str]) -> list[str]:
    """The names, with a number where one comes again."""
    out: list[str] = []
    for name in names:
        count, candidate = 1, name
        while candidate in out:
            count += 1
            candidate = f"{name}_{count}"
        out.append(candidate)
    return out


@dataclass(frozen=True, eq=False)
class Grid:
    """Where the entries of one kind and one setup go in a table of rows and channels.

    Parameters
    ----------
    kind : Kind
    setup : int
    entries : (n,) int array
        Of the `Measurements`.
    cell : (n,) int array
        Their cells, row by row.
    first : (n_rows,) int array
        One entry of each row.
    n_channels : int
    start : int
        Number of cells in the tables before this one: the place in the correlation matrix.
    in_order : bool
        The entries of this kind fill all cells one after the other.
    """

    kind: Kind
    setup: int
    entries: IntArray
    cell: IntArray
    first: IntArray
    n_channels: int
    start: int
    in_order: bool

    def spread(self, values: NDArray[Any], absent: Any) -> NDArray[Any]:
        """Values of the entries as (rows, channels)."""
        out = np.full(len(self.first) * self.n_channels, absent)
        out[self.cell] = values
        return out.reshape(len(self.first), self.n_channels)


def grids_of(observables: Observables) -> list[Grid]:
    """One grid per setup and kind, setup by setup."""
    grids: list[Grid] = []
    ordered = {
        kind: _fills_tables(m, observables.setups)
        for kind, m in ((VIS2, observables.vis2), (T3, observables.closure_phase))
    }
    start = 0
    for number, setup in enumerate(observables.setups):
        for kind, m in ((VIS2, observables.vis2), (T3, observables.closure_phase)):
            entries = np.flatnonzero(m.setup == number)
            if len(entries):
                grid = _grid(kind, m, number, setup, entries, start, ordered[kind])
                grids.append(grid)
                start += len(grid.first) * grid.n_channels
    return grids


def _grid(
    kind: Kind,
    m: Measurements,
    number: int,
    setup: Setup,
    entries: IntArray,
    start: int,
    in_order: bool,
) -> Grid:
    n_channels = len(setup.wavelength_m)
    _, first, row = np.unique(m.row[entries], return_index=True, return_inverse=True)
    cell = row.ravel() * n_channels + m.channel[entries]
    if len(np.unique(cell)) != len(cell):
        raise ValueError(f"two entries of {kind.table} have the same setup, row and channel")
    same_row = entries[first][row.ravel()]
    for name in ("u_m", "v_m", "mjd", "integration_s", "stations"):
        values = getattr(m, name)
        if not np.array_equal(values[entries], values[same_row], equal_nan=name != "stations"):
            raise ValueError(f"{name} differs between the channels of a row of {kind.table}")
    for name in ("wavelength_m", "band_m"):
        channels = getattr(setup, name)[m.channel[entries]]
        if not np.array_equal(getattr(m, name)[entries], channels, equal_nan=True):
            raise ValueError(f"{name} of {kind.table} is not that of its setup's channels")
    return Grid(kind, number, entries, cell, entries[first], n_channels, start, in_order)


def _fills_tables(m: Measurements, setups: tuple[Setup, ...]) -> bool:
    """Whether the entries are the cells of full tables in their order."""
    width = np.array([len(s.wavelength_m) for s in setups])[m.setup]
    order = np.lexsort((m.channel, m.row, m.setup))
    if not np.array_equal(order, np.arange(len(m))):
        return False
    rows, count = np.unique(np.stack([m.setup, m.row]), axis=1, return_counts=True)
    expected = np.array([len(s.wavelength_m) for s in setups])[rows[0]]
    return bool(len(width) == expected.sum() and (count == expected).all())


def measurements_of(observables: Observables, kind: Kind) -> Measurements:
    """The squared visibilities or the closure phases."""
    return observables.vis2 if kind is VIS2 else observables.closure_phase

"""Rows of OI_VIS2 and OI_T3 as `Measurements`, with errors, flags and correlation indices."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.data.measurements import Measurements
from amibayes.errors import DataError
from amibayes.oifits.columns import coordinates, integers, numbers, rest_of
from amibayes.oifits.dates import mjd_of_date
from amibayes.oifits.scales import ANGLE, TIME, scale_of
from amibayes.oifits.tables import OIFits, OITable
from amibayes.units import BoolArray, FloatArray, IntArray

DAY_S = 86400.0


@dataclass(frozen=True)
class Kind:
    """Which columns hold one kind of data, and what is impossible and not used.

    No calibration error makes a visibility of 100: a V² past ``largest_value`` is a fault, and so
    is one below ``least_value``, such as -9999: only noise is negative, and it is smaller. A
    phase past it stands for "no value" (1e20, 9.97e36, …), and any other has its turns.
    """

    table: str
    value: str
    error: str
    u: tuple[str, ...]
    v: tuple[str, ...]
    is_angle: bool
    largest_error: float
    largest_value: float
    least_value: float

    @property
    def index(self) -> str:
        """Column of the first index into the correlation matrix."""
        return f"CORRINDX_{self.value}"


VIS2 = Kind("OI_VIS2", "VIS2DATA", "VIS2ERR", ("UCOORD",), ("VCOORD",), False, 100.0, 1e4, -10.0)
T3 = Kind(
    "OI_T3",
    "T3PHI",
    "T3PHIERR",
    ("U1COORD", "U2COORD"),
    ("V1COORD", "V2COORD"),
    True,
    np.pi,
    1e10,
    -1e10,
)
KINDS = {kind.table: kind for kind in (VIS2, T3)}

MIN_BLANK = 4
"""Closure phases of a table that are exactly 0, all of them: not one of so many was measured."""

MIN_ERROR = 1e-12
"""An error below this is none: it would outweigh everything else."""


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of one data table that belong to one setup.

    Parameters
    ----------
    measurements : Measurements
        One entry per row and channel, rows in file order, channels running fastest.
    variance : (n,) float array
        Squared errors (radians² for phases); NaN where there is none.
    correlation_index : (n,) int array
        1-based index into the correlation matrix ``corrname``; 0 where there is none.
    corrname : str
    place : (n,) int array
        Entry's own place in the data set that was written (1-based), 0 for a cell that
        holds nothing; empty where the file does not say.
    insname : str
        INSNAME keyword of the table.
    independent : bool
        The file says that its closure phases are to be taken as independent.
    notes : tuple of str
    unused : str
        How many values are flagged, and why.
    """

    measurements: Measurements
    variance: FloatArray
    correlation_index: IntArray
    corrname: str
    place: IntArray
    insname: str
    independent: bool = False
    notes: tuple[str, ...] = field(default=())
    unused: str = ""


def grid(oifits: OIFits, table: OITable, name: str, n_channels: int) -> FloatArray:
    """A required column of one number per row and channel, (rows, channels).

    Raises
    ------
    DataError
        Where its width is not the number of channels.
    """
    values = numbers(oifits, table, name)
    if values.size != len(table) * n_channels:
        raise DataError(
            f"{table.label}: {name} has {values.size // max(len(table), 1)} number(s) in a row "
            f"for {n_channels} channel(s)",
            source=oifits.path,
            remedy="write the file again with matching tables",
        )
    return values.reshape(len(table), n_channels)


def channel_count(oifits: OIFits, table: OITable) -> int:
    """Number of channels of a data table."""
    return numbers(oifits, table, KINDS[table.name].value).size // max(len(table), 1)


def times_of(table: OITable) -> tuple[FloatArray, str]:
    """(MJD of each row, a note): from MJD, or TIME and DATE-OBS where MJD is no full date.

    Version 1 files write the day alone into MJD and the second of that day into TIME.
    """
    count = len(table)
    mjd = _one_number(table, "MJD", np.nan)
    seconds = _one_number(table, "TIME", 0.0) * scale_of(table.units.get("TIME", ""), TIME, "s")[0]
    night = mjd_of_date(table.keyword("DATE-OBS"))
    bad = ~(np.isfinite(mjd) & (mjd != 0))
    # One integer day in every row, and a clock that runs: MJD is only the date.
    is_date = not bad.any() and (mjd == np.floor(mjd)).all() and np.ptp(seconds) > 0
    if is_date:
        return mjd + seconds / DAY_S, f"{table.label}: MJD is a date; TIME was added to it"
    if bad.any() and np.isfinite(night):
        mjd = np.where(bad, night + seconds / DAY_S, mjd)
        return mjd, f"{table.label}: MJD missing; taken from DATE-OBS and TIME"
    if bad.any():
        return np.where(bad, seconds / DAY_S, mjd), f"{table.label}: no date"
    return mjd.reshape(count), ""


def _one_number(table: OITable, name: str, absent: float) -> FloatArray:
    values = table.columns.get(name)
    if values is None or values.dtype.kind not in "fiu" or values.size != len(table):
        return np.full(len(table), absent)
    return values.reshape(len(table)).astype(float)


def _flags(oifits: OIFits, table: OITable, n_channels: int) -> tuple[BoolArray, str]:
    if "FLAG" not in table.columns:
        return np.zeros((len(table), n_channels), dtype=bool), f"{table.label} has no FLAG"
    values = _logical(table.columns["FLAG"])
    if values.shape == (len(table),):
        values = np.repeat(values[:, None], n_channels, axis=1)
    if values.size != len(table) * n_channels:
        raise DataError(f"{table.label}: FLAG has another shape than the data", source=oifits.path)
    return values.reshape(len(table), n_channels).astype(bool), ""


def _logical(values: NDArray[Any]) -> BoolArray:
    """Flags, whatever type a file gives them; a NULL byte, or a blank, is no flag.

    Some programs write the letters T and F as text or as bytes.
    """
    if values.dtype.kind == "U":
        width = values.dtype.itemsize // 4
        letters = np.char.ljust(values, width).view(f"U{1}") if width > 1 else values
        return np.isin(letters.reshape(*values.shape[:1], -1), ["T", "t", "1"])
    if values.dtype.kind in "iu" and np.isin(values, [ord("T"), ord("F"), 0]).all():
        return np.asarray(values == ord("T"))
    if values.dtype.kind not in "biuf":
        return np.zeros(values.shape, dtype=bool)
    return np.asarray(np.nan_to_num(values.astype(float)) != 0)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Value, variance and (u, v) of every cell of a table in SI and radians."""

    value: FloatArray
    variance: FloatArray
    u_m: FloatArray
    v_m: FloatArray
    notes: tuple[str, ...]


def _cells(oifits: OIFits, table: OITable, kind: Kind, wavelength: FloatArray) -> _Cells:
    n_channels = len(wavelength)
    value = grid(oifits, table, kind.value, n_channels)
    sigma = grid(oifits, table, kind.error, n_channels)
    notes: list[str] = []
    if kind.is_angle:
        unit = table.units[kind.value]
        scale, understood = scale_of(unit, ANGLE, "deg")
        error_scale, _ = scale_of(table.units[kind.error] or unit, ANGLE, "deg")
        if not understood:
            notes.append(f"{table.label}: unit {unit!r} of {kind.value} read as degrees")
        value, sigma = value * scale, sigma * error_scale
    value = value + rest_of(table, kind.value, value.shape)
    with np.errstate(over="ignore", invalid="ignore"):
        variance = np.where(sigma > 0, sigma**2, np.nan)
    variance = variance + rest_of(table, kind.error, value.shape)
    u, u_notes = coordinates(oifits, table, kind.u, wavelength)
    v, v_notes = coordinates(oifits, table, kind.v, wavelength)
    return _Cells(value, variance, u, v, (*notes, *u_notes, *v_notes))


def unusable(kind: Kind, value: FloatArray, variance: FloatArray) -> BoolArray:
    """Where a value or its error cannot be meant: not finite, not positive, or a fill value."""
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(variance)
        usable = np.isfinite(value) & (value < kind.largest_value) & (value > kind.least_value)
        usable &= (sigma >= MIN_ERROR) & (sigma <= kind.largest_error)
    return np.asarray(~usable)


def blank(kind: Kind, value: FloatArray) -> bool:
    """Whether a table, values (rows, channels), has 0 in place of closure phases."""
    return kind.is_angle and value.size >= MIN_BLANK and not value.any()


def _repeats_a_station(stations: IntArray) -> BoolArray:
    in_order = np.sort(stations, axis=1)
    return np.asarray((np.diff(in_order, axis=1) == 0).any(axis=1))


def read_rows(
    oifits: OIFits,
    table: OITable,
    chosen: IntArray,
    station_position: IntArray,
    channels: tuple[FloatArray, FloatArray],
) -> Rows:
    """Rows ``chosen`` of a data table; `Measurements.setup` and `row` are still to be numbered.

    Parameters
    ----------
    chosen : (n,) int array
        Row numbers.
    station_position : (rows, k + 1) int array
        Of every row of the table, in `Setup.stations`.
    channels : tuple of (n_channels,) float array
        Wavelength and width in metres.

    Raises
    ------
    DataError
        Where a required column is absent or of another shape.
    """
    kind = KINDS[table.name]
    wavelength, band = channels
    n_channels, n = len(wavelength), len(chosen)
    cells = _cells(oifits, table, kind, wavelength)
    mjd, time_note = times_of(table)
    flag, flag_note = _flags(oifits, table, n_channels)
    faults = _faults(cells, kind, wavelength, station_position)
    causes = _causes({name: mask[chosen] & ~flag[chosen] for name, mask in faults.items()})
    stated = f"{flag[chosen].sum()} of {flag[chosen].size} flagged in the file"
    flag = np.logical_or.reduce([flag, *(np.broadcast_to(m, flag.shape) for m in faults.values())])
    notes = [*cells.notes, time_note, flag_note]
    notes += [f"{table.label}: values that cannot be used were flagged: {causes}"] * bool(causes)
    each, channel = np.repeat(chosen, n_channels), np.tile(np.arange(n_channels), n)
    measurements = Measurements(
        value=cells.value[chosen].ravel(),
        u_m=cells.u_m[each],
        v_m=cells.v_m[each],
        wavelength_m=wavelength[channel],
        band_m=band[channel],
        mjd=mjd[each],
        integration_s=_one_number(table, "INT_TIME", 0.0)[each],
        stations=station_position[each],
        setup=np.zeros(n * n_channels, dtype=np.intp),
        row=each,
        channel=channel,
        flag=flag[chosen].ravel(),
    )
    return Rows(
        measurements,
        cells.variance[chosen].ravel(),
        _correlation_index(oifits, table, kind, n_channels)[chosen].ravel(),
        table.keyword("CORRNAME"),
        _place(table, n_channels, chosen),
        table.keyword("INSNAME"),
        notes=tuple(note for note in notes if note),
        unused=f"{table.label}: {stated}" + (f", {causes}" if causes else ""),
    )


def _faults(
    cells: _Cells, kind: Kind, wavelength: FloatArray, station_position: IntArray
) -> dict[str, BoolArray]:
    """Where a cell cannot be used, by the reason; each mask spreads to (rows, channels)."""
    has_error = np.where(np.isfinite(cells.value), cells.variance, 1.0)
    fine = np.ones_like(cells.value)
    known = np.isfinite(np.concatenate([cells.u_m, cells.v_m], axis=1)).all(axis=1)
    return {
        "without a usable value": unusable(kind, cells.value, fine),
        "exactly 0, as all of the table": np.full_like(known, blank(kind, cells.value))[:, None],
        "without a usable error": unusable(kind, np.zeros_like(cells.value), has_error),
        "without a wavelength": np.broadcast_to(~(wavelength > 0), cells.value.shape),
        "without (u, v)": np.broadcast_to(~known[:, None], cells.value.shape),
        "of a station with itself": np.broadcast_to(
            _repeats_a_station(station_position)[:, None], cells.value.shape
        ),
    }


def _causes(faults: dict[str, BoolArray]) -> str:
    """How many cells have each fault; a cell that has several counts for the first."""
    counted = np.zeros(next(iter(faults.values())).shape, dtype=bool)
    found = []
    for name, mask in faults.items():
        count = int((mask & ~counted).sum())
        counted |= mask
        if count:
            found.append(f"{count} {name}")
    return ", ".join(found)


def _correlation_index(oifits: OIFits, table: OITable, kind: Kind, n_channels: int) -> IntArray:
    if kind.index not in table.columns or not table.keyword("CORRNAME"):
        return np.zeros((len(table), n_channels), dtype=np.intp)
    first = integers(oifits, table, kind.index, 1)
    return np.where(first > 0, first + np.arange(n_channels), 0)


def _place(table: OITable, n_channels: int, chosen: IntArray) -> IntArray:
    values = table.columns.get("NS_ENTRY")
    if values is None or values.size != len(table) * n_channels:
        return np.empty(0, dtype=np.intp)
    return values.reshape(len(table), n_channels)[chosen].ravel().astype(np.intp)

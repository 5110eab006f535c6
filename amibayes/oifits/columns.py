"""Columns and names of a file: numbers of the right shape, or one line that says what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.errors import DataError
from amibayes.oifits.scales import FREQUENCY, LENGTH, scale_of
from amibayes.oifits.tables import OIFits, OITable, plain
from amibayes.units import FloatArray, IntArray

MAX_BASELINE_M = 1e5
"""Longer than any optical interferometer by a factor of 200; in wavelengths of light it is the
(u, v) of 10 cm."""


def column(oifits: OIFits, table: OITable, name: str) -> NDArray[Any]:
    """A column that has to be there.

    Raises
    ------
    DataError
        Where it is not.
    """
    if name not in table.columns:
        raise DataError(
            f"{table.label} has no column {name}",
            source=oifits.path,
            remedy="write the file again with the columns that OIFITS requires",
        )
    return table.columns[name]


def numbers(oifits: OIFits, table: OITable, name: str) -> FloatArray:
    """A required column as float64.

    Raises
    ------
    DataError
        Where the column is absent or holds no numbers.
    """
    values = column(oifits, table, name)
    if values.dtype.kind not in "iufb":
        raise DataError(f"{table.label}: column {name} holds no numbers", source=oifits.path)
    return values.astype(float)


def integers(oifits: OIFits, table: OITable, name: str, width: int) -> IntArray:
    """A required column of whole numbers, (rows, width).

    Raises
    ------
    DataError
        Where it is absent, holds no numbers or has another width.
    """
    values = numbers(oifits, table, name)
    if values.size != len(table) * width or not np.isfinite(values).all():
        raise DataError(
            f"{table.label}: column {name} does not hold {width} number(s) in each row",
            source=oifits.path,
        )
    return values.reshape(len(table), width).astype(np.intp)


def rest_of(table: OITable, name: str, shape: tuple[int, ...]) -> FloatArray:
    """What rounding to the standard's units lost, as `write_oifits` keeps it; 0 elsewhere."""
    values = table.columns.get(f"NS_{name}_REST")
    if values is None or values.size != np.prod(shape) or values.dtype.kind != "f":
        return np.zeros(shape)
    return np.asarray(values.reshape(shape), dtype=float)


def same(a: str, b: str) -> bool:
    """Whether two names are one, whatever their padding and case."""
    return plain(a).casefold() == plain(b).casefold()


def listing(names: Sequence[str]) -> str:
    """Names for an error message, each once."""
    return ", ".join(dict.fromkeys(names))


def placed(wanted: IntArray, known: IntArray, place: IntArray) -> IntArray:
    """Places of rising numbers where they are wanted, −1 for others; any may be a billion."""
    known, place = np.append(0, known), np.append(-1, place)
    at = np.searchsorted(known, wanted, side="right") - 1
    return np.where(known[at] == wanted, place[at], -1)


def coordinates(
    oifits: OIFits, table: OITable, names: tuple[str, ...], wavelength_m: FloatArray
) -> tuple[FloatArray, tuple[str, ...]]:
    """Columns of (u, v) in metres, (rows, len(names)), and notes.

    Parameters
    ----------
    names : tuple of str
        Of the columns.
    wavelength_m : (n_channels,) float array
        Of the table: what turns numbers of wavelengths into metres.

    Raises
    ------
    DataError
        Where a column is absent, is not one number a row, or is in wavelengths, of which
        there are several.
    """
    out, notes = [], []
    for name in names:
        values = numbers(oifits, table, name)
        if values.size != len(table):
            raise DataError(f"{table.label}: {name} is not one number a row", source=oifits.path)
        metres, note = _in_metres(oifits, table, name, values.reshape(-1), wavelength_m)
        out.append(metres)
        notes += [note] if note else []
    return np.stack(out, axis=1), tuple(notes)


def _in_metres(
    oifits: OIFits, table: OITable, name: str, values: FloatArray, wavelength_m: FloatArray
) -> tuple[FloatArray, str]:
    unit = table.units.get(name, "")
    per_radian, is_frequency = scale_of(unit, FREQUENCY, "cycles/rad")
    scale, understood = scale_of(unit, LENGTH, "m")
    usable = np.abs(values[np.isfinite(values)]) * scale
    is_frequency = is_frequency and bool(unit)
    # A single number past the limit is a fault of its row; half of them are a unit.
    if not is_frequency and not (len(usable) and np.median(usable) > MAX_BASELINE_M):
        note = f"{table.label}: unit {unit!r} of {name} read as m"
        return values * scale, "" if understood else note
    known = np.unique(wavelength_m[np.isfinite(wavelength_m) & (wavelength_m > 0)])
    if len(known) != 1:
        raise DataError(
            f"{table.label}: {name} is in wavelengths ({_size(unit, usable)}), not in metres, and "
            f"there are {len(known)} channels",
            source=oifits.path,
            remedy="multiply it by the wavelength that it was divided by",
        )
    note = f"{table.label}: {name} is in wavelengths ({_size(unit, usable)}): converted to metres"
    return values * (per_radian if is_frequency else scale) * known[0], note


def _size(unit: str, values: FloatArray) -> str:
    return f"unit {unit!r}" if unit and unit.lower() not in LENGTH else f"up to {values.max():.3g}"

"""Masses from a user's table of evolutionary tracks: magnitude against mass at one age."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy import units
from astropy.io import ascii as tables
from astropy.table import Table

from amibayes.errors import DataError
from amibayes.units import FloatArray

MASS = ("mass", "mass_mjup", "m_mjup", "mass_msun", "m_msun")
DIFFERENCE = ("delta_mag", "dmag", "delta_magnitude")
ABSOLUTE = ("absolute_mag", "abs_mag", "absolute_magnitude", "magnitude", "mag")

UNITS = {"mass_mjup": "M_Jup", "m_mjup": "M_Jup", "mass_msun": "M_Sun", "m_msun": "M_Sun"}

OWN_NAMES = {"M_Jup": "jupiterMass", "M_Sun": "solMass"}
"""Units as they are written here, and as astropy knows them."""


@dataclass(frozen=True, eq=False)
class MassTable:
    """Mass as a function of the magnitude difference.

    Parameters
    ----------
    delta_mag : (n,) float array
        Increasing.
    mass : (n,) float array
        Positive, falling.
    unit : str
        Of the mass, for labels.
    """

    delta_mag: FloatArray
    mass: FloatArray
    unit: str

    def mass_at(self, delta_mag: FloatArray) -> FloatArray:
        """Mass at magnitude differences, log-linear in between; NaN outside the table."""
        log_mass = np.log(self.mass)
        wanted = np.asarray(delta_mag, dtype=float)
        inside = np.interp(wanted, self.delta_mag, log_mass, left=np.nan, right=np.nan)
        return np.asarray(np.exp(np.where(np.isnan(wanted), np.nan, inside)))

    def converted_to(self, unit: str) -> MassTable:
        """Masses in another unit.

        Raises
        ------
        ValueError
            Where one of the two is no unit of mass, and they differ.
        """
        if unit == self.unit:
            return self
        own, other = (units.Unit(OWN_NAMES.get(name, name)) for name in (self.unit, unit))
        return replace(self, mass=self.mass * own.to(other), unit=unit)

    def delta_mag_at(self, mass: FloatArray) -> FloatArray:
        """Magnitude differences of masses; NaN outside the table."""
        known = np.log(self.mass[::-1])
        return np.interp(np.log(mass), known, self.delta_mag[::-1], left=np.nan, right=np.nan)


def read_mass_table(path: str | Path, primary_magnitude: float | None = None) -> MassTable:
    """Read a table (ECSV or CSV) with a column of masses and one of magnitudes.

    Parameters
    ----------
    path : path
        Columns: ``mass`` (its unit in ECSV, or ``mass_mjup``, ``mass_msun``) and either
        ``delta_mag``, or ``absolute_mag`` in the filter of the data.
    primary_magnitude : float, optional
        Absolute magnitude of the star in that filter, which ``absolute_mag`` needs.

    Raises
    ------
    DataError
        Where it cannot be read, a column is missing or a mass has no one magnitude.
    """
    table = _read(path)
    name, mass = _column(table, MASS, path)
    unit = UNITS.get(name.lower(), str(table[name].unit or "") or "table's unit")
    if any(c.lower() in DIFFERENCE for c in table.colnames):
        delta_mag = _magnitudes(table, DIFFERENCE, path)
    else:
        magnitude = _magnitudes(table, (*DIFFERENCE, *ABSOLUTE), path)
        if primary_magnitude is None:
            raise DataError(
                "holds absolute magnitudes, and the star's is not known",
                source=path,
                remedy="give --primary-magnitude M",
            )
        delta_mag = magnitude - primary_magnitude
    order = np.argsort(delta_mag)
    delta_mag, mass = delta_mag[order], mass[order]
    if len(mass) < 2 or (mass <= 0.0).any() or (np.diff(delta_mag) <= 0.0).any():
        raise DataError(
            "needs two rows or more, all of other magnitude, with masses above zero", source=path
        )
    if (np.diff(mass) >= 0.0).any():
        raise DataError(
            "has masses that do not fall as magnitudes rise",
            source=path,
            remedy="give the table of one age",
        )
    return MassTable(delta_mag, mass, unit)


def _read(path: str | Path) -> Table:
    try:
        text = Path(path).read_text(encoding="utf-8-sig")  # spreadsheets mark UTF-8
    except (OSError, UnicodeDecodeError) as error:
        what = getattr(error, "strerror", None) or "is no text"
        raise DataError(f"cannot be read: {what}", source=path) from error
    form, options = ("ecsv", {}) if text.startswith("# %ECSV") else ("csv", {"comment": "#"})
    try:
        return tables.read([*text.splitlines(), ""], format=form, **options)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError("is neither an ECSV nor a CSV table", source=path) from error


def _magnitudes(table: Table, names: tuple[str, ...], path: str | Path) -> FloatArray:
    """A column of magnitudes, in mag whatever unit the table gives."""
    name, values = _column(table, names, path)
    if (unit := table[name].unit) is None:
        return values
    try:
        return values * float(unit.to(units.mag))
    except (AttributeError, ValueError) as error:
        raise DataError(
            f"column {name} is in {unit}, which is no unit of magnitudes", source=path
        ) from error


def _column(table: Table, names: tuple[str, ...], path: str | Path) -> tuple[str, FloatArray]:
    for column in table.colnames:
        if column.lower() in names:
            break
    else:
        raise DataError(f"has no column {' or '.join(names[:2])}", source=path, remedy="name it so")
    try:
        values: FloatArray = np.asarray(
            np.ma.filled(np.ma.asarray(table[column], dtype=float), np.nan)
        )
    except (TypeError, ValueError):
        values = np.array([np.nan])
    if not np.isfinite(values).all():
        raise DataError(f"column {column} holds what is no number", source=path)
    return column, values

"""The table of a survey: a target per row, its files, its calibrators, options of its own."""

from __future__ import annotations

import glob
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Row, Table

from amibayes.data.tables import BYTE_ORDER_MARK
from amibayes.errors import DataError

FILES, CALIBRATORS, NAME = "target", "cal", "name"

FACTS = ("distance_pc", "primary_magnitude", "mass_table", "mjd", "magnitude", "spectral_type")
"""Columns of what is known of a star, for the survey's statistics and the choice of calibrators."""

Value = str | bool | int | float


@dataclass(frozen=True)
class SurveyTarget:
    """A row of the table.

    Parameters
    ----------
    name : str
        Name of its folder.
    target, cal : tuple of str
        Files and patterns as they were written.
    options : mapping
        The row's other cells that are not empty, by the name of their column.
    beside : Path
        Folder of the table, which files are relative to.
    """

    name: str
    target: tuple[str, ...]
    cal: tuple[str, ...]
    options: Mapping[str, Value]
    beside: Path

    @property
    def facts(self) -> dict[str, Value]:
        """What is known of the star; a table of masses beside the survey's table is found there.

        Raises
        ------
        DataError
            Where a distance or magnitude is no number.
        """
        found = {name: self.options[name] for name in FACTS if name in self.options}
        for name in ("distance_pc", "primary_magnitude", "mjd", "magnitude"):
            if name in found:
                found[name] = self._number(name, found[name])
        if "mass_table" in found and (self.beside / str(found["mass_table"])).is_file():
            found["mass_table"] = str(self.beside / str(found["mass_table"]))
        return found

    def _number(self, name: str, value: Value) -> float:
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or (name == "distance_pc" and number <= 0.0):
            raise DataError(
                f"target {self.name}: column '{name}' holds {value!r}",
                source=self.beside,
                remedy="write a number" + (" above zero" if name == "distance_pc" else ""),
            )
        return number

    def files(self, patterns: tuple[str, ...]) -> list[str]:
        """Find the files of some patterns, in the order of the table; names within a pattern.

        Raises
        ------
        DataError
            Where a pattern fits no file.
        """
        return [path for pattern in patterns for path in self._matching(pattern)]

    def _matching(self, pattern: str) -> list[str]:
        if not glob.has_magic(pattern):
            return [str(self.beside / pattern)]
        found = sorted(glob.glob(pattern, root_dir=self.beside))
        if not found:
            raise DataError("no file fits this pattern", source=self.beside / pattern)
        return [str(self.beside / path) for path in found]


def read_targets(path: str | Path) -> tuple[SurveyTarget, ...]:
    """Read the table of a survey.

    Parameters
    ----------
    path : path
        ECSV, CSV, FITS or any other table that astropy reads. Column ``target`` names the
        files of a target: several with spaces between them, or semicolons where names hold
        spaces; ``*`` and ``?`` match anything; relative to the table. ``cal`` names its
        calibrators likewise, ``name`` its folder. Every other column is an option.

    Raises
    ------
    DataError
        Where it is no such table, is empty, or two targets have one name.
    """
    table = _table(Path(path))
    names = {str(c): str(c).lstrip(BYTE_ORDER_MARK).strip() for c in table.colnames}
    columns = {name.lower().replace("-", "_"): c for c, name in names.items()}
    if FILES not in columns:
        raise DataError(
            f"has no column '{FILES}'",
            source=path,
            remedy=f"name the files of each target in a column '{FILES}', calibrators in "
            f"'{CALIBRATORS}'",
        )
    beside = Path(path).parent
    rows = [_target(row, columns, beside, f"{path}, row {k}") for k, row in enumerate(table, 1)]
    if not rows:
        raise DataError("holds no target", source=path, remedy="give at least one row")
    _refuse_twins(rows, path)
    return tuple(rows)


def _table(path: Path) -> Table:
    try:
        return Table.read(path)
    # Readers of tables raise whatever their format suggests.
    except Exception as error:
        what = "cannot be read" if isinstance(error, OSError) else "is no table"
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        first = str(reason).strip().split("\n")[0]
        raise DataError(f"{what}: {first}", source=path, remedy="give an ECSV file") from error


def _target(row: Row, columns: Mapping[str, str], beside: Path, where: str) -> SurveyTarget:
    cells = {name: _cell(row[column]) for name, column in columns.items()}
    filled = {name: value for name, value in cells.items() if value is not None}
    files = _words(filled.pop(FILES, ""))
    if not files:
        raise DataError(f"has no file in column '{FILES}'", source=where)
    calibrators = _words(filled.pop(CALIBRATORS, ""))
    name = _folder_name(str(filled.pop(NAME, "")) or Path(files[0]).name.split(".")[0])
    return SurveyTarget(name, files, calibrators, filled, beside)


def _cell(value: object) -> Value | None:
    """Give a cell as a plain value; None where it is empty."""
    if value is np.ma.masked:
        return None
    plain = value.item() if isinstance(value, np.generic) else value
    if isinstance(plain, bytes):
        plain = plain.decode()
    if isinstance(plain, float) and math.isnan(plain):
        return None
    if isinstance(plain, bool | int | float):
        return plain
    return str(plain).strip() or None


def _words(cell: Value) -> tuple[str, ...]:
    parts = str(cell).split(";" if ";" in str(cell) else None)
    return tuple(part.strip() for part in parts if part.strip())


def _folder_name(name: str) -> str:
    return re.sub(r"[^\w+.-]+", "_", name).strip("_.") or "target"


def _refuse_twins(rows: list[SurveyTarget], path: str | Path) -> None:
    seen: set[str] = set()
    for row in rows:
        # Not every file system distinguishes capitals from small letters.
        if row.name.casefold() in seen:
            raise DataError(
                f"two targets are called '{row.name}'",
                source=path,
                remedy=f"give each a name of its own in a column '{NAME}'",
            )
        seen.add(row.name.casefold())

"""What an audit says, and what its checks look at."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from amibayes.oifits.rows import KINDS, Kind
from amibayes.oifits.scales import ANGLE, scale_of
from amibayes.oifits.tables import OIFits, OITable
from amibayes.units import BoolArray, FloatArray

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong or doubtful in a file.

    Parameters
    ----------
    severity : {"error", "warning"}
        Wrong: programs may stumble over it or results will be wrong; or doubtful.
    code : str
        Short name of the check.
    where : str
        Table, or "file".
    what : str
        What is there.
    why : str
        Why it matters.
    remedy : str
        What to do about it.
    certain : bool
        The remedy is certain: `repair` can apply it.
    """

    severity: Severity
    code: str
    where: str
    what: str
    why: str
    remedy: str
    certain: bool = False

    def as_json(self) -> dict[str, object]:
        """As `audit.json` holds it."""
        return asdict(self)


Findings = Iterator[Finding]

DATA_TABLES = ("OI_VIS", "OI_VIS2", "OI_T3", "OI_FLUX")


def data_tables(oifits: OIFits) -> Iterator[tuple[OITable, Kind]]:
    """Yield the V² and closure-phase tables that have rows."""
    for table in oifits.tables:
        if table.name in KINDS and len(table):
            yield table, KINDS[table.name]


def column(table: OITable, name: str) -> FloatArray | None:
    """A column of numbers as (rows, width) float64; None where there is none such."""
    values = table.columns.get(name)
    if values is None or values.dtype.kind not in "iufb" or not len(table):
        return None
    return np.asarray(values.reshape(len(table), -1), dtype=float)


def unit_in_use(table: OITable, name: str) -> str:
    """Unit of a column as the reader takes it: an error without one has that of its value."""
    unit = table.units.get(name, "")
    return unit or (table.units.get(name[:-3], "") if name.endswith("ERR") else "")


def radians(table: OITable, name: str) -> FloatArray | None:
    """A column of angles in radians; its unit, or that of its value, or degrees."""
    values, unit = column(table, name), unit_in_use(table, name)
    return None if values is None else values * scale_of(unit, ANGLE, "deg")[0]


def unflagged(table: OITable, shape: tuple[int, ...]) -> BoolArray:
    """Where FLAG is not set."""
    flag = column(table, "FLAG")
    if flag is None or flag.shape[1] not in (1, shape[1]):
        return np.ones(shape, dtype=bool)
    return np.broadcast_to(flag == 0, shape)


def listed(names: Iterable[str], most: int = 6) -> str:
    """Names in one clause, the first few of many."""
    every = list(dict.fromkeys(names))
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return ", ".join(every[:most]) + more


def count(n: int, what: str) -> str:
    """``1 value``, ``2 values``."""
    return f"{n} {what}" if n == 1 else f"{n} {what}s"

"""Results and data as astropy tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from astropy.table import QTable

from amibayes.data.measurements import Measurements
from amibayes.data.setup import Setup
from amibayes.units import FloatArray

BYTE_ORDER_MARK = "\ufeff"
"""With which spreadsheets begin a table in UTF-8; it is no part of the first column's name."""


def quantity_table(
    columns: Mapping[str, Any], units: Mapping[str, str], meta: Mapping[str, Any] | None = None
) -> QTable:
    """Make an astropy table of columns; those that ``units`` names carry one."""
    known = {name: unit for name, unit in units.items() if name in columns}
    return QTable(dict(columns), units=known, meta=dict(meta or {}))


UNITS = {
    "separation_mas": "mas", "east_mas": "mas", "north_mas": "mas", "diameter_mas": "mas",
    "position_angle_deg": "deg", "delta_mag": "mag",
}  # fmt: skip
"""Units of the quantities of a companion, by the names of their columns."""


def pretty(name: str) -> str:
    """Name of a column as a reader wants it: ``separation_mas`` is 'separation (mas)'."""
    for ending in ("_mas", "_deg"):
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} ({ending[1:]})"
    return name.replace("_", " ")


def measurements_table(
    kind: Literal["vis2", "closure_phase"],
    m: Measurements,
    error: FloatArray,
    setups: Sequence[Setup],
    source: str,
) -> QTable:
    """One kind of data, a row each, with errors (n,), places in the (u, v) plane and stations."""
    sides = [f"{i + 1}" for i in range(m.u_m.shape[1])] if kind == "closure_phase" else [""]
    columns = {
        kind: m.value,
        "error": error,
        **{f"u{side}": m.u_m[:, i] for i, side in enumerate(sides)},
        **{f"v{side}": m.v_m[:, i] for i, side in enumerate(sides)},
        "wavelength": m.wavelength_m,
        "mjd": m.mjd,
        "stations": [
            "-".join(setups[k].stations[j] for j in row)
            for k, row in zip(m.setup, m.stations, strict=True)
        ],
        "flag": m.flag,
    }
    units = {name: "m" for name in columns if name[0] in "uvw" and name != kind}
    units |= {kind: "rad", "error": "rad"} if kind == "closure_phase" else {}
    return quantity_table(columns, units | {"mjd": "d"}, {"source": source})

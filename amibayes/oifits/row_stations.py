"""The stations of every row: by STA_INDEX, or by (u, v) where that does not tell them apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from amibayes.oifits.columns import coordinates, integers
from amibayes.oifits.rows import KINDS, channel_count, times_of
from amibayes.oifits.setups import Stations, array_table, channels_of, stations_of, wavelength_table
from amibayes.oifits.tables import OIFits, OITable
from amibayes.oifits.uv_stations import UVStations, stations_from_uv
from amibayes.units import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class TableStations:
    """The stations of a data table's array, and those of each of its rows.

    Parameters
    ----------
    array : OITable, optional
        Its OI_ARRAY.
    stations : Stations
    position : (rows, 2 or 3) int array
        Places in ``stations.names``; 0 in rows of other targets where (u, v) told them.
    notes : tuple of str
    """

    array: OITable | None
    stations: Stations
    position: IntArray
    notes: tuple[str, ...] = ()


def stations_of_rows(
    oifits: OIFits, tables: Sequence[OITable], chosen: Mapping[int, IntArray]
) -> dict[int, TableStations]:
    """Stations of the rows of every data table, by the table's number.

    Parameters
    ----------
    tables : sequence of OITable
        OI_VIS2 and OI_T3.
    chosen : mapping of int to int array
        Rows in use, by number of the table.

    Raises
    ------
    DataError
        Where STA_INDEX has another width than stations.
    """
    groups: dict[tuple[int, str], list[OITable]] = {}
    for table in tables:
        array = array_table(oifits, table)
        key = (0 if array is None else array.number, table.keyword("INSNAME").casefold())
        groups.setdefault(key, []).append(table)
    out: dict[int, TableStations] = {}
    for group in groups.values():
        fault = next((f for t in group if (f := station_fault(oifits, t, chosen[t.number]))), "")
        out |= _by_uv(oifits, group, chosen, fault) if fault else _by_index(oifits, group, tables)
    return out


def _by_index(
    oifits: OIFits, group: list[OITable], tables: Sequence[OITable]
) -> dict[int, TableStations]:
    array = array_table(oifits, group[0])
    alike = [t for t in tables if array_table(oifits, t) is array and "STA_INDEX" in t.columns]
    used = np.unique(np.concatenate([_index(oifits, t).ravel() for t in alike]))
    stations = stations_of(oifits, array, used)
    return {
        t.number: TableStations(array, stations, stations.position(_index(oifits, t)))
        for t in group
    }


def _index(oifits: OIFits, table: OITable) -> IntArray:
    return integers(oifits, table, "STA_INDEX", 1 + len(KINDS[table.name].u))


def station_fault(oifits: OIFits, table: OITable, rows: IntArray) -> str:
    """Why STA_INDEX does not tell the rows of a table apart; empty where it does.

    Parameters
    ----------
    rows : int array
        Of one target.
    """
    if "STA_INDEX" not in table.columns:
        return f"{table.label} has no STA_INDEX"
    if not len(rows):
        return ""
    index = np.sort(_index(oifits, table)[rows], axis=1)
    if (index == index[0, 0]).all():
        return f"{table.label}: STA_INDEX is {index[0, 0]} throughout"
    if (np.diff(index, axis=1) == 0).any(axis=1).mean() > 0.5:
        return f"{table.label}: most rows name a station twice"
    if _is_shared(table, rows, index):
        return f"{table.label}: different (u, v) at one time have the same stations"
    return ""


def _is_shared(table: OITable, rows: IntArray, index: IntArray) -> bool:
    """Whether most rows have the stations of another one of the same date at another (u, v)."""
    names = (*KINDS[table.name].u, *KINDS[table.name].v)
    found = [table.columns.get(name) for name in names]
    sizes = [v is not None and v.dtype.kind in "fiu" and v.size == len(table) for v in found]
    if not all(sizes) or len(rows) < 2:
        return False
    uv = np.stack([np.ravel(v)[rows] for v in found if v is not None], axis=1).astype(float)
    uv = uv[np.isfinite(uv).all(axis=1)]
    mjd = np.nan_to_num(times_of(table)[0][rows])
    timeless = len(np.unique(mjd)) == 1
    # Without dates a baseline may come back wherever the Earth has turned it, and three
    # telescopes have one triangle.
    if len(uv) < len(rows) or (timeless and (table.name == "OI_T3" or (index != index[0]).any())):
        return False
    row = np.column_stack([mjd, index])
    _, here, label = np.unique(row, axis=0, return_index=True, return_inverse=True)
    first = uv[here[label.ravel()]]
    apart = np.minimum(np.linalg.norm(uv - first, axis=1), np.linalg.norm(uv + first, axis=1))
    # The Earth moves (u, v) by less than a tenth in the half hour that a date may stand for.
    return bool((apart > 0.1 * np.linalg.norm(first, axis=1)).mean() > 0.3)


def _by_uv(
    oifits: OIFits, group: list[OITable], chosen: Mapping[int, IntArray], fault: str
) -> dict[int, TableStations]:
    parts: dict[str, list[FloatArray]] = {"OI_VIS2": [], "OI_T3": []}
    dates: dict[str, list[FloatArray]] = {"OI_VIS2": [], "OI_T3": []}
    for table in group:
        kind, rows = KINDS[table.name], chosen[table.number]
        wavelength = channels_of(
            oifits, wavelength_table(oifits, table, channel_count(oifits, table))
        )[0]
        u = coordinates(oifits, table, kind.u, wavelength)[0][rows]
        v = coordinates(oifits, table, kind.v, wavelength)[0][rows]
        parts[table.name].append(np.stack([u, v], axis=2))
        dates[table.name].append(times_of(table)[0][rows])
    pairs = np.concatenate([np.empty((0, 1, 2)), *parts["OI_VIS2"]])[:, 0]
    triangles = np.concatenate([np.empty((0, 2, 2)), *parts["OI_T3"]])
    mjd = {name: np.concatenate([np.empty(0), *found]) for name, found in dates.items()}
    found = stations_from_uv(pairs, triangles, mjd["OI_VIS2"], mjd["OI_T3"])
    return _laid_out(oifits, group, chosen, found, _notes(fault, found))


def _laid_out(
    oifits: OIFits,
    group: list[OITable],
    chosen: Mapping[int, IntArray],
    found: UVStations,
    notes: tuple[str, ...],
) -> dict[int, TableStations]:
    """Stations that (u, v) told apart, back in the rows of each table."""
    number = np.arange(1, found.n_stations + 1)
    stations = Stations(tuple(f"station {i}" for i in number), number, None, None)
    start = {"OI_VIS2": 0, "OI_T3": 0}
    every = {"OI_VIS2": found.baselines, "OI_T3": found.triangles}
    out = {}
    for table in group:
        rows, first = chosen[table.number], start[table.name]
        start[table.name] += len(rows)
        position = np.zeros((len(table), every[table.name].shape[1]), dtype=np.intp)
        position[rows] = every[table.name][first : first + len(rows)]
        own = notes if table is group[0] else ()
        out[table.number] = TableStations(array_table(oifits, table), stations, position, own)
    return out


def _notes(fault: str, found: UVStations) -> tuple[str, ...]:
    notes = [
        f"{fault}: baselines and triangles were identified by their (u, v) and dates, "
        f"{found.n_stations} stations"
    ]
    if found.factor != 1.0:
        notes.append(
            f"(u, v) of OI_VIS2 are {found.factor:.4f} times those of the triangles, as if one of "
            "them had been divided by another mean wavelength: they were matched, and each is "
            "used as it is"
        )
    return tuple(notes)

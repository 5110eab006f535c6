"""From the tables of an OIFITS file to `Observables`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields, replace

import numpy as np

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.setup import Setup, without_polarisation
from amibayes.errors import DataError
from amibayes.oifits.columns import integers, listing, same
from amibayes.oifits.off_axis import RESPONSE, with_response
from amibayes.oifits.row_stations import stations_of_rows
from amibayes.oifits.rows import Rows, channel_count, read_rows
from amibayes.oifits.scatter import SCATTER, SHARED
from amibayes.oifits.setups import (
    DATA_TABLES,
    Target,
    make_setup,
    notes_of_bands,
    targets_of,
    wavelength_table,
)
from amibayes.oifits.stated import Column, Content, stated_covariance
from amibayes.oifits.tables import OWN_KEY, OIFits, OITable
from amibayes.support.options import ClosureCovariance
from amibayes.units import IntArray


def observables_of(
    oifits: OIFits,
    *,
    insname: str | None = None,
    target: str | None = None,
    closure_covariance: ClosureCovariance = "assumed",
) -> Observables:
    """Take the squared visibilities and closure phases from an opened file, as they are.

    The options, what comes out and the errors are those of `amibayes.oifits.read_oifits`.
    """
    tables = _data_tables(oifits, insname)
    name, targets = _chosen_target(oifits, tables, target)
    setups, parts = _parts(oifits, tables, targets, name)
    content = Content(
        _in_written_order(_stack([p for p in parts if p.u == 1], 1)),
        _in_written_order(_stack([p for p in parts if p.u == 2], 2)),
    )
    if all(column.measurements.flag.all() for column in content.both):
        raise DataError(
            "holds no usable V² or closure phase: " + "; ".join(p.rows.unused for p in parts),
            source=oifits.path,
            remedy="check FLAG and what is named",
        )
    stated = stated_covariance(oifits, content, closure_covariance)
    trailing = (f"{oifits.trailing_bytes} bytes after the last table",)
    return Observables(
        content.vis2.measurements,
        content.closure.measurements,
        stated.covariance,
        stated.kind,
        setups,
        stated.n_integrations,
        (*(n for p in parts for n in p.rows.notes), *stated.notes, *_unused(oifits))
        + (trailing if oifits.trailing_bytes else ()),
        stated.freedom,
        stated.scatter,
        stated.shared,
    )


def _unused(oifits: OIFits) -> list[str]:
    """Say in one line which tables are not used; those that are called the same once."""
    names = (t for t in oifits.unused if t.name not in (RESPONSE, SCATTER, SHARED))
    count = Counter(f"{t.name or 'unnamed'} {t.extver}" for t in names)
    if not count:
        return []
    told = [name + (f" ({n} tables)" if n > 1 else "") for name, n in count.items()]
    are = "are" if len(told) > 1 else "is"
    return [f"{', '.join(told)} {are} not used"]


@dataclass(frozen=True, eq=False)
class _Part:
    """Rows of one table and one setup; ``u`` is 1 for V² and 2 for closure phases."""

    u: int
    rows: Rows


def _data_tables(oifits: OIFits, insname: str | None) -> list[OITable]:
    tables = [t for t in oifits.tables if t.name in DATA_TABLES and len(t)]
    if not tables:
        raise DataError(
            "holds neither squared visibilities nor closure phases",
            source=oifits.path,
            remedy="give a file with OI_VIS2 or OI_T3",
        )
    if insname is None:
        return tables
    kept = [t for t in tables if same(t.keyword("INSNAME"), insname)]
    if not kept:  # the name of a combiner is that of both of its polarisations
        kept = [t for t in tables if same(without_polarisation(t.keyword("INSNAME")), insname)]
    if not kept:
        there = listing([t.keyword("INSNAME") for t in tables])
        raise DataError(f"has no INSNAME {insname!r}", source=oifits.path, remedy=f"it has {there}")
    return kept


def _chosen_target(
    oifits: OIFits, tables: list[OITable], wanted: str | None
) -> tuple[str, dict[int, Target]]:
    """Name of the target to read, and the target of every TARGET_ID in use."""
    known = targets_of(oifits)
    ids = np.unique(np.concatenate([_target_ids(oifits, t) for t in tables]))
    found = {int(i): known.get(int(i), Target(f"target {i}")) for i in ids}
    alike = [t for t in found.values() if wanted is None or same(t.name, wanted)]
    if not alike:
        raise DataError(
            f"has no data of target {wanted!r}",
            source=oifits.path,
            remedy=f"it has {listing([t.name for t in found.values()])}",
        )
    if len({t.name.casefold() for t in alike}) > 1:
        raise DataError(
            f"holds data of several targets: {listing([t.name for t in alike])}",
            source=oifits.path,
            remedy="choose one of them with --target NAME",
        )
    return alike[0].name, found


def _parts(
    oifits: OIFits, tables: list[OITable], targets: dict[int, Target], name: str
) -> tuple[tuple[Setup, ...], list[_Part]]:
    setups: dict[tuple[int, int, int], Setup] = {}
    rows_so_far: dict[tuple[int, int], int] = {}
    parts: list[_Part] = []
    chosen = {t.number: _rows_of_target(oifits, t, targets, name) for t in tables}
    tables = [t for t in tables if len(chosen[t.number])]
    identified = stations_of_rows(oifits, tables, chosen)
    for table in tables:
        rows_in_use, found = chosen[table.number], identified[table.number]
        wavelengths = wavelength_table(oifits, table, channel_count(oifits, table))
        own = table.header.get(f"{OWN_KEY} SETUP", 0)
        band_notes: tuple[str, ...] = ()
        key = (wavelengths.number, 0 if found.array is None else found.array.number, own)
        if key not in setups:
            target = targets[int(_target_ids(oifits, table)[rows_in_use[0]])]
            made = make_setup(oifits, wavelengths, found.array, found.stations, target)
            setups[key] = with_response(oifits, made, own)
            band_notes = notes_of_bands(oifits, wavelengths)
        setup = setups[key]
        rows = read_rows(
            oifits, table, rows_in_use, found.position, (setup.wavelength_m, setup.band_m)
        )
        number, k = list(setups).index(key), 1 + (table.name == "OI_T3")
        rows = replace(rows, notes=(*band_notes, *found.notes, *rows.notes))
        first = rows_so_far.get((number, k), 0)
        rows_so_far[number, k] = first + len(rows_in_use)
        parts.append(_Part(k, _numbered(rows, number, first, table)))
    return tuple(setups.values()), parts


def _target_ids(oifits: OIFits, table: OITable) -> IntArray:
    """TARGET_ID of each row; of the only target, where the column is absent."""
    known = list(targets_of(oifits))
    if "TARGET_ID" not in table.columns and len(known) < 2:
        return np.full(len(table), known[0] if known else 1, dtype=np.intp)
    return integers(oifits, table, "TARGET_ID", 1)[:, 0]


def _rows_of_target(
    oifits: OIFits, table: OITable, targets: dict[int, Target], name: str
) -> IntArray:
    ids = _target_ids(oifits, table)
    return np.flatnonzero([same(targets[int(i)].name, name) for i in ids])


def _numbered(rows: Rows, setup: int, first_row: int, table: OITable) -> Rows:
    """Give the entries the number of their setup, and rows that run through all its tables."""
    m = rows.measurements
    _, row = np.unique(m.row, return_inverse=True)
    independent = str(table.header.get(f"{OWN_KEY} CLOSURES", "")) == "independent"
    return replace(
        rows,
        measurements=replace(
            m, setup=np.full(len(m), setup, dtype=np.intp), row=first_row + row.ravel()
        ),
        independent=independent,
    )


def _stack(parts: Sequence[_Part], k: int) -> Column:
    rows = [p.rows for p in parts]
    sizes = [len(r.measurements) for r in rows]
    whole = all(len(r.place) == len(r.measurements) for r in rows)
    none = np.empty(0, dtype=np.intp)
    return Column(
        _concatenated([r.measurements for r in rows], k),
        np.concatenate([np.empty(0), *(r.variance for r in rows)]),
        np.concatenate([none, *(r.correlation_index for r in rows)]),
        tuple(r.corrname for r in rows),
        tuple(r.insname for r in rows),
        tuple(r.independent for r in rows),
        np.repeat(np.arange(len(rows)), sizes),
        np.concatenate([none, *(r.place for r in rows)]) if whole else none,
    )


def _concatenated(parts: list[Measurements], k: int) -> Measurements:
    empty = {"u_m": np.empty((0, k)), "v_m": np.empty((0, k))}
    whole = {"stations": np.empty((0, k + 1), np.intp), "flag": np.empty(0, bool)}
    whole |= {name: np.empty(0, np.intp) for name in ("setup", "row", "channel")}
    names = [f.name for f in fields(Measurements) if f.default is MISSING]
    start = {name: (empty | whole).get(name, np.empty(0)) for name in names}
    return Measurements(
        **{
            name: np.concatenate([s, *(getattr(p, name) for p in parts)])
            for name, s in start.items()
        }
    )


def _in_written_order(column: Column) -> Column:
    """The order in which `write_oifits` was given the entries, where the file says so."""
    present = column.place[column.place > 0]
    if not len(present) or len(np.unique(present)) != len(present):
        return column
    order = np.flatnonzero(column.place > 0)[np.argsort(present)]
    return replace(
        column,
        measurements=column.measurements.select(order),
        variance=column.variance[order],
        correlation_index=column.correlation_index[order],
        part=column.part[order],
        place=column.place[order],
    )

"""From the tables of an OIFITS file to `Observables`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from amibayes.covariance import Covariance, DiagonalCovariance
from amibayes.errors import DataError
from amibayes.observables import CovarianceKind, IntArray, Measurements, Observables, Setup
from amibayes.oifits.correlations import (
    REMEDY,
    Pairs,
    given_covariance,
    image_pairs,
    image_table,
    joined,
    oi_corr_pairs,
)
from amibayes.oifits.rows import Rows, channel_count, read_rows
from amibayes.oifits.setups import (
    DATA_TABLES,
    Target,
    array_table,
    integers,
    listing,
    make_setup,
    same,
    stations_of,
    targets_of,
    wavelength_table,
)
from amibayes.oifits.tables import OWN_KEY, OIFits, OITable, open_oifits
from amibayes.units import FloatArray

ClosureCovariance = Literal["assumed", "diagonal"]


def read_oifits(
    path: str | Path,
    *,
    insname: str | None = None,
    target: str | None = None,
    closure_covariance: ClosureCovariance = "assumed",
) -> Observables:
    """Read the squared visibilities and closure phases of an OIFITS file.

    Parameters
    ----------
    path : str or path
        Version 1 or 2, plain or gzipped.
    insname : str, optional
        Only the data of this instrument table; all are joined otherwise.
    target : str, optional
        Which target, where the file holds data of several.
    closure_covariance : {"assumed", "diagonal"}
        What errors without correlations mean: independent baseline phases, which triangles
        share, or independent closure phases. "diagonal" also sets aside correlations that
        the file gives.

    Returns
    -------
    Observables

    Raises
    ------
    DataError
        Where the file cannot be read or holds no usable V² or closure phase.
    """
    return observables_of(
        open_oifits(path), insname=insname, target=target, closure_covariance=closure_covariance
    )


def observables_of(
    oifits: OIFits,
    *,
    insname: str | None = None,
    target: str | None = None,
    closure_covariance: ClosureCovariance = "assumed",
) -> Observables:
    """Take the squared visibilities and closure phases from an opened file; see `read_oifits`."""
    tables = _data_tables(oifits, insname)
    chosen, names = _chosen_target(oifits, tables, target)
    setups, parts = _parts(oifits, tables, names, chosen)
    content = _Content(
        _in_written_order(_stack([p for p in parts if p.u == 1], 1)),
        _in_written_order(_stack([p for p in parts if p.u == 2], 2)),
    )
    covariance, kind, count, notes = _covariance(oifits, content, closure_covariance)
    unused = tuple(f"{t.name or 'unnamed'} {t.extver} is not used" for t in oifits.unused)
    trailing = (f"{oifits.trailing_bytes} bytes after the last table",)
    return Observables(
        content.vis2.measurements,
        content.closure.measurements,
        covariance,
        kind,
        setups,
        count,
        (*(n for p in parts for n in p.rows.notes), *notes, *unused)
        + (trailing if oifits.trailing_bytes else ()),
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """Rows of one table and one setup; ``u`` is 1 for V² and 2 for closure phases."""

    u: int
    rows: Rows


@dataclass(frozen=True, eq=False)
class _Column:
    """All data of one kind.

    ``measurements``, ``variance`` and ``correlation_index`` run in parallel; ``corrname`` and
    ``insname`` give the index of each entry in ``names``; ``place`` as in `Rows`.
    """

    measurements: Measurements
    variance: FloatArray
    correlation_index: IntArray
    corrname: tuple[str, ...]
    insname: tuple[str, ...]
    independent: tuple[bool, ...]
    part: IntArray
    place: IntArray

    def of_parts(self, values: Sequence[object]) -> np.ndarray[tuple[int], np.dtype[np.object_]]:
        """Values given by part, for every entry."""
        table = np.empty(len(values), dtype=object)
        table[:] = values
        return table[self.part]


@dataclass(frozen=True, eq=False)
class _Content:
    vis2: _Column
    closure: _Column

    @property
    def both(self) -> tuple[_Column, _Column]:
        return self.vis2, self.closure


def _data_tables(oifits: OIFits, insname: str | None) -> list[OITable]:
    tables = [t for t in oifits.tables if t.name in DATA_TABLES and len(t)]
    if not tables:
        raise DataError(
            "holds neither squared visibilities nor closure phases",
            source=oifits.path,
            remedy="give a file with OI_VIS2 or OI_T3",
        )
    kept = [t for t in tables if insname is None or same(t.keyword("INSNAME"), insname)]
    if not kept:
        there = listing([t.keyword("INSNAME") for t in tables])
        raise DataError(f"has no INSNAME {insname!r}", source=oifits.path, remedy=f"it has {there}")
    return kept


def _chosen_target(
    oifits: OIFits, tables: list[OITable], wanted: str | None
) -> tuple[Target, dict[int, str]]:
    """Which target to read, and the name of every TARGET_ID in use."""
    known = targets_of(oifits)
    ids = np.unique(np.concatenate([integers(oifits, t, "TARGET_ID", 1)[:, 0] for t in tables]))
    found = {int(i): known.get(int(i), Target(f"target {i}")) for i in ids}
    names = {i: t.name for i, t in found.items()}
    alike = [t for t in found.values() if wanted is None or same(t.name, wanted)]
    if not alike:
        raise DataError(
            f"has no data of target {wanted!r}",
            source=oifits.path,
            remedy=f"it has {listing(list(names.values()))}",
        )
    if len({t.name.casefold() for t in alike}) > 1:
        raise DataError(
            f"holds data of several targets: {listing([t.name for t in alike])}",
            source=oifits.path,
            remedy="choose one of them",
        )
    return alike[0], names


def _parts(
    oifits: OIFits, tables: list[OITable], names: dict[int, str], target: Target
) -> tuple[tuple[Setup, ...], list[_Part]]:
    setups: dict[tuple[int, int, int], Setup] = {}
    rows_so_far: dict[tuple[int, int], int] = {}
    parts: list[_Part] = []
    for table in tables:
        ids = integers(oifits, table, "TARGET_ID", 1)[:, 0]
        chosen = np.flatnonzero([same(names[int(i)], target.name) for i in ids])
        if not len(chosen):
            continue
        wavelengths = wavelength_table(oifits, table, channel_count(oifits, table))
        array = array_table(oifits, table)
        stations = stations_of(oifits, array, _stations_in_use(oifits, tables, array))
        own = table.header.get(f"{OWN_KEY} SETUP", 0)
        key = (wavelengths.number, 0 if array is None else array.number, own)
        if key not in setups:
            setups[key] = make_setup(oifits, wavelengths, array, stations, target)
        setup = setups[key]
        index = integers(oifits, table, "STA_INDEX", 2 + (table.name == "OI_T3"))
        rows = read_rows(
            oifits, table, chosen, stations.position(index), (setup.wavelength_m, setup.band_m)
        )
        number, k = list(setups).index(key), 1 + (table.name == "OI_T3")
        first = rows_so_far.get((number, k), 0)
        rows_so_far[number, k] = first + len(chosen)
        parts.append(_Part(k, _numbered(rows, number, first, table)))
    return tuple(setups.values()), parts


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


def _stations_in_use(oifits: OIFits, tables: list[OITable], array: OITable | None) -> IntArray:
    used = [
        integers(oifits, t, "STA_INDEX", 2 + (t.name == "OI_T3")).ravel()
        for t in tables
        if array_table(oifits, t) is array
    ]
    return np.unique(np.concatenate(used))


def _stack(parts: Sequence[_Part], k: int) -> _Column:
    rows = [p.rows for p in parts]
    sizes = [len(r.measurements) for r in rows]
    whole = all(len(r.place) == len(r.measurements) for r in rows)
    none = np.empty(0, dtype=np.intp)
    return _Column(
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
    start = {f.name: (empty | whole).get(f.name, np.empty(0)) for f in fields(Measurements)}
    return Measurements(
        **{
            name: np.concatenate([s, *(getattr(p, name) for p in parts)])
            for name, s in start.items()
        }
    )


def _in_written_order(column: _Column) -> _Column:
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


def _covariance(
    oifits: OIFits, content: _Content, closure_covariance: ClosureCovariance
) -> tuple[Covariance, CovarianceKind, int | None, tuple[str, ...]]:
    """Covariance of what is not flagged, its kind, number of integrations and notes."""
    flag = np.concatenate([c.measurements.flag for c in content.both])
    variance = np.concatenate([c.variance for c in content.both])
    closure = content.closure.measurements
    closure = closure.select(~closure.flag)
    if flag.all():
        raise DataError(
            "holds no usable V² or closure phase: every value is flagged or without an error",
            source=oifits.path,
            remedy="check FLAG and the errors",
        )
    tables = _tables_in_use(oifits, content)
    images, variance, notes = _image_pairs(oifits, content, variance)
    if closure_covariance == "diagonal":
        set_aside = ("correlations of the file set aside",) if tables or notes else ()
        return DiagonalCovariance(variance[~flag]), "diagonal", None, set_aside
    pairs = _unflagged(joined([images, *_table_pairs(oifits, content, tables, variance)]), flag)
    said = _said_kind(tables)
    covered = _covered(content, tables if said else [])[~flag]
    independent = np.concatenate([c.of_parts(c.independent).astype(bool) for c in content.both])
    independent = independent[~flag]
    try:
        covariance = given_covariance(
            variance[~flag], pairs, closure, covered=covered, independent=independent
        )
    except DataError as error:
        raise DataError(error.what, source=oifits.path, remedy=REMEDY) from error
    kind: CovarianceKind = "given" if len(pairs.first) else "assumed"
    if independent[len(independent) - len(closure) :].all() and kind == "assumed":
        kind = "diagonal"
    return covariance, said or kind, _integrations(tables), notes


def _tables_in_use(oifits: OIFits, content: _Content) -> list[OITable]:
    """The OI_CORR that the data refer to.

    Raises
    ------
    DataError
        Where one is missing.
    """
    found: list[OITable] = []
    for name in dict.fromkeys(n for c in content.both for n in c.corrname if n):
        alike = [t for t in oifits.named("OI_CORR") if same(t.keyword("CORRNAME"), name)]
        indexed = any(
            (c.correlation_index[c.of_parts(c.corrname) == name] > 0).any() for c in content.both
        )
        if indexed and not alike:
            raise DataError(
                f"refers to correlations {name!r}, and no OI_CORR has that CORRNAME",
                source=oifits.path,
                remedy="write the file again with its OI_CORR",
            )
        found += alike[:1]
    return found


def _table_pairs(
    oifits: OIFits, content: _Content, tables: list[OITable], variance: FloatArray
) -> list[Pairs]:
    index = np.concatenate([c.correlation_index for c in content.both])
    name = np.concatenate([c.of_parts(c.corrname) for c in content.both])
    out = []
    for table in tables:
        ours = np.array([same(n, table.keyword("CORRNAME")) for n in name], dtype=bool)
        out.append(oi_corr_pairs(oifits, table, np.where(ours, index, 0), variance))
    return out


def _image_pairs(
    oifits: OIFits, content: _Content, variance: FloatArray
) -> tuple[Pairs, FloatArray, tuple[str, ...]]:
    variance, pairs, notes = variance.copy(), [], []
    shift = len(content.vis2.variance)
    for column, name, start in ((content.vis2, "V2COV", 0), (content.closure, "CPCOV", shift)):
        insname = column.of_parts(column.insname)
        for ins in dict.fromkeys(column.insname):
            table = image_table(oifits, name, ins)
            if table is None:
                continue
            entries = np.flatnonzero(insname == ins)
            channels = int(column.measurements.channel[entries].max()) + 1
            found, diagonal, note = image_pairs(
                oifits, table, entries + start, variance[entries + start], channels
            )
            variance[entries + start] = diagonal
            pairs.append(found)
            notes.append(note)
    return joined(pairs), variance, tuple(notes)


def _unflagged(pairs: Pairs, flag: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Pairs:
    """The pairs of data in use, numbered among these."""
    number = np.cumsum(~flag) - 1
    keep = ~(flag[pairs.first] | flag[pairs.second])
    return Pairs(number[pairs.first[keep]], number[pairs.second[keep]], pairs.covariance[keep])


def _covered(content: _Content, own: list[OITable]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Where a correlation that is not listed is zero: in the tables that amibayes wrote."""
    index = np.concatenate([c.correlation_index for c in content.both])
    return (index > 0) & bool(own)


def _said_kind(tables: list[OITable]) -> CovarianceKind | None:
    """The kind that amibayes wrote into OI_CORR."""
    kinds = [str(t.header.get(f"{OWN_KEY} COVARIANCE", "")) for t in tables]
    known: tuple[CovarianceKind, ...] = get_args(CovarianceKind)
    return next((k for k in known if kinds and all(kind == k for kind in kinds)), None)


def _integrations(tables: list[OITable]) -> int | None:
    counts = [t.header.get(f"{OWN_KEY} NINT") for t in tables]
    known = [int(c) for c in counts if isinstance(c, int | float) and c > 0]
    return min(known) if known else None

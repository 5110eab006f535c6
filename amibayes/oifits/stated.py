"""The errors that a file states: their covariance, of which kind, from how many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from scipy.sparse import csr_array

from amibayes.data.covariance import BlockCovariance, diagonal_covariance
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.measurements import Measurements
from amibayes.data.observables import CovarianceKind
from amibayes.data.shared_errors import SharedErrors
from amibayes.errors import DataError
from amibayes.oifits.columns import same
from amibayes.oifits.correlations import (
    REMEDY,
    Pairs,
    consistent_pairs,
    given_covariance,
    image_pairs,
    image_table,
    joined,
    oi_corr_pairs,
)
from amibayes.oifits.scatter import scatter_of, shared_of
from amibayes.oifits.tables import OWN_KEY, OIFits, OITable
from amibayes.support.options import ClosureCovariance
from amibayes.units import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Column:
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
class Content:
    """The two columns of a file."""

    vis2: Column
    closure: Column

    @property
    def both(self) -> tuple[Column, Column]:
        """V², then closure phases: the order of the data vector."""
        return self.vis2, self.closure


@dataclass(frozen=True, eq=False)
class FileCovariance:
    """A covariance, its kind, what it rests on, notes, and what of it other files share."""

    covariance: BlockCovariance
    kind: CovarianceKind
    n_integrations: int | None
    freedom: Freedom | None
    notes: tuple[str, ...]
    scatter: csr_array | None = None
    shared: SharedErrors | None = None


def stated_covariance(
    oifits: OIFits, content: Content, closure_covariance: ClosureCovariance
) -> FileCovariance:
    """Covariance of what is not flagged, and what the file states of it."""
    flag = np.concatenate([c.measurements.flag for c in content.both])
    variance = np.concatenate([c.variance for c in content.both])
    closure = content.closure.measurements
    closure = closure.select(~closure.flag)
    tables = _tables_in_use(oifits, content)
    images, variance, notes = _image_pairs(oifits, content, variance)
    if closure_covariance == "diagonal":
        set_aside = ("correlations of the file set aside",) if tables or notes else ()
        return FileCovariance(
            diagonal_covariance(variance[~flag]), "diagonal", None, None, set_aside
        )
    pairs = _unflagged(joined([images, *_table_pairs(oifits, content, tables, variance)]), flag)
    pairs, note = consistent_pairs(pairs, variance[~flag], closure)
    notes += (note,) if note else ()
    written = _written_kind(tables)
    covered = _covered(content, tables if written else [])[~flag]
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
    freedom = _freedom(tables)
    index = np.concatenate([c.correlation_index for c in content.both])[~flag]
    scatter = None if freedom is None else scatter_of(oifits, tables, index, variance[~flag])
    shared = shared_of(oifits, tables, index, variance[~flag])
    return FileCovariance(
        covariance, written or kind, _integrations(tables), freedom, notes, scatter, shared
    )


def _tables_in_use(oifits: OIFits, content: Content) -> list[OITable]:
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
    oifits: OIFits, content: Content, tables: list[OITable], variance: FloatArray
) -> list[Pairs]:
    index = np.concatenate([c.correlation_index for c in content.both])
    name = np.concatenate([c.of_parts(c.corrname) for c in content.both])
    out = []
    for table in tables:
        ours = np.array([same(n, table.keyword("CORRNAME")) for n in name], dtype=bool)
        out.append(oi_corr_pairs(oifits, table, np.where(ours, index, 0), variance))
    return out


def _image_pairs(
    oifits: OIFits, content: Content, variance: FloatArray
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


def _unflagged(pairs: Pairs, flag: BoolArray) -> Pairs:
    """The pairs of data in use, numbered among these."""
    number = np.cumsum(~flag) - 1
    keep = ~(flag[pairs.first] | flag[pairs.second])
    return Pairs(number[pairs.first[keep]], number[pairs.second[keep]], pairs.covariance[keep])


def _covered(content: Content, own: list[OITable]) -> BoolArray:
    """Where a correlation that is not listed is zero: in the tables that amibayes wrote."""
    index = np.concatenate([c.correlation_index for c in content.both])
    return (index > 0) & bool(own)


def _written_kind(tables: list[OITable]) -> CovarianceKind | None:
    """The kind that amibayes wrote into OI_CORR."""
    kinds = [str(t.header.get(f"{OWN_KEY} COVARIANCE", "")) for t in tables]
    known: tuple[CovarianceKind, ...] = get_args(CovarianceKind)
    return next((k for k in known if kinds and all(kind == k for kind in kinds)), None)


def _freedom(tables: list[OITable]) -> Freedom | None:
    """Degrees of freedom that amibayes wrote into OI_CORR, the least where there are several."""
    found = []
    for table in tables:
        values = [table.header.get(f"{OWN_KEY} {key}") for key in ("DOF", "SCATDOF")]
        numbers = [float(v) for v in values if isinstance(v, int | float)]
        if len(numbers) == 2 and numbers[0] > 2.0 and numbers[1] > 0.0:
            found.append(Freedom(*numbers))
    return min(found, key=lambda f: f.degrees) if found else None


def _integrations(tables: list[OITable]) -> int | None:
    counts = [t.header.get(f"{OWN_KEY} NINT") for t in tables]
    known = [int(c) for c in counts if isinstance(c, int | float) and c > 0]
    return min(known) if known else None

"""Tables that keep what OI_CORR does not tell of a covariance.

That by the measured scatter alone, and the errors in it that data of other files have too.
They are no part of the standard; programs that do not know them pass over them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy.io import fits
from scipy.sparse import coo_array, csr_array, triu

from amibayes.data.shared_errors import SharedErrors
from amibayes.oifits.tables import OIFits, OITable
from amibayes.units import FloatArray, IntArray

SCATTER, SHARED = "AMIBAYES_SCATTER", "AMIBAYES_SHARED"


def scatter_table(
    scatter: csr_array, variance: FloatArray, index: IntArray, corrname: str
) -> fits.BinTableHDU:
    """Lay the scatter out by pairs of data.

    Parameters
    ----------
    scatter : (n, n) sparse array
    variance : (n,) float array
        By which it is divided: what is written has no unit.
    index : (n,) int array
        Place of each datum in OI_CORR.
    corrname : str
        That OI_CORR.
    """
    sigma = np.sqrt(variance)
    upper = triu(scatter).tocoo()
    pairs = np.sort(np.stack([index[upper.row], index[upper.col]]), axis=0)
    share = upper.data / (sigma[upper.row] * sigma[upper.col])
    columns = {"IINDX": ("J", pairs[0]), "JINDX": ("J", pairs[1]), "SCATTER": ("D", share)}
    built = [fits.Column(name, form, array=values) for name, (form, values) in columns.items()]
    return _table(
        SCATTER,
        built,
        corrname,
        "Covariance by the scatter between integrations alone, in units of the errors",
        "of the two data; that of OI_CORR has the expected noise in it too.",
    )


def scatter_of(
    oifits: OIFits, tables: list[OITable], index: IntArray, variance: FloatArray
) -> csr_array | None:
    """Scatter that a file holds for its unflagged data; None where it does not for all of them.

    Parameters
    ----------
    oifits : OIFits
    tables : list of OITable
        The OI_CORR in use.
    index : (n,) int array
        Place of each datum in it; 0 where it has none.
    variance : (n,) float array
    """
    columns = _columns(oifits, SCATTER, tables, index)
    if columns is None:
        return None
    row, column = _places(index, columns["IINDX"], columns["JINDX"])
    sigma = np.sqrt(variance)
    used = (row >= 0) & (column >= 0) & np.isfinite(columns["SCATTER"])
    row, column = row[used], column[used]
    value = columns["SCATTER"][used] * sigma[row] * sigma[column]
    half = coo_array((value, (row, column)), shape=(len(index), len(index)))
    return csr_array(half + half.T - coo_array((half.diagonal(), (range(len(index)),) * 2)))


def shared_table(
    shared: SharedErrors, variance: FloatArray, index: IntArray, corrname: str
) -> fits.BinTableHDU:
    """Lay the changes out, one row for each error and datum.

    Parameters
    ----------
    shared : SharedErrors
    variance : (n,) float array
        By whose root they are divided: what is written has no unit.
    index : (n,) int array
        Place of each datum in OI_CORR.
    corrname : str
        That OI_CORR.
    """
    n = len(shared.names)
    share = shared.changes / np.sqrt(variance)[:, None]
    width = max(len(name) for name in shared.names)
    built = [
        fits.Column("NAME", f"{width}A", array=np.repeat(np.array(shared.names), len(index))),
        fits.Column("INDX", "J", array=np.tile(index, n)),
        fits.Column("CHANGE", "D", array=share.T.ravel()),
    ]
    return _table(
        SHARED,
        built,
        corrname,
        "Changes of the data, in units of their errors, for one standard deviation of",
        "errors that data of other files have too, under the same name.",
    )


def shared_of(
    oifits: OIFits, tables: list[OITable], index: IntArray, variance: FloatArray
) -> SharedErrors | None:
    """Shared errors that a file holds for its unflagged data; None where it holds none.

    Parameters
    ----------
    oifits : OIFits
    tables : list of OITable
        The OI_CORR in use.
    index : (n,) int array
        Place of each datum in it; 0 where it has none.
    variance : (n,) float array
    """
    columns = _columns(oifits, SHARED, tables, index)
    if columns is None:
        return None
    (row,) = _places(index, columns["INDX"])
    label = [str(name).strip() for name in columns["NAME"]]
    names = tuple(dict.fromkeys(label))
    changes = np.zeros((len(index), len(names)))
    value = columns["CHANGE"]
    used = (row >= 0) & np.isfinite(value)
    column = np.array([names.index(name) for name in label])
    changes[row[used], column[used]] = value[used] * np.sqrt(variance)[row[used]]
    return SharedErrors(names, changes)


def _table(
    name: str, columns: list[fits.Column], corrname: str, *comments: str
) -> fits.BinTableHDU:
    """Make a table that belongs to an OI_CORR."""
    table = fits.BinTableHDU.from_columns(columns, name=name)
    table.header["CORRNAME"] = corrname
    for line in comments:
        table.header["COMMENT"] = line
    return table


def _columns(oifits: OIFits, name: str, tables: list[OITable], index: IntArray) -> Any:
    """Columns of the one table of a name that belongs to the OI_CORR in use; None without it.

    None as well where not all data, of places ``index`` (n,), stand in that OI_CORR.
    """
    found = [t for t in oifits.tables if t.name == name]
    if len(tables) != 1 or len(found) != 1 or not (index > 0).all() or not len(found[0]):
        return None
    if found[0].keyword("CORRNAME") != tables[0].keyword("CORRNAME"):
        return None
    return found[0].columns


def _places(index: IntArray, *wanted: IntArray) -> list[IntArray]:
    """Which datum, of places ``index`` (n,) in OI_CORR, stands at others; −1 for none of them."""
    place = np.full(max(int(c.max()) for c in (index, *wanted)) + 1, -1)
    place[index] = np.arange(len(index))
    return [place[c] for c in wanted]

"""The table that keeps the covariance as the measured scatter alone has it.

It is no part of the standard; programs that do not know it pass over it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy.io import fits
from scipy.sparse import coo_array, csr_array, triu

from amibayes.oifits.tables import OIFits, OITable
from amibayes.units import FloatArray, IntArray

SCATTER = "AMIBAYES_SCATTER"


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
    table = fits.BinTableHDU.from_columns(built, name=SCATTER)
    table.header["CORRNAME"] = corrname
    for line in (
        "Covariance by the scatter between integrations alone, in units of the errors",
        "of the two data; that of OI_CORR has the expected noise in it too.",
    ):
        table.header["COMMENT"] = line
    return table


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
    found = [t for t in oifits.tables if t.name == SCATTER]
    if len(tables) != 1 or len(found) != 1 or not (index > 0).all():
        return None
    columns: Any = found[0].columns
    if found[0].keyword("CORRNAME") != tables[0].keyword("CORRNAME") or not len(found[0]):
        return None
    place = np.full(max(int(c.max()) for c in (columns["IINDX"], columns["JINDX"], index)) + 1, -1)
    place[index] = np.arange(len(index))
    row, column = place[columns["IINDX"]], place[columns["JINDX"]]
    sigma = np.sqrt(variance)
    used = (row >= 0) & (column >= 0) & np.isfinite(columns["SCATTER"])
    row, column = row[used], column[used]
    value = columns["SCATTER"][used] * sigma[row] * sigma[column]
    half = coo_array((value, (row, column)), shape=(len(index), len(index)))
    return csr_array(half + half.T - coo_array((half.diagonal(), (range(len(index)),) * 2)))

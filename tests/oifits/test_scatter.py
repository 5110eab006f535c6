"""The table of the measured scatter, number by number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.sparse import csr_array

from amibayes.oifits.scatter import SCATTER, scatter_of, scatter_table
from amibayes.oifits.tables import OIFits, open_oifits

INDEX = np.array([7, 2, 9, 4])
VARIANCE = np.array([4.0, 9.0, 0.25, 16.0])
SPREAD = np.array([
    [5.0, 1.5, 0.0, -2.0], [1.5, 8.0, 0.7, 0.0], [0.0, 0.7, 0.3, 0.4], [-2.0, 0.0, 0.4, 20.0],
])  # fmt: skip


def written(path: Path, corrname: str = "C1") -> OIFits:
    oi_corr = fits.BinTableHDU.from_columns(
        [fits.Column(n, f, array=[1]) for n, f in (("IINDX", "J"), ("JINDX", "J"), ("CORR", "D"))],
        name="OI_CORR",
    )
    oi_corr.header["CORRNAME"] = "C1"
    table = scatter_table(csr_array(SPREAD), VARIANCE, INDEX, corrname)
    fits.HDUList([fits.PrimaryHDU(), oi_corr, table]).writeto(path, overwrite=True)
    return open_oifits(path)


def found_in(file: OIFits, index: np.ndarray, variance: np.ndarray) -> np.ndarray | None:
    found = scatter_of(file, [t for t in file.tables if t.name == "OI_CORR"], index, variance)
    return None if found is None else found.toarray()


def test_pairs_are_written_once_in_units_of_the_errors(tmp_path: Path) -> None:
    (table,) = (t for t in written(tmp_path / "a.fits").tables if t.name == SCATTER)
    columns = table.columns
    pairs = zip(columns["IINDX"], columns["JINDX"], columns["SCATTER"], strict=True)
    expected = {
        (7, 7): 5.0 / 4.0, (2, 2): 8.0 / 9.0, (9, 9): 0.3 / 0.25, (4, 4): 20.0 / 16.0,
        (2, 7): 1.5 / (2.0 * 3.0), (4, 7): -2.0 / (2.0 * 4.0), (2, 9): 0.7 / (3.0 * 0.5),
        (4, 9): 0.4 / (0.5 * 4.0),
    }  # fmt: skip
    found = {(int(i), int(j)): float(share) for i, j, share in pairs}
    assert found.keys() == expected.keys()
    for pair, share in expected.items():
        np.testing.assert_allclose(found[pair], share, rtol=1e-14)


def test_it_comes_back_whole_in_another_order_and_in_part(tmp_path: Path) -> None:
    file = written(tmp_path / "a.fits")
    np.testing.assert_allclose(found_in(file, INDEX, VARIANCE), SPREAD, rtol=1e-14)
    some = np.array([3, 0, 1])
    part = found_in(file, INDEX[some], VARIANCE[some])
    np.testing.assert_allclose(part, SPREAD[np.ix_(some, some)], rtol=1e-14)
    # Errors that were made three times as large take the scatter along.
    wider = found_in(file, INDEX, 9.0 * VARIANCE)
    np.testing.assert_allclose(wider, 9.0 * SPREAD, rtol=1e-14)


def test_it_is_not_taken_where_it_is_of_other_data(tmp_path: Path) -> None:
    file = written(tmp_path / "a.fits")
    assert found_in(file, np.array([7, 0, 9, 4]), VARIANCE) is None
    assert found_in(written(tmp_path / "b.fits", "C2"), INDEX, VARIANCE) is None
    assert scatter_of(file, [], INDEX, VARIANCE) is None

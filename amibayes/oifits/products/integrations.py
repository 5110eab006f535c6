"""``amimulti-oi``: N integrations of every observable, averaged here with their covariance.

A naive reader takes the integrations for spectral channels, and their errors, all 0, for
weights. They are the best that the pipeline delivers: means of phasors instead of means of
clipped phases, and the joint covariance of V² and closure phases from their scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import Block, BlockCovariance
from amibayes.data.joining import SEPARATOR
from amibayes.data.observables import Observables
from amibayes.data.outliers import outlying
from amibayes.data.shrinkage import Shrunk, shrunk_covariance
from amibayes.errors import DataError
from amibayes.oifits.products.recognise import Product, by_implaneia
from amibayes.oifits.products.repairs import with_columns
from amibayes.oifits.reader import observables_of
from amibayes.oifits.tables import OIFits
from amibayes.units import BoolArray, ComplexArray, FloatArray

CLIP = 5.0
"""Integrations that differ by more standard deviations are left out, as in extraction."""


@dataclass(frozen=True, eq=False)
class Series:
    """Observables of integrations, in the order of the rows of OI_VIS2 and OI_T3.

    Parameters
    ----------
    vis2 : (n, n_baselines) array
        Noise bias included.
    bispectrum : (n, n_triangles) complex array
    """

    vis2: FloatArray
    bispectrum: ComplexArray

    def __len__(self) -> int:
        return len(self.vis2)

    def select(self, keep: BoolArray) -> Series:
        """The integrations ``keep``."""
        return Series(self.vis2[keep], self.bispectrum[keep])

    @property
    def noise(self) -> float:
        """Variance of the real part of a visibility, from successive amplitudes.

        Differences of neighbours are free of what drifts, or changes between dithers.
        """
        amplitude = np.sqrt(np.maximum(self.vis2, 0.0))
        return float(0.5 * np.mean(np.diff(amplitude, axis=0) ** 2))

    @property
    def mean(self) -> tuple[FloatArray, FloatArray]:
        """V² without its noise bias (twice `noise`), and closure phases of mean phasors."""
        closure = np.angle(self.bispectrum.mean(axis=0))
        return self.vis2.mean(axis=0) - 2.0 * self.noise, np.asarray(closure)

    @property
    def deviation(self) -> FloatArray:
        """Deviations (n, n_baselines + n_triangles) from the mean, to first order."""
        by_vis2 = self.vis2 - self.vis2.mean(axis=0)
        by_closure = (self.bispectrum / self.bispectrum.mean(axis=0)).imag
        return np.concatenate([by_vis2, by_closure], axis=1)


def series_of(product: Product) -> Series:
    """Read the integrations of one file, those without a number everywhere left out.

    Raises
    ------
    DataError
        Where a column is missing or of another shape.
    """
    vis2 = _by_integration(product, "OI_VIS2", "VIS2DATA")
    phase = _by_integration(product, "OI_T3", "T3PHI")
    # ImPlaneIA writes closure amplitudes of four holes there, as many as there are triangles.
    own = not by_implaneia(product)
    amplitude = _by_integration(product, "OI_T3", "T3AMP") if own else np.ones_like(phase)
    if not len(vis2) == len(amplitude) == len(phase):
        raise DataError("its tables have different numbers of integrations", source=_path(product))
    bispectrum = amplitude * np.exp(1j * np.radians(phase))
    series = Series(vis2, np.asarray(bispectrum))
    used = np.concatenate([~_flag(product, "OI_VIS2"), ~_flag(product, "OI_T3")])
    whole = np.isfinite(np.concatenate([vis2, np.abs(bispectrum)], axis=1))[:, used].all(axis=1)
    return series.select(whole)


def _path(product: Product) -> str:
    return product.oifits.path


def _by_integration(product: Product, name: str, column: str) -> FloatArray:
    """A column as (n_integrations, n_rows)."""
    table = product.table(name)
    values = None if table is None else table.columns.get(column)
    if table is None or values is None or not len(table):
        raise DataError(f"has no column {column} in {name}", source=_path(product))
    return np.asarray(values, dtype=float).reshape(len(table), -1).T


def _flag(product: Product, name: str) -> BoolArray:
    table = product.table(name)
    assert table is not None
    flag = table.columns.get("FLAG")
    if flag is None:
        return np.zeros(len(table), dtype=bool)
    return np.asarray(flag.reshape(len(table), -1).astype(bool).all(axis=1))


def averaged(products: Sequence[Product], **options: Any) -> Observables:
    """Average the integrations of exposures of one star, and estimate their covariance.

    Parameters
    ----------
    products : sequence of Product
        ``amimulti-oi``, repaired, with the same rows.
    **options
        ``insname`` and ``target`` of `observables_of`.

    Raises
    ------
    DataError
        Where there is only one integration: nothing then tells the errors.
    """
    parts = [series_of(product) for product in products]
    series = Series(
        np.concatenate([p.vis2 for p in parts]), np.concatenate([p.bispectrum for p in parts])
    )
    _refuse_few(series, products)
    first = products[0]
    options.pop("closure_covariance", None)
    rows = observables_of(_mean_file(first.oifits, series, _flags(products)), **options)
    used = np.concatenate([~rows.vis2.flag, ~rows.closure_phase.flag])
    physical, basis = _expected(rows, series, used)
    kept = ~outlying(series.deviation[:, used], np.sqrt(np.diag(physical)), CLIP)
    dropped = int((~kept).sum())
    series = series.select(kept)
    rows = observables_of(_mean_file(first.oifits, series, _flags(products)), **options)
    shrunk = shrunk_covariance(series.deviation[:, used], physical, basis, rows.n_vis2)
    notes = (f"{dropped} of {len(kept)} integrations not used",) if dropped else ()
    return _observables(rows, shrunk, basis, len(series), products, notes)


def _refuse_few(series: Series, products: Sequence[Product]) -> None:
    if len(series) < 2:
        raise DataError(
            f"has {len(series) or 'no'} usable integration{'' if len(series) == 1 else 's'}: "
            "nothing tells its errors",
            source=SEPARATOR.join(_path(p) for p in products),
            remedy="give an exposure of several integrations",
        )


def _flags(products: Sequence[Product]) -> tuple[BoolArray, BoolArray]:
    """Rows that any of the files flags, of OI_VIS2 and OI_T3."""
    vis2, closure = (
        np.any([_flag(p, name) for p in products], axis=0) for name in ("OI_VIS2", "OI_T3")
    )
    return np.asarray(vis2), np.asarray(closure)


def _mean_file(oifits: OIFits, series: Series, flags: tuple[BoolArray, BoolArray]) -> OIFits:
    """The file with one number in the place of the integrations; errors by themselves."""
    vis2, closure = series.mean
    error = series.deviation.std(axis=0, ddof=1) / np.sqrt(len(series))
    error = np.maximum(error, 1e-9)  # equal integrations (a test file) are no reason to flag
    n = len(vis2)
    new = {
        "OI_VIS2": {"VIS2DATA": vis2, "VIS2ERR": error[:n], "FLAG": flags[0]},
        "OI_T3": {
            "T3PHI": np.degrees(closure),
            "T3PHIERR": np.degrees(np.minimum(error[n:], 0.99 * np.pi)),
            "FLAG": flags[1],
        },
    }
    tables = tuple(with_columns(t, new.get(t.name, {})) for t in oifits.tables)
    return replace(oifits, tables=tables)


def _expected(rows: Observables, series: Series, used: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Covariance of one integration of visibilities of equal, independent noise, and basis.

    Photons and read noise of a fringe fit are nearly the same for every baseline; how large
    they are, for V² and for closure phases, the scatter says.
    """
    vis2, closure = (m.select(~m.flag) for m in (rows.vis2, rows.closure_phase))
    noise = max(series.noise, 1e-18)
    # What is fainter than its noise has a phase that is no more uncertain than this.
    power = np.maximum(vis2.value, noise)
    matrix, baselines = closure_matrix(closure.stations) if len(closure) else _nothing()
    known = {tuple(sorted(s)): p for s, p in zip(vis2.stations.tolist(), power, strict=True)}
    usual = float(np.median(power)) if len(power) else 1.0
    of_leg = np.array([noise / known.get(tuple(b), usual) for b in baselines.tolist()])
    n, m = len(vis2), len(closure)
    physical = np.zeros((n + m, n + m))
    physical[:n, :n] = np.diag(4.0 * power * noise + 4.0 * noise**2)
    physical[n:, n:] = (matrix * of_leg) @ matrix.T
    kernel = kernel_basis(matrix) if m else np.zeros((0, 0))
    basis = np.zeros((n + m, n + kernel.shape[1]))
    basis[:n, :n], basis[n:, n:] = np.eye(n), kernel
    return physical, basis


def _nothing() -> tuple[FloatArray, Any]:
    return np.zeros((0, 0)), np.zeros((0, 2), dtype=np.intp)


def _observables(
    rows: Observables,
    shrunk: Shrunk,
    basis: FloatArray,
    n: int,
    products: Sequence[Product],
    notes: tuple[str, ...],
) -> Observables:
    source = SEPARATOR.join(_path(p) for p in products)
    block = Block(np.arange(len(basis)), shrunk.matrix / n, basis)
    if shrunk.block > 1:
        notes += (
            f"integrations are correlated in time ({shrunk.correlation:.2f} from one to the "
            f"next): the covariance rests on means of {shrunk.block}",
        )
    return replace(
        rows,
        covariance=BlockCovariance(len(basis), [block]),
        covariance_kind="estimated",
        setups=tuple(replace(s, source=source) for s in rows.setups),
        n_integrations=n,
        notes=(*rows.notes, *notes),
        freedom=shrunk.carried,
        scatter=None if shrunk.carried is None else csr_array(shrunk.scatter / n),
    )

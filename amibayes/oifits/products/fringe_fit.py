"""How errors of averages are correlated: as the pipeline's fit of the fringes makes them.

`ami_analyze` fits a flux, fringes and a pedestal to the pixels, each of which counts the same; the
noise is that of the photons. One flux divides all fringes, and fringes overlap: V² of all
baselines move together by more than independent ones of the same errors, and so does the contrast
of a companion, which they all tell (its error would be too small by 1.7). Integrations of
simulated visits scatter with these correlations, to the 0.05 that 500 of them can show.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag

from amibayes.data.closure import baseline_variances, closure_matrix, kernel_basis
from amibayes.data.covariance import dense_covariance
from amibayes.data.observables import Observables
from amibayes.errors import DataError, UsageError
from amibayes.instrument import load_instrument
from amibayes.oifits.products.recognise import Product
from amibayes.oifits.tables import plain
from amibayes.optics import fringe_basis
from amibayes.units import FloatArray, IntArray

N_PIXELS = 48
"""Of the images that are fitted: of larger ones the correlations are the same within 0.01."""

FAINTEST = 1e-4
"""V² below which fringes are taken for as bright as this."""


@lru_cache(maxsize=8)
def fit_covariance(instrument: str, filter: str) -> FloatArray | None:
    """Covariance (1 + 2n, 1 + 2n) of flux, Re V and Im V of a point, up to a factor.

    None of an instrument that is not known.
    """
    try:
        known = load_instrument(instrument, filter).as_built()
    except (UsageError, DataError):
        return None
    basis = fringe_basis(known, known.bandpass.channels(), N_PIXELS)
    columns = np.column_stack([basis.matrix, np.ones(len(basis.matrix))])
    scale = np.sqrt((columns**2).sum(axis=0))  # the pedestal is in other units
    fit = (np.linalg.pinv(columns / scale) / scale[:, None])[:-1]
    return np.asarray((fit * basis.image().ravel()) @ fit.T)


def correlated(found: Observables, product: Product) -> Observables:
    """Give the errors of an average the correlations of the fit.

    Errors of V² stay what they are; those of closure phases, all together, too.

    Parameters
    ----------
    found : Observables
        One number for each baseline and triangle, errors right.
    product : Product
        Where it is from; of another mask than the instrument's nothing is changed.
    """
    header = product.oifits.header
    names = (plain(header.get(key, "")) for key in ("INSTRUME", "FILTER"))
    covariance = fit_covariance(*names)
    if covariance is None:
        return found
    data = found.unflagged()
    vis2, closure = data.vis2, data.closure_phase
    pairs = np.sort(found.setups[0].station_index[vis2.stations], axis=1)
    rows = _rows(pairs, len(covariance) // 2)
    if rows is None or len(np.unique(rows)) < len(rows) or not len(closure):
        return found
    matrix, baselines = closure_matrix(closure.stations)
    legs = _rows(found.setups[0].station_index[baselines], len(covariance) // 2)
    if legs is None:
        return found
    errors = np.split(np.sqrt(data.covariance.variance), [len(vis2)])
    of_vis2 = _vis2(covariance, rows, np.maximum(vis2.value, FAINTEST))
    of_closure = _closures(covariance, legs, matrix, errors[1] ** 2)
    total = block_diag(of_vis2 * np.outer(errors[0], errors[0]), of_closure)
    basis = block_diag(np.eye(len(vis2)), kernel_basis(matrix))
    return replace(found, covariance=dense_covariance(total, basis))


def _rows(pairs: IntArray, n_baselines: int) -> IntArray | None:
    """Places (n,) of baselines (n, 2), counted from hole 1, among all; None where one is not."""
    n_holes = round((1.0 + np.sqrt(1.0 + 8.0 * n_baselines)) / 2.0)
    if len(pairs) and (pairs.min() < 1 or pairs.max() > n_holes):
        return None
    place = np.zeros((n_holes, n_holes), dtype=np.intp)
    place[np.triu_indices(n_holes, 1)] = np.arange(n_baselines)
    first, second = np.sort(pairs, axis=1).T - 1
    return np.asarray(place[first, second])


def _vis2(covariance: FloatArray, rows: IntArray, power: FloatArray) -> FloatArray:
    """Correlations (n, n) of V² of baselines."""
    slopes = np.zeros((len(rows), len(covariance)))
    slopes[:, 0] = -2.0 * power
    slopes[np.arange(len(rows)), 1 + rows] = 2.0 * np.sqrt(power)
    return _normed(slopes @ covariance @ slopes.T)


def _closures(
    covariance: FloatArray, legs: IntArray, matrix: FloatArray, variance: FloatArray
) -> FloatArray:
    """Covariance (n, n) of closure phases, the sum of its variances that of ``variance``."""
    imaginary = 1 + len(covariance) // 2 + legs
    sides = matrix * np.sqrt(baseline_variances(matrix, variance))
    whole = sides @ _normed(covariance[np.ix_(imaginary, imaginary)]) @ sides.T
    return np.asarray(whole * (variance.sum() / np.trace(whole)))


def _normed(covariance: FloatArray) -> FloatArray:
    size = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(size, size))

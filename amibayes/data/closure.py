"""Closure phases and the baselines they are made of: incidence, kernel basis, covariance.

Closure phases around the triangles of an array share baselines, so they are neither
independent of each other nor, as a rule, of full rank: n stations give n(n−1)(n−2)/6
triangles but only (n−1)(n−2)/2 independent combinations (kernel phases, Martinache 2010).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.optimize import nnls

from amibayes.data.blocks import orthonormal
from amibayes.data.kernel_model import stands_alone
from amibayes.units import FloatArray, IntArray

RIDGE = 1e-4
"""Weight of the pull towards equal baseline variances, relative to reproducing the errors."""

FLOOR = 0.05
"""Smallest baseline variance, in units of the mean one: no combination gets infinite weight."""


def canonical(stations: IntArray) -> tuple[IntArray, IntArray]:
    """Stations of baselines or triangles in rising order, and the sign that this gives.

    Parameters
    ----------
    stations : (n, 2) or (n, 3) int array

    Returns
    -------
    ordered : int array of the same shape
    sign : (n,) int array
        +1 or −1: a closure phase changes sign when two stations change places (0 where a
        station comes twice, +1 for kernel phases, see `amibayes.data.kernel_model`). A squared
        visibility does not: always +1.
    """
    ordered = np.sort(stations, axis=1)
    if stations.shape[1] == 2:
        return ordered, np.ones(len(stations), dtype=np.intp)
    a, b, c = stations.T
    sign = np.sign((b - a) * (c - a) * (c - b)).astype(np.intp)
    return ordered, np.where(stands_alone(stations), 1, sign)


def canonical_uv(stations: IntArray, u_m: FloatArray, v_m: FloatArray) -> FloatArray:
    """(u, v) of baselines or triangles as if their stations stood in rising order.

    Parameters
    ----------
    stations : (n, k + 1) int array
        k = 1 for baselines, 2 for triangles.
    u_m, v_m : (n, k) float array
        From each station to the next.

    Returns
    -------
    (n, 2k) float array
        u, then v.
    """
    order = np.argsort(stations, axis=1)
    parts = []
    for step in (u_m, v_m):
        place = np.concatenate([np.zeros((len(step), 1)), np.cumsum(step, axis=1)], axis=1)
        parts.append(np.diff(np.take_along_axis(place, order, axis=1), axis=1))
    return np.concatenate(parts, axis=1)


def closure_matrix(triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """Incidence of triangles on baselines: closure phase = K · baseline phase.

    Parameters
    ----------
    triangles : (n, 3) int array
        Stations a, b, c of each triangle, whose closure phase is φ(ab) + φ(bc) − φ(ac).

    Returns
    -------
    matrix : (n, n_baselines) float array
        Entries −1, 0, +1; a baseline is counted positive from the lower to the higher station.
        A kernel phase has a column of its own, with √3: as much noise as three baselines make.
    baselines : (n_baselines, 2) int array
        The baselines that the triangles use, each with its lower station first.
    """
    matrix, baselines = _closure_matrix(np.ascontiguousarray(triangles, dtype=np.intp).tobytes())
    return matrix.copy(), baselines.copy()


@lru_cache(maxsize=512)
def _closure_matrix(triangles: bytes) -> tuple[FloatArray, IntArray]:
    """`closure_matrix`, remembered: the exposures of a file repeat few sets of triangles."""
    a, b, c = np.frombuffer(triangles, dtype=np.intp).reshape(-1, 3).T
    legs = np.stack([np.stack([a, b], 1), np.stack([b, c], 1), np.stack([a, c], 1)], axis=1)
    sign = np.where(legs[..., 0] < legs[..., 1], 1.0, -1.0) * np.array([1.0, 1.0, -1.0])
    baselines, column = np.unique(np.sort(legs, axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    matrix = np.zeros((len(a), len(baselines)))
    np.add.at(matrix, (np.repeat(np.arange(len(a)), 3), column.ravel()), sign.ravel())
    alone = np.flatnonzero((a == b) & (b == c))
    matrix[alone, column.reshape(-1, 3)[alone, 0]] = np.sqrt(3.0)
    return matrix, baselines


def kernel_basis(matrix: FloatArray) -> FloatArray:
    """Orthonormal basis (n_triangles, rank) of the closure phases that a matrix can produce."""
    return orthonormal(matrix)


def baseline_variances(matrix: FloatArray, closure_variance: FloatArray) -> FloatArray:
    """Variances of independent baseline phases that reproduce closure-phase errors.

    Among the solutions of |K| s = σ² the one nearest to equal variances is taken, with a
    floor above zero: four stations have four triangles for six baselines, and plain
    non-negative least squares would leave two baselines without noise.

    Parameters
    ----------
    matrix : (n_triangles, n_baselines) float array
        From `closure_matrix`.
    closure_variance : (n_triangles,) or (n_triangles, n_sets) float array
        Squared errors of the closure phases; each column is solved by itself.

    Returns
    -------
    (n_baselines,) or (n_baselines, n_sets) float array
    """
    target = np.atleast_2d(closure_variance.T).T
    share = np.abs(matrix)
    mean = target.mean(axis=0) / share.sum(axis=1).mean()
    system = np.vstack([share, np.sqrt(RIDGE) * np.eye(share.shape[1])])
    right = np.vstack([target / mean, np.full((share.shape[1], target.shape[1]), np.sqrt(RIDGE))])
    solution = np.linalg.lstsq(system, right, rcond=None)[0]
    for column in np.flatnonzero((solution < FLOOR).any(axis=0)):
        above = right[:, column] - FLOOR * system.sum(axis=1)
        solution[:, column] = FLOOR + nnls(system, above)[0]
    return np.asarray((solution * mean).reshape(share.shape[1:] + closure_variance.shape[1:]))


def assumed_covariance(matrix: FloatArray, closure_variance: FloatArray) -> FloatArray:
    """Covariance K Σ Kᵀ of closure phases whose file gives errors and no correlations.

    Parameters
    ----------
    matrix : (n_triangles, n_baselines) float array
    closure_variance : (n_triangles, n_sets) float array
        Squared errors, one column per exposure and channel.

    Returns
    -------
    (n_sets, n_triangles, n_triangles) float array
    """
    variances = baseline_variances(matrix, closure_variance)
    return np.asarray(np.einsum("tb,bs,qb->stq", matrix, variances, matrix, optimize=True))

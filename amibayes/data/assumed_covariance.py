"""Covariances of data whose file gives errors only."""

from __future__ import annotations

import numpy as np

from amibayes.data.closure import assumed_covariance, closure_matrix, kernel_basis
from amibayes.data.covariance import (
    Block,
    BlockCovariance,
    diagonal_covariance,
    stack_covariances,
)
from amibayes.data.measurements import Measurements
from amibayes.data.observables import CovarianceKind
from amibayes.units import FloatArray, IntArray


def kernel_blocks(closure_phase: Measurements, sigma: FloatArray) -> list[Block]:
    """Covariance blocks of closure phases given by their errors alone, K Σ Kᵀ.

    Parameters
    ----------
    closure_phase : Measurements
        Unflagged.
    sigma : (n,) float array
        Errors in radians.
    """
    by_topology: dict[bytes, list[IntArray]] = {}
    for entries in closure_phase.sets:
        key = closure_phase.stations[entries].tobytes()
        by_topology.setdefault(key, []).append(entries)
    blocks = []
    for sets in by_topology.values():
        matrix, _ = closure_matrix(closure_phase.stations[sets[0]])
        basis = kernel_basis(matrix)
        variance = np.array([sigma[entries] ** 2 for entries in sets])
        full = assumed_covariance(matrix, variance.T)
        blocks += [Block(e, c, basis) for e, c in zip(sets, full, strict=True)]
    return blocks


def covariance_of_errors(
    vis2_error: FloatArray,
    closure_phase: Measurements,
    closure_error: FloatArray,
    kind: CovarianceKind,
) -> BlockCovariance:
    """Covariance of data whose file gives errors only.

    Parameters
    ----------
    vis2_error : (n_vis2,) float array
    closure_phase : Measurements
        Unflagged.
    closure_error : (n_closure,) float array
        Radians.
    kind : {"assumed", "diagonal"}
        Closures of independent baseline phases, or (the field's habit) independent.
    """
    if kind == "diagonal" or not len(closure_phase):
        return diagonal_covariance(np.concatenate([vis2_error, closure_error]) ** 2)
    closures = BlockCovariance(len(closure_error), kernel_blocks(closure_phase, closure_error))
    return stack_covariances([diagonal_covariance(vis2_error**2), closures])

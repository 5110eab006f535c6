"""How a faint companion and the nuisance parameters move the whitened data, to first order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from amibayes.likelihood.likelihood import Likelihood
from amibayes.units import FloatArray, IntArray

DENSE_ENOUGH = 0.15
"""Share of non-zeros above which a dense product is the faster one."""


@dataclass(frozen=True, eq=False)
class Part:
    """A matrix (n_rows, n_samples) and the data that its rows stand for."""

    matrix: csr_array | FloatArray
    rows: IntArray


def _part(matrix: csr_array) -> Part:
    matrix = csr_array(matrix)
    matrix.eliminate_zeros()
    rows = np.flatnonzero(np.diff(matrix.indptr))
    kept = matrix[rows]
    dense = kept.nnz > DENSE_ENOUGH * kept.shape[0] * kept.shape[1]
    return Part(kept.toarray() if dense else kept, rows)


def linear_response(likelihood: Likelihood, nuisance: FloatArray) -> tuple[Part, Part, FloatArray]:
    """Matrices A, B and V₀ with template = A·(Re(E) − V₀) + B·Im(−E).

    With V₀ = D/(1 + f) real, dV/dc = (E − V₀)/(1 + f), hence dV² = 2V₀ Re dV and
    dφ = Im dV / V₀.
    """
    response = likelihood.model.linear_response(likelihood.samples, nuisance)
    primary, scale = response.star, response.scale
    whitening = likelihood.noise.covariance.whitening
    n2 = likelihood.samples.squares.shape[0]
    by_vis2, by_closure = whitening[:, :n2], whitening[:, n2:]
    even = _part(by_vis2 @ likelihood.samples.squares.multiply(2.0 * scale * primary))
    odd = _part(by_closure @ likelihood.samples.legs.multiply(-scale / primary))
    return even, odd, np.asarray(primary)


def nuisance_directions(likelihood: Likelihood, nuisance: FloatArray) -> FloatArray:
    """Orthonormal directions (n_data, k) in which the nuisance parameters move the data."""
    single = replace(likelihood.model, companions=0)
    if not len(single.parameters):
        return np.empty((likelihood.n_independent, 0))
    return np.asarray(np.linalg.qr(likelihood.with_model(single).jacobian(nuisance))[0])

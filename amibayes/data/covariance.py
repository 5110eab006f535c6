"""The covariance of a data vector behind one small protocol.

A data vector is a column: ``x`` is (size,) or (size, n) with n vectors side by side.
A covariance may be of lower rank than its size (closure phases); `whiten` then returns
the independent combinations, of unit variance, and everything else follows from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from amibayes.data.blocks import Block, BlockCovariance, Stack
from amibayes.units import FloatArray, IntArray


@runtime_checkable
class Covariance(Protocol):
    """What the rest of the package asks of a covariance."""

    @property
    def size(self) -> int:
        """Length of the data vector."""
        ...

    @property
    def rank(self) -> int:
        """Number of independent combinations."""
        ...

    @property
    def variance(self) -> FloatArray:
        """Diagonal of the matrix, (size,)."""
        ...

    @property
    def whitening(self) -> csr_array:
        """The sparse matrix W, (rank, size), with W C Wᵀ = 1."""
        ...

    @property
    def factors(self) -> tuple[csr_array, ...]:
        """Sparse matrices whose product is the whitening, the first applied last."""
        ...

    def whiten(self, x: FloatArray) -> FloatArray:
        """Independent, unit-variance combinations, (rank, …), of data (size, …)."""
        ...

    def solve(self, x: FloatArray) -> FloatArray:
        """(Pseudo-)inverse of the covariance times x, (size, …)."""
        ...

    def logdet(self) -> float:
        """Logarithm of the determinant of the covariance of the independent combinations."""
        ...

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Noise vectors, (size, n)."""
        ...

    def dense(self) -> FloatArray:
        """The full matrix, (size, size)."""
        ...

    @property
    def symmetric(self) -> csr_array:
        """Sparse matrix (size, rank) of which S x has a row for every entry of whitened data x.

        SᵀS = 1. A row stands for its entry as closely as can be (Kessy, Lewin & Strimmer 2018,
        ZCA-cor; of correlated channels, that of their whitened data).
        """
        ...

    def select(self, keep: IntArray) -> Covariance:
        """Covariance of the entries ``keep``, in that order."""
        ...


def multiplied(factors: Sequence[csr_array | FloatArray], x: FloatArray) -> FloatArray:
    """Multiply x (n, …) by matrices, the last one first."""
    for factor in reversed(factors):
        x = factor @ x
    return np.asarray(x)


def diagonal_covariance(variance: FloatArray) -> BlockCovariance:
    """Covariance of independent errors, whose variances (size,) are positive and finite."""
    variance = np.asarray(variance, dtype=float)
    index = np.arange(len(variance))[:, None]
    return BlockCovariance(len(variance), [Stack(index, variance[:, None, None])])


def dense_covariance(matrix: FloatArray, basis: FloatArray | None = None) -> BlockCovariance:
    """Covariance of one fully correlated data vector, (size, size)."""
    return BlockCovariance(len(matrix), [Block(np.arange(len(matrix)), np.asarray(matrix), basis)])


def stack_covariances(parts: Sequence[BlockCovariance]) -> BlockCovariance:
    """Covariance of independent data vectors laid end to end."""
    starts = np.concatenate([[0], np.cumsum([part.size for part in parts])])
    return BlockCovariance(
        int(starts[-1]),
        [s.moved(int(at)) for part, at in zip(parts, starts, strict=False) for s in part.stacks],
    )


def covariance_from_matrix(matrix: FloatArray) -> BlockCovariance:
    """Covariance of a matrix split into its connected groups of correlated entries."""
    count, label = connected_components(matrix != 0, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(count)]
    return BlockCovariance(len(matrix), [Block(g, matrix[np.ix_(g, g)]) for g in groups])


__all__ = [
    "Block",
    "BlockCovariance",
    "Covariance",
    "covariance_from_matrix",
    "dense_covariance",
    "diagonal_covariance",
    "stack_covariances",
]

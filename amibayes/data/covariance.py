"""The covariance of a data vector behind one small protocol.

A data vector is a column: ``x`` is (size,) or (size, n) with n vectors side by side.
A covariance may be of lower rank than its size (closure phases); `whiten` then returns
the independent combinations, of unit variance, and everything else follows from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from amibayes.data.blocks import Block, BlockCovariance, Stack
from amibayes.errors import DataError
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

    def select(self, keep: IntArray) -> Covariance:
        """Covariance of the entries ``keep``, in that order."""
        ...


@dataclass(frozen=True, eq=False)
class DiagonalCovariance:
    """Independent errors.

    Parameters
    ----------
    variance : (size,) float array
        Positive and finite.
    """

    variance: FloatArray

    def __post_init__(self) -> None:
        variance = np.array(self.variance, dtype=float)
        if variance.ndim != 1 or not (np.isfinite(variance).all() and (variance > 0).all()):
            raise DataError(
                "an error that is zero, negative or not finite", remedy="flag such data"
            )
        variance.flags.writeable = False
        object.__setattr__(self, "variance", variance)

    @property
    def size(self) -> int:
        """Length of the data vector."""
        return len(self.variance)

    @property
    def rank(self) -> int:
        """All entries are independent."""
        return self.size

    @property
    def whitening(self) -> csr_array:
        """The sparse matrix W, (rank, size), with W C Wᵀ = 1."""
        return csr_array(diags_array(1.0 / np.sqrt(self.variance)))

    def whiten(self, x: FloatArray) -> FloatArray:
        """x / σ."""
        return np.asarray((x.T / np.sqrt(self.variance)).T)

    def solve(self, x: FloatArray) -> FloatArray:
        """x / σ²."""
        return np.asarray((x.T / self.variance).T)

    def logdet(self) -> float:
        """Σ ln σ²."""
        return float(np.log(self.variance).sum())

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Noise vectors, (size, n)."""
        return rng.standard_normal((self.size, n)) * np.sqrt(self.variance)[:, None]

    def dense(self) -> FloatArray:
        """The full matrix, (size, size)."""
        return np.diag(self.variance)

    def select(self, keep: IntArray) -> DiagonalCovariance:
        """Covariance of the entries ``keep``, in that order."""
        return DiagonalCovariance(self.variance[keep])


def dense_covariance(matrix: FloatArray, basis: FloatArray | None = None) -> BlockCovariance:
    """Covariance of one fully correlated data vector, (size, size)."""
    return BlockCovariance(len(matrix), [Block(np.arange(len(matrix)), np.asarray(matrix), basis)])


def as_blocks(covariance: Covariance, shift: int = 0) -> list[Block]:
    """List the blocks of any covariance, moved ``shift`` entries down the data vector."""
    if isinstance(covariance, BlockCovariance):
        return [Block(b.index + shift, b.matrix, b.basis) for b in covariance.blocks]
    if isinstance(covariance, DiagonalCovariance):
        return [
            Block(np.array([i + shift]), np.array([[v]])) for i, v in enumerate(covariance.variance)
        ]
    return [Block(shift + np.arange(covariance.size), covariance.dense())]


def sparse_covariance(covariance: Covariance) -> csr_array:
    """Write a covariance as a sparse matrix."""
    shape = (covariance.size, covariance.size)
    if isinstance(covariance, BlockCovariance):
        return coo_array(covariance.entries, shape=shape).tocsr()
    if isinstance(covariance, DiagonalCovariance):
        return csr_array(diags_array(covariance.variance))
    return csr_array(covariance.dense())


def scaled(covariance: Covariance, factors: FloatArray) -> Covariance:
    """Covariance of data that are multiplied by numbers, one for each.

    Parameters
    ----------
    factors : (size,) float array
        None of them zero.
    """
    if isinstance(covariance, BlockCovariance):
        return BlockCovariance(covariance.size, [s.scaled(factors) for s in covariance.stacks])
    return DiagonalCovariance(covariance.variance * factors**2)


def stack_covariances(parts: Sequence[Covariance]) -> Covariance:
    """Covariance of independent data vectors laid end to end."""
    if all(isinstance(part, DiagonalCovariance) for part in parts):
        return DiagonalCovariance(np.concatenate([part.variance for part in parts]))
    starts = np.concatenate([[0], np.cumsum([part.size for part in parts])])
    stacks = [s for part, at in zip(parts, starts, strict=False) for s in _stacks(part, int(at))]
    return BlockCovariance(int(starts[-1]), stacks)


def _stacks(covariance: Covariance, shift: int) -> list[Stack]:
    if not covariance.size:
        return []
    if isinstance(covariance, BlockCovariance):
        return [s.moved(shift) for s in covariance.stacks]
    if isinstance(covariance, DiagonalCovariance):
        index = shift + np.arange(covariance.size)[:, None]
        return [Stack(index, covariance.variance[:, None, None])]
    return [Stack(shift + np.arange(covariance.size)[None], covariance.dense()[None])]


def covariance_from_matrix(matrix: FloatArray) -> Covariance:
    """Covariance of a matrix split into its connected groups of correlated entries."""
    if not np.any(matrix - np.diag(np.diag(matrix))):
        return DiagonalCovariance(np.diag(matrix))
    count, label = connected_components(matrix != 0, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(count)]
    return BlockCovariance(len(matrix), [Block(g, matrix[np.ix_(g, g)]) for g in groups])


__all__ = [
    "Block",
    "BlockCovariance",
    "Covariance",
    "DiagonalCovariance",
    "as_blocks",
    "covariance_from_matrix",
    "dense_covariance",
    "sparse_covariance",
    "stack_covariances",
]

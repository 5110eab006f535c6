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
from numpy.typing import NDArray
from scipy.linalg import cho_factor, solve_triangular

from amibayes.errors import DataError
from amibayes.units import FloatArray

IntArray = NDArray[np.intp]


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


@dataclass(frozen=True, eq=False)
class Block:
    """A correlated group of entries.

    Parameters
    ----------
    index : (m,) int array
        Where the group stands in the data vector.
    matrix : (m, m) float array
        Its covariance.
    basis : (m, r) float array, optional
        Orthonormal basis of the combinations that carry information (all, where absent).
        For closure phases it is their kernel basis.
    """

    index: IntArray
    matrix: FloatArray
    basis: FloatArray | None = None

    def factors(self) -> tuple[FloatArray, FloatArray]:
        """(whitening (r, m), colouring (m, r)): unit noise ↔ noise of this covariance.

        Raises
        ------
        DataError
            Where the matrix is not positive definite on the basis.
        """
        basis = np.eye(len(self.index)) if self.basis is None else self.basis
        try:
            lower = cho_factor(basis.T @ self.matrix @ basis, lower=True)[0]
        except (np.linalg.LinAlgError, ValueError) as error:
            raise DataError("the covariance is not positive definite") from error
        lower = np.tril(lower)
        return solve_triangular(lower, basis.T, lower=True), basis @ lower

    def select(self, position: IntArray, inside: IntArray) -> Block:
        """Keep the entries ``inside`` of the block, which then stand at ``position``."""
        basis = self.basis
        if basis is not None:
            left, singular, _ = np.linalg.svd(basis[inside], full_matrices=False)
            basis = left[:, singular > 1e-8]
        return Block(position, self.matrix[np.ix_(inside, inside)], basis)


@dataclass(frozen=True, eq=False)
class _Batch:
    """Blocks of one shape, stacked: ``index`` (g, m), ``rows`` (g, r)."""

    index: IntArray
    rows: IntArray
    whitening: FloatArray
    colouring: FloatArray

    def apply(self, x: FloatArray, out: FloatArray) -> None:
        g, m = self.index.shape
        if m == 1:
            out[self.rows[:, 0]] = self.whitening[:, 0] * x[self.index[:, 0]]
        else:
            out[self.rows.ravel()] = (
                self.whitening @ x[self.index.ravel()].reshape(g, m, -1)
            ).reshape(self.rows.size, -1)

    def transpose(self, y: FloatArray, factor: FloatArray, out: FloatArray) -> None:
        g, r = self.rows.shape
        out[self.index.ravel()] = (factor @ y[self.rows.ravel()].reshape(g, r, -1)).reshape(
            self.index.size, -1
        )


def _stack(blocks: Sequence[Block], first_row: int) -> _Batch:
    whitening, colouring = (np.array(f) for f in zip(*(b.factors() for b in blocks), strict=True))
    g, r = whitening.shape[:2]
    rows = first_row + np.arange(g * r).reshape(g, r)
    return _Batch(np.array([b.index for b in blocks]), rows, whitening, colouring)


class BlockCovariance:
    """Independent groups of correlated entries; one block makes it dense.

    Parameters
    ----------
    size : int
        Length of the data vector.
    blocks : sequence of Block
        Every entry stands in exactly one block.

    Raises
    ------
    DataError
        Where a block is not positive definite on its basis.
    ValueError
        Where the blocks do not tile the vector.
    """

    def __init__(self, size: int, blocks: Sequence[Block]) -> None:
        everywhere = np.concatenate([b.index for b in blocks]) if blocks else np.empty(0, np.intp)
        if len(everywhere) != size or not np.array_equal(np.sort(everywhere), np.arange(size)):
            raise ValueError("the blocks of a covariance have to tile the data vector")
        self.size = size
        self.blocks = tuple(blocks)
        self._batches = self._batched()
        self.rank = sum(batch.rows.size for batch in self._batches)

    def _batched(self) -> list[_Batch]:
        kinds: dict[tuple[int, int], list[Block]] = {}
        for block in self.blocks:
            rank = len(block.index) if block.basis is None else block.basis.shape[1]
            kinds.setdefault((len(block.index), rank), []).append(block)
        batches: list[_Batch] = []
        for alike in kinds.values():
            first = sum(batch.rows.size for batch in batches)
            batches.append(_stack(alike, first))
        return batches

    @property
    def variance(self) -> FloatArray:
        """Diagonal of the matrix, (size,)."""
        diagonal = np.empty(self.size)
        for block in self.blocks:
            diagonal[block.index] = np.diag(block.matrix)
        return diagonal

    def whiten(self, x: FloatArray) -> FloatArray:
        """Independent, unit-variance combinations, (rank, …)."""
        columns = x.reshape(self.size, -1)
        out = np.empty((self.rank, columns.shape[1]))
        for batch in self._batches:
            batch.apply(columns, out)
        return out.reshape((self.rank, *x.shape[1:]))

    def solve(self, x: FloatArray) -> FloatArray:
        """(Pseudo-)inverse of the covariance times x, (size, …)."""
        white = self.whiten(x).reshape(self.rank, -1)
        out = np.empty((self.size, white.shape[1]))
        for batch in self._batches:
            batch.transpose(white, batch.whitening.swapaxes(1, 2), out)
        return out.reshape(x.shape)

    def logdet(self) -> float:
        """Logarithm of the determinant of the covariance of the independent combinations."""
        return sum(
            float(np.linalg.slogdet(b.colouring.swapaxes(1, 2) @ b.colouring)[1].sum())
            for b in self._batches
        )

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Noise vectors, (size, n)."""
        white = rng.standard_normal((self.rank, n))
        out = np.empty((self.size, n))
        for batch in self._batches:
            batch.transpose(white, batch.colouring, out)
        return out

    def dense(self) -> FloatArray:
        """The full matrix, (size, size)."""
        matrix = np.zeros((self.size, self.size))
        for block in self.blocks:
            matrix[np.ix_(block.index, block.index)] = block.matrix
        return matrix

    def select(self, keep: IntArray) -> BlockCovariance:
        """Covariance of the entries ``keep``, in that order."""
        place = np.full(self.size, -1, dtype=np.intp)
        place[keep] = np.arange(len(keep))
        kept = []
        for block in self.blocks:
            inside = np.flatnonzero(place[block.index] >= 0)
            if len(inside):
                kept.append(block.select(place[block.index[inside]], inside))
        return BlockCovariance(len(keep), kept)


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


def stack_covariances(parts: Sequence[Covariance]) -> Covariance:
    """Covariance of independent data vectors laid end to end."""
    if all(isinstance(part, DiagonalCovariance) for part in parts):
        return DiagonalCovariance(np.concatenate([part.variance for part in parts]))
    starts = np.concatenate([[0], np.cumsum([part.size for part in parts])])
    blocks = [b for part, s in zip(parts, starts, strict=False) for b in as_blocks(part, int(s))]
    return BlockCovariance(int(starts[-1]), blocks)


def covariance_from_matrix(matrix: FloatArray) -> Covariance:
    """Covariance of a matrix split into its connected groups of correlated entries."""
    from scipy.sparse.csgraph import connected_components

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
    "stack_covariances",
]

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

    def select(self, position: IntArray, inside: IntArray) -> Block:
        """Keep the entries ``inside`` of the block, which then stand at ``position``."""
        basis = self.basis
        if basis is not None:
            left, singular, _ = np.linalg.svd(basis[inside], full_matrices=False)
            basis = left[:, singular > 1e-8]
        return Block(position, self.matrix[np.ix_(inside, inside)], basis)


def _factors(blocks: Sequence[Block]) -> tuple[FloatArray, FloatArray]:
    """Whitening (g, r, m) and colouring (g, r, m)ᵀ factors of g blocks of one shape."""
    bases = np.array([np.eye(len(b.index)) if b.basis is None else b.basis for b in blocks])
    inner = bases.swapaxes(1, 2) @ np.array([b.matrix for b in blocks]) @ bases
    try:
        lower = np.linalg.cholesky(inner)
    except np.linalg.LinAlgError as error:
        raise DataError("the covariance is not positive definite") from error
    if not np.isfinite(lower).all():
        raise DataError("the covariance has entries that are not finite")
    return np.linalg.solve(lower, bases.swapaxes(1, 2)), bases @ lower


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
        self.whitening, colouring, self._logdet = self._assemble()
        self.colouring = csr_array(colouring.T)
        self._unwhitening = self.whitening.T.tocsr()
        self.rank = int(self.whitening.shape[0])

    def _alike(self) -> list[list[Block]]:
        kinds: dict[tuple[int, int], list[Block]] = {}
        for block in self.blocks:
            rank = len(block.index) if block.basis is None else block.basis.shape[1]
            kinds.setdefault((len(block.index), rank), []).append(block)
        return list(kinds.values())

    def _assemble(self) -> tuple[csr_array, csr_array, float]:
        row = 0
        places, whitening, colouring, logdet = [], [], [], 0.0
        for blocks in self._alike():
            white, colour = _factors(blocks)
            g, r, m = white.shape
            rows = row + np.arange(g * r).reshape(g, r, 1)
            columns = np.array([b.index for b in blocks]).reshape(g, 1, m)
            places.append([np.broadcast_to(x, (g, r, m)).ravel() for x in (rows, columns)])
            whitening.append(white.ravel())
            colouring.append(colour.swapaxes(1, 2).ravel())
            logdet += float(np.linalg.slogdet(colour.swapaxes(1, 2) @ colour)[1].sum())
            row += g * r
        where = tuple(np.concatenate(x) for x in zip(*places, strict=True)) if row else ([], [])
        shape = (row, self.size)
        return (
            csr_array((np.concatenate([np.empty(0), *whitening]), where), shape=shape),
            csr_array((np.concatenate([np.empty(0), *colouring]), where), shape=shape),
            logdet,
        )

    @property
    def variance(self) -> FloatArray:
        """Diagonal of the matrix, (size,)."""
        diagonal = np.empty(self.size)
        for block in self.blocks:
            diagonal[block.index] = np.diag(block.matrix)
        return diagonal

    def whiten(self, x: FloatArray) -> FloatArray:
        """Independent, unit-variance combinations, (rank, …)."""
        return np.asarray(self.whitening @ x)

    def solve(self, x: FloatArray) -> FloatArray:
        """(Pseudo-)inverse of the covariance times x, (size, …)."""
        return np.asarray(self._unwhitening @ (self.whitening @ x))

    def logdet(self) -> float:
        """Logarithm of the determinant of the covariance of the independent combinations."""
        return self._logdet

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Noise vectors, (size, n)."""
        return np.asarray(self.colouring @ rng.standard_normal((self.rank, n)))

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


def sparse_covariance(covariance: Covariance) -> csr_array:
    """Write a covariance as a sparse matrix."""
    rows, columns, values = [], [], []
    for block in as_blocks(covariance):
        m = len(block.index)
        rows.append(np.repeat(block.index, m))
        columns.append(np.tile(block.index, m))
        values.append(block.matrix.ravel())
    shape = (covariance.size, covariance.size)
    if not rows:
        return csr_array(shape)
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return coo_array(entries, shape=shape).tocsr()


def scaled(covariance: Covariance, factors: FloatArray) -> Covariance:
    """Covariance of data that are multiplied by numbers, one for each.

    Parameters
    ----------
    factors : (size,) float array
        None of them zero.
    """
    if isinstance(covariance, BlockCovariance):
        blocks = []
        for block in covariance.blocks:
            f = factors[block.index]
            basis = block.basis
            if basis is not None and not (f == f[0]).all():
                basis = np.linalg.qr(f[:, None] * basis)[0]
            blocks.append(Block(block.index, f[:, None] * block.matrix * f, basis))
        return BlockCovariance(covariance.size, blocks)
    return DiagonalCovariance(covariance.variance * factors**2)


def stack_covariances(parts: Sequence[Covariance]) -> Covariance:
    """Covariance of independent data vectors laid end to end."""
    if all(isinstance(part, DiagonalCovariance) for part in parts):
        return DiagonalCovariance(np.concatenate([part.variance for part in parts]))
    starts = np.concatenate([[0], np.cumsum([part.size for part in parts])])
    blocks = [b for part, s in zip(parts, starts, strict=False) for b in as_blocks(part, int(s))]
    return BlockCovariance(int(starts[-1]), blocks)


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

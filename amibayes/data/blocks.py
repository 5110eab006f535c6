"""Covariances of independent groups of correlated data, whitened group by group of one shape."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from amibayes.errors import DataError
from amibayes.units import FloatArray, IntArray

INDEPENDENT = 1e-8
"""Length, in units of the longest column, from which on what is new in a column is no rounding."""


def orthonormal(columns: FloatArray) -> FloatArray:
    """Orthonormal basis (n, rank) of the space of some columns (n, k), by Gram and Schmidt.

    Singular vectors of equal singular values (those of closure phases are all equal) are turned
    by the last digits, and with them all noise that is drawn in whitened data: from one
    processor to the next. This basis is a smooth function of the columns.
    """
    columns = np.asarray(columns, dtype=float)
    least = INDEPENDENT * float(np.linalg.norm(columns, axis=0).max(initial=0.0))
    if 0 < columns.shape[1] <= len(columns):
        # Of independent columns it is Q of QR, with the signs of the columns.
        turned, upper = np.linalg.qr(columns)
        if (np.abs(np.diag(upper)) > least).all():
            return np.asarray(turned * np.sign(np.diag(upper)))
    basis = np.empty((len(columns), 0))
    for column in columns.T:
        rest = column - basis @ (basis.T @ column)
        rest = rest - basis @ (basis.T @ rest)  # once more: the first leaves rounding
        length = float(np.linalg.norm(rest))
        if length > least:
            basis = np.column_stack([basis, rest / length])
    return basis


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
            basis = orthonormal(basis[inside])
        return Block(position, self.matrix[np.ix_(inside, inside)], basis)


@dataclass(frozen=True, eq=False)
class Stack:
    """Blocks of one size and rank side by side: thousands are handled as one array.

    Parameters
    ----------
    index : (g, m) int array
    matrix : (g, m, m) float array
    basis : (g, m, r) float array, optional
        As those of `Block`; absent where all combinations carry information.
    """

    index: IntArray
    matrix: FloatArray
    basis: FloatArray | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Size and rank of each block."""
        m = self.index.shape[1]
        return m, m if self.basis is None else self.basis.shape[2]

    @classmethod
    def of(cls, blocks: Sequence[Block]) -> Stack:
        """Lay blocks of one size and rank together."""
        basis = None
        if any(b.basis is not None for b in blocks):
            eye = np.eye(len(blocks[0].index))
            basis = np.array([eye if b.basis is None else b.basis for b in blocks])
        return cls(np.array([b.index for b in blocks]), np.array([b.matrix for b in blocks]), basis)

    @classmethod
    def joined(cls, stacks: Sequence[Stack]) -> Stack:
        """Stacks of one shape as one."""
        if len(stacks) == 1:
            return stacks[0]
        index, matrix = (
            np.concatenate([getattr(s, n) for s in stacks]) for n in ("index", "matrix")
        )
        if all(s.basis is None for s in stacks):
            return cls(index, matrix)
        eye = np.eye(index.shape[1])
        bases = [
            np.broadcast_to(eye, s.matrix.shape) if s.basis is None else s.basis for s in stacks
        ]
        return cls(index, matrix, np.concatenate(bases))

    def moved(self, shift: int) -> Stack:
        """The same blocks ``shift`` entries down the data vector."""
        return Stack(self.index + shift, self.matrix, self.basis)

    def scaled(self, factors: FloatArray) -> Stack:
        """Blocks of data that are multiplied by numbers (size,)."""
        f = factors[self.index]
        basis = None
        if self.basis is not None:
            basis, upper = np.linalg.qr(f[:, :, None] * self.basis)
            # Signs as those of `orthonormal`, which do not depend on rounding.
            basis = basis * np.sign(np.einsum("grr->gr", upper))[:, None]
        return replace(self.stretched(factors), basis=basis)

    def stretched(self, factors: FloatArray) -> Stack:
        """Blocks of errors that are multiplied by numbers (size,), the data as they are."""
        f = factors[self.index]
        return replace(self, matrix=f[:, :, None] * self.matrix * f[:, None])

    def part_of(self, matrix: csr_array) -> FloatArray:
        """What a matrix (size, size) has in these blocks, (g, m, m)."""
        rows = np.broadcast_to(self.index[:, :, None], self.matrix.shape)
        columns = np.broadcast_to(self.index[:, None], self.matrix.shape)
        return np.asarray(matrix[rows.ravel(), columns.ravel()]).reshape(self.matrix.shape)

    def select(self, place: IntArray) -> list[Stack]:
        """Entries that have a place (size,) of 0 or more, there."""
        new = place[self.index]
        inside = new >= 0
        whole = inside.all(axis=1)
        kept = []
        if whole.any():
            basis = None if self.basis is None else self.basis[whole]
            kept.append(Stack(new[whole], self.matrix[whole], basis))
        for k in np.flatnonzero(inside.any(axis=1) & ~whole):
            block = Block(
                self.index[k], self.matrix[k], None if self.basis is None else self.basis[k]
            )
            at = np.flatnonzero(inside[k])
            kept.append(Stack.of([block.select(new[k][at], at)]))
        return kept

    def factors(self) -> tuple[FloatArray, FloatArray]:
        """Whitening (g, r, m) and colouring (g, m, r) factors.

        Raises
        ------
        DataError
            Where a block is not positive definite on its basis.
        """
        m, _ = self.shape
        if m == 1:
            if not (np.isfinite(self.matrix).all() and (self.matrix > 0).all()):
                raise DataError(
                    "an error that is zero, negative or not finite", remedy="flag such data"
                )
            sigma = np.sqrt(self.matrix)
            return 1.0 / sigma, sigma
        basis = np.eye(m)[None] if self.basis is None else self.basis
        inner = basis.swapaxes(1, 2) @ self.matrix @ basis
        try:
            lower = np.linalg.cholesky(inner)
        except np.linalg.LinAlgError as error:
            raise DataError("the covariance is not positive definite") from error
        if not np.isfinite(lower).all():
            raise DataError("the covariance has entries that are not finite")
        right = np.broadcast_to(basis.swapaxes(1, 2), (len(lower), *basis.shape[:0:-1]))
        return np.linalg.solve(lower, right), basis @ lower

    def symmetric(self) -> FloatArray:
        """(AᵀA)^{-1/2} Aᵀ of every block, (g, r, m), A its standardised colouring."""
        _, colouring = self.factors()
        errors = np.sqrt(np.einsum("gmm->gm", self.matrix))
        left, _, right = np.linalg.svd(colouring / errors[:, :, None], full_matrices=False)
        return np.asarray((left @ right).swapaxes(1, 2))


Factors = tuple[FloatArray, FloatArray]
LARGE = 16
"""Data of a block from which on full matrices are faster: five times for 120 triangles."""


class BlockCovariance:
    """Independent groups of correlated entries; one block makes it dense.

    Parameters
    ----------
    size : int
        Length of the data vector.
    blocks : sequence of Block or Stack
        Every entry stands in exactly one block.

    Raises
    ------
    DataError
        Where a block is not positive definite on its basis.
    ValueError
        Where the blocks do not tile the vector.
    """

    def __init__(self, size: int, blocks: Sequence[Block | Stack]) -> None:
        self.size = size
        self.stacks = _stacked(blocks)
        everywhere = np.concatenate([np.empty(0, np.intp), *(s.index.ravel() for s in self.stacks)])
        if len(everywhere) != size or not np.array_equal(np.sort(everywhere), np.arange(size)):
            raise ValueError("the blocks of a covariance have to tile the data vector")
        each = [stack.factors() for stack in self.stacks]
        self.whitening, colouring, self._logdet = self._assemble(each)
        self._full = [white if white.shape[2] >= LARGE else None for white, _ in each]
        self.colouring = csr_array(colouring.T)
        self._unwhitening = self.whitening.T.tocsr()
        self.factors, self.rank = (self.whitening,), int(self.whitening.shape[0])

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """Its groups, those of one size and rank together."""
        return tuple(
            Block(s.index[k], s.matrix[k], None if s.basis is None else s.basis[k])
            for s in self.stacks
            for k in range(len(s.index))
        )

    @cached_property
    def _places(self) -> tuple[IntArray, IntArray]:
        """Row and column of every number of factors (g, r, m) of the stacks, side by side."""
        first, rows, columns = 0, [np.empty(0, np.intp)], [np.empty(0, np.intp)]
        for stack in self.stacks:
            (g, m), r = stack.index.shape, stack.shape[1]
            row = first + np.arange(g * r).reshape(g, r, 1)
            rows.append(np.broadcast_to(row, (g, r, m)).ravel())
            columns.append(np.broadcast_to(stack.index.reshape(g, 1, m), (g, r, m)).ravel())
            first += g * r
        return np.concatenate(rows), np.concatenate(columns)

    def laid_out(self, factors: Sequence[FloatArray]) -> csr_array:
        """Sparse matrix (rank, size) of a factor (g, r, m) for every stack."""
        values = np.concatenate([np.empty(0), *(f.ravel() for f in factors)])
        rank = sum(len(s.index) * s.shape[1] for s in self.stacks)
        return csr_array((values, self._places), shape=(rank, self.size))

    def _assemble(self, factors: Sequence[Factors]) -> tuple[csr_array, csr_array, float]:
        """Whitening and transposed colouring, (rank, size), and ln of the determinant."""
        colours = [colour.swapaxes(1, 2) for _, colour in factors]
        inner = (colour @ colour.swapaxes(1, 2) for colour in colours)
        logdet = sum(float(np.linalg.slogdet(matrix)[1].sum()) for matrix in inner)
        return self.laid_out([white for white, _ in factors]), self.laid_out(colours), logdet

    @property
    def variance(self) -> FloatArray:
        """Diagonal of the matrix, (size,)."""
        diagonal = np.empty(self.size)
        for stack in self.stacks:
            diagonal[stack.index] = np.einsum("gmm->gm", stack.matrix)
        return diagonal

    @property
    def has_large_blocks(self) -> bool:
        """Whether a block is large enough to be whitened as a full matrix."""
        return any(white is not None for white in self._full)

    @cached_property
    def _parts(self) -> list[tuple[slice, IntArray | None, Any]]:
        """Rows of whitened data, the data of blocks, and a matrix; small blocks are left sparse."""
        last = np.cumsum([len(s.index) * s.shape[1] for s in self.stacks]).tolist()
        rows = [slice(*ends) for ends in pairwise([0, *last])]
        return [
            (at, None, self.whitening[at]) if white is None else (at, stack.index, white)
            for at, stack, white in zip(rows, self.stacks, self._full, strict=True)
        ]

    def whiten(self, x: FloatArray) -> FloatArray:
        """Independent, unit-variance combinations, (rank, …)."""
        if x.ndim < 2 or not self.has_large_blocks:
            return np.asarray(self.whitening @ x)
        out = np.empty((self.rank, x.shape[1]))
        for rows, index, matrix in self._parts:
            out[rows] = (matrix @ (x if index is None else x[index])).reshape(out[rows].shape)
        return out

    def solve(self, x: FloatArray) -> FloatArray:
        """(Pseudo-)inverse of the covariance times x, (size, …)."""
        return np.asarray(self._unwhitening @ (self.whitening @ x))

    @cached_property
    def symmetric(self) -> csr_array:
        """Rows (size, rank) of the symmetric whitening; see `Covariance.symmetric`."""
        return csr_array(self.laid_out([s.symmetric() for s in self.stacks]).T)

    def logdet(self) -> float:
        """Logarithm of the determinant of the covariance of the independent combinations."""
        return self._logdet

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Noise vectors, (size, n)."""
        return np.asarray(self.colouring @ rng.standard_normal((self.rank, n)))

    def dense(self) -> FloatArray:
        """The full matrix, (size, size)."""
        return np.asarray(self.sparse.toarray())

    @property
    def independent(self) -> bool:
        """Whether no two entries are correlated."""
        return all(s.shape[0] == 1 for s in self.stacks)

    @property
    def sparse(self) -> csr_array:
        """The matrix, (size, size)."""
        values, rows, columns = [np.empty(0)], [np.empty(0, np.intp)], [np.empty(0, np.intp)]
        for s in self.stacks:
            values.append(s.matrix.ravel())
            rows.append(np.broadcast_to(s.index[:, :, None], s.matrix.shape).ravel())
            columns.append(np.broadcast_to(s.index[:, None], s.matrix.shape).ravel())
        places = np.concatenate(rows), np.concatenate(columns)
        return coo_array((np.concatenate(values), places), shape=(self.size, self.size)).tocsr()

    def stretched(self, factors: FloatArray) -> BlockCovariance:
        """Covariance of errors (size,) that are multiplied by numbers, the data as they are."""
        return BlockCovariance(self.size, [s.stretched(factors) for s in self.stacks])

    def scaled(self, factors: FloatArray) -> BlockCovariance:
        """Covariance of data that are multiplied by numbers (size,), none of them zero."""
        return BlockCovariance(self.size, [s.scaled(factors) for s in self.stacks])

    def select(self, keep: IntArray) -> BlockCovariance:
        """Covariance of the entries ``keep``, in that order."""
        place = np.full(self.size, -1, dtype=np.intp)
        place[keep] = np.arange(len(keep))
        return BlockCovariance(len(keep), [s for old in self.stacks for s in old.select(place)])

    def plus(self, addition: csr_array) -> BlockCovariance:
        """The sum with a covariance (size, size), of which what lies in the blocks counts."""
        return self.growing(addition)(1.0)

    def growing(self, addition: csr_array) -> Callable[[float], BlockCovariance]:
        """The sum with any amount of a covariance, as `plus` has it with one."""
        parts = [(s, s.part_of(addition)) for s in self.stacks]

        def grown(amount: float) -> BlockCovariance:
            stacks = [Stack(s.index, s.matrix + amount * part, s.basis) for s, part in parts]
            return BlockCovariance(self.size, stacks)

        return grown

    def against(self, addition: csr_array, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues (rank,) of an addition in units of this, and data (size,) along each.

        With ``amount`` times the addition, χ² is Σ along²/(1 + amount·eigenvalue), and ln of the
        determinant grows by Σ ln(1 + amount·eigenvalue).
        """
        values, along = [np.empty(0)], [np.empty(0)]
        for s in self.stacks:
            white, _ = s.factors()
            own, axes = np.linalg.eigh(white @ s.part_of(addition) @ white.swapaxes(1, 2))
            values.append(own.ravel())
            along.append((axes.swapaxes(1, 2) @ (white @ x[s.index][:, :, None])).ravel())
        return np.concatenate(values), np.concatenate(along)


def _stacked(blocks: Sequence[Block | Stack]) -> tuple[Stack, ...]:
    """Blocks by size and rank, in the order in which these first appear."""
    kinds: dict[tuple[int, int], list[Block | Stack]] = {}
    for block in blocks:
        if isinstance(block, Stack):
            shape = block.shape
        else:
            m = len(block.index)
            shape = m, m if block.basis is None else block.basis.shape[1]
        kinds.setdefault(shape, []).append(block)
    out = []
    for alike in kinds.values():
        parts: list[Stack] = []
        waiting: list[Block] = []
        for block in alike:
            if isinstance(block, Block):
                waiting.append(block)
                continue
            parts += [Stack.of(waiting)] if waiting else []
            waiting = []
            parts.append(block)
        out.append(Stack.joined([*parts, *([Stack.of(waiting)] if waiting else [])]))
    return tuple(out)

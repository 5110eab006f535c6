"""Errors that several data sets have in common: one constant of the detector, not several draws.

A coefficient that is known to some error moves all data of a visit together, target and
calibrators alike. Each such error is a column of changes of the data, for one standard
deviation, under a name by which other data sets know it again. The covariance of the data
holds them; a difference or ratio of data sets has to take them out first, and put in what is
left of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from amibayes.data.blocks import Block, BlockCovariance
from amibayes.errors import UsageError
from amibayes.units import BoolArray, FloatArray, IntArray, read_only


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Errors that the data of one set have in common with others.

    Parameters
    ----------
    names : tuple of str
    changes : (size, len(names)) array
        Of the unflagged data, V² first, for one standard deviation of each.
    """

    names: tuple[str, ...]
    changes: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "changes")

    def select(self, keep: IntArray | BoolArray) -> SharedErrors:
        """Those of some of the data."""
        return SharedErrors(self.names, self.changes[keep])

    def scaled(self, factors: FloatArray) -> SharedErrors:
        """Those of data that are multiplied by numbers (size,)."""
        return SharedErrors(self.names, self.changes * factors[:, None])

    def beside(self, other: SharedErrors) -> SharedErrors:
        """These and others of the same data, whose names differ.

        Raises
        ------
        UsageError
            Where a name is in both: the covariance holds no product of two changes by one error.
        """
        twice = sorted({*self.names} & {*other.names})
        if twice:
            raise UsageError(f"the data share the error {twice[0]!r} already")
        changes = np.hstack([self.changes, other.changes])
        return SharedErrors((*self.names, *other.names), changes)

    def added(self, matrix: csr_array, sign: float) -> csr_array:
        """A sparse covariance with these put in, or taken out."""
        return csr_array(matrix + csr_array(sign * self.changes @ self.changes.T))

    def change(self, name: str) -> FloatArray:
        """Changes (size,) by one of them; 0 where the data do not have it."""
        if name not in self.names:
            return np.zeros(len(self.changes))
        return np.asarray(self.changes[:, self.names.index(name)])


def joined_errors(parts: Sequence[tuple[int, int, SharedErrors | None]]) -> SharedErrors | None:
    """Those of data sets laid together, each (V², closure phases, errors): all V² come first."""
    names = tuple(dict.fromkeys(n for *_, s in parts if s is not None for n in s.names))
    if not names:
        return None
    rows = [
        np.zeros((n + m, len(names)))
        if shared is None
        else np.stack([shared.change(name) for name in names], axis=1)
        for n, m, shared in parts
    ]
    order = vis2_first([(n, m) for n, m, _ in parts])
    return SharedErrors(names, np.concatenate(rows)[order])


def vis2_first(counts: Sequence[tuple[int, int]]) -> IntArray:
    """Places of all V², then of all closure phases, in data sets of (V², closures) end to end."""
    starts = np.cumsum([0, *(n + m for n, m in counts)])
    vis2 = [s + np.arange(n) for s, (n, _) in zip(starts, counts, strict=False)]
    closure = [s + n + np.arange(m) for s, (n, m) in zip(starts, counts, strict=False)]
    return np.concatenate(vis2 + closure).astype(np.intp)


def with_shared(covariance: BlockCovariance, shared: SharedErrors, sign: float) -> BlockCovariance:
    """Covariance with shared errors put in, or taken out (``sign`` −1).

    Groups of data that have an error in common become one.
    """
    if not np.any(shared.changes):
        return covariance
    g = shared.changes
    blocks = covariance.blocks
    touched = [bool(np.any(g[b.index])) for b in blocks]
    ours = [b for b, hit in zip(blocks, touched, strict=True) if hit]
    others = [b for b, hit in zip(blocks, touched, strict=True) if not hit]
    index = np.concatenate([b.index for b in ours])
    bases = [np.eye(len(b.index)) if b.basis is None else b.basis for b in ours]
    matrix = block_diag(*(b.matrix for b in ours)) + sign * g[index] @ g[index].T
    return BlockCovariance(covariance.size, [*others, Block(index, matrix, block_diag(*bases))])

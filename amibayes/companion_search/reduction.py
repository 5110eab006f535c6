"""Whitened data in few numbers: what templates of the field can see, and the length of the rest.

Templates of neighbouring channels, and of a field of few fringes, are nearly alike: thousands of
data hold some hundred combinations that any template of the field touches. In these, and in the
sum of squares of all others, searches of many data sets are the same as in the data themselves,
and noise is drawn in them directly: normal deviates, and the root of a χ² for the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from amibayes.likelihood.linear_response import Part
from amibayes.support.evenly import evenly
from amibayes.units import FloatArray, IntArray

TOLERANCE = 1e-5
"""Part of a template that is left out, relative to its length: single precision loses as much in
the sums over the data."""

FIRST_TEMPLATES = 128
"""Templates whose span is found first; twice as many where they span nothing that repeats."""

WORTH, NEARLY_ALL = 0.5, 0.7
"""Parts of the data's number above which combinations of a group are not worth their making, and
those of all groups."""

Roots = tuple[tuple[IntArray, FloatArray], ...]
"""Rows of data that are correlated with each other, and a root of their covariance, (n, n)."""


@dataclass(frozen=True, eq=False)
class Reduction:
    """Combinations of whitened data, group by group, and one row for the rest of each group.

    Parameters
    ----------
    rows : tuple of (n_group,) int arrays
        Data of every group.
    bases : tuple of (n_group, n_combinations) float arrays
        Orthonormal.
    """

    rows: tuple[IntArray, ...]
    bases: tuple[FloatArray, ...]

    @property
    def label(self) -> IntArray:
        """Group of every row: combinations first, then the rest of each group, (n_rows,)."""
        each = [np.full(basis.shape[1], k) for k, basis in enumerate(self.bases)]
        return np.concatenate([*each, np.arange(len(self.bases))])

    @property
    def degrees(self) -> FloatArray:
        """Number of data of the rest of each group, (n_groups,)."""
        return np.array([float(n - r) for n, r in (basis.shape for basis in self.bases)])

    def combined(self, data: FloatArray) -> FloatArray:
        """Combinations of data (n_data, …), and zeros for the rest, (n_rows, …)."""
        parts = [b.T @ data[r] for r, b in zip(self.rows, self.bases, strict=True)]
        return np.concatenate([*parts, np.zeros((len(self.bases), *data.shape[1:]))])

    def __call__(self, data: FloatArray) -> FloatArray:
        """Combinations of data (n_data, …), and the length of the rest, (n_rows, …)."""
        out, first = self.combined(data), 0
        rest = out[-len(self.bases) :]
        for k, (rows, basis) in enumerate(zip(self.rows, self.bases, strict=True)):
            held = out[first : first + basis.shape[1]]
            first += basis.shape[1]
            left = np.einsum("i...,i...->...", data[rows], data[rows]) - (held**2).sum(axis=0)
            rest[k] = np.sqrt(np.maximum(left, 0.0))
        return out

    def of_part(self, part: Part, offset: FloatArray, n_data: int) -> tuple[Part, FloatArray]:
        """Combine a part of a response to a companion, and its offset (n_rows of the part,)."""
        place = np.full(n_data, -1)
        place[part.rows] = np.arange(len(part.rows))
        found = []
        for rows, basis in zip(self.rows, self.bases, strict=True):
            here = place[rows] >= 0
            at = place[rows][here]
            # Sparse matrices multiply from the left only.
            product = (part.matrix[at].T @ basis[here]).T
            found.append(np.column_stack([product, basis[here].T @ offset[at]]))
        matrix = np.concatenate(found)
        touched = np.flatnonzero(np.abs(matrix).max(axis=1) > 0.0)
        return Part((np.ascontiguousarray(matrix[touched, :-1]),), touched), matrix[touched, -1]

    def normals(self, n: int, rng: np.random.Generator) -> FloatArray:
        """What data sets of unit normal deviates are, (n_rows, n)."""
        held = rng.standard_normal((len(self.label) - len(self.bases), n))
        left = [rng.chisquare(d, n) if d > 0.0 else np.zeros(n) for d in self.degrees]
        return np.concatenate([held, np.sqrt(left)])

    def roots(self, several: Sequence[Roots]) -> tuple[Roots, ...]:
        """Roots of covariances of the rows, from those of the data that are correlated.

        Of groups by themselves. What combinations have more of the variance, the rest has less.
        ``several`` have the same rows of data.
        """
        found: list[list[tuple[IntArray, FloatArray]]] = [[] for _ in several]
        first = 0
        for k, (rows, basis) in enumerate(zip(self.rows, self.bases, strict=True)):
            covariance = self._covariances(rows, basis, several)
            here = np.arange(first, first + basis.shape[1])
            lower = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(here)))
            first += len(here)
            rest = len(rows) - np.trace(covariance, axis1=1, axis2=2)
            scatter = np.sqrt(np.maximum(rest, 0.0) / max(self.degrees[k], 1.0))
            for own, root, size in zip(found, lower, scatter, strict=True):
                own.append((here, np.asarray(root)))
                if self.degrees[k]:
                    own.append((np.array([k - len(self.bases)]), np.array([[size]])))
        return tuple(map(tuple, found))

    def _covariances(
        self, rows: IntArray, basis: FloatArray, several: Sequence[Roots]
    ) -> FloatArray:
        """Covariances of the combinations of one group, (n, n_combinations, n_combinations)."""
        out = np.broadcast_to(np.eye(basis.shape[1]), (len(several), *(basis.shape[1],) * 2)).copy()
        for same in zip(*several, strict=True):
            own = same[0][0]
            at = np.minimum(np.searchsorted(rows, own), len(rows) - 1)
            inside = rows[at] == own
            if inside.any():
                held = np.where(inside[:, None], basis[at], 0.0)
                turned = np.stack([root.T for _, root in same]) @ held
                out += turned.swapaxes(1, 2) @ turned - held.T @ held
        return out

    def added(self, noise: FloatArray, signal: FloatArray) -> FloatArray:
        """Data of noise and signal, (n_rows, n) each.

        Rests have no direction: they are taken as at right angles, which is so up to a part in
        the root of their number.
        """
        out, k = noise + signal, len(self.bases)
        out[-k:] = np.hypot(noise[-k:], signal[-k:])
        return out


def reduction_of(
    templates: Callable[[IntArray], FloatArray],
    n_positions: int,
    beside: FloatArray,
    label: IntArray,
) -> Reduction | None:
    """Find the combinations that all templates span; None where they are not few.

    Parameters
    ----------
    templates : callable
        Gives templates (n_data, m) of positions by their numbers.
    n_positions : int
    beside : (n_data, k) float array
        Orthonormal directions that are held as well.
    label : (n_data,) int array
        Group of every datum, from 0.
    """
    groups = tuple(np.flatnonzero(label == k) for k in range(int(label.max(initial=0)) + 1))
    wanted = FIRST_TEMPLATES
    while wanted <= WORTH * len(label):
        tried = np.unique((evenly(wanted) * n_positions).astype(np.intp))
        found = templates(tried)
        size = float((found**2).sum())
        least = TOLERANCE**2 * size / found.shape[1]
        columns = np.hstack([found / np.sqrt(found.shape[1]), beside * np.sqrt(size)])
        spans = [_span(columns[rows], least) for rows in groups]
        bases = tuple(basis for basis, _ in spans)
        if all(repeats for _, repeats in spans) or wanted >= n_positions:
            count = sum(basis.shape[1] for basis in bases) + len(bases)
            return Reduction(groups, bases) if count < NEARLY_ALL * len(label) else None
        wanted *= 2
    return None


def _span(columns: FloatArray, least: float) -> tuple[FloatArray, bool]:
    """Orthonormal directions (n, r) of columns (n, m), but those of squares below ``least``.

    And whether they hold more columns of the kind as well: they are few, or all there are.
    """
    columns = columns[:, (columns != 0.0).any(axis=0)]
    tall = len(columns) > columns.shape[1]
    values, vectors = np.linalg.eigh(columns.T @ columns if tall else columns @ columns.T)
    kept = values > least
    if kept.sum() > WORTH * len(columns):
        return np.eye(len(columns)), True
    basis = vectors[:, kept]
    if tall:
        basis = columns @ (basis / np.sqrt(values[kept]))
    return np.asarray(basis), bool(kept.sum() <= WORTH * columns.shape[1])

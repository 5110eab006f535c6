"""Templates of some positions, and what many data sets make of them.

Where a companion has one contrast its template at a position and at the mirror image are
even + odd and even − odd: both are searched with half of the work. Where bands have
contrasts of their own there is one template of each band.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amibayes.companion_search.grid import Grid
from amibayes.companion_search.scan import (
    GroupWeights,
    ScaleGroups,
    best_positive,
    weighted_gain,
)
from amibayes.units import BoolArray, FloatArray, IntArray

UNCOUPLED = 1e-6
"""Correlation of templates below which bands are each for themselves."""


@dataclass(frozen=True, eq=False)
class DataRows:
    """Data sets without nuisance directions, one a row, (n, n_data), and parts of them.

    Cut once for all positions: ``even`` and ``odd`` are the data that the two parts of a
    template touch.
    """

    every: NDArray[Any]
    even: NDArray[Any]
    odd: NDArray[Any]


Highest = tuple[NDArray[Any], IntArray]
"""Largest gain of n data sets, (n,), and at which of m positions, (n,)."""


def highest_of(score: NDArray[Any]) -> Highest:
    """Largest of the scores (n, m) of each data set, and where."""
    top = score.argmax(axis=1)
    return score[np.arange(len(score)), top], top


Match = Sequence[NDArray[Any]] | NDArray[Any]
"""Products of templates of unit length with data, (n_bands, …, m)."""


class Templates(Protocol):
    """Templates of m positions, nuisance directions taken out."""

    @property
    def sigma(self) -> FloatArray:
        """Error of each contrast by itself, 1/length, (n_bands, m)."""
        ...

    @property
    def unit(self) -> FloatArray:
        """Templates of unit length, (n_bands, n_data, m)."""
        ...

    def match(self, data: DataRows) -> Match:
        """Products with data sets, (n_bands, n, m), in their precision."""
        ...

    def best(self, match: Match) -> tuple[FloatArray, FloatArray]:
        """Contrasts that gain most, none below zero, and what they gain.

        Returns
        -------
        contrasts : (n_bands, …, m) array
            In units of their errors.
        gain : (…, m) array
            In χ².
        """
        ...

    def highest(
        self,
        data: DataRows,
        weights: GroupWeights | None = None,
        which: IntArray | slice = slice(None),
    ) -> Highest:
        """Largest gain in χ², weighted or not, of the data sets ``which``."""
        ...


class BandTemplates:
    """One template of each band.

    Parameters
    ----------
    templates : (n_bands, n_data, m) float array
    """

    def __init__(self, templates: FloatArray) -> None:
        length = np.maximum(np.linalg.norm(templates, axis=1), 1e-300)
        self._unit: FloatArray = templates / length[:, None]
        self._sigma: FloatArray = 1.0 / length
        n = len(templates)
        pairs = [(a, b) for b in range(n) for a in range(b)]
        shared = {(a, b): np.einsum("dm,dm->m", self._unit[a], self._unit[b]) for a, b in pairs}
        self._shared = {p: s for p, s in shared.items() if np.abs(s).max() > UNCOUPLED}

    @classmethod
    def beside(cls, templates: FloatArray, basis: FloatArray) -> BandTemplates:
        """Make them of templates that have the directions (n_data, k) of ``basis`` in them."""
        along = np.einsum("dk,bdm->bkm", basis, templates)
        return cls(templates - np.einsum("dk,bkm->bdm", basis, along))

    @property
    def unit(self) -> FloatArray:
        """Templates of unit length, (n_bands, n_data, m)."""
        return self._unit

    @property
    def sigma(self) -> FloatArray:
        """Error of each contrast by itself, (n_bands, m)."""
        return self._sigma

    def match(self, data: DataRows) -> Match:
        """Products with data sets."""
        return [data.every @ unit.astype(data.every.dtype) for unit in self._unit]

    def best(self, match: Match) -> tuple[FloatArray, FloatArray]:
        """Contrasts that gain most, none below zero, by coordinate descent."""
        return best_positive(match, self._shared)

    def highest(
        self,
        data: DataRows,
        weights: GroupWeights | None = None,
        which: IntArray | slice = slice(None),
    ) -> Highest:
        """Largest gain in χ² of the data sets ``which``."""
        match = [product[which] for product in self.match(data)]
        if weights is None:
            return highest_of(best_positive(match, self._shared)[1])
        return highest_of(weighted_gain(weights.of(which), self._unit, match))


@dataclass(frozen=True, eq=False)
class MirroredTemplates:
    """One template at positions and, after them, at their mirror images.

    Parameters
    ----------
    even, odd : (n_rows, m) array of floats
        Of the data that each part touches; nuisance directions are still in them. In single
        precision where they are very many.
    even_rows, odd_rows : (n_rows,) int array
        Those data.
    norm : (2m,) float array
        Length squared, without the nuisance directions.
    basis : (n_data, k) float array
        The nuisance directions.
    squares : dict
        Sums of squares over groups of data that were asked for.
    """

    even: NDArray[Any]
    odd: NDArray[Any]
    even_rows: IntArray
    odd_rows: IntArray
    norm: FloatArray
    basis: FloatArray
    squares: dict[int, tuple[ScaleGroups, FloatArray]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        even: FloatArray,
        odd: FloatArray,
        rows: tuple[IntArray, IntArray],
        shared: tuple[IntArray, IntArray],
        basis: FloatArray,
    ) -> MirroredTemplates:
        """Make them of their parts; ``shared`` are rows of each with data of the other."""
        norm = np.einsum("dm,dm->m", even, even) + np.einsum("dm,dm->m", odd, odd)
        i, j = shared
        cross = 2.0 * np.einsum("dm,dm->m", even[i], odd[j]) if len(i) else 0.0 * norm
        both = left = at_both(norm, cross)
        if basis.size:
            along = at_both(basis[rows[0]].T @ even, basis[rows[1]].T @ odd)
            left = both - (along**2).sum(axis=0)
        return cls(even, odd, *rows, floored(left, both), basis)

    def single(self) -> MirroredTemplates:
        """The same in single precision, in half of the memory."""
        even, odd = (part.astype(np.float32) for part in (self.even, self.odd))
        return replace(self, even=even, odd=odd, squares={})

    @property
    def sigma(self) -> FloatArray:
        """Error of the contrast, 1/length, (1, 2m)."""
        return np.asarray(1.0 / np.sqrt(self.norm))[None]

    def laid_out(self, sign: float = 1.0) -> FloatArray:
        """Templates (n_data, m) at the positions, or with −1 at the mirror images."""
        templates = np.zeros((len(self.basis), self.even.shape[1]))
        templates[self.even_rows] = self.even
        templates[self.odd_rows] += sign * self.odd
        return templates - self.basis @ (self.basis.T @ templates)

    def _squares(self, groups: ScaleGroups) -> FloatArray:
        """Sums over the groups of the squares of templates, (n_groups, 2m), made once."""
        known = self.squares.get(id(groups))
        if known is None or known[0] is not groups:
            known = groups, np.asarray(groups.sums(self.both**2))
            self.squares[id(groups)] = known
        return known[1]

    @property
    def both(self) -> FloatArray:
        """Templates (n_data, 2m) of positions and mirror images."""
        return np.hstack([self.laid_out(), self.laid_out(-1.0)])

    @property
    def unit(self) -> FloatArray:
        """Templates of unit length, (1, n_data, 2m)."""
        return np.asarray(self.both / np.sqrt(self.norm))[None]

    def match(self, data: DataRows) -> Match:
        """Products with data sets."""
        kind = data.even.dtype
        even, odd = (part.astype(kind, copy=False) for part in (self.even, self.odd))
        product = at_both(data.even @ even, data.odd @ odd)
        product *= self.sigma[0].astype(kind)
        return [product]

    def match_each(self, own: FloatArray) -> FloatArray:
        """Products with data (n_data, m) without nuisance directions, one a position, (m,)."""
        even = np.einsum("dm,dm->m", own[self.even_rows], self.even)
        odd = np.einsum("dm,dm->m", own[self.odd_rows], self.odd)
        return np.asarray((even + odd) * self.sigma[0, : len(even)])

    def best(self, match: Match) -> tuple[FloatArray, FloatArray]:
        """Contrast that gains most, not below zero."""
        return best_positive(match, {})

    @classmethod
    def joined(cls, parts: Sequence[tuple[MirroredTemplates, BoolArray]]) -> MirroredTemplates:
        """Some positions (m,) of each of several, as one."""
        first = parts[0][0]
        even, odd = (
            np.hstack([getattr(t, name)[:, chosen] for t, chosen in parts])
            for name in ("even", "odd")
        )
        halves = [(np.split(t.norm, 2), chosen) for t, chosen in parts]
        norm = np.concatenate([half[k][chosen] for k in (0, 1) for half, chosen in halves])
        return cls(even, odd, first.even_rows, first.odd_rows, norm, first.basis)

    def highest(
        self,
        data: DataRows,
        weights: GroupWeights | None = None,
        which: IntArray | slice = slice(None),
    ) -> Highest:
        """Largest gain in χ² of the data sets ``which``."""
        half = self.even.shape[1]
        found = [(np.empty(0, dtype=data.even.dtype), np.empty(0, dtype=np.intp))]
        some = weights and weights.of(which)
        for score, turned in self._roots(data.even[which], data.odd[which], some):
            root, top = highest_of(score)
            mirror = turned[np.arange(len(top)), top] < 0.0
            found.append((np.maximum(root, 0.0) ** 2, top + half * mirror))
        gains, tops = zip(*found, strict=True)
        return np.concatenate(gains), np.concatenate(tops)

    def best_of_parts(
        self, data: DataRows, weights: GroupWeights | None, first: IntArray
    ) -> NDArray[Any]:
        """Roots of the largest gains within runs of positions from ``first`` (k,) on, (n, k)."""
        roots = self._roots(data.even, data.odd, weights)
        return np.concatenate([np.maximum.reduceat(score, first, axis=1) for score, _ in roots])

    def _roots(
        self, by_even: NDArray[Any], by_odd: NDArray[Any], weights: GroupWeights | None
    ) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
        """Yield roots of the gains at positions or mirror images, whichever gains more, (n, m).

        Below zero where neither gains; and numbers (n, m) below zero where it is the mirror
        image. Where both have templates of equal length, that is the odd part's product, and
        half of the scores are not needed. Each is worked on in the memory of the one before.
        """
        squares = self.norm[None] if weights is None else self._squares(weights.groups)
        here, mirrored = np.split(squares, 2, axis=1)
        equal = bool((np.abs(here - mirrored) <= EQUAL * mirrored).all())
        length = np.sqrt(here) if weights is None and equal else 1.0
        even, odd = ((x / length).astype(by_even.dtype) for x in (self.even, self.odd))
        n, m = len(by_even), here.shape[1]
        at_once = max(SCORES_AT_ONCE // max(m, 1), len(self.basis))
        # One memory for all parts: the system clears new memory of this size first.
        memory = np.empty((3, min(at_once, n), m), dtype=by_even.dtype)
        for part in (slice(k, k + at_once) for k in range(0, n, at_once)):
            some = None if weights is None else weights.of(part)
            score, turned, other = memory[:, : len(by_even[part])]
            np.matmul(by_even[part], even, out=score)
            np.matmul(by_odd[part], odd, out=turned)
            if equal:
                score += np.abs(turned, out=other)
                if some is not None:
                    score /= np.sqrt(some.of_sums(here))
            else:
                np.subtract(score, turned, out=other)
                score += turned
                for x, square in ((score, here), (other, mirrored)):
                    x /= np.sqrt(square if some is None else some.of_sums(square)).astype(x.dtype)
                np.subtract(score, other, out=turned)
                np.maximum(score, other, out=score)
            yield score, turned


MANY_ROWS = 128
"""Numbers of data from which on products of matrices take longer than what is done with them."""

COARSE_GAIN = 5.0
"""How much faster many data sets are searched where coarse templates rule out most places."""


@dataclass(frozen=True, eq=False)
class CoarseTemplates:
    """Templates at every second position along each axis, tile by tile of a lattice.

    Positions of the lattice are λ/8B apart, so that the largest gain lies beside one of these
    that is nearly the best. Where it does not (`NEARLY`) another is taken, some per cent
    smaller, in data and in null sets alike.

    Parameters
    ----------
    templates : MirroredTemplates
    first : (n_tiles,) int array
        Where each tile begins.
    """

    templates: MirroredTemplates
    first: IntArray

    @classmethod
    def of(cls, tiles: Sequence[tuple[IntArray, MirroredTemplates]], grid: Grid) -> CoarseTemplates:
        """Take them from those at all positions, of tiles and then their mirror images."""
        parts = [(t, grid.coarse(index[: len(index) // 2])) for index, t in tiles]
        sizes = np.array([int(chosen.sum()) for _, chosen in parts])
        return cls(MirroredTemplates.joined(parts), np.cumsum(sizes) - sizes)

    def promising(self, data: DataRows, weights: GroupWeights | None) -> Iterator[IntArray]:
        """Yield, for every tile, which data sets may have their largest gain in it."""
        best = self.templates.best_of_parts(data, weights, self.first)
        return map(np.flatnonzero, (best >= NEARLY * best.max(axis=1, keepdims=True)).T)


NEARLY = 0.8
"""Best coarse score of a tile, as part of the best of all, from which on all of it is looked at: of
100 data sets of noise one has its largest gain elsewhere."""


EQUAL = 1e-9
"""Lengths of templates that differ by less, relatively, are equal but for rounding."""

SCORES_AT_ONCE = 100_000
"""Scores that are worked on at once: what fits a processor's cache, twice. Not fewer data sets
than have numbers themselves: laying out the templates for each product takes as long else."""


UNMEASURED = 1e-12
"""Part of a template's square that rounding leaves of one which star and background make whole:
what is left of its data, of 1e-16, then gains nothing."""


def floored(left: FloatArray, whole: FloatArray) -> FloatArray:
    """Squares of templates of which a part was taken out, kept above what rounding makes."""
    return np.asarray(np.maximum(left, UNMEASURED * whole + 1e-300))


def at_both(even: NDArray[Any], odd: NDArray[Any]) -> NDArray[Any]:
    """Values at positions and at their mirror images, one after the other."""
    return np.concatenate([even + odd, even - odd], axis=-1)

"""An orthonormal basis of channels: what they have in common, a slope, and details."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from amibayes.units import FloatArray, IntArray

CURVED = 0.25
"""Variance of changes over half of a range of channels, in units of that over the whole of it."""

LEAF = (4, 16)
"""Channels of the shortest ranges, of up to 64 and of more than 256: they cost as many products."""


@dataclass(frozen=True, eq=False)
class SmoothBasis:
    """Orthonormal rows of n channels: an offset, a slope, and details of ever shorter ranges.

    Of many series of channels at once: they differ in their values alone.

    Parameters
    ----------
    row, column : (n_entries,) int arrays
        Sorted by row, and by column within one.
    value : (…, n_entries) float array
    depth : (n,) int array
        How often a row's range was halved; −1 of offset, slope and differences of polarisations.
    spectrum : (n,) int array
        Which of the spectra (polarisations) a channel is of.
    slope : bool
        Whether there is one: none of single channels.
    """

    row: IntArray
    column: IntArray
    value: FloatArray
    depth: IntArray
    spectrum: IntArray
    slope: bool

    @property
    def curves(self) -> NDArray[np.bool_]:
        """Details of the whole range (n,), where those of shorter ranges are apart from them."""
        return np.asarray((self.depth == 0) & (self.depth.max() > 0))

    @property
    def slope_share(self) -> FloatArray:
        """Variance in each row of an error that changes over channels, its slope of mean square 1.

        Beside the slope are curved changes, a quarter of it in the details of the whole range and a
        quarter of that in those of its halves: red noise, as the transfer functions of
        spectrographs differ. Of single channels it is an offset.
        """
        depth = self.depth
        share = CURVED ** (depth + 1.0) / np.bincount(depth + 1)[depth + 1]
        share[depth < 0] = 0.0
        share[int(self.slope)] = 1.0
        return np.asarray(len(depth) * share)

    def variance(self, phi: FloatArray | float) -> FloatArray:
        """Variance of the rows, (…, n), where channels are correlated by φ^|i−j|, φ (…).

        Channels have unit variance. Those of different spectra are not correlated.
        """
        row, value, power = self.row, self.value, np.asarray(phi)[..., None]
        before = np.zeros_like(value)
        if power.any():
            # Sum of all channels before, each times φ to the power of its distance, by doubling.
            run = row * (self.spectrum.max() + 1) + self.spectrum[self.column]
            before[..., 1:] = power * value[..., :-1] * (np.diff(run) == 0)
            step, longest = 1, int(np.bincount(run).max(initial=1))
            while step < longest:
                same = run[step:] == run[:-step]
                before[..., step:] += power * before[..., :-step] * same
                step, power = 2 * step, power**2
        begins = np.flatnonzero(np.diff(row, prepend=-1))
        return np.asarray(np.add.reduceat(value * (value + 2.0 * before), begins, axis=-1))


def smooth_basis(weight: FloatArray, lengths: Sequence[int] = ()) -> SmoothBasis:
    """Rows of which the first is along ``weight`` (…, n) and the second a slope of it.

    All others see neither: differences within a range of channels that are orthogonal to both,
    those between the halves of these, and so on (multiwavelets: Alpert 1993, SIAM J. Math.
    Anal. 24, 246). They have n log n entries.

    Parameters
    ----------
    weight : (…, n) float array
        Of any number of series of channels.
    lengths : sequence of int, optional
        Channels of each of the spectra that ``weight`` is made of: offset and slope are common to
        these, and their differences come next.
    """
    lengths = tuple(lengths) or (weight.shape[-1],)
    n, longest = sum(lengths), max(lengths)
    across = [np.linspace(-1.0, 1.0, k) if k > 1 else np.zeros(1) for k in lengths]
    both = [weight, weight * np.concatenate(across)]
    wanted = np.stack(both[: 1 + (longest > 1)], axis=-1)
    details: list[tuple[int, int, FloatArray]] = []
    leaf = int(np.clip(longest // 16, *LEAF))

    def kept(turned: FloatArray, first: int, depth: int) -> FloatArray:
        """What is wanted of a range; the rest becomes details."""
        n = wanted.shape[-1]
        details.extend((depth, first, turned[..., k]) for k in range(n, turned.shape[-1]))
        return turned[..., :n]

    def joined(left: FloatArray, right: FloatArray, first: int) -> FloatArray:
        """Basis of what is wanted in two ranges that follow each other from ``first`` on."""
        middle, cut = first + left.shape[-2], left.shape[-1]
        last = middle + right.shape[-2]
        parts = (left, wanted[..., first:middle, :]), (right, wanted[..., middle:last, :])
        products = np.concatenate([np.swapaxes(q, -1, -2) @ w for q, w in parts], axis=-2)
        mixed = np.linalg.qr(products, mode="complete")[0]
        turned = left @ mixed[..., :cut, :], right @ mixed[..., cut:, :]
        return np.concatenate(turned, axis=-2)

    def along(first: int, last: int, depth: int) -> FloatArray:
        """Basis of what is wanted in a range, (…, length, 1 or 2)."""
        if last - first <= leaf:
            turned = np.linalg.qr(wanted[..., first:last, :], mode="complete")[0]
            return kept(turned, first, depth)
        middle = (first + last) // 2
        halves = along(first, middle, depth + 1), along(middle, last, depth + 1)
        return kept(joined(*halves, first), first, depth)

    cuts = np.cumsum([0, *lengths]).tolist()
    whole, *others = [along(first, last, 0) for first, last in pairwise(cuts)]
    for other in others:
        whole = kept(joined(whole, other, 0), 0, -1)
    whole = whole * np.sign((whole * wanted).sum(axis=-2, keepdims=True))
    rows = [(-1, 0, whole[..., k]) for k in range(whole.shape[-1])]
    rows += sorted(details, key=lambda d: d[:2])
    length = [values.shape[-1] for _, _, values in rows]
    column = np.concatenate([first + np.arange(v.shape[-1]) for _, first, v in rows])
    value, depth = np.concatenate([v for *_, v in rows], -1), np.array([d for d, *_ in rows])
    row, spectrum = np.repeat(np.arange(n), length), np.repeat(np.arange(len(lengths)), lengths)
    return SmoothBasis(row, column, value, depth, spectrum, longest > 1)

"""Shares of recovered companions on rings: quantiles of their critical contrasts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.limits.critical import CriticalContrasts
from amibayes.units import BoolArray, FloatArray, IntArray

FAINTEST = 1e-3
"""Contrast, in units of a ring's typical error, that counts as none: noise alone was detected."""


@dataclass(frozen=True, eq=False)
class Pooled:
    """Critical contrasts c of rings, each ring's known from all rings of its kind as well.

    In units of a ring's typical error they are distributed nearly the same on all rings. Each
    ring's own quantiles are drawn towards those of all of them, the more the less they are known:
    by the scatter that rings have beyond Monte Carlo error.

    Parameters
    ----------
    values : (n_rings, n, n_noise) float array
        ln of c for all position angles and components of the noise, in units of the ring's
        typical error.
    typical : (n_rings,) float array
        ln of that error, the median over the position angle.
    kind : (n_rings,) bool array
        Rings are pooled with those of the same kind.
    repeated : int
        Values that each trial has.
    """

    values: FloatArray
    typical: FloatArray
    kind: BoolArray
    repeated: int = 1

    @classmethod
    def of(cls, critical: CriticalContrasts, in_errors: FloatArray) -> Pooled:
        """Take logarithms of what `amibayes.limits.components.over_components` gives."""
        typical = np.median(critical.sigma, axis=1)
        values = in_errors * (critical.sigma / typical[:, None])[..., None, None]
        merged = np.maximum(values, FAINTEST).reshape(len(values), -1, values.shape[3])
        return cls(np.log(merged), np.log(typical), critical.by_detection, in_errors.shape[2])

    def contrast(self, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Contrasts above which shares of companions are recovered; NaN where none up to 1 is.

        Returns
        -------
        contrast : (n_rings, n_shares) float array
        error : (n_rings, n_shares) float array
            Of its logarithm, by the injections. NaN where companions that no contrast shows are
            so many that their number decides whether there is a limit.
        """
        found = np.full((len(self.values), len(shares)), np.nan)
        error = np.zeros_like(found)
        for kind in np.unique(self.kind):
            rings = np.flatnonzero(self.kind == kind)
            found[rings], error[rings] = self._of_kind(rings, shares)
        with np.errstate(invalid="ignore", over="ignore"):
            contrast = np.exp(found + self.typical[:, None])
            return np.where(contrast <= 1.0, contrast, np.nan), error

    def _of_kind(self, rings: IntArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
        values, n = self.values[rings], self.values.shape[2]
        own = np.array([quantiles(ring, shares) for ring in values])
        common = np.broadcast_to(quantiles(values, shares), own.shape)
        if n < 2:
            return own, np.zeros_like(own)
        # Each realisation of the noise covers all position angles of a ring.
        each = np.array([[quantiles(ring[:, j], shares) for ring in values] for j in range(n)])
        known = np.isfinite(each).all(axis=0) & np.isfinite(common) & np.isfinite(own)
        each, apart = np.where(known, each, 0.0), np.where(known, own, 0.0)
        apart = apart - np.where(known, common, 0.0)
        count = np.maximum(known.sum(axis=0), 1)
        chance = each.var(axis=0, ddof=1).sum(axis=0) / n / count
        # Two rings or more tell how different they are; one by itself is taken as it is.
        between = np.maximum((apart**2).sum(axis=0) / np.maximum(count - 1, 1) - chance, 0.0)
        share = between / np.maximum(between + chance, 1e-300) if len(rings) > 1 else 1.0
        shrunk = np.where(known, np.where(known, common, 0.0) + share * apart, own)
        error = np.sqrt(chance * np.maximum(share, 1.0 / count)) * np.ones_like(own)
        if known.all():
            return shrunk, error
        # A realisation shows none up to any contrast: what all of them together tell is left.
        by_rank = np.array([_rank_error(ring, shares, self.repeated) for ring in values])
        return shrunk, np.where(known, error, by_rank)


def _rank_error(values: FloatArray, shares: FloatArray, repeated: int) -> FloatArray:
    """Errors of quantiles by the chance of how many values lie below, NaN where infinite."""
    spread = np.sqrt(shares * (1.0 - shares) * repeated / values.size)
    ends = [quantiles(values, np.clip(shares + side * spread, 0.0, 1.0)) for side in (-1.0, 1.0)]
    half = 0.5 * (np.where(np.isfinite(ends[1]), ends[1], np.nan) - ends[0])
    return np.asarray(half)


def quantiles(values: FloatArray, shares: FloatArray) -> FloatArray:
    """Numbers below which shares of some values (any shape) lie, by Hazen's rule.

    Infinite where one of the two beside is; interpolated between them, no rounding moves them
    by a step.
    """
    ordered = np.sort(values, axis=None)
    middle, known = (np.arange(len(ordered)) + 0.5) / len(ordered), np.isfinite(ordered)
    out = np.interp(shares, middle, np.where(known, ordered, 0.0))
    after = np.minimum(np.searchsorted(middle, shares), len(ordered) - 1)
    return np.where(known[after], out, np.inf)

"""A sampled pupil: holes covered exactly, with a map of wavefront error inside them.

A sum over cells is the transform of the pupil blurred by one cell; dividing the field by
the cell's own transform takes the blur back, which brings the sum within 2e-6 of the
peak of the analytic image for 1024 cells across (1.9e-5 without).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from amibayes.errors import UsageError
from amibayes.instrument import Mask
from amibayes.optics.holes import coverage
from amibayes.support.notebook import Shown
from amibayes.units import FloatArray, read_only


@dataclass(frozen=True, eq=False)
class Patch:
    """The cells about one hole.

    Parameters
    ----------
    x_m, y_m : (n_x,), (n_y,) arrays
        Centres of the cells, metres.
    area_m2 : (n_y, n_x) array
        Area of each cell that the hole covers, m².
    opd_m : (n_y, n_x) array
        Optical path in each cell, metres.
    """

    x_m: FloatArray
    y_m: FloatArray
    area_m2: FloatArray
    opd_m: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class PupilMap(Shown):
    """Optical path over a square pupil.

    Parameters
    ----------
    opd_m : (n, n) array
        Optical path of every cell, metres, indices [y, x], y upward; 1024 × 1024 is usual.
    width_m : float
        Side of the square, centred on the mask, metres.
    """

    opd_m: FloatArray
    width_m: float

    def __post_init__(self) -> None:
        read_only(self, "opd_m")
        if self.opd_m.ndim != 2 or self.opd_m.shape[0] != self.opd_m.shape[1]:
            raise UsageError(f"a wavefront map of shape {self.opd_m.shape} is not square")
        if not np.all(np.isfinite(self.opd_m)):
            raise UsageError("a wavefront map holds numbers that are not finite")

    @property
    def cell_m(self) -> float:
        """Side of a cell, metres."""
        return self.width_m / len(self.opd_m)

    @property
    def edges_m(self) -> FloatArray:
        """Edges of the cells along an axis, metres, shape (n + 1,)."""
        return np.linspace(-0.5 * self.width_m, 0.5 * self.width_m, len(self.opd_m) + 1)

    def cell_transform(self, fx: FloatArray, fy: FloatArray) -> FloatArray:
        """Transform of one cell over its area, shape (n_y, n_x)."""
        return np.outer(np.sinc(fy * self.cell_m), np.sinc(fx * self.cell_m))

    def patches(self, mask: Mask) -> Iterator[Patch]:
        """Give the cells about each hole, in the holes' order.

        Raises
        ------
        UsageError
            Where a hole reaches outside the map.
        """
        edges = self.edges_m
        centres = 0.5 * (edges[1:] + edges[:-1])
        half = mask.corners_m.max(axis=0)  # opposite corners are alike
        for hole in mask.holes_m:
            low = np.searchsorted(edges, hole - half, side="right") - 1
            high = np.searchsorted(edges, hole + half, side="left")
            if low.min() < 0 or high.max() >= len(edges):
                raise UsageError(f"a wavefront map {self.width_m:g} m wide does not cover the mask")
            x, y = (slice(a, b) for a, b in zip(low, high, strict=True))
            part = coverage(mask, hole, edges[low[0] : high[0] + 1], edges[low[1] : high[1] + 1])
            yield Patch(centres[x], centres[y], part * self.cell_m**2, self.opd_m[y, x])

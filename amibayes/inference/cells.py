"""Cells of a polar lattice: the edge of a field is an edge of cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from amibayes.units import FloatArray


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a polar lattice: ranges of separation (mas) and position angle (radians)."""

    inner: FloatArray
    outer: FloatArray
    first: FloatArray
    last: FloatArray

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: Any) -> Cells:
        return Cells(self.inner[index], self.outer[index], self.first[index], self.last[index])

    @property
    def centre(self) -> tuple[FloatArray, FloatArray]:
        """Separation (the mean over the cell's area) and position angle, (n,) each."""
        a, b = self.inner, self.outer
        rho = 2.0 / 3.0 * (a * a + a * b + b * b) / (a + b)
        return rho, 0.5 * (self.first + self.last)

    @property
    def position(self) -> tuple[FloatArray, FloatArray]:
        """East and north of the centres, mas, (n,) each."""
        rho, angle = self.centre
        return rho * np.sin(angle), rho * np.cos(angle)

    @property
    def size(self) -> FloatArray:
        """Longer side, mas, (n,)."""
        across = self.outer * (self.last - self.first)
        return np.maximum(self.outer - self.inner, across)

    def halved(self) -> Cells:
        """Four cells for each one, halved in separation and in angle."""
        rho, angle = 0.5 * (self.inner + self.outer), 0.5 * (self.first + self.last)
        return Cells(
            np.concatenate([self.inner, rho, self.inner, rho]),
            np.concatenate([rho, self.outer, rho, self.outer]),
            np.concatenate([self.first, self.first, angle, angle]),
            np.concatenate([angle, angle, self.last, self.last]),
        )

    @staticmethod
    def join(one: Cells, other: Cells) -> Cells:
        """Cells of both."""
        names = ("inner", "outer", "first", "last")
        return Cells(*(np.concatenate([getattr(one, n), getattr(other, n)]) for n in names))


def polar_cells(inner_mas: float, outer_mas: float, step_mas: float) -> Cells:
    """Tile an annulus with cells of about a step in both directions."""
    n_rings = max(1, int(np.ceil((outer_mas - inner_mas) / step_mas)))
    edges = np.linspace(inner_mas, outer_mas, n_rings + 1)
    counts = np.maximum(6, np.ceil(2.0 * np.pi * edges[1:] / step_mas)).astype(int)
    ring = np.repeat(np.arange(n_rings), counts)
    place = np.arange(len(ring)) - np.repeat(np.cumsum(counts) - counts, counts)
    width = 2.0 * np.pi / counts[ring]
    return Cells(edges[ring], edges[ring + 1], place * width, (place + 1) * width)

"""Positions of a search, a lattice inside an annulus, symmetric about the star; and rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.likelihood.likelihood import Likelihood
from amibayes.units import MAS, BoolArray, FloatArray, IntArray

WIDTHS, CACHED = (64, 128), 65536
"""Fewest and most positions that are worked on at once, and numbers that fit a processor's cache,
several times."""

RATE_STEPS_PER_FRINGE = 4
"""Steps in rate per λ/B_max of the place at the date farthest from the reference date."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Positions on a square lattice inside an annulus, symmetric about the star.

    Parameters
    ----------
    step_mas : float
        Spacing of the lattice.
    inner_mas, outer_mas : float
        Range of separations.
    columns, rows : (n,) int array
        Lattice coordinates, east = column·step, north = row·step. The first half of the
        positions is one half plane, the second half its mirror image in the same order.
    """

    step_mas: float
    inner_mas: float
    outer_mas: float
    columns: IntArray
    rows: IntArray

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def east_mas(self) -> FloatArray:
        """East offsets, (n,)."""
        return np.asarray(self.columns * self.step_mas, dtype=float)

    @property
    def north_mas(self) -> FloatArray:
        """North offsets, (n,)."""
        return np.asarray(self.rows * self.step_mas, dtype=float)

    @property
    def places(self) -> FloatArray:
        """East and north offsets, (2, n)."""
        return np.stack([self.east_mas, self.north_mas])

    def holds(self, separation_mas: float) -> bool:
        """Whether a separation is one of the annulus, its edges left out."""
        return self.inner_mas < separation_mas < self.outer_mas

    @property
    def half_width(self) -> int:
        """Number of lattice points from the star to the edge of the map."""
        return int(self.outer_mas / self.step_mas)

    def half_plane(
        self, n_samples: int, among: IntArray | None = None, *, tiles: bool = False
    ) -> list[IntArray]:
        """Positions of one half plane, in pieces whose fringes at so many points stay in cache.

        Or ``among`` some of them only.

        With ``tiles``, in squares with an even number of positions a side; those at the edges
        of the annulus have fewer.
        """
        half = np.arange(len(self) // 2) if among is None else among
        width = int(np.clip(CACHED // n_samples, *WIDTHS))
        if not tiles or not len(half):
            return np.split(half, range(width, len(half), width)) if len(half) else []
        side = int(np.sqrt(width)) // 2 * 2
        tile = np.stack([self.rows[half], self.columns[half]]) // side
        label = np.unique(tile, axis=1, return_inverse=True)[1].ravel()
        return np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])

    def coarse(self, tile: IntArray) -> BoolArray:
        """Which positions (n,) of a tile are every second one along each axis, (n,).

        And those at the edge of the annulus that have none of these beside them.
        """
        rows, columns = self.rows[tile], self.columns[tile]
        even = (rows % 2 == 0) & (columns % 2 == 0)
        far = [np.abs(x[:, None] - x[even]) > 1 for x in (rows, columns)]
        return np.asarray(even | (far[0] | far[1]).all(axis=1))

    def image(self, values: FloatArray) -> FloatArray:
        """Lay values (n,) out as a map [north, east], NaN outside the annulus."""
        n = 2 * self.half_width + 1
        out = np.full((n, n), np.nan)
        out[self.rows + self.half_width, self.columns + self.half_width] = values
        return out


def make_grid(inner_mas: float, outer_mas: float, step_mas: float) -> Grid:
    """Fill the annulus inner ≤ separation ≤ outer with a lattice (the star itself left out)."""
    n = int(outer_mas / step_mas)
    axis = np.arange(-n, n + 1)
    columns, rows = np.meshgrid(axis, axis[n:])
    radius = np.hypot(columns, rows) * step_mas
    upper = (rows > 0) | (columns > 0)
    inside = upper & (radius >= inner_mas) & (radius <= outer_mas)
    columns, rows = columns[inside], rows[inside]
    return Grid(
        step_mas,
        inner_mas,
        outer_mas,
        np.concatenate([columns, -columns]),
        np.concatenate([rows, -rows]),
    )


def rates_per_axis(likelihood: Likelihood) -> int:
    """Number of rates that are tried along east, and along north."""
    model, samples = likelihood.model, likelihood.samples
    if not model.moves:
        return 1
    fringe = 1.0 / samples.frequency.max() / MAS
    farthest = float(np.abs(samples.years(model.reference_mjd)).max())
    return 2 * int(np.ceil(RATE_STEPS_PER_FRINGE * model.fastest_mas_yr * farthest / fringe)) + 1


def trial_rates(likelihood: Likelihood) -> FloatArray:
    """Rates along east and north that are tried, mas/yr, (n, 2), symmetric about 0."""
    fastest, n = likelihood.model.fastest_mas_yr, rates_per_axis(likelihood)
    axis = np.linspace(-fastest, fastest, n) if n > 1 else np.zeros(1)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)

"""The aperture mask: where the holes are, their shape, and what follows from that.

Baseline (i, j), i < j, is the vector from hole i to hole j: u = x_j − x_i, v = y_j − y_i,
in metres, in the image's own axes (x right, y up). An object of visibility V then shows
the fringe Re[V e^{+2πi (ux + vy)/λ}], and a Fourier transform of the image at +(u, v)/λ is V.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from amibayes.errors import DataError
from amibayes.units import FloatArray, IntArray, read_only

SHAPES = ("hexagon", "circle")


@dataclass(frozen=True, eq=False)
class Mask:
    """A mask of equal holes.

    Parameters
    ----------
    name : str
        What it is called.
    holes_m : (n, 2) array
        Hole centres x, y, projected on the primary mirror, in the image's axes, metres.
    shape : {"hexagon", "circle"}
        Shape of every hole.
    size_m : float
        Flat to flat of a hexagon, diameter of a circle, metres.
    orientation_rad : float
        Direction of a corner of the hexagon, from +x towards +y; 0 has flat top and bottom.
    hole_map : (2, 2) array
        Linear map that every hole, of that shape and size, has gone through.
    """

    name: str
    holes_m: FloatArray
    shape: str
    size_m: float
    orientation_rad: float = 0.0
    hole_map: FloatArray = field(default_factory=lambda: np.eye(2))

    def __post_init__(self) -> None:
        read_only(self, "holes_m", "hole_map")
        if self.holes_m.ndim != 2 or self.holes_m.shape[1] != 2 or len(self.holes_m) < 2:
            raise DataError(f"mask {self.name} needs two holes or more, each with x and y")
        if self.shape not in SHAPES:
            raise DataError(f"mask {self.name} has holes of unknown shape '{self.shape}'")
        if not 0.0 < self.size_m < np.inf:
            raise DataError(f"mask {self.name} has holes of size {self.size_m:g} m")
        closest = self.shortest_m
        if closest < self.size_m * (1.0 - 1e-9):
            raise DataError(f"mask {self.name} has two holes {closest:.3f} m apart: they overlap")

    @property
    def n_holes(self) -> int:
        """How many holes."""
        return len(self.holes_m)

    @cached_property
    def pairs(self) -> IntArray:
        """Holes (i, j), i < j, of every baseline, shape (n_baselines, 2)."""
        return np.array(list(combinations(range(self.n_holes), 2)), dtype=np.intp)

    @cached_property
    def triangles(self) -> IntArray:
        """Holes (i, j, k), i < j < k, of every triangle, shape (n_triangles, 3)."""
        return np.array(list(combinations(range(self.n_holes), 3)), dtype=np.intp).reshape(-1, 3)

    @cached_property
    def triangle_baselines(self) -> IntArray:
        """Indices of the baselines (ij), (jk), (ik) of every triangle, shape (n_triangles, 3).

        The bispectrum is V(ij)·V(jk)·V*(ik).
        """
        index = np.zeros((self.n_holes, self.n_holes), dtype=np.intp)
        index[self.pairs[:, 0], self.pairs[:, 1]] = np.arange(len(self.pairs))
        i, j, k = self.triangles.T
        return np.stack([index[i, j], index[j, k], index[i, k]], axis=1)

    @property
    def n_baselines(self) -> int:
        """How many baselines."""
        return len(self.pairs)

    @cached_property
    def uv_m(self) -> FloatArray:
        """Baseline vectors u, v in metres, shape (n_baselines, 2)."""
        return np.asarray(self.holes_m[self.pairs[:, 1]] - self.holes_m[self.pairs[:, 0]])

    @property
    def longest_m(self) -> float:
        """Longest baseline, metres."""
        return float(np.hypot(*self.uv_m.T).max())

    @property
    def shortest_m(self) -> float:
        """Shortest baseline, metres."""
        return float(np.hypot(*self.uv_m.T).min())

    @property
    def extent_m(self) -> float:
        """Largest |u| or |v| at which two points of the holes interfere, metres."""
        reach = self.size_m * (2.0 / np.sqrt(3.0) if self.shape == "hexagon" else 1.0)
        return float(np.abs(self.uv_m).max() + reach * np.linalg.norm(self.hole_map, 2))

    @property
    def hole_area_m2(self) -> float:
        """Area of one hole, m²."""
        factor = np.sqrt(3.0) / 2.0 if self.shape == "hexagon" else np.pi / 4.0
        return float(factor * self.size_m**2 * abs(np.linalg.det(self.hole_map)))

    @property
    def area_m2(self) -> float:
        """Collecting area of all holes, m²."""
        return self.n_holes * self.hole_area_m2

    @cached_property
    def corners_m(self) -> FloatArray:
        """Corners of one hexagon about its centre, shape (6, 2), metres.

        A circle is given by 720 points on it, for drawing.
        """
        hexagon = self.shape == "hexagon"
        count, radius = (6, self.size_m / np.sqrt(3.0)) if hexagon else (720, self.size_m / 2.0)
        angle = self.orientation_rad + np.arange(count) * (2.0 * np.pi / count)
        corners = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return np.asarray(corners @ self.hole_map.T)

    def rotated(self, angle_rad: float) -> Mask:
        """Return the mask turned by ``angle_rad`` from +x towards +y."""
        c, s = np.cos(angle_rad), np.sin(angle_rad)
        return self.mapped(np.array([[c, -s], [s, c]]))

    def mapped(self, matrix: FloatArray) -> Mask:
        """Return the mask under a linear map (2, 2), its holes with it."""
        a = np.asarray(matrix, dtype=float)
        return replace(self, holes_m=self.holes_m @ a.T, hole_map=a @ self.hole_map)

    @property
    def is_mapped(self) -> bool:
        """Whether the holes are under a map."""
        return not np.array_equal(self.hole_map, np.eye(2))

    def redundant_pairs(self, tolerance_m: float | None = None) -> IntArray:
        """Pairs of baselines that are the same within a tolerance, up to their sign.

        Parameters
        ----------
        tolerance_m : float, optional
            Distance in the (u, v) plane; by default half a hole, within which two
            splodges cannot be told apart.

        Returns
        -------
        (n, 2) array
            Indices of the baselines; empty for a non-redundant mask.
        """
        limit = 0.5 * self.size_m if tolerance_m is None else tolerance_m
        first, second = np.triu_indices(self.n_baselines, 1)
        apart = [np.hypot(*(self.uv_m[first] - s * self.uv_m[second]).T) for s in (1.0, -1.0)]
        close = np.minimum(*apart) < limit
        return np.stack([first[close], second[close]], axis=1)

    @property
    def non_redundant(self) -> bool:
        """Whether every baseline occurs once."""
        return len(self.redundant_pairs()) == 0

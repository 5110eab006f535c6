"""Between a detector's pixel axes and the sky: one place for the signs.

With y up at position angle θ (east of north) and east to its left (parity −1), a pixel
direction (x, y) lies at position angle θ + atan2(−x, y): east = −x cos θ + y sin θ and
north = x sin θ + y cos θ. Baselines turn as positions do. The matrix is its own inverse.
Parity +1 is the mirror image, x reversed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from amibayes.support.quantities import takes_quantities
from amibayes.units import FloatArray


@takes_quantities
@dataclass(frozen=True)
class Orientation:
    """How an image lies on the sky.

    Parameters
    ----------
    position_angle_rad : float
        Position angle of the image's +y, radians east of north.
    parity : int
        −1 with east to the left of north (the sky as it is seen), +1 for its mirror image.
    """

    position_angle_rad: float = 0.0
    parity: int = -1

    def __post_init__(self) -> None:
        if self.parity not in (-1, 1):
            raise ValueError(f"parity is {self.parity}, neither -1 nor 1")

    @property
    def matrix(self) -> FloatArray:
        """Rows east and north, columns x and y: sky = matrix @ image, shape (2, 2)."""
        c, s = np.cos(self.position_angle_rad), np.sin(self.position_angle_rad)
        return np.array([[self.parity * c, s], [-self.parity * s, c]])

    def to_sky(self, vectors: ArrayLike) -> FloatArray:
        """(x, y) vectors, shape (…, 2), as (east, north); positions and baselines alike."""
        return np.asarray(np.asarray(vectors, dtype=float) @ self.matrix.T)

    def to_image(self, vectors: ArrayLike) -> FloatArray:
        """(east, north) vectors, shape (…, 2), as (x, y)."""
        return np.asarray(np.asarray(vectors, dtype=float) @ self.matrix)

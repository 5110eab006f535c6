"""Between a detector's pixel axes and the sky: one place for the signs.

With y up at position angle θ (east of north) and east to its left (parity −1), a pixel
direction (x, y) lies at position angle θ + atan2(−x, y): east = −x cos θ + y sin θ and
north = x sin θ + y cos θ. Baselines turn as positions do. Parity +1 is the mirror image, x
reversed. Real pixels are not quite square, nor their axes at right angles: places are
skewed too, and baselines the other way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from amibayes.support.arguments import checks_arguments
from amibayes.units import DEGREE, FloatArray

SAME_ORIENTATION_RAD = 0.05 * DEGREE
"""Dithers of a visit differ by arcseconds, rolls of two visits by degrees; at 400 mas this is
0.35 mas for one of two exposures, and nothing for their mean."""


@checks_arguments
@dataclass(frozen=True)
class Orientation:
    """How an image lies on the sky.

    Parameters
    ----------
    position_angle_rad : float
        Position angle of the image's +y, radians east of north.
    parity : int
        −1 with east to the left of north (the sky as it is seen), +1 for its mirror image.
    skew : (xx, xy, yx, yy)
        Matrix that pixels, neither square nor upright, are multiplied by before they are
        turned; its determinant is 1, and it leaves the direction of +y alone.
    """

    position_angle_rad: float = 0.0
    parity: int = -1
    skew: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if self.parity not in (-1, 1):
            raise ValueError(f"parity is {self.parity}, neither -1 nor 1")

    def is_like(self, other: Orientation) -> bool:
        """Whether two images lie alike, as far as dithers of one visit do."""
        apart = self.position_angle_rad - other.position_angle_rad
        near = abs((apart + np.pi) % (2.0 * np.pi) - np.pi) <= SAME_ORIENTATION_RAD
        skewed = np.abs(np.subtract(self.skew, other.skew)).max() > SAME_ORIENTATION_RAD
        return near and self.parity == other.parity and not skewed

    @property
    def matrix(self) -> FloatArray:
        """Rows east and north, columns x and y: sky = matrix @ image, shape (2, 2)."""
        c, s = np.cos(self.position_angle_rad), np.sin(self.position_angle_rad)
        turn = np.array([[self.parity * c, s], [-self.parity * s, c]])
        return np.asarray(turn @ np.reshape(self.skew, (2, 2)))

    @property
    def inverse(self) -> FloatArray:
        """Rows x and y, columns east and north: image = inverse @ sky, shape (2, 2)."""
        return np.asarray(np.linalg.inv(self.matrix))

    def to_sky(self, vectors: ArrayLike) -> FloatArray:
        """(x, y) places, shape (…, 2), as (east, north)."""
        return np.asarray(np.asarray(vectors, dtype=float) @ self.matrix.T)

    def to_image(self, vectors: ArrayLike) -> FloatArray:
        """(east, north) places, shape (…, 2), as (x, y)."""
        return np.asarray(np.asarray(vectors, dtype=float) @ self.inverse.T)

    def baselines_to_sky(self, vectors: ArrayLike) -> FloatArray:
        """(x, y) baselines or frequencies, shape (…, 2), as (east, north).

        Their product with a place is a phase, the same in either axes: they turn as places
        do, and are skewed the other way.
        """
        return np.asarray(np.asarray(vectors, dtype=float) @ self.inverse)


def orientation_of_matrix(matrix: FloatArray) -> Orientation:
    """Orientation of d(east, north)/d(x, y), (2, 2), in any unit; that of +y is its angle."""
    parity = -1 if np.linalg.det(matrix) < 0.0 else 1
    angle = float(np.arctan2(matrix[0, 1], matrix[1, 1]))
    skew = np.linalg.inv(Orientation(angle, parity).matrix) @ matrix
    skew = skew / np.sqrt(abs(np.linalg.det(matrix)))
    xx, xy, yx, yy = (
        float(s) for s in np.where(np.abs(skew - np.eye(2)) < 1e-12, np.eye(2), skew).ravel()
    )
    return Orientation(angle, parity, (xx, xy, yx, yy))

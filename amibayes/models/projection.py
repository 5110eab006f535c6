"""Spatial frequencies in the plane of a flat structure that is seen at an angle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from amibayes.units import DEGREE, FloatArray


@dataclass(frozen=True, eq=False)
class Projection:
    """Frequencies (n_samples, n) along both axes of a structure, and what an angle does to them.

    A structure whose minor axis is foreshortened by q has the Fourier transform of the one seen
    face on, at the frequency (a, q·b): a along the major axis, b along the minor one.

    Parameters
    ----------
    a, b : (n_samples, n) float array
        Along the major axis, and along the minor axis 90° further east; cycles per radian.
    ratio : (n,) float array
        q, the cosine of the inclination.
    """

    a: FloatArray
    b: FloatArray
    ratio: FloatArray

    @classmethod
    def of(cls, u: FloatArray, v: FloatArray, ratio: FloatArray, angle_deg: FloatArray) -> Any:
        """Turn frequencies (n_samples,) to the axes of structures.

        Parameters
        ----------
        u, v : (n_samples,) float array
            East and north, cycles per radian.
        ratio : (n,) float array
        angle_deg : (n,) float array
            Position angle of the major axis, east of north.
        """
        sine, cosine = np.sin(angle_deg * DEGREE), np.cos(angle_deg * DEGREE)
        u, v = u[:, None], v[:, None]
        return cls(u * sine + v * cosine, u * cosine - v * sine, ratio)

    @property
    def length(self) -> FloatArray:
        """Length of the frequency in the plane of the structure, (n_samples, n)."""
        # np.hypot, safe for numbers whose squares overflow, takes several times as long.
        return np.asarray(np.sqrt(self.a**2 + (self.ratio * self.b) ** 2))

    def length_slopes(self) -> tuple[FloatArray, FloatArray]:
        """Half the derivatives of length² by the axis ratio and by the angle (per degree)."""
        by_ratio = self.ratio * self.b**2
        by_angle = DEGREE * self.a * self.b * (1.0 - self.ratio**2)
        return by_ratio, by_angle

    def along(self, angle_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Frequency along an azimuth in the plane, from the major axis on, and 90° further."""
        sine, cosine = np.sin(angle_deg * DEGREE), np.cos(angle_deg * DEGREE)
        below = self.ratio * self.b
        return self.a * cosine + below * sine, below * cosine - self.a * sine

    def along_slopes(self, angle_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives of `along`, at a fixed azimuth, by the axis ratio and by the angle."""
        sine, cosine = np.sin(angle_deg * DEGREE), np.cos(angle_deg * DEGREE)
        by_ratio = self.b * sine
        by_angle = DEGREE * (self.b * cosine - self.ratio * self.a * sine)
        return by_ratio, by_angle

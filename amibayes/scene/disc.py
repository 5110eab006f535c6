"""The uniform disc: the one formula for resolved stars, targets and calibrators alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import j0, j1

from amibayes.units import MAS, FloatArray


def disc_visibility(frequency: FloatArray, diameter_mas: ArrayLike) -> FloatArray:
    """Visibility 2 J1(z)/z of uniform discs; see `uniform_disc`, which costs twice as much."""
    z = np.pi * MAS * np.asarray(frequency, dtype=float) * np.asarray(diameter_mas, dtype=float)
    size = np.maximum(np.abs(z), 1e-8)  # where it is 1 to rounding
    return np.asarray(2.0 * j1(size) / size)


def uniform_disc(frequency: FloatArray, diameter_mas: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Visibility 2 J1(z)/z, z = πθ|u|, of uniform discs, and its derivative per mas.

    Parameters
    ----------
    frequency : (…) float array
        Length of the spatial frequency, cycles per radian.
    diameter_mas : float or array
        Broadcasts against ``frequency``.
    """
    per_mas = np.pi * MAS * np.asarray(frequency, dtype=float)
    z = per_mas * np.asarray(diameter_mas, dtype=float)
    small = np.abs(z) < 1e-4
    safe = np.where(small, 1.0, z)
    value = np.where(small, 1.0 - z * z / 8.0, 2.0 * j1(safe) / safe)
    # d/dz 2 J1(z)/z = −2 J2(z)/z and J2 = 2 J1/z − J0.
    slope = np.where(small, -z / 4.0, 2.0 * (j0(safe) - value) / safe)
    return value, slope * per_mas

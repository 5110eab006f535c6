"""Units at the edges: radians and SI inside, mas, degrees and magnitudes outside."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
SingleArray = NDArray[np.float32]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]
SingleComplexArray = NDArray[np.complex64]

MAS = np.pi / (180.0 * 3600.0 * 1000.0)
"""One milliarcsecond in radians."""

DEGREE = np.pi / 180.0
"""One degree in radians."""


def read_only(container: Any, *names: str) -> None:
    """Replace array fields of a frozen dataclass by read-only float arrays (copies)."""
    for name in names:
        array = np.array(getattr(container, name), dtype=float)
        array.flags.writeable = False
        object.__setattr__(container, name, array)


def freeze(container: Any) -> None:
    """Replace every array field of a frozen dataclass by a read-only copy."""
    for field in fields(container):
        value = getattr(container, field.name)
        if isinstance(value, np.ndarray):
            copy = value.copy()
            copy.flags.writeable = False
            object.__setattr__(container, field.name, copy)


def contrast_to_delta_mag(contrast: ArrayLike) -> FloatArray:
    """Magnitude difference, −2.5 log10(contrast), of a companion/primary flux ratio.

    A contrast of zero is infinitely faint; a negative one has no magnitude (NaN).
    """
    c = np.asarray(contrast, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-2.5 * np.log10(c))


def delta_mag_to_contrast(delta_mag: ArrayLike) -> FloatArray:
    """Companion/primary flux ratio of a magnitude difference."""
    return np.asarray(10.0 ** (-0.4 * np.asarray(delta_mag, dtype=float)))


def separation(east: ArrayLike, north: ArrayLike) -> FloatArray:
    """Angular separation, in the unit of its arguments."""
    return np.asarray(np.hypot(east, north), dtype=float)


def position_angle_deg(east: ArrayLike, north: ArrayLike) -> FloatArray:
    """Position angle, degrees east of north in [0, 360)."""
    return np.asarray(np.degrees(np.arctan2(east, north)) % 360.0)


def offset(separation: ArrayLike, position_angle_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """(east, north) offset of a separation and position angle (degrees east of north)."""
    angle = np.radians(np.asarray(position_angle_deg, dtype=float))
    rho = np.asarray(separation, dtype=float)
    return np.asarray(rho * np.sin(angle)), np.asarray(rho * np.cos(angle))

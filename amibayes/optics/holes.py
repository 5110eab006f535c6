"""Fourier transforms and exact pixel coverage of a single hole."""

from __future__ import annotations

import numpy as np
from scipy.special import j1

from amibayes.instrument import Mask
from amibayes.units import FloatArray


def hole_transform(mask: Mask, fx: FloatArray, fy: FloatArray) -> FloatArray:
    """Fourier transform of one hole about its centre, ∫ e^{−2πi f·b} db.

    Real, since the holes are symmetric. The hexagon is three rhombi that meet at its
    centre, each a product of two sinc: no direction is singular.

    Parameters
    ----------
    mask : Mask
        Shape, size and orientation of the hole.
    fx, fy : arrays
        Spatial frequencies (image angle / wavelength), 1/m; broadcast together.

    Returns
    -------
    array
        m²; the hole's area at zero frequency.
    """
    if mask.shape == "circle":
        (xx, xy), (yx, yy) = mask.hole_map
        return _disc(mask, np.hypot(xx * fx + yx * fy, xy * fx + yy * fy))
    # The spokes to three corners sum to zero: a rhombus, sinc·sinc along two of them, has
    # its centre at minus the third.
    pairs = [_cosine_and_sinc(fx, fy, *spoke) for spoke in mask.corners_m[::2]]
    cosine, sinc = zip(*pairs, strict=True)
    total = cosine[0] * sinc[1]
    total *= sinc[2]
    total += sinc[0] * (cosine[1] * sinc[2] + cosine[2] * sinc[1])
    total *= mask.hole_area_m2 / 3.0
    return np.asarray(total)


def _cosine_and_sinc(
    fx: FloatArray, fy: FloatArray, x: float, y: float
) -> tuple[FloatArray, FloatArray]:
    """cos t and sin t / t of t = π(fx·x + fy·y).

    On a grid (fx a row, fy a column) the exponentials are taken along the axes only; their
    product leaves the sine an absolute error, so that near 0 the series must serve.
    """
    turn = np.exp(1j * np.pi * x * fx) * np.exp(1j * np.pi * y * fy)
    phase = np.pi * (fx * x + fy * y)
    small = np.abs(phase) < 1e-3
    square = phase[small] ** 2
    phase[small] = 1.0
    sinc = turn.imag / phase
    sinc[small] = 1.0 - square / 6.0 * (1.0 - square / 20.0)
    return turn.real, sinc


def _disc(mask: Mask, frequency: FloatArray) -> FloatArray:
    argument = np.pi * mask.size_m * frequency
    safe = np.where(argument < 1e-8, 1.0, argument)
    return np.asarray(mask.hole_area_m2 * np.where(argument < 1e-8, 1.0, 2.0 * j1(safe) / safe))


def coverage(mask: Mask, centre_m: FloatArray, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
    """Fraction of every cell of a grid that one hole covers, without approximation.

    Parameters
    ----------
    mask : Mask
        Shape, size and orientation of the hole.
    centre_m : (2,) array
        Centre of the hole, metres.
    x_m, y_m : (n_x + 1,), (n_y + 1,) arrays
        Rising edges of the cells, metres.

    Returns
    -------
    (n_y, n_x) array
        Between 0 and 1.
    """
    x, y = np.meshgrid(x_m - centre_m[0], y_m - centre_m[1])
    corner = _disc_quadrant(x, y, 0.5 * mask.size_m) if mask.shape == "circle" else None
    area = _polygon_quadrant(x, y, mask.corners_m) if corner is None else corner
    covered = np.diff(np.diff(area, axis=0), axis=1)
    cell = np.diff(y_m)[:, None] * np.diff(x_m)
    return np.asarray(np.clip(covered / cell, 0.0, 1.0))


def _polygon_quadrant(x: FloatArray, y: FloatArray, corners: FloatArray) -> FloatArray:
    """Area of a polygon (corners anticlockwise) left of ``x`` and below ``y``.

    Green's theorem: −∮ min(Y, y) dX over the part of the outline left of x, measured
    from the polygon's foot so that nothing large cancels.
    """
    total = np.zeros_like(x)
    foot = corners[:, 1].min()
    for (x1, y1), (x2, y2) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if x1 == x2:
            continue
        sign = 1.0 if x1 > x2 else -1.0
        (xa, ya), (xb, yb) = sorted([(x1, y1), (x2, y2)])
        reach = np.clip(x, xa, xb) - xa
        top = ya + (yb - ya) * reach / (xb - xa)
        below = 0.5 * (ya + top) - foot - _mean_positive(ya - y, top - y)
        total += sign * reach * below
    return total


def _mean_positive(first: FloatArray, last: FloatArray) -> FloatArray:
    """Mean of max(h, 0) where h runs straight from ``first`` to ``last``."""
    spread = np.abs(first) + np.abs(last)
    crossing = np.maximum(first, last) ** 2 / (2.0 * np.where(spread > 0.0, spread, 1.0))
    both = 0.5 * (first + last)
    same = np.where(both > 0.0, both, 0.0)
    return np.asarray(np.where(first * last < 0.0, crossing, same))


def _disc_quadrant(x: FloatArray, y: FloatArray, radius: float) -> FloatArray:
    """Area of a disc left of ``x`` and below ``y``."""
    x = np.clip(x, -radius, radius)
    y = np.clip(y, -radius, radius)
    half_chord = np.sqrt(radius**2 - y**2)

    def under(limit: FloatArray) -> FloatArray:
        height = np.sqrt(np.maximum(radius**2 - limit**2, 0.0))
        return 0.5 * (limit * height + radius**2 * np.arcsin(limit / radius))

    middle = np.clip(x, -half_chord, half_chord)
    inside = y * (middle + half_chord) + under(middle) - under(-half_chord)
    sides = 2.0 * (under(x) - under(middle) + under(-half_chord) - under(np.full_like(x, -radius)))
    left_only = np.where(x < -half_chord, 2.0 * (under(x) - under(np.full_like(x, -radius))), 0.0)
    whole = np.where(x < -half_chord, left_only, sides)
    return np.asarray(np.where(y > 0.0, whole + np.where(x < -half_chord, 0.0, inside), inside))

"""Separation, position angle and Δmag of draws of a companion, and intervals of any quantity."""

from __future__ import annotations

import numpy as np

from amibayes.units import FloatArray, contrast_to_delta_mag, position_angle_deg, separation

DERIVED = ("separation_mas", "position_angle_deg", "delta_mag")
"""Quantities that follow from the parameters of the companion."""


def derived(name: str, east: FloatArray, north: FloatArray, contrast: FloatArray) -> FloatArray:
    """One of `DERIVED`, of positions in mas and contrasts."""
    if name == "separation_mas":
        return separation(east, north)
    if name == "position_angle_deg":
        return position_angle_deg(east, north)
    # A fit may leave nothing of a companion; its Δmag is then far beyond any limit.
    return contrast_to_delta_mag(np.maximum(contrast, 1e-300))


def interval(name: str, values: FloatArray, level: float) -> tuple[float, float, float]:
    """(median, lower, upper) of draws.

    Position angles are cut opposite their mean; the median lies in [0, 360) and the limits
    on both sides of it.
    """
    angle, cut = name == "position_angle_deg", 0.0
    if angle:
        cut = float(np.angle(np.exp(1j * np.radians(values)).mean(), deg=True)) - 180.0
        values = (values - cut) % 360.0
    low, mid, high = np.quantile(values, [0.5 - level / 2, 0.5, 0.5 + level / 2]) + cut
    turn = 360.0 * (mid // 360.0) if angle else 0.0
    return float(mid - turn), float(low - turn), float(high - turn)

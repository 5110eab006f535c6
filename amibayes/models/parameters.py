"""Bounds of the free parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amibayes.units import MAS

MAX_BACKGROUND = 10.0
"""Largest over-resolved flux, in units of the primary's."""


MAX_CONTRAST = 1.0
"""A companion brighter than its primary is the same binary seen from the other star."""


@dataclass(frozen=True)
class Box:
    """The field of a search: range of separations, and λ/B_max."""

    inner_mas: float
    outer_mas: float
    fringe_mas: float


def nuisance_bounds(
    parameters: Sequence[str], lowest_frequency: float
) -> list[tuple[float, float]]:
    """Ranges of the free diameter (to λ/B_min) and background.

    Parameters
    ----------
    parameters : sequence of str
        Names of the free parameters.
    lowest_frequency : float
        B_min/λ of the data, cycles per radian.
    """
    ranges = {
        "diameter_mas": (0.0, 1.0 / lowest_frequency / MAS),
        "background": (0.0, MAX_BACKGROUND),
    }
    return [ranges[name] for name in parameters if name in ranges]

"""The field of an image: what the data can see, without places that they cannot tell apart."""

from __future__ import annotations

import numpy as np

from amibayes.errors import UsageError
from amibayes.imaging.grid import PixelGrid
from amibayes.models.uv_points import UVPoints
from amibayes.units import MAS

PIXELS_PER_BEAM = 4.0
"""Pixels across λ/2B: finer ones are filled by the regulariser alone."""

MAX_SIDE = 101
"""Pixels along a side: more take minutes and show no more."""

MAX_NUMBERS = 4e7
"""Entries of the transform of all pixels, 16 bytes each."""

WIDE_NUMBERS = 1e7
"""Entries up to which the default field is wider than λ/B_min in all: with more, of thousands of
spectral channels, an image would take a quarter of an hour."""

SAME_PLACE = 0.9
"""Height of the dirty beam beside its middle with which the sky repeats itself. The holes of
NIRISS are on a lattice: 0.98. Four stations at one time reach 0.93, at four times 0.6."""


def choose_grid(
    samples: UVPoints, field_mas: float | None = None, pixel_mas: float | None = None
) -> PixelGrid:
    """Choose pixels that the data can tell apart, over the field that they can see.

    Raises
    ------
    UsageError
        Where there would be too few or too many pixels.
    """
    beam = 0.5 / float(samples.frequency.max()) / MAS
    field = field_mas or default_field(samples)
    pixel = pixel_mas or max(beam / PIXELS_PER_BEAM, field / MAX_SIDE)
    n = int(np.ceil(field / pixel)) // 2 * 2 + 1
    if n < 5 or float(n) ** 2 * len(samples) > MAX_NUMBERS:
        raise UsageError(
            f"an image of {n} pixels a side for {len(samples)} points of the (u, v) plane",
            remedy="give other --field and --pixel, or average channels with --bin-channels",
        )
    return PixelGrid(n, pixel)


def default_field(samples: UVPoints) -> float:
    """Side of the field, mas: λ/B_min either way, as in a search, if that is without repetition.

    Two places of a square are as far apart as its side along one of the axes at most. The field
    ends where the dirty beam comes back within that, and where pixels of a quarter of λ/2B would
    be too many for the points, but not before λ/B_min.
    """
    wide = 1.0 / float(samples.frequency.min()) / MAS
    beam = 0.5 / float(samples.frequency.max()) / MAS
    affordable = beam / PIXELS_PER_BEAM * np.sqrt(WIDE_NUMBERS / len(samples))
    return float(max(min(2.0 * wide, repetition_mas(samples), affordable), wide))


def repetition_mas(samples: UVPoints) -> float:
    """Smallest side of a square in which two places look the same; infinite within 2 λ/B_min."""
    fringe = 1.0 / float(samples.frequency.max()) / MAS
    widest = 2.0 / float(samples.frequency.min()) / MAS
    step = max(0.25 * fringe, widest / (2 * MAX_SIDE))
    east = np.arange(0.0, widest, step)
    north = np.concatenate([-east[:0:-1], east])
    turn = 2j * np.pi * MAS
    up = np.exp(turn * np.outer(north, samples.v))
    beam = (up @ np.exp(turn * np.outer(samples.u, east))).real / len(samples)
    apart = np.hypot(north[:, None], east) > fringe
    side = np.maximum(np.abs(north)[:, None], east)
    return float(side[apart & (beam > SAME_PLACE)].min(initial=np.inf))

"""Positions behind the mask as built: bias and pulls of a companion of contrast 0.1, as a table.

    python docs/mask_map_bias.py [--seeds 3]

Images are made wave by wave behind a mask of the commissioning's map, by test code that knows
neither the fringe model nor the package's own map (`tests/extraction/test_mask_map.py`), and
extracted with the map as it is fitted, and without. The table goes to docs/howto/niriss.md.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pages import put_table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "extraction"))

from test_mask_map import cube, mapped_image

from amibayes import Companion, Likelihood, calibrate, search
from amibayes.extraction import ExtractOptions, extract_all
from amibayes.extraction.visits import visit_maps
from amibayes.models.binary import BinaryModel
from amibayes.units import FloatArray, offset

PLACES = ((100, 20), (150, 120), (200, 70), (250, 200), (300, 160), (350, 310), (400, 250))
"""Separations (mas) and position angles (deg)."""

CONTRAST, BRIGHT, FAINT = 0.1, 1e10, 1e7
"""Photons of an integration: for the bias, and for pulls. There are 8 of target and calibrator."""


def found(target: Any, star: Any, options: ExtractOptions) -> Companion:
    """The companion by one extraction and search."""
    maps = visit_maps([target, star], options, {})
    data, reference = (
        extract_all(c, options, maps=[m])[0].observables
        for c, m in zip((target, star), maps, strict=True)
    )
    data = calibrate([data], [reference], method="weighted").observables
    return search(Likelihood(data, BinaryModel(diameter_mas=0.0)), (60.0, 500.0)).companion


def row(separation: float, angle: float, star: FloatArray, seeds: int) -> str:
    """Bias and pulls at one place."""
    east, north = (float(x) for x in offset(separation, angle))
    image = mapped_image([(0.0, 0.0, 1.0), (-east, north, CONTRAST)])
    pair = cube(image, 4, photons=BRIGHT), cube(star, 5, "other", photons=BRIGHT)
    ours = found(*pair, ExtractOptions())
    scaled = found(*(_unknown(c) for c in pair), ExtractOptions())
    pulls = np.array([_pulls(image, star, seed, (east, north)) for seed in range(seeds)])
    return (
        f"| {separation} | {angle} | {100 * (ours.separation_mas / separation - 1):+.4f} | "
        f"{ours.position_angle_deg - angle:+.4f} | "
        f"{100 * (scaled.separation_mas / separation - 1):+.3f} | "
        f"{np.sqrt((pulls[:, :2] ** 2).mean()):.2f} | {np.sqrt((pulls[:, 2] ** 2).mean()):.2f} |"
    )


def _unknown(given: Any) -> Any:
    """The same images, of pixels whose size nothing tells: one scale is fitted, no map."""
    return replace(given, pixels_known=False)


def _pulls(
    image: FloatArray, star: FloatArray, seed: int, place: tuple[float, float]
) -> list[float]:
    pair = (
        cube(image, 100 + 2 * seed, photons=FAINT),
        cube(star, 101 + 2 * seed, "other", photons=FAINT),
    )
    c = found(*pair, ExtractOptions())
    return [
        (c.east_mas - place[0]) / c.east_error_mas,
        (c.north_mas - place[1]) / c.north_error_mas,
        (c.contrast - CONTRAST) / c.contrast_error,
    ]


def main() -> int:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="draws for the pulls of a place")
    seeds = parser.parse_args().seeds
    star = mapped_image([(0.0, 0.0, 1.0)])
    rows = [
        "| separation (mas) | position angle (deg) | bias of separation (%) | of angle (deg) | "
        "with one scale (%) | rms pull of position | of contrast |",
        f"|{'---|' * 7}",
    ]
    for place in PLACES:
        rows.append(row(*place, star, seeds))
        print(rows[-1], flush=True)
    put_table("howto/niriss.md", rows, "map: docs/mask_map_bias.py")
    return 0


if __name__ == "__main__":
    sys.exit(main())

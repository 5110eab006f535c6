"""A small cube with flags, errors, times and a header."""

from __future__ import annotations

import numpy as np

from amibayes.cube import Cube
from amibayes.scene.orientation import Orientation
from amibayes.units import DEGREE, MAS


def make_cube(rng: np.random.Generator, n: int = 5, size: tuple[int, int] = (8, 10)) -> Cube:
    """Noise of n images, half of whose pixels are flagged."""
    images = rng.normal(100.0, 3.0, (n, *size)).astype(np.float32)
    dq = rng.integers(0, 2, images.shape).astype(np.uint32) * np.uint32(2**31 + 4)
    return Cube(
        images=images,
        pixel_scale_rad=65.6 * MAS,
        instrument="NIRISS",
        filter="F430M",
        orientation=Orientation(123.4 * DEGREE, -1),
        error=np.abs(images) / 10.0,
        dq=dq,
        integration_time_s=1.05616,
        mjd=60000.0 + np.arange(n) / 1e4,
        header={"NGROUPS": 14, "PUPIL": "MASK_NRM", "V3I_YANG": 0.57, "TARGPROP": "AB-DOR"},
    )

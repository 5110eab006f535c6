"""A star through the mask by poppy, which shares nothing with our optics."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from amibayes.instrument import Instrument
from amibayes.units import FloatArray


def poppy_image(
    instrument: Instrument,
    wavelength_m: FloatArray,
    weight: FloatArray,
    side_px: int,
    *,
    oversample: int = 1,
    n_pupil: int = 1024,
) -> FloatArray:
    """Image of a point source by Fraunhofer transforms of a sampled pupil."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        poppy = pytest.importorskip("poppy")
        holes = []
        for k, (x, y) in enumerate(instrument.mask.holes_m):
            hole = poppy.HexagonAperture(
                flattoflat=instrument.mask.size_m, rotation=0.0, name=f"hole {k}"
            )
            hole.shift_x, hole.shift_y = x, y
            holes.append(hole)
        system = poppy.OpticalSystem(pupil_diameter=6.6, npix=n_pupil, oversample=1)
        system.add_pupil(poppy.CompoundAnalyticOptic(holes, mergemode="or"))
        pixel = np.degrees(instrument.pixel_scale_rad) * 3600.0
        system.add_detector(pixelscale=pixel, fov_pixels=side_px, oversample=oversample)
        images = [
            w * system.calc_psf(wavelength=float(x))[0].data
            for x, w in zip(wavelength_m, weight, strict=True)
        ]
    return np.asarray(sum(images))

"""Exposures whose images are poppy's and whose noise is numpy's: nothing of our simulator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from poppy_rig import poppy_image

from amibayes.cube import Cube, write_cube
from amibayes.instrument import load_instrument
from amibayes.units import FloatArray

SIDE_PX, MARGIN_PX, OVERSAMPLE = 80, 8, 3
READ_NOISE_E, FLAT_ERROR, POINTING_ARCSEC = 15.0, 1e-3, 0.015


@dataclass(frozen=True)
class PoppyExposure:
    """NIRISS images of a star and its calibrators, on one detector.

    Parameters
    ----------
    filter : str
    electrons : float
        Of the star, in one integration.
    n_integrations, n_calibrators : int
    field_mas : (float, float)
    """

    filter: str = "F430M"
    electrons: float = 1e6
    n_integrations: int = 30
    n_calibrators: int = 2
    field_mas: tuple[float, float] = (50.0, 400.0)

    def write(
        self, truth: FloatArray | None, seed: np.random.SeedSequence, folder: Path
    ) -> tuple[list[Path], list[Path]]:
        """See `amibayes.validation.plan.Condition`: +y is north, and east is left."""
        rng = np.random.default_rng(seed)
        flat = 1.0 + FLAT_ERROR * rng.standard_normal((SIDE_PX, SIDE_PX))
        paths = []
        for k in range(1 + self.n_calibrators):
            paths.append(folder / f"star{k}_calints.fits")
            write_cube(paths[-1], self._cube(None if k else truth, flat, rng))
        return paths[:1], paths[1:]

    def _cube(self, truth: FloatArray | None, flat: FloatArray, rng: np.random.Generator) -> Cube:
        pointing = POINTING_ARCSEC * rng.standard_normal(2)
        light = self._light(pointing)
        if truth is not None:
            place = np.array([-truth[0], truth[1]]) / 1000.0
            light = light + truth[2] * self._light(pointing + place)
        mean = np.broadcast_to(self.electrons * light * flat, (self.n_integrations, *flat.shape))
        images = rng.poisson(mean) + READ_NOISE_E * rng.standard_normal(mean.shape)
        instrument = load_instrument("niriss", self.filter)
        return Cube(
            images=images,
            pixel_scale_rad=instrument.pixel_scale_rad,
            instrument="NIRISS",
            filter=self.filter,
            error=np.sqrt(np.maximum(mean, 1.0) + READ_NOISE_E**2),
            integration_time_s=1.0,
            mjd=60000.0 + np.arange(self.n_integrations) / 86400.0,
            pixels_known=instrument.mask.is_mapped,
        )

    def _light(self, place_arcsec: FloatArray) -> FloatArray:
        """Share of a source's light in each pixel, the mean over what lies within it.

        The image has no frequencies beyond those of the mask, well below the fine pixels': moved
        by a phase of its transform it is exact, but for light that comes in at the other edge.
        """
        fine, pixel_arcsec = fine_image(self.filter)
        x, y = OVERSAMPLE * place_arcsec / pixel_arcsec
        v, u = (np.fft.fftfreq(n) for n in fine.shape)
        moved = np.exp(-2j * np.pi * (u * x + v[:, None] * y)) * np.fft.fft2(fine)
        n, edge = SIDE_PX + 2 * MARGIN_PX, slice(MARGIN_PX, -MARGIN_PX)
        pixels = np.fft.ifft2(moved).real.reshape(n, OVERSAMPLE, n, OVERSAMPLE).sum(axis=(1, 3))
        return np.asarray(np.maximum(pixels, 0.0)[edge, edge])


@cache
def fine_image(name: str) -> tuple[FloatArray, float]:
    """A point source in the middle, and the side of a pixel (arcseconds) before it is divided."""
    instrument = load_instrument("niriss", name)
    channels = instrument.bandpass.channels()
    fine = poppy_image(
        instrument,
        channels.wavelength_m,
        channels.weight,
        SIDE_PX + 2 * MARGIN_PX,
        oversample=OVERSAMPLE,
    )
    return fine / fine.sum(), float(np.degrees(instrument.pixel_scale_rad) * 3600.0)

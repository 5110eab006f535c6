"""The pixels of an image, and what each of them adds to the visibilities."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.models.companion import point_visibility
from amibayes.models.uv_points import UVPoints
from amibayes.scene.disc import uniform_disc
from amibayes.units import ComplexArray, FloatArray

CHUNK = 512
"""Pixels that are transformed together: some ten megabytes for a thousand points."""


@dataclass(frozen=True)
class PixelGrid:
    """Square pixels around the star, which is in the middle of the middle one.

    Parameters
    ----------
    n : int
        Pixels along a side, odd.
    pixel_mas : float
    """

    n: int
    pixel_mas: float

    def __post_init__(self) -> None:
        if self.n < 3 or self.n % 2 == 0 or not self.pixel_mas > 0.0:
            raise ValueError("an image needs an odd number of pixels, 3 or more, of some size")

    @cached_property
    def offset_mas(self) -> FloatArray:
        """Offsets along a side, rising, (n,)."""
        return np.asarray(self.pixel_mas * (np.arange(self.n) - self.n // 2), dtype=float)

    @property
    def east_mas(self) -> FloatArray:
        """Of each pixel, row after row from the south, each from the west, (n²,)."""
        return np.tile(self.offset_mas, self.n)

    @property
    def north_mas(self) -> FloatArray:
        """As ``east_mas``."""
        return np.repeat(self.offset_mas, self.n)


@dataclass(frozen=True, eq=False)
class PixelResponse:
    """Visibility that each pixel adds, and the flux that it adds to the total.

    Parameters
    ----------
    fringe : (n_points, n_pixels) complex array
    flux : (n_points, n_pixels) float array, optional
        What the extraction lets through of its flux; 1 everywhere where absent.
    star : (n_points,) float array
        Visibility of the star; 0 where there is none.
    star_flux : float
        1, or 0 where there is none.
    """

    fringe: ComplexArray
    flux: FloatArray | None
    star: FloatArray
    star_flux: float

    def visibility(self, light: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Visibility (n_points,) of light (n_pixels,), and the total that it is in units of."""
        through = light.sum() if self.flux is None else self.flux @ light
        total = self.star_flux + np.broadcast_to(through, len(self.star))
        return (self.star + self.fringe @ light) / total, total

    def pulled(
        self, by_visibility: ComplexArray, value: ComplexArray, total: FloatArray
    ) -> FloatArray:
        """Re Σ by_visibility · dV/dx of every pixel, (n_pixels,)."""
        weight = by_visibility / total
        moved = (weight @ self.fringe).real
        down = (weight * value).real
        return np.asarray(moved - (down.sum() if self.flux is None else down @ self.flux))


def pixel_response(
    samples: UVPoints, grid: PixelGrid, *, star: bool = True, diameter_mas: float = 0.0
) -> PixelResponse:
    """Transform every pixel: averaged over the channels, and as the extraction lets it through.

    Parameters
    ----------
    samples : UVPoints
    grid : PixelGrid
    star : bool
        Whether there is a star of flux 1 in the middle, beside the image.
    diameter_mas : float
        Of the star, a uniform disc.
    """
    n, pixels = len(samples), grid.n**2
    fringe = np.empty((n, pixels), dtype=complex)
    flux = None if samples.off_axis is None else np.empty((n, pixels))
    east, north = grid.east_mas, grid.north_mas
    for k in range(0, pixels, CHUNK):
        part = slice(k, k + CHUNK)
        fringe[:, part] = point_visibility(samples, east[part], north[part])
        if samples.off_axis is not None and flux is not None:
            start = samples.off_axis.start
            seen = east[part] - start[0], north[part] - start[1]
            through, flux[:, part] = samples.off_axis.at(seen)
            fringe[:, part] *= through
    disc = uniform_disc(samples.frequency, diameter_mas)[0] if diameter_mas else np.ones(n)
    return PixelResponse(fringe, flux, disc * star, float(star))

"""A cube as extraction sees it: the mask behind it, and where on the detector to look."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.signal import fftconvolve

from amibayes.cube import Cube
from amibayes.errors import DataError, UsageError
from amibayes.extraction.options import ExtractOptions
from amibayes.instrument import Channels, Instrument, Mask, load_instrument
from amibayes.optics import FringeBasis, fringe_field, fringe_image
from amibayes.scene.spectrum import Blackbody
from amibayes.units import BoolArray, FloatArray

LARGEST = 1.25
"""Images wider than this many times the instrument's usual subarray are cropped to it."""

NYQUIST = 0.5
"""Cycles per pixel beyond which fringes look like others."""

COMPANION, COMPANION_UNSAMPLED = 0.02, 0.1
"""A companion's light looks like another scale, or map of the mask, by up to this times the rms of
|V − 1|; the latter where pixels do not sample the fringes (up to 0.07 at 390 mas in F277W)."""

CONVERGED_PX = 5e-3
"""Centres are no better known than this: integrations point by more to either side."""


@dataclass(frozen=True, eq=False)
class View:
    """The part of the detector that is used, and the mask that made the image.

    Parameters
    ----------
    instrument : Instrument
        With the cube's pixel scale.
    channels : Channels
        Wavelengths of the star's light.
    rows, columns : slice
        Part of the detector.
    centre_px : (x, y)
        Place of the star relative to the middle of that part.
    rotation_rad : float
        Of the mask in the image.
    drawing : Mask, optional
        The instrument's own, where that of ``instrument`` was mapped.
    mask_map : (2, 2) array
        From the drawing to the mask of ``instrument``.
    """

    instrument: Instrument
    channels: Channels
    rows: slice
    columns: slice
    centre_px: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    drawing: Mask | None = None
    mask_map: FloatArray = field(default_factory=lambda: np.eye(2))

    @property
    def part(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def shape(self) -> tuple[int, int]:
        """(n_y, n_x) of the part that is used."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    @property
    def wavelength_m(self) -> float:
        """Wavelength whose frequency is the mean of the photons', metres."""
        return float(1.0 / (self.channels.weight @ (1.0 / self.channels.wavelength_m)))

    @cached_property
    def uv_m(self) -> FloatArray:
        """(n_baselines, 2) baselines in the image's axes, metres."""
        return self.instrument.mask.rotated(self.rotation_rad).uv_m

    @cached_property
    def frequency_px(self) -> FloatArray:
        """(n_baselines, 2) fringe frequencies, cycles per pixel."""
        return np.asarray(self.uv_m * (self.instrument.pixel_scale_rad / self.wavelength_m))

    @cached_property
    def unsampled(self) -> BoolArray:
        """(n_baselines,) whose fringes the pixels do not sample."""
        return np.asarray(np.abs(self.frequency_px).max(axis=1) > NYQUIST)

    def unlike_a_star(self, coefficients: FloatArray) -> float:
        """How large an error of the geometry a companion may cause.

        Parameters
        ----------
        coefficients : (1 + 2·n_baselines,) array
            Of the fringe model.
        """
        real, imaginary = coefficients[1:].reshape(2, -1) / coefficients[0]
        share = COMPANION_UNSAMPLED if self.unsampled.any() else COMPANION
        return share * float(np.sqrt(np.mean((real - 1.0) ** 2 + imaginary**2)))

    def moved(self, by_px: FloatArray) -> View:
        """The same with the star elsewhere, by (x, y)."""
        x, y = (float(c) for c in self.centre_px + by_px)
        return replace(self, centre_px=(x, y))

    def mapped(self, matrix: FloatArray) -> View:
        """The same with the mask's drawing under another map (2, 2)."""
        drawing = self.drawing or self.instrument.mask
        mapped = self.instrument.with_mask(drawing.mapped(matrix))
        return replace(self, instrument=mapped, drawing=drawing, mask_map=np.array(matrix))

    def basis(self) -> FringeBasis:
        """Make the fringe model of this image."""
        reach = max(self.shape) + 2.0 * max(abs(c) for c in self.centre_px)
        field = fringe_field(
            self.instrument, self.channels, int(np.ceil(reach)), rotation_rad=self.rotation_rad
        )
        return field.basis(self.shape, self.centre_px)

    def axes_px(self) -> tuple[FloatArray, FloatArray]:
        """Coordinates x (n_x,) and y (n_y,) of the pixels, from the star."""
        ny, nx = self.shape
        x = np.arange(nx) - 0.5 * (nx - 1) - self.centre_px[0]
        y = np.arange(ny) - 0.5 * (ny - 1) - self.centre_px[1]
        return np.asarray(x), np.asarray(y)


def plain_view(instrument: Instrument, n_pixels: int) -> View:
    """Make that of a square image with the star in its middle."""
    side = slice(0, n_pixels)
    return View(instrument, instrument.bandpass.channels(), side, side)


def instrument_of(cube: Cube) -> Instrument:
    """Find the instrument that a cube says it is of, with the cube's pixel scale.

    Raises
    ------
    DataError
        Where no such instrument or filter is known.
    """
    try:
        found = load_instrument(cube.instrument, cube.filter)
    except UsageError as error:
        raise DataError(error.what, source=cube.source, remedy=error.remedy) from None
    return replace(found, pixel_scale_rad=cube.pixel_scale_rad)


def look_at(image: FloatArray, cube: Cube, options: ExtractOptions) -> View:
    """Find the star in a clean image (n_y, n_x) of the whole detector.

    Raises
    ------
    DataError
        Where the image is too small, or the star stands at its edge.
    """
    instrument = instrument_of(cube)
    spectrum = None if options.temperature_k is None else Blackbody(options.temperature_k)
    channels = instrument.bandpass.channels(spectrum)
    _refuse_small(image, instrument, cube.source)
    place = _peak(image, instrument, channels)
    sides = [
        _part(size, instrument.n_pixels, at) for size, at in zip(image.shape, place, strict=True)
    ]
    offset = [
        at - part.start - 0.5 * (part.stop - part.start - 1)
        for at, part in zip(place, sides, strict=True)
    ]
    reach = [min(at, size - 1 - at) for at, size in zip(place, image.shape, strict=True)]
    if min(reach) * instrument.pixel_scale_rad < 1.5 * instrument.resolution_rad:
        raise DataError(
            f"the star stands at the edge of the image, at x = {place[1]}, y = {place[0]}",
            source=cube.source,
            remedy="give images with the star inside",
        )
    return View(instrument, channels, sides[0], sides[1], (float(offset[1]), float(offset[0])))


def _refuse_small(image: FloatArray, instrument: Instrument, source: str) -> None:
    needed = int(np.ceil(instrument.field_rad / instrument.pixel_scale_rad))
    if min(image.shape) < needed:
        raise DataError(
            f"images of {image.shape[1]} x {image.shape[0]} pixels do not hold one fringe of the "
            f"shortest baseline ({needed} pixels)",
            source=source,
            remedy="give larger images, or check instrument, filter and pixel scale",
        )


def _peak(image: FloatArray, instrument: Instrument, channels: Channels) -> tuple[int, int]:
    """Pixel (y, x) at which the image is most like that of a star."""
    side = min(*image.shape, 31)
    n = instrument.mask.n_baselines
    few = Channels.monochromatic(channels.mean_m)
    star = fringe_image(instrument, few, np.repeat([1.0, 0.0], [1 + n, n]), side - 1 + side % 2, 1)
    found = fftconvolve(image - np.median(image), star, mode="same")
    y, x = np.unravel_index(int(found.argmax()), image.shape)
    return int(y), int(x)


def _part(size: int, usual: int, place: int) -> slice:
    if size <= LARGEST * usual:
        return slice(0, size)
    start = min(max(place - usual // 2, 0), size - usual)
    return slice(start, start + usual)

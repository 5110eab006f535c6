"""The fringe model at any place on the detector, for a fraction of the cost of `fringe_basis`.

Every fringe is a wave under a hill: the wave is known exactly, and the hill, the power of
one hole's diffraction pattern with what the width of the filter makes of it, is so smooth
that a sample per pixel or two holds all of it. Hills are computed once for an instrument;
interpolation, the average over the pixels and the wave are then one small matrix per
axis and baseline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from amibayes.instrument import Channels, Instrument, Mask
from amibayes.optics.fringes import FringeBasis
from amibayes.optics.holes import hole_transform
from amibayes.optics.psf import ComplexArray
from amibayes.optics.sampling import HALF_WIDTH, fine_sampling, interpolator, pixel_weights
from amibayes.units import FloatArray, read_only

REACH_STEP_PX = 8
"""Fields come in sizes that differ by so much, so that few are made."""


@dataclass(frozen=True, eq=False)
class FringeField:
    """Hills and waves of an instrument, about the star.

    Parameters
    ----------
    hills : (1 + n_baselines, k, k) complex array
        Envelope and fringes less their waves, photons per pixel for one through the mask.
    frequency_px : (1 + n_baselines, 2) array
        Of the waves, cycles per pixel; 0 for the envelope.
    oversample : int
        Samples per pixel.
    """

    hills: ComplexArray
    frequency_px: FloatArray
    oversample: int

    def __post_init__(self) -> None:
        read_only(self, "frequency_px")
        self.hills.flags.writeable = False

    def basis(
        self, shape: tuple[int, int], centre_px: tuple[float, float] = (0.0, 0.0)
    ) -> FringeBasis:
        """Fringe model of an image (n_y, n_x) with the star ``centre_px`` from its middle."""
        waves = self.waves(shape, centre_px)
        columns = np.concatenate([waves[:1].real, 2.0 * waves[1:].real, -2.0 * waves[1:].imag])
        return FringeBasis(columns.reshape(len(columns), -1).T, shape)

    def waves(self, shape: tuple[int, int], centre_px: tuple[float, float]) -> ComplexArray:
        """Envelope and fringes averaged over the pixels, (1 + n_baselines, n_y, n_x)."""
        along_y, along_x = self._operators(shape, centre_px)
        return np.asarray(along_y @ self.hills @ along_x.swapaxes(1, 2))

    def _operators(
        self, shape: tuple[int, int], centre_px: tuple[float, float]
    ) -> tuple[ComplexArray, ComplexArray]:
        """Matrices along y and along x."""
        along_y, along_x = (
            self._operator(size, centre, frequency)
            for size, centre, frequency in zip(
                shape, centre_px[::-1], self.frequency_px.T[::-1], strict=True
            )
        )
        return along_y, along_x

    def _operator(self, n_pixels: int, centre_px: float, frequency: FloatArray) -> ComplexArray:
        """Matrices (n_waves, n_pixels, k) from the samples of a hill to pixels of the wave."""
        nodes, weight = pixel_weights()
        over, size = self.oversample, self.hills.shape[-1]
        first = -0.5 * (n_pixels - 1) - centre_px
        sample, taps = interpolator((first + nodes) * over + 0.5 * (size - 1))
        # Pixels differ by whole samples: one kernel serves them all.
        start = int(sample.min())
        kernel = np.zeros((len(nodes), int(sample.max()) - start + 1))
        np.add.at(kernel, (np.arange(len(nodes))[:, None], sample - start), taps)
        turn = np.exp(2j * np.pi * np.outer(frequency, first + nodes)) * weight
        once = turn @ kernel
        pixel = np.arange(n_pixels)
        wave = np.exp(2j * np.pi * np.outer(frequency, pixel))
        operator = np.zeros((len(frequency), n_pixels, size), dtype=complex)
        column = start + over * pixel[:, None] + np.arange(kernel.shape[1])
        operator[:, pixel[:, None], column] = wave[..., None] * once[:, None, :]
        return operator


def fringe_field(
    instrument: Instrument, channels: Channels, n_pixels: int, *, rotation_rad: float = 0.0
) -> FringeField:
    """Field that serves pixels up to ``n_pixels`` / 2 from the star on every side.

    Parameters
    ----------
    instrument : Instrument
        Mask and pixel scale.
    channels : Channels
        Wavelengths and weights.
    n_pixels : int
        Twice the largest distance of a pixel from the star along an axis.
    rotation_rad : float
        The mask is turned by this angle, from +x towards +y.

    Notes
    -----
    The last few are remembered, by what they are made of.
    """
    size = REACH_STEP_PX * math.ceil(n_pixels / REACH_STEP_PX)
    return _remembered(_Recipe.of(instrument, channels, size, rotation_rad))


def fringe_image(
    instrument: Instrument,
    channels: Channels,
    coefficients: FloatArray,
    n_pixels: int,
    oversample: int,
    *,
    rotation_rad: float = 0.0,
) -> FloatArray:
    """Image of coefficients (1 + 2·n_baselines,) of the fringe model, on cells of pixels.

    Returns
    -------
    (n_pixels·oversample, n_pixels·oversample) array
        Photons per cell, by what its centre gets; the star is in the middle.

    Notes
    -----
    The last few envelopes are remembered.
    """
    recipe = _Recipe.of(instrument, channels, n_pixels, rotation_rad)
    mask, place = recipe.mask, recipe.cells(oversample)
    weight = np.array([2.0, 2.0j]) @ coefficients[1:].reshape(2, -1)
    total = np.zeros((len(place), len(place)))
    for wavelength, power in zip(channels.wavelength_m, _powers(recipe, oversample), strict=True):
        x, y = np.exp(2j * np.pi / wavelength * mask.uv_m.T[:, :, None] * place)
        y *= weight[:, None]
        # The real part of a sum of waves is one product of real matrices.
        fringes = np.concatenate([y.real, -y.imag]).T @ np.concatenate([x.real, x.imag])
        fringes += mask.n_holes * coefficients[0]
        total += fringes * power
    return total


@lru_cache(maxsize=4)
def _powers(recipe: _Recipe, oversample: int) -> tuple[FloatArray, ...]:
    """Photons of one hole per cell, for every wavelength."""
    place, channels, mask = recipe.cells(oversample), recipe.channels, recipe.mask
    step = place[1] - place[0]
    powers = []
    for wavelength, share in zip(channels.wavelength_m, channels.weight, strict=True):
        f = place / wavelength
        power = hole_transform(mask, f[None, :], f[:, None]) ** 2
        power *= share * step**2 / (wavelength**2 * mask.area_m2)
        power.flags.writeable = False
        powers.append(power)
    return tuple(powers)


@dataclass(frozen=True)
class _Recipe:
    """What a field is made of; equal where the numbers are."""

    numbers: bytes
    shape: str
    n_pixels: int
    instrument: Instrument = field(compare=False)
    channels: Channels = field(compare=False)

    @classmethod
    def of(
        cls, instrument: Instrument, channels: Channels, n_pixels: int, rotation_rad: float
    ) -> _Recipe:
        mask = instrument.mask
        numbers = np.concatenate(
            [
                *(a.ravel() for a in (mask.holes_m, channels.wavelength_m, channels.weight)),
                [mask.size_m, mask.orientation_rad, instrument.pixel_scale_rad, rotation_rad],
            ]
        )
        return cls(numbers.tobytes(), mask.shape, n_pixels, instrument, channels)

    @property
    def mask(self) -> Mask:
        """The mask as it is turned."""
        return self.instrument.mask.rotated(float(np.frombuffer(self.numbers)[-1]))

    def cells(self, oversample: int) -> FloatArray:
        """Angles of the middles of cells along an axis."""
        size = self.n_pixels * oversample
        step = self.instrument.pixel_scale_rad / oversample
        return np.asarray(step * (np.arange(size) - 0.5 * (size - 1)))


@lru_cache(maxsize=6)
def _remembered(recipe: _Recipe) -> FringeField:
    pixel, channels = recipe.instrument.pixel_scale_rad, recipe.channels
    mask = recipe.mask
    mean = float(1.0 / (channels.weight @ (1.0 / channels.wavelength_m)))
    over = fine_sampling(_band_limit(mask, channels, mean) * pixel)
    half = (recipe.n_pixels // 2 + 1) * over + HALF_WIDTH + over
    place = np.arange(-half, half + 1) * (pixel / over)
    uv = np.vstack([np.zeros((1, 2)), mask.uv_m])
    hills = np.zeros((len(uv), len(place), len(place)), dtype=complex)
    for wavelength, weight in zip(channels.wavelength_m, channels.weight, strict=True):
        f = place / wavelength
        power = hole_transform(mask, f[None, :], f[:, None]) ** 2
        power *= weight * pixel**2 / (wavelength**2 * mask.area_m2)
        rest = uv * (1.0 / wavelength - 1.0 / mean)
        x, y = (np.exp(2j * np.pi * np.outer(r, place)) for r in rest.T)
        hills += (y[:, :, None] * power) * x[:, None, :]
    hills[0] *= mask.n_holes
    return FringeField(hills, uv * (pixel / mean), over)


def _band_limit(mask: Mask, channels: Channels, mean_m: float) -> float:
    """Largest frequency of a hill along an axis, cycles per radian."""
    hole = mask.extent_m - float(np.abs(mask.uv_m).max())
    apart = np.abs(1.0 / channels.wavelength_m - 1.0 / mean_m).max()
    return float(hole / channels.wavelength_m.min() + np.abs(mask.uv_m).max() * apart)

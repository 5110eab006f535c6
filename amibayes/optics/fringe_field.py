"""The fringe model at any place on the detector, for a fraction of the cost of `fringe_basis`.

Every fringe is a wave under a hill: the wave is known exactly, and the hill, the power of
one hole's diffraction pattern with what the width of the filter makes of it, is so smooth
that a sample every pixel or two holds all of it. So it is with the average over a pixel of
wave and hill, less the wave. These hills are computed once for an instrument; what is left
is to interpolate them, with one small matrix per axis, and to multiply by the waves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from amibayes.instrument import Channels, Instrument, Mask
from amibayes.optics.fringes import FringeBasis
from amibayes.optics.holes import hole_transform
from amibayes.optics.sampling import HALF_WIDTH, MAX_FREQUENCY, interpolator, pixel_weights
from amibayes.units import ComplexArray, FloatArray, SingleArray, read_only

REACH_STEP_PX = 8
"""Fields come in sizes that differ by so much, so that few are made."""


@dataclass(frozen=True, eq=False)
class FringeField:
    """Hills and waves of an instrument, about the star.

    Parameters
    ----------
    hills : (2, 1 + n_baselines, k, k) array
        Real and imaginary part of envelope and fringes, averaged over a pixel, less their
        waves; photons per pixel for one through the mask.
    frequency_px : (1 + n_baselines, 2) array
        Of the waves, cycles per pixel; 0 for the envelope.
    spacing_px : float
        Distance of the samples.
    """

    hills: FloatArray
    frequency_px: FloatArray
    spacing_px: float

    def __post_init__(self) -> None:
        read_only(self, "hills", "frequency_px")

    def basis(
        self, shape: tuple[int, int], centre_px: tuple[float, float] = (0.0, 0.0)
    ) -> FringeBasis:
        """Fringe model of an image (n_y, n_x) with the star ``centre_px`` from its middle."""
        (up, wave_y), (across, wave_x) = (
            self._along(size, centre, frequency)
            for size, centre, frequency in zip(
                shape, centre_px[::-1], self.frequency_px.T[::-1], strict=True
            )
        )
        real, imaginary = up @ (self.hills @ across.T)
        fringe = np.empty((len(real) - 1, *shape), dtype=complex)
        fringe.real, fringe.imag = real[1:], imaginary[1:]
        fringe *= 2.0 * wave_y[1:, :, None]
        fringe *= wave_x[1:, None, :]
        columns = np.concatenate([real[:1], fringe.real, -fringe.imag])
        return FringeBasis(columns.reshape(len(columns), -1).T, shape)

    def _along(
        self, n_pixels: int, centre_px: float, frequency: FloatArray
    ) -> tuple[FloatArray, ComplexArray]:
        """Matrix (n_pixels, k) from samples to pixels of an axis, and waves (n, n_pixels)."""
        pixel = np.arange(n_pixels) - 0.5 * (n_pixels - 1) - centre_px
        size = self.hills.shape[-1]
        sample, weight = interpolator(pixel / self.spacing_px + 0.5 * (size - 1))
        matrix = np.zeros((n_pixels, size))
        np.put_along_axis(matrix, sample, weight, axis=1)
        return matrix, np.exp(2j * np.pi * np.outer(frequency, pixel))


def fringe_field(
    instrument: Instrument, channels: Channels, n_pixels: int, *, rotation_rad: float
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
) -> SingleArray:
    """Image of coefficients (1 + 2·n_baselines,) of the fringe model, on cells of pixels.

    Returns
    -------
    (n_pixels·oversample, n_pixels·oversample) array
        Photons per cell, by what its centre gets, in single precision; the star is in the
        middle.

    Notes
    -----
    The last few envelopes are remembered.
    """
    recipe = _Recipe.of(instrument, channels, n_pixels, rotation_rad)
    mask, place = recipe.mask, recipe.cells(oversample)
    size, half = len(place), len(place) // 2
    real, imaginary = 2.0 * coefficients[1:].reshape(2, -1, 1).astype(np.float32)
    total, fringes = np.zeros((2, size, size), np.float32)
    for wavelength, power in zip(channels.wavelength_m, _powers(recipe, oversample), strict=True):
        turns = mask.uv_m.T[:, :, None] / wavelength * place
        turns -= np.rint(turns)
        phase = (2.0 * np.pi * turns).astype(np.float32)
        cosine, sine = np.cos(phase[1]), np.sin(phase[1])
        # Cells lie evenly about the star: what is even and what is odd along x serve both sides.
        even = (real * cosine - imaginary * sine).T @ np.cos(phase[0, :, half:])
        odd = (real * sine + imaginary * cosine).T @ np.sin(phase[0, :, half:])
        even += np.float32(mask.n_holes * coefficients[0])
        fringes[:, half:] = even - odd
        fringes[:, : size - half] = (even + odd)[:, ::-1]
        total += np.multiply(fringes, power, out=fringes)
    return total


@lru_cache(maxsize=6)
def _powers(recipe: _Recipe, oversample: int) -> tuple[SingleArray, ...]:
    """Photons of one hole per cell, for every wavelength."""
    place, channels, mask = recipe.cells(oversample), recipe.channels, recipe.mask
    step = place[1] - place[0]
    powers = []
    for wavelength, share in zip(channels.wavelength_m, channels.weight, strict=True):
        f = place / wavelength
        power = hole_transform(mask, f[None, :], f[:, None]) ** 2
        power *= share * step**2 / (wavelength**2 * mask.area_m2)
        powers.append(power.astype(np.float32))
        powers[-1].flags.writeable = False
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
                *(
                    a.ravel()
                    for a in (
                        mask.holes_m,
                        mask.hole_map,
                        channels.wavelength_m,
                        channels.weight,
                    )
                ),
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
    pixel, channels, mask = recipe.instrument.pixel_scale_rad, recipe.channels, recipe.mask
    mean = float(1.0 / (channels.weight @ (1.0 / channels.wavelength_m)))
    spacing = MAX_FREQUENCY / (_band_limit(mask, channels, mean) * pixel)
    uv = np.vstack([np.zeros((1, 2)), mask.uv_m])
    reach = math.ceil(0.5 * recipe.n_pixels / spacing) + HALF_WIDTH
    margin = HALF_WIDTH + math.ceil(0.5 / spacing)
    place = np.arange(-reach - margin, reach + margin + 1) * (spacing * pixel)
    hills = np.zeros((len(uv), len(place), len(place)), dtype=complex)
    for wavelength, weight in zip(channels.wavelength_m, channels.weight, strict=True):
        f = place / wavelength
        power = hole_transform(mask, f[None, :], f[:, None]) ** 2
        power *= weight * pixel**2 / (wavelength**2 * mask.area_m2)
        rest = uv * (1.0 / wavelength - 1.0 / mean)
        x, y = (np.exp(2j * np.pi * np.outer(r, place)) for r in rest.T)
        hills += (y[:, :, None] * power) * x[:, None, :]
    hills[0] *= mask.n_holes
    frequency = uv * (pixel / mean)
    across, up = (_averaging(f, spacing, margin, len(place)) for f in frequency.T)
    averaged = up @ hills @ across.swapaxes(1, 2)
    return FringeField(np.stack([averaged.real, averaged.imag]), frequency, spacing)


def _averaging(frequency_px: FloatArray, spacing_px: float, margin: int, size: int) -> ComplexArray:
    """Matrices (n_waves, size − 2·margin, size): a pixel's mean of wave and hill, less the wave."""
    nodes, weight = pixel_weights()
    sample, bspline_weights = interpolator(nodes / spacing_px + margin)
    kernel = np.zeros((len(nodes), 2 * margin + 1))
    np.put_along_axis(kernel, sample, bspline_weights, axis=1)
    once = (np.exp(2j * np.pi * np.outer(frequency_px, nodes)) * weight) @ kernel
    row = np.arange(size - 2 * margin)[:, None]
    matrix = np.zeros((len(once), len(row), size), dtype=complex)
    matrix[:, row, row + np.arange(2 * margin + 1)] = once[:, None, :]
    return matrix


def _band_limit(mask: Mask, channels: Channels, mean_m: float) -> float:
    """Largest frequency of a hill along an axis, cycles per radian."""
    hole = mask.extent_m - float(np.abs(mask.uv_m).max())
    apart = np.abs(1.0 / channels.wavelength_m - 1.0 / mean_m).max()
    return float(hole / channels.wavelength_m.min() + np.abs(mask.uv_m).max() * apart)

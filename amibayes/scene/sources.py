"""What is on the sky: a star and anything about it, each a shape with a known transform.

Fluxes are relative to the star. Positions are east and north of it, radians inside. A
component's transform is ∫ I e^{−2πi(f_e α + f_n δ)} dα dδ, in the unit of its flux; the
scene's visibility is the sum divided by the total flux.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import j0, j1

from amibayes.errors import DataError
from amibayes.scene.spectrum import Flat, Spectrum
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Shown
from amibayes.units import ComplexArray, FloatArray, read_only

_BLOCK = 4096
"""Frequencies of an image's transform that are computed at once, to bound the memory."""


class Component(Protocol):
    """A piece of the scene."""

    @property
    def flux(self) -> float:
        """Flux relative to the star."""

    @property
    def radius_rad(self) -> float:
        """Distance from the star within which all of its light lies, radians."""

    def transform(self, east: FloatArray, north: FloatArray) -> ComplexArray:
        """Fourier transform at spatial frequencies (cycles per radian), times the flux."""


@checks_arguments
@dataclass(frozen=True)
class Point:
    """A point source.

    Parameters
    ----------
    flux : float
        Relative to the star; not negative.
    east_rad, north_rad : float
        Place, radians.
    """

    flux: float = 1.0
    east_rad: float = 0.0
    north_rad: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.flux < np.inf:
            raise DataError(f"a source of relative flux {self.flux:g} is not possible")

    @property
    def radius_rad(self) -> float:
        """Distance from the star, radians."""
        return float(np.hypot(self.east_rad, self.north_rad)) + self._size_rad()

    def _size_rad(self) -> float:
        return 0.0

    def transform(self, east: FloatArray, north: FloatArray) -> ComplexArray:
        """Fourier transform at spatial frequencies (cycles per radian), times the flux."""
        turn = np.exp(-2j * np.pi * (east * self.east_rad + north * self.north_rad))
        return np.asarray(self.flux * turn * self._profile(np.hypot(east, north)))

    def _profile(self, frequency: FloatArray) -> FloatArray:
        return np.ones_like(frequency)


@checks_arguments
@dataclass(frozen=True)
class UniformDisc(Point):
    """A disc of even brightness, ``diameter_rad`` across."""

    diameter_rad: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_negative("diameter of a disc", self.diameter_rad)

    def _size_rad(self) -> float:
        return 0.5 * self.diameter_rad

    def _profile(self, frequency: FloatArray) -> FloatArray:
        return _airy(np.pi * self.diameter_rad * frequency)


@checks_arguments
@dataclass(frozen=True)
class GaussianDisc(Point):
    """A round Gaussian of full width ``fwhm_rad`` at half its maximum."""

    fwhm_rad: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_negative("width of a Gaussian", self.fwhm_rad)

    def _size_rad(self) -> float:
        # 1e-7 of the light lies outside 2.41 times the full width.
        return 2.41 * self.fwhm_rad

    def _profile(self, frequency: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-((np.pi * self.fwhm_rad * frequency) ** 2) / (4.0 * np.log(2.0))))


@checks_arguments
@dataclass(frozen=True)
class Ring(Point):
    """A flat ring of mean diameter ``diameter_rad`` and radial width ``width_rad``."""

    diameter_rad: float = 0.0
    width_rad: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_negative("diameter of a ring", self.diameter_rad)
        _refuse_negative("width of a ring", self.width_rad)
        if self.width_rad > self.diameter_rad:
            raise DataError("a ring is wider than it is across: make it a disc")

    def _size_rad(self) -> float:
        return 0.5 * (self.diameter_rad + self.width_rad)

    def _profile(self, frequency: FloatArray) -> FloatArray:
        if self.width_rad == 0.0:
            return np.asarray(j0(np.pi * self.diameter_rad * frequency))
        outer, inner = self.diameter_rad + self.width_rad, self.diameter_rad - self.width_rad
        full = outer**2 * _airy(np.pi * outer * frequency)
        hole = inner**2 * _airy(np.pi * inner * frequency)
        return np.asarray((full - hole) / (outer**2 - inner**2))


def _airy(argument: FloatArray) -> FloatArray:
    """2 J1(x)/x, 1 at zero."""
    small = np.abs(argument) < 1e-8
    safe = np.where(small, 1.0, argument)
    return np.asarray(np.where(small, 1.0, 2.0 * j1(safe) / safe))


def _refuse_negative(what: str, value: float) -> None:
    if not 0.0 <= value < np.inf:
        raise DataError(f"the {what} is {value:g}; it cannot be negative or infinite")


@dataclass(frozen=True, eq=False)
class SkyImage:
    """Light given as an image; every pixel's flux sits at its centre.

    Parameters
    ----------
    pixels : (n_y, n_x) array
        Brightness on any scale, not negative.
    sky_per_pixel : (2, 2) array
        Rows east and north, columns x and y: radians on the sky per pixel.
    flux : float
        Total flux relative to the star.
    east_rad, north_rad : float
        Place of the middle of the array, radians.
    """

    pixels: FloatArray
    sky_per_pixel: FloatArray
    flux: float = 1.0
    east_rad: float = 0.0
    north_rad: float = 0.0

    def __post_init__(self) -> None:
        read_only(self, "pixels", "sky_per_pixel")
        if self.pixels.ndim != 2 or not np.all(np.isfinite(self.pixels)):
            raise DataError("an image must have two axes and finite pixels")
        if self.pixels.min() < 0.0 or self.pixels.sum() <= 0.0:
            raise DataError("an image of the sky has negative pixels, or no light at all")
        if not 0.0 <= self.flux < np.inf:
            raise DataError(f"an image of relative flux {self.flux:g} is not possible")
        if not abs(np.linalg.det(self.sky_per_pixel)) > 0.0:
            raise DataError("an image needs a pixel scale above zero")

    @property
    def radius_rad(self) -> float:
        """Distance from the star within which all of its light lies, radians."""
        y, x = np.nonzero(self.pixels)
        offset = self._offsets(x, self.pixels.shape[1]), self._offsets(y, self.pixels.shape[0])
        sky = self.sky_per_pixel @ np.stack(offset) + [[self.east_rad], [self.north_rad]]
        return float(np.hypot(*sky).max())

    @staticmethod
    def _offsets(index: ArrayLike, size: int) -> FloatArray:
        return np.asarray(np.asarray(index, dtype=float) - 0.5 * (size - 1))

    def transform(self, east: FloatArray, north: FloatArray) -> ComplexArray:
        """Fourier transform at spatial frequencies (cycles per radian), times the flux."""
        shape = np.broadcast_shapes(np.shape(east), np.shape(north))
        frequency = np.stack([np.broadcast_to(part, shape).ravel() for part in (east, north)])
        blocks = np.array_split(frequency, 1 + frequency.shape[1] // _BLOCK, axis=1)
        total = np.concatenate([self._sum(*(self.sky_per_pixel.T @ part)) for part in blocks])
        place = np.exp(-2j * np.pi * (np.array([self.east_rad, self.north_rad]) @ frequency))
        return np.asarray(self.flux / self.pixels.sum() * total * place).reshape(shape)

    def _sum(self, fx: FloatArray, fy: FloatArray) -> ComplexArray:
        """Sum of the pixels at frequencies in cycles per pixel, two matrix products."""
        rows, columns = self.pixels.shape
        up = np.exp(-2j * np.pi * np.outer(fy, self._offsets(np.arange(rows), rows)))
        across = np.exp(-2j * np.pi * np.outer(fx, self._offsets(np.arange(columns), columns)))
        return np.asarray(np.einsum("fx,fx->f", up @ self.pixels, across))


@dataclass(frozen=True, eq=False, repr=False)
class Scene(Shown):
    """A star with a magnitude and a spectrum, and what surrounds it.

    Parameters
    ----------
    components : tuple of Component
        The first is the star, of flux 1; all share its spectrum.
    name : str
        What to call it.
    magnitude : float or None
        Of the star alone, Vega, in ``magnitude_filter``.
    magnitude_filter : str or None
        Filter of the magnitude; the one observed in where ``None``.
    spectrum : Spectrum
        Of the star.
    source : str
        File it came from, for messages.
    """

    components: tuple[Component, ...] = (Point(),)
    name: str = "star"
    magnitude: float | None = None
    magnitude_filter: str | None = None
    spectrum: Spectrum = field(default_factory=Flat)
    source: str | None = None

    @property
    def flux(self) -> float:
        """Flux of everything, relative to the star."""
        return float(sum(component.flux for component in self.components))

    @property
    def radius_rad(self) -> float:
        """Distance from the star within which all light lies, radians."""
        return max(component.radius_rad for component in self.components)

    @property
    def points(self) -> tuple[Point, ...]:
        """The components that are points."""
        return tuple(part for part in self.components if type(part) is Point)

    @property
    def extended(self) -> tuple[Component, ...]:
        """The components that are not points."""
        return tuple(part for part in self.components if type(part) is not Point)

    def visibility(self, u_m: ArrayLike, v_m: ArrayLike, wavelength_m: ArrayLike) -> ComplexArray:
        """Complex visibility on sky baselines, e^{−2πi(uα + vδ)/λ} convention.

        Parameters
        ----------
        u_m, v_m : arrays
            Baselines east and north, metres.
        wavelength_m : array
            Wavelengths, metres; broadcast against the baselines.

        Returns
        -------
        array
            Of the broadcast shape; 1 at zero baseline.
        """
        east = np.asarray(u_m, dtype=float) / np.asarray(wavelength_m, dtype=float)
        north = np.asarray(v_m, dtype=float) / np.asarray(wavelength_m, dtype=float)
        total = sum(component.transform(east, north) for component in self.components)
        return np.asarray(total / self.flux, dtype=complex)

    def brightness(self, n_pixels: int, pixel_rad: float) -> FloatArray:
        """Sky brightness, north up and east left, blurred to the pixels' own resolution.

        Made from the transform, cut off by a Gaussian at the pixels' Nyquist frequency: for
        looking at. Flux per pixel, shape (n_pixels, n_pixels), indices [y, x].
        """
        frequency = np.fft.fftfreq(n_pixels, pixel_rad)
        north, west = np.meshgrid(frequency, frequency, indexing="ij")
        taper = np.exp(-0.5 * ((north**2 + west**2) * (2.0 * pixel_rad) ** 2) * np.pi)
        middle = np.exp(-1j * np.pi * (n_pixels - 1) * pixel_rad * (north + west))
        total = sum(component.transform(-west, north) for component in self.components)
        return np.asarray(np.fft.ifft2(total * taper * middle).real)

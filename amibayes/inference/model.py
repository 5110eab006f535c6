"""The binary model: a disc, point companions, over-resolved light, and the channel's width.

V = (V_A + Σ c_k E_k) / (1 + Σ c_k + f) with V_A the uniform disc of the primary,
c_k the contrast (companion/primary flux ratio), f the over-resolved background
(primary = 1) and E_k = sinc · exp(−2πi(uα + vδ)/λ), whose sinc is the average over the
channel. Of data in several bands each may have a contrast of its own, and of data of
several dates the place may move linearly. Everything is evaluated for many parameter sets
at once: points of the (u, v) plane down the rows, parameter sets across the columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from amibayes.disc import uniform_disc
from amibayes.inference.samples import Samples
from amibayes.units import MAS, FloatArray

ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class BinaryModel:
    """What is fitted and what is held fixed.

    Parameters
    ----------
    companions : int
        Number of companions, 0 or more.
    diameter_mas : float or "free"
        Uniform-disc diameter of the primary.
    background : float or "free"
        Over-resolved flux in units of the primary's.
    smearing : bool
        Average over the width of each channel.
    bands : tuple of str
        Bands of the data (`amibayes.inference.bands`) that have a contrast of their own, the
        reference band first; empty where all share one.
    fastest_mas_yr : float
        Companions move linearly, at most so fast along east and along north; 0: they stand.
    reference_mjd : float
        Date at which a moving companion is at its east and north.
    """

    companions: int = 1
    diameter_mas: float | Literal["free"] = 0.0
    background: float | Literal["free"] = 0.0
    smearing: bool = True
    bands: tuple[str, ...] = ()
    fastest_mas_yr: float = 0.0
    reference_mjd: float = 0.0

    @property
    def n_contrasts(self) -> int:
        """Number of contrasts of each companion."""
        return max(len(self.bands), 1)

    @property
    def moves(self) -> bool:
        """Whether companions move."""
        return self.fastest_mas_yr > 0.0

    @property
    def width(self) -> int:
        """Number of parameters of each companion: place, contrasts, rates."""
        return 2 + self.n_contrasts + 2 * self.moves

    @property
    def contrast_columns(self) -> IntArray:
        """Where the contrasts stand in a parameter vector."""
        first = self.width * np.arange(self.companions)[:, None]
        return np.asarray((first + 2 + np.arange(self.n_contrasts)).ravel(), dtype=np.intp)

    @property
    def rate_columns(self) -> IntArray:
        """Where the rates stand in a parameter vector."""
        last = self.width * np.arange(1, self.companions + 1)[:, None]
        return np.asarray((last + np.arange(-2 * self.moves, 0)).ravel(), dtype=np.intp)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of a parameter vector."""
        names: list[str] = []
        for k in range(self.companions):
            suffix = "" if k == 0 else f"_{k + 1}"
            names += [f"east_mas{suffix}", f"north_mas{suffix}", f"contrast{suffix}"]
            names += [f"contrast{suffix}[{band}]" for band in self.bands[1:]]
            if self.moves:
                names += [f"east_rate_mas_yr{suffix}", f"north_rate_mas_yr{suffix}"]
        if self.diameter_mas == "free":
            names.append("diameter_mas")
        if self.background == "free":
            names.append("background")
        return tuple(names)

    @property
    def n_nuisance(self) -> int:
        """Number of free parameters that are not a companion's."""
        return len(self.parameters) - self.width * self.companions

    def tied(self, theta: FloatArray) -> FloatArray:
        """Companions (n, width) that stand, alike in every band, from east, north, contrast."""
        place, contrast = theta[:, :2], theta[:, 2:3]
        still = np.zeros((len(theta), 2 * self.moves))
        return np.hstack([place, np.repeat(contrast, self.n_contrasts, axis=1), still])

    def split(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(companions (k, width, n), diameter_mas (n,), background (n,)) of theta (n, n_dim)."""
        n, end = len(theta), self.width * self.companions
        pairs = theta[:, :end].T.reshape(self.companions, self.width, n)
        rest = list(theta[:, end:].T)
        diameter = rest.pop(0) if self.diameter_mas == "free" else np.full(n, self.diameter_mas)
        background = rest.pop(0) if self.background == "free" else np.full(n, self.background)
        return pairs, np.asarray(diameter, dtype=float), np.asarray(background, dtype=float)

    def visibility(self, samples: Samples, theta: FloatArray) -> ComplexArray:
        """Complex visibilities, (n_samples, n), of parameter sets theta (n, n_dim)."""
        pairs, diameter, background = self.split(theta)
        total = 1.0 + background
        light = disc(samples, diameter).astype(complex)
        for block in pairs:
            contrast = self._contrast(samples, block)
            wave, seen = self._seen(samples, *self._place(samples, block))
            light += contrast * wave
            total = total + contrast * seen
        return np.asarray(light / total)

    def _place(self, samples: Samples, block: FloatArray) -> tuple[FloatArray, FloatArray]:
        """East and north of a companion (width, n): (n,), or (n_samples, n) where it moves."""
        if not self.moves:
            return block[0], block[1]
        years = samples.years(self.reference_mjd)[:, None]
        return block[0] + years * block[-2], block[1] + years * block[-1]

    def _contrast(self, samples: Samples, block: FloatArray) -> FloatArray:
        """Contrast of a companion (width, n): (n,), or (n_samples, n) with several bands."""
        return block[2] if self.n_contrasts == 1 else block[2 + samples.band]

    def _seen(
        self, samples: Samples, east_mas: FloatArray, north_mas: FloatArray
    ) -> tuple[ComplexArray, FloatArray | float]:
        """Visibility and flux of a point as the extraction lets them through."""
        wave = self.companion(samples, east_mas, north_mas)
        if samples.off_axis is None:
            return wave, 1.0
        fringe, flux = samples.off_axis.at(east_mas, north_mas)
        return np.asarray(wave * fringe), flux

    def companion(
        self, samples: Samples, east_mas: FloatArray, north_mas: FloatArray
    ) -> ComplexArray:
        """Visibility of a point at an offset, averaged over the channel, (n_samples, n)."""
        angle = _angle(samples, east_mas, north_mas)
        wave = np.exp(-1j * angle)
        if self.smearing:
            wave *= np.sinc(angle * (_half_band(samples) / np.pi))
        return np.asarray(wave)

    def gradient(self, samples: Samples, theta: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Visibilities (n_samples, n) and their derivatives (n_dim, n_samples, n)."""
        pairs, diameter, background = self.split(theta)
        total = 1.0 + background
        primary, by_diameter = uniform_disc(samples.frequency[:, None], diameter)
        light, found = primary.astype(complex), []
        for block in pairs:
            place, contrast = self._place(samples, block), self._contrast(samples, block)
            wave, slope = self._companion_slope(samples, *place)
            seen = _Seen.of(samples, *place, wave, slope)
            light = light + contrast * seen.wave
            total = total + contrast * seen.flux
            found.append((contrast, seen))
        value = np.asarray(light / total, dtype=complex)
        out: list[ComplexArray] = []
        for contrast, seen in found:
            moved = [w - value * f for w, f in zip(seen.wave_slopes, seen.flux_slopes, strict=True)]
            by_place = [contrast * m / total for m in moved]
            brighter = (seen.wave - value * seen.flux) / total
            out += [*by_place, *self._by_band(samples, brighter)]
            if self.moves:
                out += [samples.years(self.reference_mjd)[:, None] * s for s in by_place]
        if self.diameter_mas == "free":
            out.append((by_diameter / total).astype(complex))
        if self.background == "free":
            out.append(np.asarray(-value / total, dtype=complex))
        return value, np.array(out).reshape(len(out), *value.shape)

    def _by_band(self, samples: Samples, by_contrast: ComplexArray) -> list[ComplexArray]:
        """Derivatives by each contrast from that by one common to all bands."""
        if self.n_contrasts == 1:
            return [by_contrast]
        which = [samples.band[:, None] == b for b in range(self.n_contrasts)]
        return [np.where(here, by_contrast, 0.0) for here in which]

    def _companion_slope(
        self, samples: Samples, east_mas: FloatArray, north_mas: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Visibility of a companion and its derivative by the phase angle."""
        angle = _angle(samples, east_mas, north_mas)
        wave = np.exp(-1j * angle)
        if not self.smearing:
            return wave, -1j * wave
        half = _half_band(samples)
        value, slope = _sinc(angle * half)
        return value * wave, (half * slope - 1j * value) * wave


@dataclass(frozen=True, eq=False)
class _Seen:
    """Visibility and flux of a point as the extraction lets them through; slopes per mas."""

    wave: ComplexArray
    flux: FloatArray | float
    wave_slopes: tuple[ComplexArray, ComplexArray]
    flux_slopes: tuple[FloatArray | float, FloatArray | float]

    @classmethod
    def of(
        cls,
        samples: Samples,
        east_mas: FloatArray,
        north_mas: FloatArray,
        wave: ComplexArray,
        slope: ComplexArray,
    ) -> _Seen:
        by_angle = slope * (2.0 * np.pi * MAS)
        slopes = (by_angle * samples.u[:, None], by_angle * samples.v[:, None])
        if samples.off_axis is None:
            return cls(wave, 1.0, slopes, (0.0, 0.0))
        fringe, flux = samples.off_axis.at(east_mas, north_mas)
        of_fringe, of_flux = samples.off_axis.slopes(east_mas, north_mas)
        return cls(
            wave * fringe,
            flux,
            (
                fringe * (slopes[0] + wave * of_fringe[0]),
                fringe * (slopes[1] + wave * of_fringe[1]),
            ),
            (flux * of_flux[0], flux * of_flux[1]),
        )


def _angle(samples: Samples, east_mas: FloatArray, north_mas: FloatArray) -> FloatArray:
    """2π(uα + vδ), (n_samples, n), of places (n,) or of moving ones (n_samples, n)."""
    if east_mas.ndim == 2:
        u, v = samples.u[:, None] * MAS, samples.v[:, None] * MAS
        return np.asarray(2.0 * np.pi * (u * east_mas + v * north_mas))
    turns = np.outer(samples.u, east_mas * MAS) + np.outer(samples.v, north_mas * MAS)
    return 2.0 * np.pi * turns


def _half_band(samples: Samples) -> FloatArray:
    return 0.5 * samples.relative_band[:, None]


def _sinc(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evaluate sin(x)/x and its derivative."""
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    value = np.where(small, 1.0 - x * x / 6.0, np.sin(safe) / safe)
    slope = np.where(small, -x / 3.0, (np.cos(safe) - value) / safe)
    return value, slope


def disc(samples: Samples, diameter_mas: FloatArray) -> FloatArray:
    """Visibility of uniform discs, (n_samples, n)."""
    if not np.any(diameter_mas):
        return np.ones((len(samples), len(diameter_mas)))
    return uniform_disc(samples.frequency[:, None], diameter_mas)[0]

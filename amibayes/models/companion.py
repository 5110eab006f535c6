"""A companion: a disc with contrasts and a colour, which may move, seen through a channel.

c·(λ/λ₀)^P·D·E with D the visibility of a uniform disc, P the slope of the flux ratio with
wavelength, and E = sinc · exp(−2πi(uα + vδ)/λ), whose sinc is the average over the channel. Of
data in several bands each may have a contrast of its own, and of data of several dates the
place may move linearly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from amibayes.models.parameters import MAX_CONTRAST, Parameter
from amibayes.models.source import Slope, Source
from amibayes.models.uv_points import UVPoints
from amibayes.scene.disc import uniform_disc
from amibayes.units import MAS, ComplexArray, FloatArray

MAX_SLOPE = 10.0
"""Largest exponent of a flux ratio with wavelength: a 1000 K body beside a hot star at 1 µm."""


def companion_parameters(
    k: int,
    bands: tuple[str, ...],
    fastest_mas_yr: float,
    shapes: tuple[str, ...] = (),
) -> tuple[Parameter, ...]:
    """Parameters of companion ``k``: place, contrasts, rates, shapes.

    Parameters
    ----------
    k : int
        1, 2, …
    bands : tuple of str
        That have a contrast of their own; empty where all share one.
    fastest_mas_yr : float
        0 where it stands still.
    shapes : tuple of {"companion_diameter_mas", "contrast_slope"}
        What is free of them.
    """
    suffix = "" if k == 1 else f"_{k}"
    found = [Parameter(f"{axis}_mas{suffix}", "mas", "position", k) for axis in ("east", "north")]
    found.append(Parameter(f"contrast{suffix}", "", "flux", k, 0.0, MAX_CONTRAST))
    found += [
        Parameter(f"contrast{suffix}[{band}]", "", "flux", k, 0.0, MAX_CONTRAST)
        for band in bands[1:]
    ]
    if fastest_mas_yr > 0.0:
        limits = (-fastest_mas_yr, fastest_mas_yr)
        found += [
            Parameter(f"{axis}_rate_mas_yr{suffix}", "mas/yr", "rate", k, *limits)
            for axis in ("east", "north")
        ]
    if "companion_diameter_mas" in shapes:
        found.append(Parameter(f"companion_diameter_mas{suffix}", "mas", "shape", k, lower=0.0))
    if "contrast_slope" in shapes:
        found.append(Parameter(f"contrast_slope{suffix}", "", "shape", k, -MAX_SLOPE, MAX_SLOPE))
    return tuple(found)


ALONG = ((1.0, 0.0), (0.0, 1.0))
"""Derivatives of the place by its east and by its north."""


@dataclass(frozen=True)
class Companion:
    """A companion.

    Parameters
    ----------
    number : int
        1 for the first companion.
    smearing : bool
        Average over the width of each channel.
    bands : tuple of str
        That have a contrast of their own.
    fastest_mas_yr : float
        0: it stands still.
    reference_mjd : float
        Date at which a moving companion is at its east and north.
    diameter_mas : float or "free"
    slope : float or "free"
        Exponent P of the flux ratio, (λ/λ₀)^P.
    reference_wavelength_m : float
        λ₀; 0 for the geometric mean of the data's.
    """

    number: int = 1
    smearing: bool = True
    bands: tuple[str, ...] = ()
    fastest_mas_yr: float = 0.0
    reference_mjd: float = 0.0
    diameter_mas: float | Literal["free"] = 0.0
    slope: float | Literal["free"] = 0.0
    reference_wavelength_m: float = 0.0

    @property
    def shapes(self) -> tuple[str, ...]:
        """What is free of disc and colour."""
        pairs = (("companion_diameter_mas", self.diameter_mas), ("contrast_slope", self.slope))
        return tuple(name for name, value in pairs if value == "free")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Place, contrasts, rates, shapes."""
        return companion_parameters(self.number, self.bands, self.fastest_mas_yr, self.shapes)

    @property
    def n_contrasts(self) -> int:
        """Number of contrasts."""
        return max(len(self.bands), 1)

    def source(self, samples: UVPoints, values: FloatArray, *, slopes: bool = False) -> Source:
        """Make the companion of ``values`` (n_parameters, n)."""
        place, bright, rates, shapes = self._split(values)
        flux = bright[0] if self.n_contrasts == 1 else bright[samples.band]
        colour, by_slope = self.colour(samples, shapes)
        flux = flux if colour is None else flux * colour
        years = samples.years(self.reference_mjd)[:, None] if len(rates) else np.zeros(1)
        east, north = place[:, None] + years * rates[:, None] if len(rates) else place
        disc, by_diameter = self.disc(samples, shapes)
        if not slopes:
            wave = point_visibility(samples, east, north, self.smearing)
            return Source(flux, wave if disc is None else disc * wave, (east, north))
        wave, by_angle = point_slope(samples, east, north, self.smearing)
        point = wave
        if disc is not None:
            wave, by_angle = disc * wave, disc * by_angle
        by_turn = by_angle * (2.0 * np.pi * MAS)
        by_place = by_turn * samples.u[:, None], by_turn * samples.v[:, None]
        found = [Slope(wave=w, place=p) for w, p in zip(by_place, ALONG, strict=True)]
        found += [Slope(flux=f) for f in self._by_contrast(samples, colour)]
        if len(rates):
            found += [s.times(years) for s in found[: len(ALONG)]]
        found += [] if self.diameter_mas != "free" else [Slope(wave=by_diameter * point)]
        found += [] if self.slope != "free" else [Slope(flux=flux * by_slope)]
        return Source(flux, wave, (east, north), found)

    def _split(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Place, contrasts, rates and shapes."""
        first = 2 + self.n_contrasts
        last = len(values) - len(self.shapes)
        return values[:2], values[2:first], values[first:last], values[last:]

    def colour(self, samples: UVPoints, shapes: FloatArray) -> tuple[Any, Any]:
        """(λ/λ₀)^P, (n_samples, n), and its logarithmic derivative by P; None where P is 0."""
        if self.slope == 0.0:
            return None, None
        log = samples.log_colour(self.reference_wavelength_m)[:, None]
        slope = shapes[-1] if self.slope == "free" else np.full(1, float(self.slope))
        return np.exp(log * slope), log

    def disc(self, samples: UVPoints, shapes: FloatArray) -> tuple[Any, Any]:
        """Visibility of the disc, (n_samples, n), and its derivative; None for a point."""
        if self.diameter_mas == 0.0:
            return None, None
        diameter = shapes[0] if self.diameter_mas == "free" else np.full(1, self.diameter_mas)
        return uniform_disc(samples.frequency[:, None], diameter)

    def _by_contrast(self, samples: UVPoints, colour: FloatArray | None) -> list[Any]:
        """Derivatives of the flux by each contrast."""
        each = 1.0 if colour is None else colour
        if self.n_contrasts == 1:
            return [each]
        return [each * (samples.band[:, None] == b) for b in range(self.n_contrasts)]


def point_visibility(
    samples: UVPoints, east_mas: FloatArray, north_mas: FloatArray, smearing: bool = True
) -> ComplexArray:
    """Visibility of a point at an offset, averaged over the channel, (n_samples, n)."""
    out = np.empty((len(samples), east_mas.shape[-1]), dtype=complex)
    # The sine changes its sign with the place, the cosine does not.
    fringes_into(out.real, out.imag, samples, -east_mas, -north_mas, smearing)
    return out


BLOCK = 16384
"""Numbers that are worked on at once: what fits a processor's cache, several times."""


def fringes_into(
    cosine: FloatArray,
    sine: FloatArray,
    samples: UVPoints,
    east_mas: FloatArray,
    north_mas: FloatArray,
    smearing: bool,
) -> None:
    """Put cosine and sine of 2π(uα + vδ), damped by the channel's width, (n_samples, n) each.

    Of places (n,) or of moving ones (n_samples, n).
    """
    half_turns = np.pi * MAS * np.column_stack([samples.u, samples.v])
    band, step = _half_band(samples), max(1, BLOCK // max(cosine.shape[1], 1))
    for first in range(0, len(samples), step):
        rows = slice(first, first + step)
        half = _along(half_turns[rows], east_mas, north_mas, rows)
        c, s = _cosine_and_sine(half)
        if not smearing:
            cosine[rows], sine[rows] = c, s
            continue
        half *= band[rows]
        damping = _sinc_of_twice(half)
        np.multiply(c, damping, out=cosine[rows])
        np.multiply(s, damping, out=sine[rows])


def _along(
    frequency: FloatArray, east_mas: FloatArray, north_mas: FloatArray, rows: slice
) -> FloatArray:
    """Products of frequencies (m, 2) with places (n,), or with those of ``rows``, (m, n)."""
    if east_mas.ndim == 2 or len(east_mas) == 1:
        east, north = (x[rows] if x.ndim == 2 else x for x in (east_mas, north_mas))
        product = frequency[:, :1] * east
        product += frequency[:, 1:] * north
        return np.asarray(product)
    # A product of matrices: rows of some ten places are too short for sums by broadcasting.
    return np.asarray(frequency @ np.stack([east_mas, north_mas]))


def fringes_of_one(samples: UVPoints, smearing: bool) -> Callable[[FloatArray, FloatArray], None]:
    """Make what puts the fringes of one place (2,), mas, into an array (2 n_samples,).

    Cosines, then sines, as `fringes_into` does for many: of one, with few samples, the time goes
    into calls, of which here are a third as many.
    """
    turns = 2.0 * np.pi * MAS * np.column_stack([samples.u, samples.v])
    half, n = 0.5 * samples.relative_band, len(samples)

    def fill(out: FloatArray, place: FloatArray) -> None:
        angle = turns @ place
        np.cos(angle, out=out[:n])
        np.sin(angle, out=out[n:])
        if smearing:
            size = np.maximum(np.abs(angle * half), 1e-8)  # where it is 1 to rounding
            damping = np.sin(size) / size
            out[:n] *= damping
            out[n:] *= damping

    return fill


def _cosine_and_sine(half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosine and sine of twice an angle, of any shape, by its tangent t.

    2/(1 + t²) − 1 and 2t/(1 + t²): one vectorised function in place of two that are not, a
    third of the time, and as exact (2e-16).
    """
    tangent = np.tan(half)
    cosine = _one_and_square(tangent)
    np.divide(2.0, cosine, out=cosine)
    tangent *= cosine
    cosine -= 1.0
    return cosine, tangent


def _one_and_square(x: FloatArray) -> FloatArray:
    """1 + x²."""
    square = x * x
    square += 1.0
    return square


def point_slope(
    samples: UVPoints, east_mas: FloatArray, north_mas: FloatArray, smearing: bool
) -> tuple[ComplexArray, ComplexArray]:
    """Visibility of a point and its derivative by the phase angle, (n_samples, n) each."""
    angle = phase_angle(samples, east_mas, north_mas)
    cosine, sine = _cosine_and_sine(0.5 * angle)
    wave: ComplexArray = np.asarray(cosine - 1j * sine)
    if not smearing:
        return wave, -1j * wave
    half = _half_band(samples)
    value, slope = _sinc(angle * half)
    return value * wave, (half * slope - 1j * value) * wave


def phase_angle(samples: UVPoints, east_mas: FloatArray, north_mas: FloatArray) -> FloatArray:
    """2π(uα + vδ), (n_samples, n), of places (n,) or of moving ones (n_samples, n)."""
    if east_mas.ndim == 2:
        u, v = samples.u[:, None] * MAS, samples.v[:, None] * MAS
        return np.asarray(2.0 * np.pi * (u * east_mas + v * north_mas))
    turns = np.outer(samples.u, east_mas * MAS) + np.outer(samples.v, north_mas * MAS)
    return 2.0 * np.pi * turns


def _half_band(samples: UVPoints) -> FloatArray:
    return 0.5 * samples.relative_band[:, None]


def _sinc_of_twice(x: FloatArray) -> FloatArray:
    """Evaluate sin(2x)/2x, t/((1 + t²)x) of the tangent t of x."""
    shifted = x + 1e-30  # keeps 0/0 away, and is nothing beside any other number
    tangent = np.tan(shifted)
    shifted *= _one_and_square(tangent)
    tangent /= shifted
    return tangent


def _sinc(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evaluate sin(x)/x and its derivative."""
    small = np.abs(x) < 1e-4  # where the series is exact to rounding
    safe = np.where(small, 1.0, x)
    cosine, sine = _cosine_and_sine(0.5 * safe)
    value = np.where(small, 1.0 - x * x / 6.0, sine / safe)
    slope = np.where(small, -x / 3.0, (cosine - value) / safe)
    return value, slope

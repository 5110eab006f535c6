"""Extended light around the star: discs, rings and crescents, inclined, with closed transforms.

All are centred on the star. With ρ the spatial frequency in the plane of the structure
(`amibayes.models.projection`) and x = πθρ, θ the size along the major axis:

- Gaussian of FWHM θ: exp(−x²/(4 ln 2));
- uniform disc of diameter θ: 2J₁(x)/x;
- thin ring of diameter θ: J₀(x); smoothed in its plane by a Gaussian of FWHM wθ:
  times exp(−w²x²/(4 ln 2));
- crescent, a ring of brightness 1 + A cos(φ − φ₀): J₀(x) − iA J₁(x) cos(η − φ₀), η the azimuth
  of the frequency (Lazareff et al. 2017, A&A 599, A85).

The average over a channel is that of two frequencies in it (Gauss–Legendre), exact for phases
of the width up to a radian to 1e-3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.special import j0, j1

from amibayes.models.companion import MAX_SLOPE
from amibayes.models.parameters import Parameter
from amibayes.models.projection import Projection
from amibayes.models.response_waves import ResponseWaves
from amibayes.models.source import Slope, Source
from amibayes.models.uv_points import UVPoints
from amibayes.units import MAS, ComplexArray, FloatArray

Profile = Literal["gaussian", "uniform", "ring"]

MAX_FLUX = 10.0
"""Largest flux in units of the star's: discs of young stars outshine them."""

MIN_RATIO = 0.05
"""Least axis ratio: seen nearer to edge-on a flat structure is a line to any baseline."""

GAUSS = 1.0 / (4.0 * np.log(2.0))
"""A Gaussian of FWHM θ has the transform exp(−(πθρ)²/(4 ln 2))."""

SMALL = 1e-4
"""Arguments below which series are exact to rounding."""

NODES = 1.0 / np.sqrt(3.0)
"""Nodes ±1/√3 of the Gauss–Legendre rule of two points."""

Rows = dict[str, Any]
"""Derivatives by the name of a shape, (n_samples, n) each."""


@dataclass(frozen=True)
class Extended:
    """A disc, a ring or a crescent around the star.

    Parameters
    ----------
    profile : {"gaussian", "uniform", "ring"}
    name : str
        What its parameters' names begin with.
    inclined : bool
        Axis ratio and position angle are free; else it is seen face on.
    smoothed : bool
        Of a ring: the width of its Gaussian, in units of the diameter, is free; else 0.
    crescent : bool
        Of a ring: its brightness goes with the azimuth.
    slope : float or "free"
        Exponent P of the flux with wavelength, (λ/λ₀)^P.
    reference_wavelength_m : float
        λ₀; 0 for the geometric mean of the data's.
    smearing : bool
        Average over the width of each channel.

    Notes
    -----
    Parameters are the flux in units of the star's; the FWHM or diameter in mas; the axis ratio
    (cosine of the inclination) and the position angle of the major axis; the width of a ring;
    the modulation A of a crescent, and the angle of its brightest part, east of north as it
    would be seen face on.
    """

    profile: Profile = "gaussian"
    name: str = "disc"
    inclined: bool = True
    smoothed: bool = False
    crescent: bool = False
    slope: float | Literal["free"] = 0.0
    reference_wavelength_m: float = 0.0
    smearing: bool = True

    @property
    def coloured(self) -> bool:
        """Whether its flux ratio goes with wavelength."""
        return self.slope != 0.0

    @property
    def size(self) -> str:
        """Name of the size."""
        return "fwhm_mas" if self.profile == "gaussian" else "diameter_mas"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Flux, size, and what else is free."""
        found = [("flux", "", 0.0, MAX_FLUX), (self.size, "mas", 0.0, np.inf)]
        if self.inclined:
            found += [("axis_ratio", "", MIN_RATIO, 1.0), ("position_angle_deg", "deg", 0.0, 180.0)]
        if self.smoothed:
            found.append(("width", "", 0.0, 1.0))
        if self.crescent:
            found += [("modulation", "", 0.0, 1.0), ("bright_angle_deg", "deg", 0.0, 360.0)]
        if self.slope == "free":
            found.append(("slope", "", -MAX_SLOPE, MAX_SLOPE))
        return tuple(
            Parameter(f"{self.name}_{name}", unit, "nuisance", 0, low, high)
            for name, unit, low, high in found
        )

    def source(self, samples: UVPoints, values: FloatArray, *, slopes: bool = False) -> Source:
        """Make the source of ``values`` (n_parameters, n)."""
        of = self.named(values)
        if samples.response_waves is not None:
            return self._seen(samples, samples.response_waves, of, slopes=slopes)
        wave, rows = self._averaged(samples, of, slopes=slopes)
        return self._source(samples, of, wave, rows, slopes=slopes)

    def _source(
        self,
        samples: UVPoints,
        of: dict[str, FloatArray],
        wave: ComplexArray,
        rows: Rows,
        *,
        slopes: bool,
        share: Any = 1.0,
        shares: Rows | None = None,
    ) -> Source:
        """Put fringes and their derivatives, and those of the share that is seen, together."""
        flux, colour, log = self._flux(samples, of)
        if not slopes:
            return Source(flux, wave, None, share=share)
        found = []
        for name in (p.name.removeprefix(f"{self.name}_") for p in self.parameters):
            if name == "flux":
                found.append(Slope(flux=colour))
            elif name == "slope":
                found.append(Slope(flux=flux * log))
            else:
                found.append(Slope(wave=rows[name], share=(shares or {}).get(name)))
        return Source(flux, wave, None, found, share)

    def _seen(
        self, samples: UVPoints, through: ResponseWaves, of: dict[str, FloatArray], *, slopes: bool
    ) -> Source:
        """What an extraction sees of it: each wave of the response shifts the frequency."""
        wave: Any = 0.0
        share: Any = 0.0
        rows: Rows = {}
        shares: Rows = {}
        for (p, q), fringe, flux in zip(through.shift, through.fringe, through.flux, strict=True):
            value, slope = self._at(samples.u + p, samples.v + q, of, slopes=slopes)
            whole, by_whole = self._at(np.full(1, p), np.full(1, q), of, slopes=slopes)
            wave, share = wave + fringe * value, share + (flux * whole).real
            for name in slope:
                rows[name] = rows.get(name, 0.0) + fringe * slope[name]
                shares[name] = shares.get(name, 0.0) + (flux * by_whole[name]).real
        return self._source(samples, of, wave, rows, slopes=slopes, share=share, shares=shares)

    def named(self, values: FloatArray) -> dict[str, FloatArray]:
        """Values by name, with those that are fixed."""
        n = values.shape[1]
        fixed = {"axis_ratio": 1.0, "position_angle_deg": 0.0, "width": 0.0, "modulation": 0.0}
        fixed |= {"bright_angle_deg": 0.0, "slope": 0.0 if self.slope == "free" else self.slope}
        found = {name: np.full(n, float(value)) for name, value in fixed.items()}
        names = (p.name.removeprefix(f"{self.name}_") for p in self.parameters)
        return found | dict(zip(names, values, strict=True))

    def _flux(self, samples: UVPoints, of: dict[str, FloatArray]) -> tuple[Any, Any, Any]:
        """Flux, its derivative by that at λ₀, and ln(λ/λ₀)."""
        if not self.coloured:
            return of["flux"], 1.0, None
        log = samples.log_colour(self.reference_wavelength_m)[:, None]
        colour = np.exp(log * of["slope"])
        return of["flux"] * colour, colour, log

    def _averaged(
        self, samples: UVPoints, of: dict[str, FloatArray], *, slopes: bool
    ) -> tuple[ComplexArray, Rows]:
        """Visibility (n_samples, n) averaged over the channels, and its derivatives."""
        half = 0.5 * samples.relative_band
        if not self.smearing or not half.any():
            return self._at(samples.u, samples.v, of, slopes=slopes)
        factors = [1.0 - NODES * half, 1.0 + NODES * half]
        (low, below), (high, above) = (
            self._at(samples.u * f, samples.v * f, of, slopes=slopes) for f in factors
        )
        return 0.5 * (low + high), {k: 0.5 * (below[k] + above[k]) for k in below}

    def _at(
        self, u: FloatArray, v: FloatArray, of: dict[str, FloatArray], *, slopes: bool
    ) -> tuple[ComplexArray, Rows]:
        """Visibility at frequencies (n_samples,) and its derivatives by every shape."""
        plane = Projection.of(u, v, of["axis_ratio"], of["position_angle_deg"])
        per_mas = np.pi * MAS
        x = per_mas * of[self.size] * plane.length
        value, over_x = PROFILES[self.profile](x)
        if not slopes:
            return self._wave(plane, of, x, value, over_x), {}
        by_ratio, by_angle = plane.length_slopes()
        square = (per_mas * of[self.size]) ** 2
        # Derivatives of x²/2, which is smooth where x is 0.
        moves: Rows = {
            self.size: per_mas**2 * of[self.size] * plane.length**2,
            "axis_ratio": square * by_ratio,
            "position_angle_deg": square * by_angle,
        }
        if self.profile != "ring":
            return value.astype(complex), {k: over_x * m for k, m in moves.items()}
        return self._ring(plane, of, x, value, over_x, moves)

    def _wave(
        self,
        plane: Projection,
        of: dict[str, FloatArray],
        x: FloatArray,
        value: FloatArray,
        over_x: FloatArray,
    ) -> ComplexArray:
        """Visibility without its derivatives."""
        if self.profile != "ring":
            return value.astype(complex)
        wave = value.astype(complex)
        if self.crescent:
            along, _ = plane.along(of["bright_angle_deg"] - of["position_angle_deg"])
            wave = wave + 1j * of["modulation"] * over_x * (np.pi * MAS * of[self.size] * along)
        return wave * np.exp(-GAUSS * (of["width"] * x) ** 2) if self.smoothed else wave

    def _ring(
        self,
        plane: Projection,
        of: dict[str, FloatArray],
        x: FloatArray,
        value: FloatArray,
        over_x: FloatArray,
        moves: Rows,
    ) -> tuple[ComplexArray, Rows]:
        """Put modulation and width in a thin ring; ``over_x`` is −J₁(x)/x."""
        azimuth = of["bright_angle_deg"] - of["position_angle_deg"]
        along, across = plane.along(azimuth)
        by_ratio, by_angle = plane.along_slopes(azimuth)
        size, turn = np.pi * MAS * of[self.size], np.pi / 180.0
        slim = np.exp(-GAUSS * (of["width"] * x) ** 2)
        modulated = 1j * of["modulation"] * over_x
        # d/d(x²/2) of −J₁(x)/x is J₂(x)/x².
        curve = 1j * of["modulation"] * size * along * _j2_over_square(x)
        ring = value + modulated * size * along
        shifts = {
            self.size: np.pi * MAS * along,
            "axis_ratio": size * by_ratio,
            "position_angle_deg": size * (by_angle - turn * across),
        }
        fade = -2.0 * GAUSS * of["width"] ** 2 * ring
        rows = {
            k: slim * ((over_x + curve + fade) * moves[k] + modulated * shifts[k]) for k in moves
        }
        rows["width"] = -2.0 * GAUSS * of["width"] * x**2 * slim * ring
        rows["modulation"] = 1j * slim * over_x * size * along
        rows["bright_angle_deg"] = slim * modulated * size * turn * across
        return slim * ring, rows


def _gaussian(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    value = np.exp(-GAUSS * x**2)
    return value, -2.0 * GAUSS * value


def _uniform(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """2J₁(x)/x, whose derivative by x²/2 is −2J₂(x)/x²."""
    return 2.0 * _j1_over_x(x), -2.0 * _j2_over_square(x)


def _ring(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """J₀(x), whose derivative by x²/2 is −J₁(x)/x."""
    return j0(x), -_j1_over_x(x)


def _j1_over_x(x: FloatArray) -> FloatArray:
    small = x < SMALL
    safe = np.where(small, 1.0, x)
    return np.where(small, 0.5 - x * x / 16.0, j1(safe) / safe)


def _j2_over_square(x: FloatArray) -> FloatArray:
    """J₂(x)/x² by J₂ = 2J₁/x − J₀; the series where that loses digits."""
    small = x < 0.03
    safe = np.where(small, 1.0, x)
    closed = (2.0 * j1(safe) / safe - j0(safe)) / safe**2
    return np.where(small, 0.125 - x * x / 96.0, closed)


PROFILES = {"gaussian": _gaussian, "uniform": _uniform, "ring": _ring}
"""Visibility as a function of x, and its derivative by x²/2, of each profile."""

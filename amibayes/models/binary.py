"""The binary model: a star, companions, over-resolved light, seen through channels.

V = (V_A + Σ c_k E_k) / (1 + Σ c_k + f) with V_A the disc of the primary, c_k the contrast
(companion/primary flux ratio), E_k a companion's fringes and f the over-resolved background
(primary = 1). Everything is evaluated for many parameter sets at once: points of the (u, v)
plane down the rows, parameter sets across the columns.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from amibayes.models.background import Background
from amibayes.models.companion import Companion
from amibayes.models.off_axis import Place
from amibayes.models.parameters import Parameters
from amibayes.models.source import CENTRED, Component, Slope, Source
from amibayes.models.star import Star
from amibayes.models.uv_points import UVPoints
from amibayes.support.arguments import checks_arguments, in_range
from amibayes.units import ComplexArray, FloatArray


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """How a faint companion moves the visibility: dV/dc = scale·(ρDE − ρ_F·star).

    E are the fringes of a point, ρ and ρ_F the response of the extraction to its visibility
    and flux (1 where there is none). A free disc or colour of the companion is left at its
    value here, that of a point as bright in all channels: without light it has no effect.

    Parameters
    ----------
    star : (n_samples,) float array
        Visibility without a companion; its real part where light around the star is lopsided.
    scale : (n_samples,) float array
        1/(flux without a companion), times the companion's colour.
    disc : (n_samples,) float array
        D, the visibility of the companion's disc.
    across : (n_samples,) float array
        Imaginary part of the visibility without a companion: 0 but for crescents.
    """

    star: FloatArray
    scale: FloatArray
    disc: FloatArray
    across: FloatArray


NEVER_NEGATIVE = (
    "companions", "diameter_mas", "background", "fastest_mas_yr", "limb_darkening",
    "companion_diameter_mas", "reference_wavelength_m",
)  # fmt: skip
"""Fields of `BinaryModel` that are sizes, numbers or fluxes."""


@checks_arguments
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
        Bands of the data (`amibayes.models.bands`) that have a contrast of their own, the
        reference band first; empty where all share one.
    fastest_mas_yr : float
        Companions move linearly, at most so fast along east and along north; 0: they stand.
    reference_mjd : float
        Date at which a moving companion is at its east and north.
    surroundings : tuple of Component
        What else is on the sky, such as a disc; its parameters are nuisances, component 0.
    limb_darkening : float or "free"
        Exponent α of the primary's brightness μ^α; 0 for a uniform disc.
    companion_diameter_mas : float or "free"
        Uniform-disc diameter of companions.
    contrast_slope : float or "free"
        Exponent P of the flux ratio with wavelength, c·(λ/λ₀)^P.
    reference_wavelength_m : float
        λ₀; 0 for the geometric mean over the points of the data.
    """

    companions: int = 1
    diameter_mas: float | Literal["free"] = 0.0
    background: float | Literal["free"] = 0.0
    smearing: bool = True
    bands: tuple[str, ...] = ()
    fastest_mas_yr: float = 0.0
    reference_mjd: float = 0.0
    surroundings: tuple[Component, ...] = ()
    limb_darkening: float | Literal["free"] = 0.0
    companion_diameter_mas: float | Literal["free"] = 0.0
    contrast_slope: float | Literal["free"] = 0.0
    reference_wavelength_m: float = 0.0

    def __post_init__(self) -> None:
        for name in ("contrast_slope", "reference_mjd"):
            in_range("BinaryModel", name, getattr(self, name))
        for name in NEVER_NEGATIVE:
            in_range("BinaryModel", name, getattr(self, name), 0.0)

    @property
    def n_contrasts(self) -> int:
        """Number of contrasts of each companion."""
        return max(len(self.bands), 1)

    @property
    def coloured(self) -> bool:
        """Whether a flux ratio goes with wavelength."""
        around = any(getattr(c, "coloured", False) for c in self.surroundings)
        return self.contrast_slope != 0.0 or around

    @property
    def moves(self) -> bool:
        """Whether companions move."""
        return self.fastest_mas_yr > 0.0

    @cached_property
    def components(self) -> tuple[Component, ...]:
        """Companions, star and background, in the order of a parameter vector."""
        companions = [self._companion(k + 1) for k in range(self.companions)]
        star = Star(self.diameter_mas, self.limb_darkening)
        return (*companions, star, Background(self.background), *self.surroundings)

    def _companion(self, k: int) -> Companion:
        return Companion(
            k,
            self.smearing,
            self.bands,
            self.fastest_mas_yr,
            self.reference_mjd,
            self.companion_diameter_mas,
            self.contrast_slope,
            self.reference_wavelength_m,
        )

    @cached_property
    def parameters(self) -> Parameters:
        """Free parameters, in the order of a parameter vector."""
        return Parameters(tuple(p for c in self.components for p in c.parameters))

    def at_rest(self, three: FloatArray) -> FloatArray:
        """Companions (n, width) that stand, alike in every band, from east, north, contrast.

        Free shapes are those of a point without colour.
        """
        one = replace(self, companions=1).parameters
        out = np.zeros((len(three), len(one.companion())))
        out[:, one.place()] = three[:, :2]
        out[:, one.contrasts] = three[:, 2:]
        return out

    def visibility(self, samples: UVPoints, theta: FloatArray) -> ComplexArray:
        """Complex visibilities, (n_samples, n), of parameter sets theta (n, n_dim)."""
        sources = self._sources(samples, theta, slopes=False)
        light, total = _mixed(samples, sources, _start(samples))
        if samples.off_axis is not None:
            light, total = _mixed(samples, sources, samples.off_axis.centre(light))
        # numpy divides complex numbers by real ones as if these were complex.
        return np.asarray(light * (1.0 / total))

    def gradient(self, samples: UVPoints, theta: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Visibilities (n_samples, n) and their derivatives (n_dim, n_samples, n)."""
        sources = self._sources(samples, theta, slopes=True)
        mixed = _Mixed.of(samples, sources, _start(samples))
        if samples.off_axis is not None:
            centre = samples.off_axis.centre(mixed.light)
            moves = samples.off_axis.centre_slopes(mixed.light, mixed.light_slopes)
            mixed = _Mixed.of(samples, sources, centre).pulled(moves)
        value = np.asarray(mixed.light / mixed.total, dtype=complex)
        return value, np.asarray((mixed.light_slopes - value * mixed.total_slopes) / mixed.total)

    def linear_response(self, samples: UVPoints, nuisance: FloatArray) -> LinearResponse:
        """Make the response to a faint companion from values of the nuisance parameters."""
        alone = replace(self, companions=0)
        sources = alone._sources(samples, np.atleast_2d(nuisance), slopes=False)
        light, total = _mixed(samples, sources, CENTRED)
        one = np.ones(len(samples))
        scale = 1.0 / (np.asarray(total).reshape(-1) * one)
        point = self._companion(1)
        rest = np.zeros((len(point.shapes), 1))
        colour, disc = point.colour(samples, rest)[0], point.disc(samples, rest)[0]
        return LinearResponse(
            np.asarray(light[:, 0].real * scale),
            scale * (one if colour is None else np.broadcast_to(colour, (len(one), 1))[:, 0]),
            one if disc is None else np.broadcast_to(disc, (len(one), 1))[:, 0],
            np.asarray((light[:, 0].imag if np.iscomplexobj(light) else 0.0) * scale),
        )

    def _sources(self, samples: UVPoints, theta: FloatArray, *, slopes: bool) -> list[Source]:
        """Every component at parameter sets (n, n_dim)."""
        values, first, found = theta.T, 0, []
        for component in self.components:
            last = first + len(component.parameters)
            found.append(component.source(samples, values[first:last], slopes=slopes))
            first = last
        return found


@dataclass(frozen=True, eq=False)
class _Mixed:
    """Light (n_samples, n) and flux of all sources, and their slopes.

    ``pulls`` are those by the places as the extraction sees them, from the centre of the
    image: east and north summed over the sources, (2, n_samples, n).
    """

    light: ComplexArray
    total: FloatArray
    light_slopes: ComplexArray
    total_slopes: FloatArray
    light_pulls: ComplexArray
    total_pulls: FloatArray

    @classmethod
    def of(cls, samples: UVPoints, sources: Sequence[Source], centre: Place) -> _Mixed:
        """Add the sources up, seen from a centre."""
        through = [_through(samples, s.place, centre, slopes=True) for s in sources]
        pairs = list(zip(sources, through, strict=True))
        light, total = (sum(x) for x in zip(*(_lit(s, t) for s, t in pairs), strict=True))
        slopes = [_by_parameter(s, slope, t) for s, t in pairs for slope in s.slopes]
        pulls = [] if samples.off_axis is None else [_by_place(s, t) for s, t in pairs]
        return cls(
            light,
            total,
            _stacked([p for p, _ in slopes], light.shape, complex),
            _stacked([q for _, q in slopes], light.shape, float),
            _stacked([sum(p[k][0] for p in pulls) for k in (0, 1)], light.shape, complex),
            _stacked([sum(p[k][1] for p in pulls) for k in (0, 1)], light.shape, float),
        )

    def pulled(self, moves: FloatArray) -> _Mixed:
        """Add what parameters do by moving the centre, (n_dim, 2, n_samples, n) mas each."""
        return replace(
            self,
            light_slopes=self.light_slopes - np.einsum("qksn,ksn->qsn", moves, self.light_pulls),
            total_slopes=self.total_slopes - np.einsum("qksn,ksn->qsn", moves, self.total_pulls),
        )


def _stacked(rows: list[Any], shape: tuple[int, ...], kind: type) -> Any:
    out: Any = np.empty((len(rows), *shape), dtype=kind)
    for row, values in zip(out, rows, strict=True):
        row[...] = values
    return out


def _mixed(
    samples: UVPoints, sources: Sequence[Source], centre: Place
) -> tuple[ComplexArray, FloatArray]:
    """Light (n_samples, n) and flux of all sources seen from a centre."""
    lit = [_lit(s, _through(samples, s.place, centre, slopes=False)) for s in sources]
    light, total = (_sum(x) for x in zip(*lit, strict=True))
    return light, total


def _sum(parts: Iterable[Any]) -> Any:
    """Add numbers and arrays; a plain 0 is left out, which costs a pass over a large array."""
    return functools.reduce(operator.add, [p for p in parts if np.ndim(p) or p] or [0.0])


Through = tuple[Any, Any]
"""Response of the extraction to a source's visibility and flux: values, then slopes by place."""

OPEN: Through = ((1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
"""All is let through."""


def _lit(source: Source, through: Through) -> tuple[Any, Any]:
    """Light and flux of a source, as the extraction lets them through."""
    fringe, flux = through
    wave, share = source.wave, source.share
    if through is not OPEN:
        wave, share = wave * fringe[0], share * flux[0]
    # The star's flux, 1, costs a pass over a large array as well.
    one = isinstance(source.flux, float) and source.flux == 1.0
    return wave if one else source.flux * wave, source.flux * share


def _by_place(source: Source, through: Through) -> list[tuple[Any, Any]]:
    """Derivatives of light and flux by the east and north from which the source is seen."""
    fringe, flux = through
    return [(source.flux * (source.wave * fringe[k]), source.flux * flux[k]) for k in (1, 2)]


def _by_parameter(source: Source, slope: Slope, through: Through) -> tuple[Any, Any]:
    """Derivatives of light and flux by one of the source's parameters."""
    fringe, flux = through
    light: Any = 0.0
    total: Any = 0.0
    if slope.flux is not None:
        light = slope.flux * (source.wave * fringe[0])
        total = slope.flux * (source.share * flux[0])
    if slope.share is not None:
        total = total + source.flux * slope.share
    if slope.wave is not None:
        light = light + source.flux * (slope.wave * fringe[0])
    if slope.place is not None and through is not OPEN:
        pulls = _by_place(source, through)
        for along, (by_light, by_total) in zip(slope.place, pulls, strict=True):
            light, total = light + along * by_light, total + along * by_total
    return light, total


def _start(samples: UVPoints) -> Place:
    """Where the axis is from a lone star."""
    return CENTRED if samples.off_axis is None else samples.off_axis.start


def _through(samples: UVPoints, place: Place | None, centre: Place, *, slopes: bool) -> Through:
    """What the extraction makes of a source's visibility and flux."""
    if samples.off_axis is None or place is None:
        return OPEN
    seen = place[0] - centre[0], place[1] - centre[1]
    if slopes:
        return samples.off_axis.with_slopes(seen)
    fringe, flux = samples.off_axis.at(seen)
    return (fringe,), (flux,)

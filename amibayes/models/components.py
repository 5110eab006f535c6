"""The binary model: a disc, point companions, over-resolved light, and the channel's width.

V = (V_A + Σ c_k E_k) / (1 + Σ c_k + f) with V_A the uniform disc of the primary,
c_k the contrast (companion/primary flux ratio), f the over-resolved background
(primary = 1) and E_k = sinc · exp(−2πi(uα + vδ)/λ), whose sinc is the average over the
channel. Of data in several bands each may have a contrast of its own, and of data of
several dates the place may move linearly. Everything is evaluated for many parameter sets
at once: points of the (u, v) plane down the rows, parameter sets across the columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from amibayes.models.off_axis import Place
from amibayes.models.uv_points import UVPoints
from amibayes.scene.disc import uniform_disc
from amibayes.support.quantities import takes_quantities
from amibayes.units import MAS, ComplexArray, FloatArray, IntArray


@takes_quantities
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

    def visibility(self, samples: UVPoints, theta: FloatArray) -> ComplexArray:
        """Complex visibilities, (n_samples, n), of parameter sets theta (n, n_dim)."""
        pairs, diameter, background = self.split(theta)
        points = [_star(disc(samples, diameter))]
        points += [self._point(samples, block) for block in pairs]
        light, total = _mixed(samples, background, points, _start(samples))
        if samples.off_axis is not None:
            centre = samples.off_axis.centre(light)
            light, total = _mixed(samples, background, points, centre)
        return np.asarray(light / total)

    def _point(self, samples: UVPoints, block: FloatArray) -> _Point:
        """A companion (width, n)."""
        place = self._place(samples, block)
        return _Point(self._contrast(samples, block), place, self.companion(samples, *place))

    def _place(self, samples: UVPoints, block: FloatArray) -> tuple[FloatArray, FloatArray]:
        """East and north of a companion (width, n): (n,), or (n_samples, n) where it moves."""
        if not self.moves:
            return block[0], block[1]
        years = samples.years(self.reference_mjd)[:, None]
        return block[0] + years * block[-2], block[1] + years * block[-1]

    def _contrast(self, samples: UVPoints, block: FloatArray) -> FloatArray:
        """Contrast of a companion (width, n): (n,), or (n_samples, n) with several bands."""
        return block[2] if self.n_contrasts == 1 else block[2 + samples.band]

    def companion(
        self, samples: UVPoints, east_mas: FloatArray, north_mas: FloatArray
    ) -> ComplexArray:
        """Visibility of a point at an offset, averaged over the channel, (n_samples, n)."""
        angle = _angle(samples, east_mas, north_mas)
        wave = np.exp(-1j * angle)
        if self.smearing:
            wave *= np.sinc(angle * (_half_band(samples) / np.pi))
        return np.asarray(wave)

    def gradient(self, samples: UVPoints, theta: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Visibilities (n_samples, n) and their derivatives (n_dim, n_samples, n)."""
        pairs, diameter, background = self.split(theta)
        primary, by_diameter = uniform_disc(samples.frequency[:, None], diameter)
        points = [_star(primary)]
        points += [self._sloping_point(samples, block) for block in pairs]
        mixed = self._mixed_slopes(samples, background, points, by_diameter, _start(samples))
        if samples.off_axis is not None:
            centre = samples.off_axis.centre(mixed.light)
            moves = samples.off_axis.centre_slopes(mixed.light, mixed.light_slopes)
            mixed = self._mixed_slopes(samples, background, points, by_diameter, centre)
            mixed = mixed.pulled(moves)
        value = np.asarray(mixed.light / mixed.total, dtype=complex)
        return value, np.asarray((mixed.light_slopes - value * mixed.total_slopes) / mixed.total)

    def _sloping_point(self, samples: UVPoints, block: FloatArray) -> _Point:
        """A companion (width, n) with the slopes of its wave by place."""
        place = self._place(samples, block)
        wave, slope = self._companion_slope(samples, *place)
        by_angle = slope * (2.0 * np.pi * MAS)
        slopes = (by_angle * samples.u[:, None], by_angle * samples.v[:, None])
        return _Point(self._contrast(samples, block), place, wave, slopes)

    def _mixed_slopes(
        self,
        samples: UVPoints,
        background: FloatArray,
        points: list[_Point],
        by_diameter: FloatArray,
        centre: Place,
    ) -> _Mixed:
        """Light and flux of star and companions, with slopes by every parameter."""
        light: Any = 0.0
        total: Any = background
        by_light: list[Any] = []
        by_total: list[Any] = []
        pulls: list[tuple[Any, Any]] = []
        through = [_let_through_slopes(samples, p.place, centre) for p in points]
        for point, (fringe, flux) in zip(points, through, strict=True):
            shine = point.contrast * point.wave
            light = light + shine * fringe[0]
            total = total + point.contrast * flux[0]
            pull = [(shine * fringe[k], point.contrast * flux[k]) for k in (1, 2)]
            pulls += pull
            if not point.wave_slopes:
                continue
            placed = [
                (point.contrast * slope * fringe[0] + p, q)
                for slope, (p, q) in zip(point.wave_slopes, pull, strict=True)
            ]
            by_light += [p for p, _ in placed] + self._by_band(samples, point.wave * fringe[0])
            by_total += [q for _, q in placed]
            by_total += self._by_band(samples, np.broadcast_to(flux[0], point.wave.shape))
            if self.moves:
                years = samples.years(self.reference_mjd)[:, None]
                by_light += [years * p for p, _ in placed]
                by_total += [years * q for _, q in placed]
        if self.diameter_mas == "free":
            by_light.append(by_diameter * through[0][0][0])
            by_total.append(0.0)
        if self.background == "free":
            by_light.append(0.0)
            by_total.append(1.0)
        return _Mixed.of(light, total, by_light, by_total, pulls)

    def _by_band(self, samples: UVPoints, by_contrast: NDArray[Any]) -> list[NDArray[Any]]:
        """Derivatives by each contrast from that by one common to all bands."""
        if self.n_contrasts == 1:
            return [by_contrast]
        which = [samples.band[:, None] == b for b in range(self.n_contrasts)]
        return [np.where(here, by_contrast, 0.0) for here in which]

    def _companion_slope(
        self, samples: UVPoints, east_mas: FloatArray, north_mas: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Visibility of a companion and its derivative by the phase angle."""
        angle = _angle(samples, east_mas, north_mas)
        wave = np.exp(-1j * angle)
        if not self.smearing:
            return wave, -1j * wave
        half = _half_band(samples)
        value, slope = _sinc(angle * half)
        return value * wave, (half * slope - 1j * value) * wave


CENTRED: Place = (np.zeros(1), np.zeros(1))
"""On the star."""


@dataclass(frozen=True, eq=False)
class _Point:
    """The star or a companion: contrast, place, wave, and slopes of a wave by place."""

    contrast: FloatArray | float
    place: Place
    wave: ComplexArray
    wave_slopes: tuple[ComplexArray, ...] = ()


@dataclass(frozen=True, eq=False)
class _Mixed:
    """Light (n_samples, n) and flux of star and companions, and their slopes.

    ``pulls`` are those by the places as the extraction sees them, from the centre of the
    image: east and north of star and companions in turn, (k, n_samples, n).
    """

    light: ComplexArray
    total: FloatArray
    light_slopes: ComplexArray
    total_slopes: FloatArray
    light_pulls: ComplexArray
    total_pulls: FloatArray

    @classmethod
    def of(
        cls,
        light: ComplexArray,
        total: FloatArray,
        by_light: list[Any],
        by_total: list[Any],
        pulls: list[tuple[Any, Any]],
    ) -> _Mixed:
        def stacked(rows: list[Any], kind: type) -> Any:
            out = np.empty((len(rows), *light.shape), dtype=kind)
            for row, values in zip(out, rows, strict=True):
                row[...] = values
            return out

        return cls(
            light,
            total,
            stacked(by_light, complex),
            stacked(by_total, float),
            stacked([p for p, _ in pulls], complex),
            stacked([q for _, q in pulls], float),
        )

    def pulled(self, moves: FloatArray) -> _Mixed:
        """Add what parameters do by moving the centre, (n_dim, 2, n_samples, n) mas each."""
        by = np.tile(moves, (1, len(self.light_pulls) // 2, 1, 1))
        return replace(
            self,
            light_slopes=self.light_slopes - np.einsum("qksn,ksn->qsn", by, self.light_pulls),
            total_slopes=self.total_slopes - np.einsum("qksn,ksn->qsn", by, self.total_pulls),
        )


def _star(disc: FloatArray) -> _Point:
    """The star itself."""
    return _Point(1.0, CENTRED, disc.astype(complex))


def _start(samples: UVPoints) -> Place:
    """Where the axis is from a lone star."""
    return CENTRED if samples.off_axis is None else samples.off_axis.start


def _mixed(
    samples: UVPoints, background: FloatArray, points: list[_Point], centre: Place
) -> tuple[ComplexArray, FloatArray]:
    """Light (n_samples, n) and flux of star and companions seen from a centre."""
    light, total = np.zeros(1, dtype=complex), background
    for point in points:
        fringe, flux = _let_through(samples, point.place, centre)
        light = light + point.contrast * (point.wave * fringe)
        total = total + point.contrast * flux
    return light, total


def _let_through(samples: UVPoints, place: Place, centre: Place) -> tuple[Any, Any]:
    """What the extraction makes of a point's visibility and flux."""
    if samples.off_axis is None:
        return 1.0, 1.0
    return samples.off_axis.at(_seen_from(centre, place))


def _let_through_slopes(samples: UVPoints, place: Place, centre: Place) -> tuple[Any, Any]:
    """Both with their derivatives by east and by north, per mas."""
    if samples.off_axis is None:
        return (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    return samples.off_axis.with_slopes(_seen_from(centre, place))


def _seen_from(centre: Place, place: Place) -> Place:
    """Places of a companion from the axis of the image instead of from the star."""
    return place[0] - centre[0], place[1] - centre[1]


def _angle(samples: UVPoints, east_mas: FloatArray, north_mas: FloatArray) -> FloatArray:
    """2π(uα + vδ), (n_samples, n), of places (n,) or of moving ones (n_samples, n)."""
    if east_mas.ndim == 2:
        u, v = samples.u[:, None] * MAS, samples.v[:, None] * MAS
        return np.asarray(2.0 * np.pi * (u * east_mas + v * north_mas))
    turns = np.outer(samples.u, east_mas * MAS) + np.outer(samples.v, north_mas * MAS)
    return 2.0 * np.pi * turns


def _half_band(samples: UVPoints) -> FloatArray:
    return 0.5 * samples.relative_band[:, None]


def _sinc(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evaluate sin(x)/x and its derivative."""
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    value = np.where(small, 1.0 - x * x / 6.0, np.sin(safe) / safe)
    slope = np.where(small, -x / 3.0, (np.cos(safe) - value) / safe)
    return value, slope


def disc(samples: UVPoints, diameter_mas: FloatArray) -> FloatArray:
    """Visibility of uniform discs, (n_samples, n)."""
    if not np.any(diameter_mas):
        return np.ones((len(samples), len(diameter_mas)))
    return uniform_disc(samples.frequency[:, None], diameter_mas)[0]

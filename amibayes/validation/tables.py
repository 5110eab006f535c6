"""Simulated OIFITS files of a star: squared visibilities and closure phases from a formula.

Written out by itself: of the package it takes the containers and the writer of files, and neither
the models nor the covariances, so that a mistake in them is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import j1

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.instrument import load_instrument
from amibayes.oifits.writer import write_oifits
from amibayes.parallel import child_seeds
from amibayes.units import MAS, FloatArray

VLTI_M = np.array([[-32.0, -48.0], [-9.9, -20.3], [44.9, -110.7], [103.3, 25.7]])
"""Stations A0, G1, J2 and K0 of the VLTI, east and north: baselines of 36 to 154 m."""

VLTI_LATITUDE, DECLINATION = np.radians([-24.63, -40.0])

N_WITHIN = 7
"""Wavelengths within a channel: the mean of their visibilities is known to 1e-4."""


@dataclass(frozen=True)
class SimulatedTable:
    """Calibrated data of a star, whose stated errors are right unless outliers are added.

    Parameters
    ----------
    array : {"niriss", "vlti"}
        F480M; or four telescopes of the VLTI in three channels of H at three hour angles.
    vis2_error, closure_error_deg : float
        Closure phases come of independent errors of the baselines' phases.
    common : float
        Share of the variance that the channels of one exposure have in common.
    outliers : float
        Share of data that err by ten times as much.
    epochs : int
        Files, on different dates with the array turned by 40 degrees from one to the next.
    companion_mas : float
        Diameter of the companion, a uniform disc.
    calibration : (float, float)
        Standard deviation of calibration errors: relative of V², and of closure phases in
        degrees. Half of the variance is an offset of the channels of an exposure, half a slope.
    field_mas : (float, float)
        Separations of the truths, and the field that is searched.
    """

    array: str = "niriss"
    vis2_error: float = 0.005
    closure_error_deg: float = 0.3
    common: float = 0.0
    outliers: float = 0.0
    epochs: int = 1
    companion_mas: float = 0.0
    calibration: tuple[float, float] = (0.0, 0.0)
    field_mas: tuple[float, float] = (50.0, 400.0)

    def write(
        self, truth: FloatArray | None, seed: np.random.SeedSequence, folder: Path
    ) -> tuple[list[Path], list[Path]]:
        """See `amibayes.validation.plan.Condition`."""
        paths = []
        for k, child in enumerate(child_seeds(seed, self.epochs)):
            rng = np.random.default_rng(child)
            exposures = [self._observed(e, truth, rng) for e in self._exposures(k)]
            paths.append(folder / f"epoch{k}.fits")
            write_oifits(paths[-1], join(exposures))
        return paths, []

    def _exposures(self, epoch: int) -> list[Observables]:
        """Sheets of one date, with the stations as they are seen from the star."""
        turn, date = np.radians(40.0 * epoch), 60000.0 + epoch
        if self.array == "niriss":
            holes = np.asarray(load_instrument("niriss", "F480M").mask.holes_m)
            return [self._sheet(_turned(holes, turn), [4.817e-6], 0.302e-6, "NIRISS", date)]
        channels = np.linspace(1.57e-6, 1.73e-6, 3)
        return [
            self._sheet(_projected(hours), channels, 0.08e-6, "PIONIER", date + hours / 24.0)
            for hours in (-2.0, 0.0, 2.0)
        ]

    def _sheet(
        self, stations: FloatArray, channels: object, band: float, name: str, mjd: float
    ) -> Observables:
        return point_source(
            stations,
            np.asarray(channels),
            band,
            vis2_error=self.vis2_error,
            closure_error_rad=np.radians(self.closure_error_deg),
            insname=name,
            mjd=mjd,
        )

    def _observed(
        self, sheet: Observables, truth: FloatArray | None, rng: np.random.Generator
    ) -> Observables:
        band = sheet.setups[0].band_m
        vis2, closure = sheet.vis2, sheet.closure_phase
        light = _visibility(vis2.u_m[:, 0], vis2.v_m[:, 0], vis2, band, truth, self.companion_mas)
        phase = np.zeros(len(closure))
        for sign, u, v in _sides(closure):
            side = _visibility(u, v, closure, band, truth, self.companion_mas)
            phase = phase + sign * np.angle(side)
        gain, drift = self._calibration_errors(sheet, rng)
        noise, of_phase = self._noise(sheet, rng)
        value = np.abs(light) ** 2 * (1.0 + gain) + noise
        angle = np.angle(np.exp(1j * (phase + drift + of_phase)))
        return replace(
            sheet,
            vis2=replace(vis2, value=value),
            closure_phase=replace(closure, value=angle),
        )

    def _noise(self, sheet: Observables, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Errors of V² and closure phases; those of baselines' phases add up to the latter."""
        n, channels = len(sheet.setups[0].stations), len(sheet.setups[0].wavelength_m)
        size = np.radians(self.closure_error_deg) / np.sqrt(3.0)
        vis2 = self.vis2_error * self._draw((n, n, channels), rng)
        phases = size * self._draw((n, n, channels), rng)
        of_vis2, of_phase = _of_baselines(sheet, vis2, phases)
        return self._spoilt(of_vis2, rng), self._spoilt(of_phase, rng)

    def _calibration_errors(
        self, sheet: Observables, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Relative errors of V², and errors of closure phases, smooth over the channels."""
        if not any(self.calibration):
            return np.zeros(len(sheet.vis2)), np.zeros(len(sheet.closure_phase))
        n, channels = len(sheet.setups[0].stations), sheet.setups[0].wavelength_m
        slope = (channels - channels.mean()) / max(channels.std(), 1e-12)
        smooth = rng.standard_normal((2, n, n, 2)) @ np.stack([np.ones_like(slope), slope])
        gains, phases = np.sqrt(0.5) * smooth
        size = np.radians(self.calibration[1]) / np.sqrt(3.0)
        return _of_baselines(sheet, self.calibration[0] * gains, size * phases)

    def _draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Normal numbers, of which the last axis shares a part."""
        shared = rng.standard_normal((*shape[:-1], 1))
        own = rng.standard_normal(shape)
        return np.asarray(np.sqrt(self.common) * shared + np.sqrt(1.0 - self.common) * own)

    def _spoilt(self, errors: FloatArray, rng: np.random.Generator) -> FloatArray:
        return np.where(rng.random(len(errors)) < self.outliers, 10.0 * errors, errors)


def _turned(stations: FloatArray, angle: float) -> FloatArray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray(stations @ np.array([[cosine, sine], [-sine, cosine]]))


def _projected(hours: float) -> FloatArray:
    """East and north coordinates on the sky of the VLTI's stations at an hour angle."""
    east, north = VLTI_M.T
    angle = np.radians(15.0 * hours)
    # Towards the hour angle 0 on the equator, towards the east, and towards the pole.
    x, y = -north * np.sin(VLTI_LATITUDE), east
    z = north * np.cos(VLTI_LATITUDE)
    u = np.sin(angle) * x + np.cos(angle) * y
    v = np.sin(DECLINATION) * (np.sin(angle) * y - np.cos(angle) * x) + np.cos(DECLINATION) * z
    return np.column_stack([u, v])


def _of_baselines(
    sheet: Observables, vis2: FloatArray, phases: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Errors of V² and closure phases from those of baselines, (n, n, n_channels) each."""
    table, triangle = sheet.vis2, sheet.closure_phase
    a, b, c = triangle.stations.T
    k = triangle.channel
    of_vis2 = vis2[table.stations[:, 0], table.stations[:, 1], table.channel]
    return of_vis2, phases[a, b, k] + phases[b, c, k] - phases[a, c, k]


def _sides(closure: Measurements) -> list[tuple[float, FloatArray, FloatArray]]:
    """The sides of triangles, with the sign of their phase: 12, 23, and 13 taken backwards."""
    (u1, u2), (v1, v2) = closure.u_m.T, closure.v_m.T
    return [(1.0, u1, v1), (1.0, u2, v2), (-1.0, u1 + u2, v1 + v2)]


def _visibility(
    u: FloatArray,
    v: FloatArray,
    table: Measurements,
    band_m: FloatArray,
    truth: FloatArray | None,
    diameter_mas: float,
) -> FloatArray:
    """Complex visibility of a point and a disc, the mean over flat channels."""
    if truth is None:
        return np.ones(len(u), dtype=complex)
    east, north, contrast = truth[0] * MAS, truth[1] * MAS, truth[2]
    offsets = (np.arange(N_WITHIN) + 0.5) / N_WITHIN - 0.5
    wavelength = table.wavelength_m[:, None] + band_m[table.channel][:, None] * offsets
    phase = -2.0 * np.pi * ((u * east + v * north)[:, None] / wavelength)
    x = np.maximum(np.pi * diameter_mas * MAS * np.hypot(u, v)[:, None] / wavelength, 1e-9)
    light = contrast * (2.0 * j1(x) / x * np.exp(1j * phase)).mean(axis=1)
    return np.asarray((1.0 + light) / (1.0 + contrast))

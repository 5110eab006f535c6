"""Photons, groups and integrations.

The brightest pixel rules the groups, the photons rule the integrations:
n_groups = floor(limit / (peak · rate · t_frame)), n_int = round(photons / (rate · n_groups ·
t_frame)) + 1. With the point-sampled peak A·Ω/λ² of holes 0.82 m wide and a frame of
0.0745 s these give all of Table 1 of Soulain et al. (2020); with the 0.07544 s that the
paper states they do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from amibayes.errors import UsageError
from amibayes.instrument import Bandpass, Channels, Instrument
from amibayes.optics import psf
from amibayes.scene.spectrum import Blackbody, Spectrum, g2v
from amibayes.simulation.detector import PRESETS, Detector
from amibayes.simulation.exposure import MAX_INTEGRATIONS
from amibayes.support.arguments import checks_arguments
from amibayes.support.options import PEAK_LIMIT_E

PAPER_TEMPERATURE_K = 5450.0
"""Temperature of the paper's G2V star."""

MAX_GROUPS = 800
"""More groups than this are not allowed in a NISRAPID ramp."""

MIN_PHOTONS = 100.0
"""With fewer the error of a closure phase, √1.5·N_holes/√N, is near a radian."""

LONGEST_S = 1e7
"""Clock time (four months) past which a plan is a slip of the pen."""

MIGRATION_E = PRESETS["realistic"].migration_threshold_e
"""Charge above which new electrons start to go to the neighbours."""


PAPER_FRAME_S = 0.0745
"""Frame time behind Table 1."""


def positive(name: str, value: float) -> float:
    """Give a finite number above zero back.

    Raises
    ------
    UsageError
        For any other, with its name.
    """
    if not 0.0 < value < math.inf:
        raise UsageError(f"{name} {value:g} is not a positive number")
    return value


@dataclass(frozen=True)
class PlanOptions:
    """Which rules a plan follows.

    Parameters
    ----------
    preset : {"default", "paper"}
        ``default``: the brightest pixel of the worst centring, as built. ``paper``: the
        top of the image, as in Table 1 of Soulain et al. (2020).
    peak_limit_e : float
        Charge that the brightest pixel may reach.
    frame_time_s : float, optional
        Time of a frame; 0.07544 s unless given, 0.0745 s for ``paper``.

    Raises
    ------
    UsageError
        Where a number or the preset makes no sense.
    """

    preset: str = "default"
    peak_limit_e: float = PEAK_LIMIT_E
    frame_time_s: float = 0.0

    def __post_init__(self) -> None:
        if self.preset not in PRESET_FRAMES_S:
            known = ", ".join(PRESET_FRAMES_S)
            raise UsageError(f"no preset '{self.preset}'", remedy=f"choose from {known}")
        positive("peak limit", self.peak_limit_e)
        frame = self.frame_time_s or PRESET_FRAMES_S[self.preset]
        object.__setattr__(self, "frame_time_s", positive("frame time", frame))


PRESET_FRAMES_S = {"default": 0.07544, "paper": PAPER_FRAME_S}

PAPER = PlanOptions("paper")
"""The rules behind Table 1 of Soulain et al. (2020)."""


@dataclass(frozen=True)
class Peaks:
    """Share of the photons that the brightest pixel gets.

    Parameters
    ----------
    point_sampled : float
        A·Ω_pixel/λ² of the collecting area A: the top of the image, taken for a pixel
        (for NIRISS with the paper's holes).
    centred, cornered : float
        Average over the brightest pixel, with the star in its middle and at its corner.
    """

    point_sampled: float
    centred: float
    cornered: float


@dataclass(frozen=True, eq=False)
class Plan:
    """An exposure.

    Parameters
    ----------
    instrument : Instrument
    options : PlanOptions
        The rules it follows.
    count_rate_e_s : float
        Electrons per second through the mask.
    photons_wanted : float or None
        None where a time was asked for.
    n_groups, n_integrations : int
    peaks : Peaks
    groups : dict
        Groups by each of the peaks: ``paper`` (point-sampled, its frame time),
        ``centred``, ``cornered``.
    warnings : tuple of str
    """

    instrument: Instrument
    options: PlanOptions
    count_rate_e_s: float
    photons_wanted: float | None
    n_groups: int
    n_integrations: int
    peaks: Peaks
    groups: dict[str, int]
    warnings: tuple[str, ...] = ()

    @property
    def integration_time_s(self) -> float:
        """Time in which one ramp collects light."""
        return self.n_groups * self.options.frame_time_s

    @property
    def total_photons(self) -> float:
        """Photons that all integrations collect."""
        return self.count_rate_e_s * self.integration_time_s * self.n_integrations

    @property
    def exposure_time_s(self) -> float:
        """Time on the clock: every ramp is followed by a frame that resets the detector."""
        return (self.n_groups + 1) * self.options.frame_time_s * self.n_integrations

    @property
    def peak_e(self) -> float:
        """Electrons in the brightest pixel at the end of a ramp, star in its middle."""
        return self.peaks.centred * self.count_rate_e_s * self.integration_time_s


@checks_arguments
def make_plan(
    instrument: Instrument,
    *,
    magnitude: float | None = None,
    count_rate_e_s: float | None = None,
    photons: float | None = None,
    time_s: float | None = None,
    options: PlanOptions | None = None,
    detector: Detector | None = None,
) -> Plan:
    """Plan an exposure.

    Parameters
    ----------
    instrument : Instrument
        Mask, filter and pixel scale; `Instrument.as_built` for the telescope's own.
    magnitude, count_rate_e_s : float
        One of them: Vega magnitude in the filter, or electrons per second.
    photons, time_s : float
        One of them: photons to collect, or time on the clock.
    options : PlanOptions, optional
        Rules; as built and pixel-integrated unless given.
    detector : Detector, optional
        For its full well.

    Returns
    -------
    Plan

    Raises
    ------
    UsageError
        Where a number makes no sense, two groups saturate, or no exposure would be so long
        or so short.
    """
    rules = options or PlanOptions()
    rate = _rate(instrument, magnitude, count_rate_e_s)
    peaks = peak_fractions(instrument)
    groups = _groups(peaks, rate, rules)
    full_well = (detector or PRESETS["paper"]).full_well_e
    _refuse_saturated(peaks.centred * rate * rules.frame_time_s, full_well)
    wanted = groups["paper" if rules.preset == "paper" else "centred"]
    n_groups = min(max(wanted, 2), MAX_GROUPS)
    n = integrations(rate, n_groups, rules, photons=photons, time_s=time_s)
    plan = Plan(instrument, rules, rate, photons, n_groups, n, peaks, groups)
    return replace(plan, warnings=tuple(_warnings(plan, wanted, full_well)))


def integrations(
    rate: float,
    n_groups: int,
    rules: PlanOptions,
    *,
    photons: float | None = None,
    time_s: float | None = None,
) -> int:
    """Integrations for so many photons, or those that fit into so much time.

    Raises
    ------
    UsageError
        Where no exposure would be so long or so short.
    """
    if (photons is None) == (time_s is None):
        raise UsageError("give either the photons or the time")
    clock = (n_groups + 1) * rules.frame_time_s
    if photons is not None:
        _refuse_dark(positive("photons", photons))
        n = integrations_for(photons, rate, n_groups, rules.frame_time_s)
    else:
        assert time_s is not None
        n = math.floor(positive("time", time_s) / clock)
    if n == 0:
        raise UsageError(
            f"{time_s:g} s do not hold one integration: a ramp of {n_groups} groups and its reset "
            f"take {clock:.3g} s"
        )
    if n * clock > LONGEST_S:
        raise UsageError(
            f"that exposure takes {n * clock / 86400.0:.3g} days",
            remedy=f"a brighter star, fewer photons, or less than {LONGEST_S:.0e} s",
        )
    return n


def _refuse_dark(photons: float) -> None:
    if photons < MIN_PHOTONS:
        raise UsageError(
            f"{photons:g} photons carry no closure phase", remedy=f"at least {MIN_PHOTONS:g}"
        )


def integrations_for(photons: float, rate: float, n_groups: int, frame_time_s: float) -> int:
    """Integrations that collect so many photons, by the rule behind Table 1."""
    return round(photons / (rate * n_groups * frame_time_s)) + 1


def published_rate(instrument: Instrument, magnitude: float) -> float | None:
    """Electrons per second of a G2V star; None where the instrument's file has none."""
    known = instrument.planning
    if known is None or instrument.bandpass.name not in known.rates_e_s:
        return None
    fainter = magnitude - known.magnitude
    return known.rates_e_s[instrument.bandpass.name] * float(10.0 ** (-0.4 * fainter))


def _rate(instrument: Instrument, magnitude: float | None, rate: float | None) -> float:
    if (magnitude is None) == (rate is None):
        raise UsageError("give either the magnitude or the count rate")
    if rate is not None:
        return positive("count rate", rate)
    assert magnitude is not None
    if not -30.0 < magnitude < 40.0:
        raise UsageError(f"a magnitude of {magnitude:g} is not one of a star")
    known = published_rate(instrument, magnitude)
    if known is not None:
        return known
    return instrument.count_rate(sun_like(instrument.bandpass), magnitude)


def sun_like(bandpass: Bandpass) -> Spectrum:
    """Spectrum of a G2V star, a blackbody where its table does not reach."""
    table = g2v()
    low, high = bandpass.wavelength_m[[0, -1]]
    inside = table.wavelength_m[0] <= low and high <= table.wavelength_m[-1]
    return table if inside else Blackbody(PAPER_TEMPERATURE_K)


def star_channels(instrument: Instrument) -> Channels:
    """Wavelengths that stand for the filter, for the planned star."""
    return instrument.bandpass.channels(sun_like(instrument.bandpass), 5)


def peak_fractions(instrument: Instrument) -> Peaks:
    """Share of the photons in the brightest pixel, by each way of counting."""
    channels = star_channels(instrument)
    middle, corner = (
        float(psf(instrument, channels, 4, centre_px=(offset, offset)).max())
        for offset in (0.5, 0.0)
    )
    known = instrument.planning
    scale = 1.0 if known is None else (known.hole_m / instrument.mask.size_m) ** 2
    # the top of |Σ_k A_k|² / (λ² Σ_k A_k), of holes as they are drawn
    drawn = instrument.mask.area_m2 / abs(float(np.linalg.det(instrument.mask.hole_map)))
    top = drawn * scale / instrument.bandpass.pivot_m**2
    return Peaks(top * instrument.pixel_scale_rad**2, middle, corner)


def _groups(peaks: Peaks, rate: float, rules: PlanOptions) -> dict[str, int]:
    paper_frame = rules.frame_time_s if rules.preset == "paper" else PAPER_FRAME_S
    per_frame = {
        "paper": peaks.point_sampled * rate * paper_frame,
        "centred": peaks.centred * rate * rules.frame_time_s,
        "cornered": peaks.cornered * rate * rules.frame_time_s,
    }
    return {name: math.floor(rules.peak_limit_e / e) for name, e in per_frame.items()}


def _refuse_saturated(per_frame: float, full_well_e: float) -> None:
    if 2.0 * per_frame > full_well_e:
        raise UsageError(
            f"the star saturates: a slope needs 2 groups, which collect {2.0 * per_frame:.0f} "
            f"electrons in the brightest pixel, and {full_well_e:.0f} fill it",
            remedy="a fainter star or a narrower filter",
        )


def _warnings(plan: Plan, wanted: int, full_well_e: float) -> list[str]:
    found = []
    limit = plan.options.peak_limit_e
    if wanted < 2:
        found.append(f"a slope needs 2 groups, which exceed {limit:.0f} e-")
    if wanted > MAX_GROUPS:
        found.append(f"{wanted} groups would fit; a ramp has {MAX_GROUPS} at most")
    if plan.n_integrations > MAX_INTEGRATIONS:
        found.append(
            f"{plan.n_integrations} integrations do not fit in one exposure, "
            f"which takes {MAX_INTEGRATIONS}"
        )
    if plan.peak_e > full_well_e:
        found.append(f"the brightest pixel saturates: {plan.peak_e:.0f} of {full_well_e:.0f} e-")
    elif plan.peak_e > MIGRATION_E:
        found.append(
            f"the brightest pixel reaches {plan.peak_e:.0f} e-: above {MIGRATION_E:.0f} e- "
            "charge migrates to its neighbours (about 1 %)"
        )
    return found + _departure(plan)


def _departure(plan: Plan) -> list[str]:
    """Say where the frame time that the paper states gives other numbers than its table."""
    if plan.options.preset != "paper" or plan.photons_wanted is None:
        return []
    stated, rate = PRESET_FRAMES_S["default"], plan.count_rate_e_s
    groups = math.floor(plan.options.peak_limit_e / (plan.peaks.point_sampled * rate * stated))
    n = integrations_for(plan.photons_wanted, rate, max(groups, 2), stated)
    if (groups, n) == (plan.n_groups, plan.n_integrations):
        return []
    return [
        f"Table 1 rests on frames of {plan.options.frame_time_s:g} s; the {stated:g} s that the "
        f"paper states would give {groups} groups and {n} integrations"
    ]

"""A night's programme from a TOML file: the target and its calibrators, dithers and rolls."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from amibayes.errors import DataError, UsageError
from amibayes.instrument import Instrument, load_instrument
from amibayes.optics import PupilMap, Wavefront
from amibayes.parallel import child_seeds
from amibayes.scene.file import read_image, scene_from
from amibayes.scene.orientation import Orientation
from amibayes.scene.sources import Scene
from amibayes.simulation.budget import LONGEST_S, PlanOptions, integrations, make_plan
from amibayes.simulation.detector import Detector, DetectorMaps, detector_preset, draw_maps
from amibayes.simulation.exposure import Exposure, refuse_too_many
from amibayes.simulation.observation import Observation, star_rate
from amibayes.simulation.observe import PreparedExposure, prepare_exposure
from amibayes.simulation.wavefront import WAVEFRONT_PRESETS, WavefrontErrors
from amibayes.support.toml import Section, read_toml
from amibayes.units import DEGREE, MAS

PHOTONS = 1e7
"""Photons of an exposure where the file does not say."""

MAX_POINTING_MAS = 1000.0
"""Jitter or dither past this would leave the star out of most images."""

MAX_PIXELS = 2048
"""Side of the largest image: the detector's own."""

BETWEEN_S = 300.0
"""Time from the end of an exposure to the start of the next."""

MASK_MAPS = ("drawn", "as built")
"""The mask of the instrument's drawing, or under its affine map (`Instrument.as_built`)."""

SCENE_TABLES = ("name", "star", "companion", "disc", "gaussian", "ring", "image")


@dataclass(frozen=True)
class Overrides:
    """What the command line says in place of the file."""

    filter: str | None = None
    photons: float | None = None
    ramps: bool = False


@dataclass(frozen=True, eq=False)
class ExposureSpec:
    """One exposure of a programme; the name is that of its file."""

    name: str
    observation: Observation
    errors: WavefrontErrors

    @property
    def file_name(self) -> str:
        """``…_calints.fits``."""
        return f"{self.name}_calints.fits"


@dataclass(frozen=True, eq=False)
class Program:
    """All exposures of a file.

    Parameters
    ----------
    specs : tuple of ExposureSpec
        Target first.
    text : str
        The file itself.
    """

    specs: tuple[ExposureSpec, ...]
    text: str

    @property
    def keeps_ramps(self) -> bool:
        """Whether the reads are written as well."""
        return self.specs[0].observation.exposure.keep_ramps

    @property
    def history(self) -> tuple[str, ...]:
        """The file without its comments, line by line, as a FITS header can hold it."""
        lines = [_without_comment(line) for line in self.text.expandtabs(4).splitlines()]
        return tuple(line.encode("ascii", "replace").decode() for line in lines if line)

    def prepared_exposures(self, seed: int) -> Iterator[tuple[ExposureSpec, PreparedExposure]]:
        """Open each exposure in turn: one detector and one telescope for all of them.

        Parameters
        ----------
        seed : int
            Of all random numbers.

        Yields
        ------
        ExposureSpec, PreparedExposure
        """
        of_maps, of_shared, of_specs = child_seeds(np.random.SeedSequence(seed), 3)
        seeds = child_seeds(of_specs, len(self.specs))
        for spec, child in zip(self.specs, seeds, strict=True):
            of_drift, of_exposure = child_seeds(child, 2)
            wavefront = _wavefront(spec, of_shared, of_drift)
            notes = spec.observation.notes | {"SEED": seed}
            observation = replace(spec.observation, wavefront=wavefront, notes=notes)
            yield spec, prepare_exposure(observation, of_exposure, _maps(spec, of_maps))


def _without_comment(line: str) -> str:
    """Cut a comment off, unless quotes make it doubtful where it begins."""
    return re.sub(r"""(^|\s)#[^"']*$""", "", line).rstrip()


def _maps(spec: ExposureSpec, seed: np.random.SeedSequence) -> DetectorMaps:
    n = spec.observation.exposure.n_pixels
    return draw_maps(spec.observation.detector, (n, n), np.random.default_rng(seed))


def _wavefront(
    spec: ExposureSpec, shared: np.random.SeedSequence, drift: np.random.SeedSequence
) -> Wavefront:
    n_holes = spec.observation.instrument.mask.n_holes
    return spec.errors.drifted(spec.errors.shared(n_holes, shared), n_holes, drift)


def example() -> str:
    """A documented file whose defaults just work."""
    return (resources.files("amibayes.simulation") / "data" / "example.toml").read_text("utf-8")


def read_program(path: str | Path, overrides: Overrides | None = None) -> Program:
    """Read what to observe, and how.

    Parameters
    ----------
    path : path
        TOML file; `example` is one, with every key explained.
    overrides : Overrides, optional
        What holds in place of the file.

    Returns
    -------
    Program

    Raises
    ------
    DataError
        Where the file is wrong: it names the key and the fault.
    UsageError
        Where the overrides ask for a filter that there is not.
    """
    top = read_toml(path)
    with naming_source(str(path)):
        reader = _Reader(top, overrides or Overrides())
        stars = [reader.star(top, is_calibrator=False)]
        for number, section in enumerate(top.sections("calibrator"), 1):
            stars.append(reader.star(section, is_calibrator=True, number=number))
        reader.refuse_unknown()
        specs = _scheduled([spec for star in stars for spec in star])
    return Program(specs, Path(path).read_text("utf-8"))


@contextmanager
def naming_source(source: str, kind: type[DataError | UsageError] = DataError) -> Iterator[None]:
    """Name the file or option in errors that do not know it: what it asks for is its own fault."""
    try:
        yield
    except (DataError, UsageError) as error:
        if error.source is not None:
            raise
        raise kind(error.what, source=source, remedy=error.remedy) from error


class _Reader:
    """Reads the tables that all stars of a programme share."""

    def __init__(self, top: Section, overrides: Overrides) -> None:
        self.top = top
        self.overrides = overrides
        self.exposure, self.detector_table, self.wavefront_table, instrument = (
            top.section(key) if key in top else Section({}, top.source, key)
            for key in ("exposure", "detector", "wavefront", "instrument")
        )
        self.instrument_name = instrument.text("name", "niriss")
        named = instrument.text("filter", _star_filter(top))
        self.filter = overrides.filter or named
        self.preset = self.detector_table.text("preset", "paper")
        # The paper's mask is perfect; what is realistic has the telescope's.
        usual = MASK_MAPS[self.preset != "paper"]
        mask_map = instrument.text("mask_map", usual, choices=MASK_MAPS)
        instrument.refuse_unknown()
        beside = Path(top.source).parent / self.instrument_name
        source = str(beside) if beside.is_file() else self.instrument_name
        self.source = source
        drawn = self._loaded()
        self.instrument = drawn if mask_map == "drawn" else drawn.as_built()
        self.detector = _detector(self.detector_table, self.preset)
        self.errors = _errors(self.wavefront_table, self.preset)

    def _loaded(self) -> Instrument:
        """Load the instrument; who named an unknown filter is told so."""
        try:
            return load_instrument(self.source, self.filter or None)
        except UsageError as error:
            what = f"{self.instrument_name} {error.what}" if self.filter else error.what
            if self.overrides.filter:
                raise UsageError(what, source="--filter", remedy=error.remedy) from error
            raise DataError(what, source=self.top.source, remedy=error.remedy) from error

    def star(self, section: Section, *, is_calibrator: bool, number: int = 0) -> list[ExposureSpec]:
        """Give the exposures of the target or of a calibrator."""
        scene = scene_from(section)
        name = section.text("name", f"calibrator_{number}") if is_calibrator else scene.name
        own = section if is_calibrator else self.exposure
        rate = self._rate(own, scene)
        errors = self.errors
        if is_calibrator:
            drift = section.number("drift_nm", errors.piston_drift_m * 1e9, at_least=0.0) * 1e-9
            errors = replace(errors, piston_drift_m=drift)
        observation = Observation(
            replace(scene, name=name),
            self.instrument,
            self._exposure(own, rate * scene.flux),
            self.detector,
            count_rate_e_s=rate,
            n_wavelengths=self.exposure.whole("n_wavelengths", 9, at_least=1),
            start_mjd=self.exposure.number("start_mjd", 60000.0, at_least=0.0),
            notes={"IS_PSF": is_calibrator},
        )
        if is_calibrator:
            section.refuse_unknown(SCENE_TABLES)
        return self._dithered(_slug(name), observation, errors)

    def refuse_unknown(self) -> None:
        """Refuse keys that nobody read."""
        for section in (self.exposure, self.detector_table, self.wavefront_table):
            section.refuse_unknown()
        self.top.refuse_unknown(("instrument", "exposure", "detector", "wavefront", *SCENE_TABLES))

    def _rate(self, own: Section, scene: Scene) -> float:
        if "count_rate" in own:
            return own.number("count_rate", above=0.0)
        own.number("count_rate", 1.0)
        return star_rate(scene, self.instrument, self.source)

    def _exposure(self, own: Section, rate: float) -> Exposure:
        table = self.exposure
        photons = own.number("photons", table.number("photons", PHOTONS, above=0.0), above=0.0)
        rules = self._options(table.number("peak_limit_e", 30000.0, above=0.0))
        n_groups, n_integrations = (_count(own, table, k) for k in ("n_groups", "n_integrations"))
        if n_groups is None:
            n_groups = self._groups(rate, rules)
        if self.overrides.photons is not None:
            with naming_source("--photons", UsageError):
                n_integrations = integrations(
                    rate, max(n_groups, 1), rules, photons=self.overrides.photons
                )
                refuse_too_many(n_integrations)
        elif n_integrations is None:
            n_integrations = integrations(rate, max(n_groups, 1), rules, photons=photons)
        return Exposure(
            n_groups,
            n_integrations,
            jitter_rad=_pointing(table, "jitter_mas", 7.0),
            dither_rad=_pointing(table, "dither_mas", 15.0),
            n_pixels=table.whole("n_pixels", 80, at_least=8, at_most=MAX_PIXELS),
            keep_ramps=table.flag("ramps", False) or self.overrides.ramps,
            frame_jitter_rad=_pointing(table, "frame_jitter_mas", 0.0),
        )

    def _options(self, limit: float) -> PlanOptions:
        if self.preset == "paper":
            return PlanOptions("paper", peak_limit_e=limit)
        return PlanOptions(peak_limit_e=limit, frame_time_s=self.detector.frame_time_s)

    def _groups(self, rate: float, rules: PlanOptions) -> int:
        """Groups that the brightest pixel allows, however long the exposure is."""
        plan = make_plan(
            self.instrument,
            count_rate_e_s=rate,
            time_s=LONGEST_S,
            options=rules,
            detector=self.detector,
        )
        return plan.n_groups

    def _dithered(
        self, name: str, observation: Observation, errors: WavefrontErrors
    ) -> list[ExposureSpec]:
        """Repeat an exposure at every roll and dither."""
        dithers = self.exposure.whole("dithers", 1, at_least=1)
        rolls = self.exposure.numbers("roll_deg") if "roll_deg" in self.exposure else np.zeros(1)
        self.exposure.refuse_unknown(("roll_deg", "n_groups", "n_integrations", "count_rate"))
        angles = np.repeat(rolls, dithers) * DEGREE
        names = [name] if len(angles) == 1 else [f"{name}_{k + 1}" for k in range(len(angles))]
        return [
            ExposureSpec(label, replace(observation, orientation=Orientation(float(angle))), errors)
            for label, angle in zip(names, angles, strict=True)
        ]


def _star_filter(top: Section) -> str:
    """Filter of the star's magnitude, which is observed in unless another is named."""
    star = top.section("star")
    return star.text("filter") if "filter" in star else ""


def _count(own: Section, table: Section, key: str) -> int | None:
    for section in (own, table):
        if key in section:
            return section.whole(key, at_least=1)
    return None


def _detector(table: Section, preset: str) -> Detector:
    standard = detector_preset(preset)
    changes: dict[str, Any] = {}
    for entry in fields(Detector):
        usual = getattr(standard, entry.name)
        if isinstance(usual, bool):
            changes[entry.name] = table.flag(entry.name, usual)
        else:
            changes[entry.name] = table.number(entry.name, usual)
    return replace(standard, **changes)


def _errors(table: Section, preset: str) -> WavefrontErrors:
    usual = WAVEFRONT_PRESETS[preset]
    return WavefrontErrors(
        table.number("piston_nm", usual.piston_m * 1e9, at_least=0.0) * 1e-9,
        table.number("tilt_mas", usual.tilt_rad / MAS, at_least=0.0) * MAS,
        table.number("drift_nm", usual.piston_drift_m * 1e9, at_least=0.0) * 1e-9,
        table.number("tilt_drift_mas", usual.tilt_drift_rad / MAS, at_least=0.0) * MAS,
        _pupil_map(table),
    )


def _pupil_map(table: Section) -> PupilMap | None:
    if "map" not in table:
        return None
    opd_m, _ = read_image(Path(table.source).parent / table.text("map"))
    return PupilMap(opd_m, table.number("map_width_m", above=0.0))


def _slug(name: str) -> str:
    """Turn a star's name into a file's."""
    return re.sub(r"[^A-Za-z0-9+.-]+", "_", name).strip("_.") or "star"


def _scheduled(specs: list[ExposureSpec]) -> tuple[ExposureSpec, ...]:
    """Put the exposures one after the other.

    Raises
    ------
    DataError
        Where two have one name, so that their files would collide.
    """
    names = [spec.name for spec in specs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise DataError(f"two stars are called '{twice}'", remedy="give each a name of its own")
    start = specs[0].observation.start_mjd
    timed = []
    for spec in specs:
        timed.append(replace(spec, observation=replace(spec.observation, start_mjd=start)))
        exposure, frame = spec.observation.exposure, spec.observation.detector.frame_time_s
        duration = exposure.n_integrations * (exposure.n_groups + 1) * frame
        start += (duration + BETWEEN_S) / 86400.0
    return tuple(timed)


def _pointing(table: Section, key: str, default_mas: float) -> float:
    """Rms of the pointing along an axis, radians."""
    return MAS * table.number(key, default_mas, at_least=0.0, at_most=MAX_POINTING_MAS)

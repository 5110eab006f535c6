"""Instruments by name, or from a user's own TOML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from astropy import constants

from amibayes.errors import DataError, UsageError
from amibayes.instrument.bandpass import Bandpass
from amibayes.instrument.header_rules import HeaderRules, rules_of
from amibayes.instrument.mask import SHAPES, Mask
from amibayes.scene.spectrum import Spectrum
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Shown
from amibayes.support.toml import Section, read_toml
from amibayes.units import DEGREE, MAS, FloatArray, read_only

_JANSKY = 1e-26

MAX_DISTORTION = 0.2
"""A mask whose area is changed by more belongs into another file."""

_PLANCK = float(constants.h.value)


@dataclass(frozen=True, eq=False)
class Distortion:
    """What is known before of the affine map from the mask's drawing to the mask in images.

    Parameters
    ----------
    matrix : (2, 2) array
        Times x and y of the drawing.
    error : float
        Standard deviation of each of the four numbers.
    """

    matrix: FloatArray = field(default_factory=lambda: np.eye(2))
    error: float = 0.01

    def __post_init__(self) -> None:
        read_only(self, "matrix")


@dataclass(frozen=True)
class ChargeMigration:
    """What is known before of charge that passes between pixels (`amibayes.ramps`).

    Parameters
    ----------
    per_e : float
        Displacement of the side between two pixels per electron by which their charges
        differ, pixels.
    error : float
        Its standard deviation.
    """

    per_e: float
    error: float


@dataclass(frozen=True)
class Planning:
    """Published count rates that exposures are planned with.

    Parameters
    ----------
    magnitude : float
        Vega magnitude of the star.
    hole_m : float
        Size of a hole behind the published peaks.
    rates_e_s : mapping of str to float
        By filter.
    """

    magnitude: float
    hole_m: float
    rates_e_s: Mapping[str, float]


@dataclass(frozen=True, eq=False, repr=False)
class Instrument(Shown):
    """A mask, a filter and a detector's pixel scale.

    Parameters
    ----------
    name : str
        What it is called.
    mask : Mask
        The aperture mask.
    bandpass : Bandpass
        The filter in use.
    pixel_scale_rad : float
        Angle of a pixel, radians.
    n_pixels : int
        Side of the usual subarray.
    header : HeaderRules
    planning : Planning, optional
    distortion : Distortion
    charge_migration : ChargeMigration, optional
    """

    name: str
    mask: Mask
    bandpass: Bandpass
    pixel_scale_rad: float
    n_pixels: int = 80
    header: HeaderRules = field(default_factory=HeaderRules)
    planning: Planning | None = None
    distortion: Distortion = field(default_factory=Distortion)
    charge_migration: ChargeMigration | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.pixel_scale_rad < 1.0:
            raise DataError(f"instrument {self.name} has a pixel of {self.pixel_scale_rad:g} rad")

    @property
    def resolution_rad(self) -> float:
        """λ/2B of the longest baseline at the pivot wavelength, radians."""
        return 0.5 * self.bandpass.pivot_m / self.mask.longest_m

    @property
    def field_rad(self) -> float:
        """λ/B of the shortest baseline, the widest separation free of ambiguity, radians."""
        return self.bandpass.pivot_m / self.mask.shortest_m

    def splodges_px(self, n_pixels: int) -> FloatArray:
        """Place of each baseline's splodge in the Fourier transform of an image.

        Returns
        -------
        (n_baselines, 2) array
            Offsets (x, y) from zero frequency, in cells of an ``n_pixels``-wide transform.
        """
        cell = self.pixel_scale_rad * n_pixels / self.bandpass.pivot_m
        return np.asarray(self.mask.uv_m * cell)

    def count_rate(
        self, spectrum: Spectrum, magnitude: float, reference: Bandpass | None = None
    ) -> float:
        """Electrons per second of a star through all holes.

        Parameters
        ----------
        spectrum : Spectrum
            Shape of the star's spectrum.
        magnitude : float
            Vega magnitude in the filter ``reference``.
        reference : Bandpass, optional
            Filter in which the magnitude is; this instrument's own unless given.

        Raises
        ------
        UsageError
            Where the reference filter has no zero point.
        """
        band = reference or self.bandpass
        if band.vega_flux_jy is None:
            raise UsageError(
                f"filter {band.name} of {self.name} has no zero point",
                remedy="give 'vega_flux_jy' in the instrument's TOML, or a count rate",
            )
        vega = band.vega_flux_jy * _JANSKY / _PLANCK * band.photon_integral(_FlatInFrequency())
        colour = self.bandpass.photon_integral(spectrum) / band.photon_integral(spectrum)
        return float(self.mask.area_m2 * 10.0 ** (-0.4 * magnitude) * vega * colour)

    def with_mask(self, mask: Mask) -> Instrument:
        """Return the same instrument behind another mask."""
        return replace(self, mask=mask)

    def as_built(self) -> Instrument:
        """Return it with the mask where the telescope's images show it: mapped by `distortion`.

        The distortion that is left is none: what is mapped once is not mapped again.
        """
        left = replace(self.distortion, matrix=np.eye(2))
        return replace(self, mask=self.mask.mapped(self.distortion.matrix), distortion=left)


@dataclass(frozen=True, eq=False)
class _FlatInFrequency:
    """Constant F_ν: 1/λ photons per unit of wavelength."""

    name: str = "flat in frequency"

    def photon_density(self, wavelength_m: FloatArray) -> FloatArray:
        return np.asarray(1.0 / wavelength_m)


def instrument_names() -> list[str]:
    """Names of the instruments that come with the package."""
    return list(_own_files())


def recognised(header: Mapping[str, Any], source: str) -> tuple[str, HeaderRules]:
    """Find the instrument of a header among those of the package, by the rules of their files.

    Returns
    -------
    str
        INSTRUME as it is, or the name of the file where INSTRUME alone does not name it;
        empty where there is none.
    HeaderRules
        None in particular where the package does not know the instrument.

    Raises
    ------
    DataError
        Where an arm or a mask of a known instrument is another one.
    """
    stated = str(header.get("INSTRUME") or "").strip()
    for name, rules in _all_rules().items():
        if rules.describes(header, name):
            return stated if stated.lower() == name else name.upper(), rules
    for name, rules in _all_rules().items():
        if rules.shares_instrume(header, name):
            key = rules.arm_keyword
            raise DataError(
                f"is of {stated} with {key} {header.get(key)}, which is not known",
                source=source,
                remedy="give --instrument",
            )
    return stated, HeaderRules()


@cache
def _all_rules() -> dict[str, HeaderRules]:
    """Rules of the package's own instruments, by the names of their files."""
    return {name: _own_rules(name) for name in instrument_names()}


def header_rules(name: str) -> HeaderRules:
    """Rules of an instrument by name or file; none where the package does not know it."""
    if name.lower() in instrument_names():
        return _own_rules(name.lower())
    return _rules_in(_path(name)) if name.endswith(".toml") else HeaderRules()


@cache
def _own_rules(name: str) -> HeaderRules:
    """Rules of one of the package's own instruments: each cube asks for them several times."""
    return _rules_in(_path(name))


def _rules_in(path: Path) -> HeaderRules:
    top = read_toml(path)
    return rules_of(top.section("header")) if "header" in top else HeaderRules()


@checks_arguments
def load_instrument(name: str | Path, filter: str | None = None) -> Instrument:
    """Load an instrument that comes with the package, or from a TOML file.

    Parameters
    ----------
    name : str or path
        ``"niriss"``, ``"sphere"``, ``"sphere_ifs"``, ``"gpi"``, ``"visir"``, ``"vampires"``,
        ``"vampires_sam7"``, or the path of a TOML file (the files in
        ``amibayes/instrument/data`` are examples).
    filter : str, optional
        Name of the filter; may be left out where the instrument has only one.

    Raises
    ------
    UsageError
        Where no such instrument is known, or the filter is not among its own.
    DataError
        Where the file is wrong: it names the key and the fault.
    """
    path = _path(name)
    own = path in _own_files().values()
    return (_remembered if own else _loaded)(path, filter)


def _loaded(path: Path, filter: str | None) -> Instrument:
    top = read_toml(path)
    filters = top.section("filters")
    chosen = _choose(filters, filter)
    instrument = Instrument(
        name=top.text("name"),
        mask=_mask(top.section("mask")),
        bandpass=_bandpass(chosen, filters.section(chosen)),
        pixel_scale_rad=top.number("pixel_scale_mas", above=0.0) * MAS,
        n_pixels=int(top.number("n_pixels", 80, at_least=2)),
        header=rules_of(top.section("header")) if "header" in top else HeaderRules(),
        planning=_planning(top.section("planning")) if "planning" in top else None,
        distortion=_distortion(top.section("distortion")) if "distortion" in top else Distortion(),
        charge_migration=_migration(top),
    )
    top.refuse_unknown(("source", "note"))
    return instrument


_remembered = lru_cache(maxsize=32)(_loaded)
"""The package's own files do not change; a cube asks for its instrument several times."""


@cache
def _own_files() -> dict[str, Path]:
    """Files of the package's own instruments by name: each cube asks for them several times."""
    folder = Path(str(resources.files("amibayes.instrument") / "data"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def _path(name: str | Path) -> Path:
    text = str(name)
    if text.lower() in _own_files():
        return _own_files()[text.lower()]
    if Path(text).suffix != ".toml" and not Path(text).exists():
        known = ", ".join(instrument_names())
        raise UsageError(
            f"instrument '{text}' is not known", remedy=f"choose from {known}, or give a TOML file"
        )
    return Path(text)


def _choose(filters: Section, wanted: str | None) -> str:
    names = filters.keys()
    if not names:
        raise DataError("holds no filter", source=filters.source, remedy="add [filters.NAME]")
    if wanted is None and len(names) == 1:
        return names[0]
    match = [name for name in names if wanted is not None and name.lower() == wanted.lower()]
    if not match:
        what = "needs a filter" if wanted is None else f"has no filter '{wanted}'"
        raise UsageError(what, source=filters.source, remedy=f"choose from {', '.join(names)}")
    return match[0]


def _distortion(section: Section) -> Distortion:
    matrix = section.numbers("matrix", columns=2)
    if matrix.shape != (2, 2) or abs(np.linalg.det(matrix) - 1.0) > MAX_DISTORTION:
        raise section.fault("matrix", "is not two rows of two numbers, nearly the unit matrix")
    found = Distortion(matrix, section.number("error", above=0.0))
    section.refuse_unknown(("source", "note"))
    return found


def _migration(top: Section) -> ChargeMigration | None:
    if "charge_migration" not in top:
        return None
    section = top.section("charge_migration")
    found = ChargeMigration(section.number("per_e"), section.number("error", above=0.0))
    section.refuse_unknown(("source", "note"))
    return found


def _planning(section: Section) -> Planning:
    rates = section.section("rates_e_s")
    found = Planning(
        section.number("magnitude"),
        section.number("hole_m", above=0.0),
        MappingProxyType({name: rates.number(name, above=0.0) for name in rates.keys()}),  # noqa: SIM118
    )
    section.refuse_unknown(("source", "note"))
    return found


def _mask(section: Section) -> Mask:
    scale = section.number("scale", 1.0, above=0.0)
    arguments = {
        "name": section.text("name"),
        "holes_m": scale * section.numbers("holes_m", columns=2),
        "shape": section.text("shape", choices=SHAPES),
        "size_m": scale * section.number("size_m", above=0.0),
        "orientation_rad": section.number("orientation_deg", 0.0) * DEGREE,
    }
    section.refuse_unknown(("source", "note"))
    return _build(Mask, section, arguments)


def _bandpass(name: str, section: Section) -> Bandpass:
    vega = section.number("vega_flux_jy", above=0.0) if "vega_flux_jy" in section else None
    arguments = {
        "name": name,
        "wavelength_m": 1e-6 * section.numbers("wavelength_um"),
        "throughput": section.numbers("throughput"),
        "vega_flux_jy": vega,
    }
    section.refuse_unknown(("source", "note"))
    return _build(Bandpass, section, arguments)


_Container = TypeVar("_Container")


def _build(kind: type[_Container], section: Section, arguments: dict[str, Any]) -> _Container:
    """Make the container; a fault that it finds is one of the file."""
    try:
        return kind(**arguments)
    except DataError as error:
        raise DataError(f"table [{section.name}]: {error.what}", source=section.source) from None

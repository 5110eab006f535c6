"""TUNIT strings as files write them, turned into SI and radians."""

from __future__ import annotations

from amibayes.units import DEGREE, MAS

_LENGTH = {
    "m meter meters metre metres": 1.0,
    "um micron microns mum micrometer micrometers micrometre µm μm": 1e-6,
    "nm nanometer nanometers nanometre": 1e-9,
    "angstrom angstroms a": 1e-10,
    "cm centimeter": 1e-2,
    "mm millimeter": 1e-3,
    "km kilometer": 1e3,
}
_ANGLE = {
    "deg degree degrees": DEGREE,
    "rad radian radians": 1.0,
    "mrad milliradian": 1e-3,
    "arcmin": DEGREE / 60,
    "arcsec": MAS * 1e3,
    "mas": MAS,
}
_TIME = {
    "s sec second seconds": 1.0,
    "ms": 1e-3,
    "min minute minutes": 60.0,
    "h hour hours hr": 3600.0,
    "d day days": 86400.0,
}
_FREQUENCY = {
    "lambda wavelength wavelengths rad-1 rad^-1 1/rad cycles/rad cycle/rad": 1.0,
    "klambda kilolambda 1e3lambda": 1e3,
    "mlambda megalambda 1e6lambda": 1e6,
    "glambda gigalambda 1e9lambda": 1e9,
    "arcsec-1 arcsec^-1 1/arcsec cycles/arcsec cycle/arcsec": 1.0 / (MAS * 1e3),
    "mas-1 mas^-1 1/mas cycles/mas": 1.0 / MAS,
}


def _spelled_out(scales: dict[str, float]) -> dict[str, float]:
    return {name: scale for names, scale in scales.items() for name in names.split()}


LENGTH, ANGLE, TIME = _spelled_out(_LENGTH), _spelled_out(_ANGLE), _spelled_out(_TIME)

FREQUENCY = _spelled_out(_FREQUENCY)
"""Baselines as numbers of wavelengths, per radian; small letters, so that m is mega here."""


def scale_of(unit: str, known: dict[str, float], default: str) -> tuple[float, bool]:
    """(factor to SI or radians, whether the unit was understood); absent means ``default``."""
    name = unit.strip().lower() or default
    return known.get(name, known[default]), name in known

"""What a header says about an image: instrument, filter, scale, orientation, time."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from amibayes.errors import DataError
from amibayes.instrument import HeaderRules
from amibayes.scene.orientation import Orientation, orientation_of_matrix
from amibayes.units import DEGREE, MAS, FloatArray

Header = Mapping[str, Any]

UNITS = {
    "dn/s": "DN/s",
    "electron/s": "electron/s",
    "electrons/s": "electron/s",
    "e-/s": "electron/s",
    "e/s": "electron/s",
}
"""Spellings of the units that amibayes understands."""


def number(header: Header, key: str, source: str) -> float | None:
    """Give a finite number of the header, None where the key is missing.

    Raises
    ------
    DataError
        Where the key holds something else.
    """
    value = header.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise DataError(f"keyword {key} = {value!r} is not a finite number", source=source)
    return float(value)


def text(header: Header, key: str) -> str | None:
    """Give a word of the header, None where it is missing or empty."""
    value = str(header.get(key) or "").strip()
    return value or None


SPECTRAL = ("WAVE", "AWAV", "FREQ", "LAMBDA", "WAVELENGTH")
"""CTYPE3 of cubes whose third axis is the wavelength."""


def check_mask(header: Header, rules: HeaderRules, source: str) -> None:
    """Refuse images of a known instrument that were not taken through its mask.

    Raises
    ------
    DataError
        Naming the pupil element; also where the images are one of each wavelength.
    """
    found = text(header, rules.mask_keyword) if rules.mask_keyword else None
    if found is not None and rules.mask_value.upper() not in found.upper():
        raise DataError(
            f"was not taken through the mask ({rules.mask_keyword} is {found})", source=source
        )
    axis = (text(header, "CTYPE3") or "").upper()
    if axis in SPECTRAL:
        raise DataError(
            f"holds an image of each wavelength (CTYPE3 is {axis}), not of each integration",
            source=source,
            remedy="give one slice of every exposure, with --instrument of a TOML with its "
            "wavelengths",
        )


def upright_notes(header: Header, rules: HeaderRules, source: str) -> tuple[str, ...]:
    """Say where north is taken as up in images of an instrument that turns with the sky."""
    if rules.upright or wcs_matrix(header, source) is not None or "ROLL_REF" in header:
        return ()
    return (
        f"{source}: its header does not say how the sky lies on the detector: taken as north up, "
        "east left; give --position-angle",
    )


DISAGREE_RAD = 0.1 * DEGREE
"""WCS and roll of one JWST header agree to a hundredth of a degree."""

DISAGREE_SCALE = 0.02
"""Pixel scales of a WCS and of a keyword that differ by more are not of one image."""


def orientation_of(header: Header, source: str) -> Orientation:
    """Read the orientation: a celestial WCS, else JWST keywords, else north up, east left."""
    matrix = wcs_matrix(header, source)
    if matrix is not None:
        return orientation_of_matrix(matrix)
    return _orientation_of_roll(header, source) or Orientation()


def _orientation_of_roll(header: Header, source: str) -> Orientation | None:
    """ROLL_REF, V3I_YANG and VPARITY, where there is a roll.

    V3I_YANG is counted in the sense of the pixels: with VPARITY −1 it adds to the roll, with +1
    it is taken off, as jwst's ``calc_rotation_matrix`` has it.
    """
    roll = number(header, "ROLL_REF", source)
    if roll is None:
        return None
    yang = number(header, "V3I_YANG", source) or 0.0
    parity = number(header, "VPARITY", source) or -1.0
    if abs(parity) != 1.0:
        raise DataError(f"keyword VPARITY = {parity:g} is neither 1 nor -1", source=source)
    return Orientation((roll - parity * yang) * DEGREE, int(parity))


def orientation_notes(header: Header, source: str, comments: Mapping[str, str]) -> tuple[str, ...]:
    """Say where the WCS and the keywords of a header contradict each other."""
    matrix, roll = wcs_matrix(header, source), _orientation_of_roll(header, source)
    if matrix is None:
        return ()
    found, notes = orientation_of_matrix(matrix), []
    if roll is not None:
        apart = found.position_angle_rad - roll.position_angle_rad
        apart = float((apart + np.pi) % (2.0 * np.pi) - np.pi)
        if abs(apart) > DISAGREE_RAD:
            notes.append(
                f"{source}: +y lies at {found.position_angle_rad / DEGREE % 360.0:.3f} deg by the "
                f"WCS, {apart / DEGREE:+.3f} deg from ROLL_REF - VPARITY V3I_YANG; the WCS is used"
            )
        if found.parity != roll.parity:
            notes.append(
                f"{source}: VPARITY is {roll.parity:+d}, the WCS has the other; it is used"
            )
    stated = _stated_scale(header, source, comments)
    scale = float(np.sqrt(abs(np.linalg.det(matrix))))
    if stated is not None and abs(stated / scale - 1.0) > DISAGREE_SCALE:
        notes.append(
            f"{source}: pixels of {stated / MAS:.3f} mas by a keyword, {scale / MAS:.3f} mas by "
            "the WCS, which is used"
        )
    return tuple(notes)


PIXEL_SCALES = ("PIXELSCL", "PIXSCL", "PIXSCALE", "PIXSCAL", "PIXSCAL1", "SECPIX", "SECPIX1")
"""Keywords for the side of a pixel, in the order of preference."""

PIXEL_UNITS = (
    (r"\bmas\b|milli-?\s?arc-?sec", MAS),
    (r"\bmarcsec\b", MAS),
    (r"\bmicro-?arcsec|\buas\b", 1e-3 * MAS),
    (r"arc-?sec|\bas\b|''|\"", 1e3 * MAS),
    (r"\bdeg", DEGREE),
    (r"\brad", 1.0),
)
"""What the comment of such a keyword says of its unit; without a word it is arcsec."""


def knows_pixels(header: Header, source: str) -> bool:
    """Whether a header knows the pixels: a celestial WCS, or PIXELSCL of a telescope's file.

    Simulations without any orientation carry a PIXELSCL that is what they were asked for,
    and their images may be of other pixels.
    """
    if wcs_matrix(header, source) is not None:
        return True
    return "ROLL_REF" in header and any(key in header for key in PIXEL_SCALES)


def pixel_scale_of(
    header: Header, source: str, comments: Mapping[str, str] = MappingProxyType({})
) -> float | None:
    """Read the side of a pixel (rad) from a celestial WCS, else from one of `PIXEL_SCALES`.

    Parameters
    ----------
    comments : mapping of str to str
        Of the keywords, where programs write the unit.
    """
    matrix = wcs_matrix(header, source)
    if matrix is not None:
        return float(np.sqrt(abs(np.linalg.det(matrix))))
    return _stated_scale(header, source, comments)


def _stated_scale(header: Header, source: str, comments: Mapping[str, str]) -> float | None:
    """Side of a pixel by the first of `PIXEL_SCALES` that the header has."""
    for key in PIXEL_SCALES:
        scale = number(header, key, source)
        if scale is None:
            continue
        comment = comments.get(key, "")
        unit = next((u for p, u in PIXEL_UNITS if re.search(p, comment, re.IGNORECASE)), None)
        side = scale * (1e3 * MAS if unit is None else unit)
        if not 1e-2 * MAS < side < 1e4 * MAS:
            raise DataError(
                f"keyword {key} = {scale:g} is no pixel scale in {comment or 'arcsec'}",
                source=source,
                remedy="give --pixel-scale",
            )
        return side
    return None


def wcs_matrix(header: Header, source: str) -> FloatArray | None:
    """Read d(east, north)/d(x, y) in radians per pixel from a celestial WCS, if there is one."""
    axes = [text(header, f"CTYPE{i}") or "" for i in (1, 2)]
    if not (axes[0].startswith("RA") and axes[1].startswith("DEC")):
        return None
    keys = [f"{i}_{j}" for i in (1, 2) for j in (1, 2)]
    cd = [number(header, f"CD{key}", source) for key in keys]
    if any(value is not None for value in cd):
        degrees = np.array([value or 0.0 for value in cd]).reshape(2, 2)
    else:
        pc = [number(header, f"PC{key}", source) for key in keys]
        unit = (1.0, 0.0, 0.0, 1.0)
        rotation = [u if value is None else value for value, u in zip(pc, unit, strict=True)]
        steps = [number(header, f"CDELT{i}", source) or 0.0 for i in (1, 2)]
        degrees = np.array(rotation).reshape(2, 2) * np.array(steps)[:, None]
    return degrees * DEGREE if abs(np.linalg.det(degrees)) > 0.0 else None


def unit_of(header: Header) -> str:
    """Read the unit of the images; ami_sim's ``UNITS`` counts as well."""
    word = text(header, "BUNIT") or text(header, "UNITS") or "unknown"
    return UNITS.get(word.lower(), word)


def integration_time_of(header: Header, source: str) -> float | None:
    """Read the time of one integration (s)."""
    time = number(header, "EFFINTTM", source)
    if time is not None:
        return time
    frame = number(header, "TGROUP", source) or number(header, "TFRAME", source)
    groups = number(header, "NGROUPS", source)
    return None if frame is None or groups is None else frame * groups

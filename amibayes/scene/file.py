"""Scenes from TOML files.

A file holds ``[star]`` (magnitude, filter, spectrum, diameter_mas) and any number of
``[[companion]]``, ``[[disc]]``, ``[[gaussian]]``, ``[[ring]]`` and ``[[image]]``. Each of
these has ``contrast`` or ``delta_mag`` (its whole flux against the star's) and a place,
``separation_mas`` with ``position_angle_deg`` or ``east_mas`` with ``north_mas``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning

from amibayes.errors import AmibayesError, DataError
from amibayes.scene.orientation import Orientation
from amibayes.scene.sources import (
    Component,
    GaussianDisc,
    Point,
    Ring,
    Scene,
    SkyImage,
    UniformDisc,
)
from amibayes.scene.spectrum import Spectrum, spectrum_named
from amibayes.support.toml import Section, read_toml
from amibayes.units import DEGREE, MAS, FloatArray, delta_mag_to_contrast, offset

OTHER_TABLES = ("instrument", "exposure", "detector", "calibrator", "wavefront")
"""Tables of a simulation's file that are not about the scene."""


def load_scene(path: str | Path, others: tuple[str, ...] = OTHER_TABLES) -> Scene:
    """Read a scene from a TOML file.

    Parameters
    ----------
    path : str or path
        The file; ``examples/paper_scene.toml`` is one.
    others : tuple of str
        Top-level keys that are somebody else's to read.

    Raises
    ------
    DataError
        Where the file is wrong: it names the key and the fault.
    """
    top = read_toml(path)
    scene = scene_from(top)
    top.refuse_unknown(others)
    return scene


def scene_from(top: Section) -> Scene:
    """Make the scene of a TOML file that has been read.

    Raises
    ------
    DataError
        Where a key of the scene is wrong.
    """
    star = top.section("star")
    primary = _primary(star)
    others = [make(part) for name, make in _MAKERS.items() for part in top.sections(name)]
    scene = Scene(
        components=(primary, *others),
        name=top.text("name", Path(top.source).stem),
        magnitude=star.number("magnitude") if "magnitude" in star else None,
        magnitude_filter=star.text("filter") if "filter" in star else None,
        spectrum=_spectrum(star),
        source=top.source,
    )
    star.refuse_unknown()
    return scene


def _primary(star: Section) -> Component:
    """Make the star of flux 1: a point, a disc, or an image of everything."""
    if "file" in star:
        return _sky_image(star, 1.0, (0.0, 0.0))
    diameter = star.number("diameter_mas", 0.0, at_least=0.0) * MAS
    return UniformDisc(diameter_rad=diameter) if diameter else Point()


def _spectrum(star: Section) -> Spectrum:
    name = star.text("spectrum", "flat")
    beside = Path(star.source).parent / name
    try:
        return spectrum_named(str(beside) if beside.is_file() else name)
    except AmibayesError as error:
        if error.source is not None:
            raise
        raise star.fault("spectrum", f"is wrong: {error.what}", error.remedy) from None


def _companion(part: Section) -> Component:
    east, north = _place(part, needed=True)
    return _checked(part, Point(_contrast(part), east, north))


def _disc(part: Section) -> Component:
    diameter = part.number("diameter_mas", above=0.0) * MAS
    return _checked(part, UniformDisc(_contrast(part), *_place(part), diameter))


def _gaussian(part: Section) -> Component:
    fwhm = part.number("fwhm_mas", above=0.0) * MAS
    return _checked(part, GaussianDisc(_contrast(part), *_place(part), fwhm))


def _ring(part: Section) -> Component:
    diameter = part.number("diameter_mas", above=0.0) * MAS
    width = part.number("width_mas", 0.0, at_least=0.0) * MAS
    if width > diameter:
        raise part.fault("width_mas", "is larger than the ring's diameter", "make it a disc")
    return _checked(part, Ring(_contrast(part), *_place(part), diameter, width))


def _image(part: Section) -> Component:
    return _checked(part, _sky_image(part, _contrast(part), _place(part)))


def _sky_image(part: Section, flux: float, place: tuple[float, float]) -> Component:
    path = Path(part.source).parent / part.text("file")
    pixels, header_scale = read_image(path)
    scale = _image_scale(part, path, header_scale)
    try:
        return SkyImage(pixels, scale, flux, *place)
    except DataError as error:
        raise DataError(error.what, source=path) from None


def _checked(part: Section, component: Component) -> Component:
    part.refuse_unknown()
    return component


def _contrast(part: Section) -> float:
    if ("contrast" in part) == ("delta_mag" in part):
        raise part.fault("contrast", "or 'delta_mag' is needed, one of them")
    if "contrast" in part:
        return part.number("contrast", at_least=0.0)
    return float(delta_mag_to_contrast(part.number("delta_mag")))


def _place(part: Section, *, needed: bool = False) -> tuple[float, float]:
    polar, cartesian = "separation_mas" in part, "east_mas" in part or "north_mas" in part
    if polar and cartesian:
        raise part.fault("separation_mas", "is given and 'east_mas' or 'north_mas' too")
    if not polar and not cartesian and needed:
        raise part.fault("separation_mas", "is missing")
    if polar:
        separation = part.number("separation_mas", at_least=0.0) * MAS
        east, north = offset(separation, part.number("position_angle_deg"))
        return float(east), float(north)
    return part.number("east_mas", 0.0) * MAS, part.number("north_mas", 0.0) * MAS


def _image_scale(part: Section, path: Path, header: FloatArray | None) -> FloatArray:
    """Radians on the sky per pixel: what the TOML says, else the image's own WCS."""
    if "scale_mas" in part:
        angle = part.number("position_angle_deg", 0.0) * DEGREE
        return part.number("scale_mas", above=0.0) * MAS * Orientation(angle).matrix
    if header is None:
        raise DataError(
            "has no celestial coordinates in its header, hence no pixel scale",
            source=path,
            remedy=f"give 'scale_mas' and 'position_angle_deg' beside 'file' in {part.source}",
        )
    return header


def read_image(path: Path) -> tuple[FloatArray, FloatArray | None]:
    """Read the first image of a FITS file, and its scale where the header has one.

    Returns
    -------
    pixels : (n_y, n_x) array
        The image.
    sky_per_pixel : (2, 2) array or None
        Rows east and north, columns x and y, radians per pixel.

    Raises
    ------
    DataError
        Where the file cannot be read or holds no two-dimensional image.
    """
    try:
        with fits.open(path, memmap=False) as units:
            for unit in units:
                if unit.data is not None and unit.is_image:
                    pixels = np.squeeze(np.asarray(unit.data, dtype=float))
                    return _two_axes(pixels, path), _header_scale(unit.header)
    except OSError as error:
        raise DataError(f"cannot be read as FITS: {error}", source=path) from error
    raise DataError("holds no image", source=path)


def _two_axes(pixels: FloatArray, path: Path) -> FloatArray:
    if pixels.ndim != 2:
        raise DataError(f"holds an image of {pixels.ndim} axes, not 2", source=path)
    return pixels


def _header_scale(header: fits.Header) -> FloatArray | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(header)
        if not wcs.has_celestial:
            return None
        return np.asarray(wcs.celestial.pixel_scale_matrix * DEGREE)


_MAKERS: dict[str, Callable[[Section], Component]] = {
    "companion": _companion,
    "disc": _disc,
    "gaussian": _gaussian,
    "ring": _ring,
    "image": _image,
}

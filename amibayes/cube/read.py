"""Reading image cubes, whole or a few integrations at a time."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from amibayes.cube import header as keys
from amibayes.cube.container import NEVER_USED, NO_LIGHT, Cube
from amibayes.cube.ramps import RampFile
from amibayes.cube.read_ramps import check_ramps, ramp_file, refuse_raw
from amibayes.errors import DataError
from amibayes.instrument import (
    HeaderRules,
    header_rules,
    instrument_names,
    load_instrument,
    recognised,
)
from amibayes.support.arguments import checks_arguments
from amibayes.support.fits_errors import reporting_damage
from amibayes.units import DEGREE, FloatArray


@dataclass(frozen=True)
class CubeFile:
    """An open cube: its description now, its images when asked for.

    ``template`` is a cube of no integrations that carries everything else.
    """

    template: Cube
    n_integrations: int
    _hdus: dict[str, Any]
    _mjd: FloatArray | None

    def read(self, start: int = 0, stop: int | None = None) -> Cube:
        """Read the integrations from ``start`` up to ``stop``."""
        part = slice(start, self.n_integrations if stop is None else stop)
        with reporting_damage(self.template.source):
            arrays = {name: _section(hdu, part) for name, hdu in self._hdus.items()}
        mjd = None if self._mjd is None else self._mjd[part]
        return replace(
            self.template,
            images=arrays["SCI"],
            error=arrays.get("ERR"),
            dq=arrays.get("DQ"),
            mjd=mjd,
        )

    def chunks(self, size: int = 256) -> Iterator[Cube]:
        """Read the whole cube, ``size`` integrations at a time.

        Raises
        ------
        DataError
            After the last chunk, where no pixel of the whole cube held light.
        """
        light = False
        for start in range(0, self.n_integrations, size):
            chunk = self.read(start, min(start + size, self.n_integrations))
            light = light or holds_light(chunk)
            yield chunk
        if not light:
            raise no_light(self.template.source)


def holds_light(cube: Cube) -> bool:
    """Tell whether any two usable pixels differ."""
    good = cube.images[~cube.bad]
    return good.size > 0 and bool(np.ptp(good) > 0.0)


def no_light(source: str) -> DataError:
    """Describe a cube without a single usable value."""
    return DataError(NO_LIGHT, source=source)


@checks_arguments
def read_cube(path: str | Path, **options: Any) -> Cube:
    """Read a whole cube; see `open_cube` for the options and errors."""
    with open_cube(path, **options) as file:
        cube = file.read()
    if not holds_light(cube):
        raise no_light(str(path))
    return cube


@contextmanager
def open_cube(
    path: str | Path,
    *,
    instrument: str | None = None,
    filter: str | None = None,
    pixel_scale_rad: float | None = None,
    position_angle_deg: float | None = None,
    bad_flags: tuple[str, ...] | None = None,
) -> Iterator[CubeFile | RampFile]:
    """Open a JWST-like ``calints`` file, or any FITS file with an image or a cube.

    Parameters
    ----------
    path : path
        FITS file; its images are in the extension ``SCI``, else in the first one that
        holds any.
    instrument, filter, pixel_scale_rad : optional
        Used in place of what the header says.
    position_angle_deg : float, optional
        Position angle of the image's +y axis, in place of what the header says.
    bad_flags : tuple of str, optional
        Names of the data quality flags (`DQ_FLAGS`) of pixels that are not to be used; by
        default DO_NOT_USE, NON_SCIENCE, DEAD and REFERENCE_PIXEL.

    Yields
    ------
    CubeFile
        To be read whole or in chunks while the block lasts.

    Raises
    ------
    DataError
        Where the file is missing, damaged, holds no cube, or does not say which
        instrument, filter or pixel scale it is of.
    """
    source = str(path)
    given = {
        "instrument": instrument,
        "filter": filter,
        "pixel_scale_rad": pixel_scale_rad,
        "position_angle_deg": position_angle_deg,
        "bad_flags": NEVER_USED if bad_flags is None else tuple(bad_flags),
    }
    with _opened(Path(path)) as hdus:
        with reporting_damage(path):
            file = _described(hdus, given, source)
        yield file


def _described(hdus: Any, given: dict[str, Any], source: str) -> CubeFile | RampFile:
    if any(hdu.name == "KP-DATA" for hdu in hdus):
        raise DataError(
            "holds kernel phases (KPFITS) of images without a mask",
            source=source,
            remedy="give it to search, limits or calibrate",
        )
    science = _science(hdus, source)
    _check_complete(hdus, source)
    header = _merged(hdus, science)
    check_ramps(hdus, science, header, source)
    is_ramp = len(science.shape) == 4
    chosen = {} if is_ramp else {"SCI": science} | _companions(hdus, science, source)
    template = _template(header, science, given, source, _comments(hdus, science))
    n = 1 if len(science.shape) == 2 else science.shape[0]
    mjd = _mid_times(hdus, n, header, source)
    if is_ramp:
        return ramp_file(hdus, science, template, mjd)
    return CubeFile(template, n, chosen, mjd)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a FITS file, with every complaint of the library as one line."""
    if path.is_dir():
        raise DataError("is a folder", source=path)
    if not path.exists():
        raise DataError("is not there", source=path)
    with reporting_damage(path):
        hdus = fits.open(path, memmap=False)
        len(hdus)  # reads every header
    with hdus:
        yield hdus


def _science(hdus: Any, source: str) -> Any:
    named = [hdu for hdu in hdus if hdu.name == "SCI"]
    images = [hdu for hdu in (named or hdus) if hdu.is_image and len(hdu.shape) > 0]
    if not images:
        raise DataError("holds no image", source=source)
    hdu = images[0]
    if len(hdu.shape) > 3:
        refuse_raw(hdus, hdu, source)
    if len(hdu.shape) < 2 or 0 in hdu.shape:
        raise DataError(f"its image has the shape {hdu.shape}", source=source)
    return hdu


def _companions(hdus: Any, science: Any, source: str) -> dict[str, Any]:
    """Find the error and data quality that belong to the image."""
    found = {}
    for hdu in hdus:
        if hdu.name not in ("ERR", "DQ") or hdu.name in found:
            continue
        # An extension of no known kind, as a damaged file has them, has no shape.
        shape = getattr(hdu, "shape", "of no image")
        if not hdu.is_image or shape != science.shape:
            raise DataError(
                f"{hdu.name} has the shape {shape}, the images {science.shape}", source=source
            )
        found[hdu.name] = hdu
    return found


def _check_complete(hdus: Any, source: str) -> None:
    """Refuse a file that ends before its data do; zeros would be read in their place."""
    if hdus.fileinfo(0)["file"].compression:
        return
    size = Path(source).stat().st_size
    for index, hdu in enumerate(hdus):
        place = hdus.fileinfo(index)
        if place["datLoc"] + hdu.size > size:
            raise DataError(
                f"is cut short: {size} bytes, and extension {hdu.name or index} needs "
                f"{place['datLoc'] + hdu.size}",
                source=source,
            )


def _merged(hdus: Any, science: Any) -> dict[str, Any]:
    """Merge the primary header and the image's own, which wins."""
    merged: dict[str, Any] = {}
    for hdu in (hdus[0], science):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for card in hdu.header.cards:
                if card.keyword not in ("", "COMMENT", "HISTORY"):
                    merged[card.keyword] = card.value
    return merged


def _comments(hdus: Any, science: Any) -> dict[str, str]:
    """What the headers say beside the keywords of `_merged`."""
    cards = [card for hdu in (hdus[0], science) for card in hdu.header.cards]
    return {card.keyword: str(card.comment) for card in cards}


def _template(
    header: dict[str, Any],
    science: Any,
    given: dict[str, Any],
    source: str,
    comments: dict[str, str],
) -> Cube:
    angle = given["position_angle_deg"]
    if given["instrument"]:
        stated, rules = given["instrument"], header_rules(given["instrument"])
    else:
        stated, rules = recognised(header, source)
    keys.check_mask(header, rules, source)
    orientation = keys.orientation_of(header, source)
    if angle is not None:
        orientation = replace(orientation, position_angle_rad=angle * DEGREE)
    scale = given["pixel_scale_rad"] or keys.pixel_scale_of(header, source, comments)
    instrument = stated or None
    filter_ = given["filter"] or rules.filter_of(header, source)
    for value, option in ((instrument, "instrument"), (filter_, "filter")):
        if value is None:
            raise DataError(f"does not say its {option}", source=source, remedy=f"give --{option}")
    scale = scale or _usual_pixel_scale(str(instrument), str(filter_), source)
    return Cube(
        images=np.empty((0, *science.shape[-2:])),
        pixel_scale_rad=scale,
        instrument=str(instrument),
        filter=str(filter_),
        orientation=orientation,
        unit=keys.unit_of(header),
        integration_time_s=keys.integration_time_of(header, source),
        header=MappingProxyType(header),
        source=source,
        bad_flags=given["bad_flags"],
        notes=() if angle is not None else _notes(header, rules, source, comments),
        pixels_known=given["pixel_scale_rad"] is not None or keys.knows_pixels(header, source),
    )


def _notes(
    header: dict[str, Any], rules: HeaderRules, source: str, comments: dict[str, str]
) -> tuple[str, ...]:
    """What is doubtful about how the image lies on the sky."""
    upright = keys.upright_notes(header, rules, source)
    return upright + keys.orientation_notes(header, source, comments)


def _usual_pixel_scale(instrument: str, filter: str, source: str) -> float:
    """Side of a pixel of an instrument that the package knows."""
    if instrument.lower() in instrument_names() or instrument.endswith(".toml"):
        return load_instrument(instrument, filter).pixel_scale_rad
    raise DataError("does not say its pixel scale", source=source, remedy="give --pixel-scale")


def _mid_times(hdus: Any, n: int, header: dict[str, Any], source: str) -> FloatArray | None:
    table = next((hdu for hdu in hdus if hdu.name == "INT_TIMES"), None)
    names = getattr(getattr(table, "columns", None), "names", ())  # an image has none
    if "int_mid_MJD_UTC" not in names:
        return None
    assert table is not None
    times = np.asarray(table.data["int_mid_MJD_UTC"], dtype=float)
    if len(times) == n:
        return times
    rows = _rows_of_segment(table, header, source)
    if np.count_nonzero(rows) != n:
        raise DataError(
            f"INT_TIMES has {len(times)} rows for {n} images",
            source=source,
            remedy="say with INTSTART and INTEND which integration_number are those of the "
            "images, or take the table away",
        )
    return times[rows]


def _rows_of_segment(table: Any, header: dict[str, Any], source: str) -> NDArray[np.bool_]:
    """Rows of this file, where the table is that of an exposure cut into several files."""
    first, last = (keys.number(header, key, source) for key in ("INTSTART", "INTEND"))
    if first is None or last is None or "integration_number" not in table.columns.names:
        return np.zeros(len(table.data), dtype=bool)
    number = np.asarray(table.data["integration_number"])
    return np.asarray((first <= number) & (number <= last))


def _section(hdu: Any, part: slice) -> NDArray[Any]:
    """Read a few images, and no others, into memory."""
    if len(hdu.shape) == 2:
        return np.asarray(hdu.section[:, :])[None][part]
    return np.asarray(hdu.section[part])

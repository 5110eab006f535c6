"""Writing cubes as JWST-like ``calints`` files, whole or a few integrations at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from amibayes.cube.container import Cube
from amibayes.cube.stream import EmptyImage, FitsStream
from amibayes.support.arguments import checks_arguments
from amibayes.units import DEGREE, MAS, FloatArray

DAY_S = 86400.0

SHIFT_KEYWORDS = ("BNDSHFTX", "BNDSHFTY")
"""Displacement of pixels' sides by charge in simulated images, pixels per electron."""

MAP_KEYWORDS = ("MASK_XX", "MASK_XY", "MASK_YX", "MASK_YY")
"""Affine map of the mask in simulated images, by rows; none where it is the drawing."""

COMMENTS = {
    "TELESCOP": "telescope",
    "INSTRUME": "instrument",
    "FILTER": "filter element",
    "PUPIL": "pupil element",
    "PIXELSCL": "[arcsec] side of a pixel",
    "NINTS": "number of integrations",
    "NGROUPS": "number of groups in an integration",
    "TFRAME": "[s] time between frames",
    "TGROUP": "[s] time between groups",
    "EFFINTTM": "[s] effective integration time",
    "ROLL_REF": "[deg] roll angle of V3, north over east",
    "V3I_YANG": "[deg] angle from V3 to the image's y axis",
    "VPARITY": "-1: x is 90 deg west of y",
    "BUNIT": "unit of the images",
    "ORIGIN": "simulated, not observed",
    "TARGPROP": "name of the target",
    "DATE-OBS": "UTC date at the start",
    "TIME-OBS": "UTC time at the start",
    "EXPSTART": "[d] UTC start, MJD",
    "EXPMID": "[d] UTC middle, MJD",
    "EXPEND": "[d] UTC end, MJD",
    "EFFEXPTM": "[s] effective exposure time",
    "DURATION": "[s] on the clock, resets included",
    "IS_PSF": "the target is a calibrator",
    "SEED": "of all random numbers",
    "RATE": "[electron/s] of the star, true",
    "SPECTRUM": "of the star",
    "MAG": "Vega magnitude of the star",
    "MAGFILT": "filter of the magnitude",
    "DITHER_X": "[mas] true dither along x",
    "DITHER_Y": "[mas] true dither along y",
    "JITTER": "[mas] rms per axis",
    "JITTERFR": "[mas] rms per axis of frames in an integration",
    "ZEROREAD": "the read after the reset is kept",
    "RDNOISE": "[electron] CDS read noise",
    "FLATERR": "rms relative error of the flat",
    **dict.fromkeys(SHIFT_KEYWORDS, "[pixel/electron] shift of sides by charge, true"),
    **dict.fromkeys(MAP_KEYWORDS, "from the mask's drawing to the mask, true"),
    "N_SRC": "sources, see the table SCENE",
}

_IN_SCIENCE = ("BUNIT", "ROLL_REF", "V3I_YANG", "VPARITY", "PA_V3")
_STRUCTURE = ("SIMPLE", "BITPIX", "NAXIS", "EXTEND", "PCOUNT", "GCOUNT", "XTENSION", "EXTNAME")
_STALE = ("BSCALE", "BZERO", "BLANK", "CHECKSUM", "DATASUM", "EXTVER", "UNITS", "FILENAME")


class CubeStream:
    """Takes the images of a cube that is being written."""

    def __init__(self, stream: FitsStream) -> None:
        self._stream = stream

    def write(
        self,
        start: int,
        images: NDArray[Any],
        error: NDArray[Any] | None = None,
        dq: NDArray[Any] | None = None,
    ) -> None:
        """Write consecutive integrations from number ``start`` on; without ``dq`` all are good."""
        # Left unwritten, the bytes 0 of an unsigned plane would read as its highest bit.
        flags = np.zeros(images.shape, dtype=np.uint32) if dq is None else dq
        for name, planes in (("SCI", images), ("ERR", error), ("DQ", flags)):
            if planes is not None:
                self._stream.write(name, start, planes)


@contextmanager
def cube_stream(
    path: str | Path,
    template: Cube,
    n_integrations: int,
    *,
    mjd: FloatArray | None = None,
    history: Sequence[str] = (),
    tables: Sequence[Any] = (),
) -> Iterator[CubeStream]:
    """Open a ``calints`` file to be written in chunks.

    Parameters
    ----------
    path : path
        The file; it appears whole when the block succeeds.
    template : Cube
        Everything but the images; an ``ERR`` extension is written where it has errors.
    n_integrations : int
        Number of images that will be written.
    mjd : (n_integrations,) array, optional
        Mid times.
    history : sequence of str
        Lines for the primary header.
    tables : sequence of astropy HDUs
        Written after the images.

    Yields
    ------
    CubeStream

    Raises
    ------
    RunError
        Where the file cannot be written.
    """
    primary, science = headers_of(template, n_integrations)
    for line in history:
        primary.add_history(line)
    shape = (n_integrations, *template.images.shape[1:])
    hdus: list[Any] = [fits.PrimaryHDU(header=primary)]
    hdus.append(EmptyImage("SCI", shape, "float32", science))
    if template.error is not None:
        hdus.append(EmptyImage("ERR", shape, "float32", _unit_header(template.unit)))
    hdus.append(EmptyImage("DQ", shape, "uint32"))
    if mjd is not None:
        hdus.append(int_times(mjd, template.integration_time_s or 0.0))
    with FitsStream.create(path, [*hdus, *tables]) as stream:
        yield CubeStream(stream)


@checks_arguments
def write_cube(path: str | Path, cube: Cube) -> None:
    """Write a whole cube as a ``calints`` file.

    Raises
    ------
    RunError
        Where the file cannot be written.
    """
    with cube_stream(path, cube, cube.n_integrations, mjd=cube.mjd) as stream:
        stream.write(0, cube.images, cube.error, cube.dq)


def headers_of(cube: Cube, n: int) -> tuple[Any, Any]:
    """Split the keywords between the primary header and that of SCI, as JWST files do."""
    both = _kept(cube.header) | _essential(cube, n)
    science = {key: both.pop(key) for key in _IN_SCIENCE if key in both}
    return header_of(both), header_of(science)


def header_of(keywords: Mapping[str, Any]) -> Any:
    """Make a FITS header, with comments where the keyword is known."""
    header = fits.Header()
    for key, value in keywords.items():
        header[key if len(key) <= 8 else f"HIERARCH {key}"] = (value, COMMENTS.get(key, ""))
    return header


def _kept(header: Mapping[str, Any]) -> dict[str, Any]:
    """Keep the keywords that are still true of a file of amibayes' own form."""
    wcs = ("CTYPE", "CUNIT", "CRPIX", "CRVAL", "CDELT", "CD1_", "CD2_", "PC1_", "PC2_", "WCSAXES")
    return {
        key: value
        for key, value in header.items()
        if not key.startswith((*_STRUCTURE, *wcs)) and key not in _STALE
    }


def _essential(cube: Cube, n: int) -> dict[str, Any]:
    angle = cube.orientation.position_angle_rad / DEGREE
    yang = float(cube.header.get("V3I_YANG", 0.0))
    found = {
        "INSTRUME": cube.instrument,
        "FILTER": cube.filter,
        "PIXELSCL": cube.pixel_scale_rad / MAS / 1000.0,
        "NINTS": n,
        "BUNIT": cube.unit,
        "ROLL_REF": angle + cube.orientation.parity * yang,
        "V3I_YANG": yang,
        "VPARITY": cube.orientation.parity,
    }
    if cube.integration_time_s is not None:
        found["EFFINTTM"] = cube.integration_time_s
    return found


def _unit_header(unit: str) -> Any:
    header = fits.Header()
    header["BUNIT"] = (unit, COMMENTS["BUNIT"])
    return header


def int_times(mjd: FloatArray, integration_time_s: float) -> Any:
    """Table INT_TIMES of integrations whose middles are at some dates (n_integrations,)."""
    half = integration_time_s / 2.0 / DAY_S
    columns = [
        fits.Column("integration_number", "J", array=np.arange(1, len(mjd) + 1)),
        fits.Column("int_start_MJD_UTC", "D", "d", array=mjd - half),
        fits.Column("int_mid_MJD_UTC", "D", "d", array=mjd),
        fits.Column("int_end_MJD_UTC", "D", "d", array=mjd + half),
    ]
    # The jwst package refuses a table without them; the barycentre's times ask for a star's place.
    columns += [
        fits.Column(f"int_{part}_BJD_TDB", "D", "d", array=np.full(len(mjd), np.nan))
        for part in ("start", "mid", "end")
    ]
    return fits.BinTableHDU.from_columns(columns, name="INT_TIMES")

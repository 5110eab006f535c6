"""A simulated visit of JWST, in the files that the archive and the jwst package give.

    python docs/jwst_visit.py [FOLDER]

Writes the ramps (``*_ramp.fits``), the images (``*_calints.fits``) and one raw exposure
(``*_uncal.fits``) of a target with a companion (150 mas at 40°, 5 magnitudes fainter), in two
dithers, and of two single stars, into FOLDER (``visit``).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.instrument import load_instrument
from amibayes.scene.orientation import Orientation
from amibayes.scene.sources import Point, Scene
from amibayes.simulation import Detector, Exposure
from amibayes.simulation.detector import draw_maps
from amibayes.simulation.observation import Observation
from amibayes.simulation.observe import PreparedExposure, prepare_exposure
from amibayes.simulation.wavefront import WavefrontErrors
from amibayes.units import DEGREE, MAS, offset

SEPARATION_MAS, ANGLE_DEG, DELTA_MAG = 150.0, 40.0, 5.0

GAIN_E_DN, BIAS_DN = 1.61, 12000.0

YANG_DEG = 0.56987018
"""V3I_YANG of NIRISS."""

FRAME_S = 0.07544

ERRORS = WavefrontErrors(piston_m=30e-9, piston_drift_m=2e-9)
"""Of the telescope, and what changes from star to star: calibration cannot take that out."""

DETECTOR = Detector(zero_read=False, boundary_shift_x=3.6e-7, boundary_shift_y=3.6e-7)
"""Charge moves the sides of pixels, as in the real one."""


@dataclass(frozen=True)
class Pointed:
    """One exposure: its file's stem, the star, and the roll of the telescope."""

    stem: str
    star: str
    magnitude: float
    roll_deg: float
    contrast: float = 0.0


VISIT = (
    Pointed("jw09999001001_03101_00001_nis", "HD-1", 6.0, 100.0, 10 ** (-0.4 * DELTA_MAG)),
    Pointed("jw09999001001_03101_00002_nis", "HD-1", 6.0, 100.001, 10 ** (-0.4 * DELTA_MAG)),
    Pointed("jw09999002001_03101_00001_nis", "HD-2", 6.1, 100.3),
    Pointed("jw09999003001_03101_00001_nis", "HD-3", 5.9, 100.2),
)


def write_visit(
    folder: Path, n_pixels: int = 80, n_integrations: int = 60, n_groups: int = 18
) -> None:
    """Simulate the visit and write its files."""
    folder.mkdir(parents=True, exist_ok=True)
    shared = ERRORS.shared(7, np.random.SeedSequence(1))
    maps = draw_maps(DETECTOR, (n_pixels, n_pixels), np.random.default_rng(2))
    for number, pointed in enumerate(VISIT):
        seed = np.random.SeedSequence([3, number])
        drift, own = seed.spawn(2)
        exposure = Exposure(n_groups, n_integrations, n_pixels=n_pixels, keep_ramps=True)
        seen = replace(_observation(pointed, exposure), wavefront=ERRORS.drifted(shared, 7, drift))
        _write(folder, pointed, prepare_exposure(seen, own, maps), raw=number == 0)


def _observation(pointed: Pointed, exposure: Exposure) -> Observation:
    east, north = (float(x) for x in offset(SEPARATION_MAS * MAS, ANGLE_DEG))
    others = (Point(pointed.contrast, east, north),) if pointed.contrast else ()
    return Observation(
        Scene((Point(), *others), name=pointed.star, magnitude=pointed.magnitude),
        load_instrument("niriss", "F480M").as_built(),
        exposure,
        DETECTOR,
        Orientation((pointed.roll_deg + YANG_DEG) * DEGREE),
        start_mjd=60000.0 + 0.02 * int(pointed.stem[7:10]) + 0.005 * int(pointed.stem[20:25]),
    )


def _write(folder: Path, pointed: Pointed, prepared: PreparedExposure, raw: bool) -> None:
    from amibayes.parallel import SerialExecutor

    chunks = list(prepared.take(SerialExecutor()))
    images, error, dq, ramps = (
        np.concatenate([getattr(c, name) for c in chunks])
        for name in ("images", "error", "dq", "ramps")
    )
    times = _int_times(prepared.observation)
    ramps = ramps / GAIN_E_DN
    parts = {"SCI": ramps, "GROUPDQ": np.zeros(ramps.shape, np.uint8)}
    parts["PIXELDQ"] = np.bitwise_or.reduce(dq, axis=0)
    _save(folder / f"{pointed.stem}_ramp.fits", pointed, prepared, parts, "DN", times)
    slopes = {"SCI": images / GAIN_E_DN, "ERR": error / GAIN_E_DN, "DQ": dq}
    _save(folder / f"{pointed.stem}_calints.fits", pointed, prepared, slopes, "DN/s", times)
    if raw:
        counts = np.clip(np.rint(ramps + BIAS_DN), 0, 65535).astype(np.uint16)
        path = folder / f"{pointed.stem}_uncal.fits"
        _save(path, pointed, prepared, {"SCI": counts}, "DN", times)


def _save(
    path: Path,
    pointed: Pointed,
    prepared: PreparedExposure,
    parts: dict[str, Any],
    unit: str,
    times: Any,
) -> None:
    hdus: list[Any] = [fits.PrimaryHDU()]
    hdus[0].header.update(_primary(path, pointed, prepared.observation))
    for name, array in parts.items():
        kept = array.astype(np.float32) if array.dtype.kind == "f" else array
        hdus.append(fits.ImageHDU(kept, name=name))
    hdus[1].header.update({"BUNIT": unit} | _wcs(pointed, prepared.observation))
    fits.HDUList([*hdus, times]).writeto(path, overwrite=True)


def _primary(path: Path, pointed: Pointed, seen: Observation) -> dict[str, Any]:
    exposure, middle = seen.exposure, seen.mid_times_mjd
    return {
        "FILENAME": path.name,
        "TELESCOP": "JWST",
        "CAL_VER": "3.0.0",
        "TARGPROP": pointed.star,
        "TARGNAME": pointed.star,
        "INSTRUME": "NIRISS",
        "DETECTOR": "NIS",
        "FILTER": "F480M",
        "PUPIL": "NRM",
        "EXP_TYPE": "NIS_AMI",
        "READPATT": "NISRAPID",
        "SUBARRAY": "SUB80",
        "IS_PSF": not pointed.contrast,
        "NINTS": exposure.n_integrations,
        "NGROUPS": exposure.n_groups,
        "NFRAMES": 1,
        "GROUPGAP": 0,
        "TFRAME": FRAME_S,
        "TGROUP": FRAME_S,
        "EFFINTTM": exposure.n_groups * FRAME_S,
        "EXPSTART": seen.start_mjd,
        "EXPMID": float(middle.mean()),
        "EXPEND": float(2.0 * middle.mean() - seen.start_mjd),
        "S_JUMP": "COMPLETE",
        "S_CHGMIG": "SKIPPED",
    }


def _wcs(pointed: Pointed, seen: Observation) -> dict[str, Any]:
    matrix = seen.orientation.matrix * seen.instrument.pixel_scale_rad / DEGREE
    middle = 0.5 * (seen.exposure.n_pixels + 1)
    return {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CRPIX1": middle,
        "CRPIX2": middle,
        "CRVAL1": 82.2,
        "CRVAL2": -65.4,
        **{f"CD{i + 1}_{j + 1}": float(matrix[i, j]) for i in (0, 1) for j in (0, 1)},
        "ROLL_REF": pointed.roll_deg,
        "V3I_YANG": YANG_DEG,
        "VPARITY": -1,
    }


def _int_times(seen: Observation) -> Any:
    middle, half = seen.mid_times_mjd, 0.5 * seen.exposure.n_groups * FRAME_S / 86400.0
    columns = [
        fits.Column("integration_number", "J", array=np.arange(1, len(middle) + 1)),
        fits.Column("int_start_MJD_UTC", "D", array=middle - half),
        fits.Column("int_mid_MJD_UTC", "D", array=middle),
        fits.Column("int_end_MJD_UTC", "D", array=middle + half),
    ]
    return fits.BinTableHDU.from_columns(columns, name="INT_TIMES")


if __name__ == "__main__":
    write_visit(Path(sys.argv[1] if len(sys.argv) > 1 else "visit"))

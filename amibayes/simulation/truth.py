"""What a simulated file says of itself: JWST's keywords, and the truth behind the images."""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy.io import fits
from astropy.time import Time

from amibayes import __version__
from amibayes.cube.write import MAP_KEYWORDS, SHIFT_KEYWORDS
from amibayes.instrument import instrument_names
from amibayes.scene.sources import Scene
from amibayes.simulation.exposure import Pointings
from amibayes.simulation.observation import Observation
from amibayes.units import MAS


def exposure_header(
    observation: Observation, pointings: Pointings, rate_e_s: float
) -> dict[str, Any]:
    """Keywords of an exposure: JWST's, and what is true of it."""
    return {
        **_telescope(observation),
        **_times(observation),
        **_truth(observation, pointings, rate_e_s),
        **observation.notes,
    }


def instrument_keyword(name: str) -> str:
    """Name of an instrument by which a reader finds it again."""
    first = name.split()[0]
    return first.upper() if first.lower() in instrument_names() else name


def _telescope(observation: Observation) -> dict[str, Any]:
    instrument, exposure = observation.instrument, observation.exposure
    header: dict[str, Any] = {
        "ORIGIN": f"amibayes {__version__}",
        "TARGPROP": observation.scene.name,
    }
    if instrument.header.simulated:
        usual = exposure.n_pixels == instrument.n_pixels
        header["SUBARRAY"] = f"SUB{instrument.n_pixels}" if usual else "CUSTOM"
    return header | dict(instrument.header.simulated)


def _times(observation: Observation) -> dict[str, Any]:
    exposure, frame = observation.exposure, observation.detector.frame_time_s
    ramp = exposure.n_groups * frame
    duration = exposure.n_integrations * (ramp + frame)
    start = observation.start_mjd
    day, clock = Time(start, format="mjd").isot.split("T")
    return {
        "DATE-OBS": day,
        "TIME-OBS": clock,
        "VSTSTART": f"{day} {clock}",
        "EXPSTART": start,
        "EXPMID": start + 0.5 * duration / 86400.0,
        "EXPEND": start + duration / 86400.0,
        "NGROUPS": exposure.n_groups,
        "NFRAMES": 1,
        "GROUPGAP": 0,
        "TFRAME": frame,
        "TGROUP": frame,
        "EFFINTTM": ramp,
        "EFFEXPTM": ramp * exposure.n_integrations,
        "DURATION": duration,
    }


def _truth(observation: Observation, pointings: Pointings, rate_e_s: float) -> dict[str, Any]:
    scene, detector = observation.scene, observation.detector
    pixel = observation.instrument.pixel_scale_rad / MAS
    header: dict[str, Any] = {
        "RATE": rate_e_s,
        "SPECTRUM": scene.spectrum.name,
        "DITHER_X": float(pointings.dither_px[0]) * pixel,
        "DITHER_Y": float(pointings.dither_px[1]) * pixel,
        "JITTER": observation.exposure.jitter_rad / MAS,
        "JITTERFR": observation.exposure.frame_jitter_rad / MAS,
        "ZEROREAD": detector.zero_read,
        "RDNOISE": detector.read_noise_e,
        "FLATERR": detector.flat_error,
        SHIFT_KEYWORDS[0]: detector.boundary_shift_x,
        SHIFT_KEYWORDS[1]: detector.boundary_shift_y,
        "N_SRC": len(scene.components),
    }
    mask = observation.instrument.mask
    if mask.is_mapped:
        header |= dict(zip(MAP_KEYWORDS, mask.hole_map.ravel().tolist(), strict=True))
    if scene.magnitude is not None:
        header["MAG"] = scene.magnitude
        header["MAGFILT"] = scene.magnitude_filter or observation.instrument.bandpass.name
    return header


def truth_tables(observation: Observation, pointings: Pointings) -> list[Any]:
    """Tables SCENE, POINTING and, where there is one, WAVEFRONT."""
    pixel = observation.instrument.pixel_scale_rad / MAS
    jitter = pointings.jitter_px * pixel
    pointing = fits.BinTableHDU.from_columns(
        [
            fits.Column("jitter_x", "D", "mas", array=jitter[:, 0]),
            fits.Column("jitter_y", "D", "mas", array=jitter[:, 1]),
        ],
        name="POINTING",
    )
    return [_scene_table(observation.scene), pointing, *_wavefront_table(observation)]


def _scene_table(scene: Scene) -> Any:
    kinds = [type(part).__name__ for part in scene.components]
    names = ("diameter_rad", "fwhm_rad", "width_rad")
    sizes = {name: [getattr(p, name, 0.0) / MAS for p in scene.components] for name in names}
    east = [getattr(part, "east_rad", 0.0) / MAS for part in scene.components]
    north = [getattr(part, "north_rad", 0.0) / MAS for part in scene.components]
    columns = [
        fits.Column("kind", "16A", array=np.array(kinds)),
        fits.Column("flux", "D", array=[part.flux for part in scene.components]),
        fits.Column("east", "D", "mas", array=east),
        fits.Column("north", "D", "mas", array=north),
        *(fits.Column(name[:-4], "D", "mas", array=size) for name, size in sizes.items()),
    ]
    return fits.BinTableHDU.from_columns(columns, name="SCENE")


def _wavefront_table(observation: Observation) -> list[Any]:
    wavefront, mask = observation.wavefront, observation.instrument.mask
    if wavefront is None or (wavefront.piston_m is None and wavefront.tilt_rad is None):
        return []
    piston = np.zeros(mask.n_holes) if wavefront.piston_m is None else wavefront.piston_m
    tilt = np.zeros((mask.n_holes, 2)) if wavefront.tilt_rad is None else wavefront.tilt_rad
    columns = [
        fits.Column("hole", "J", array=np.arange(1, mask.n_holes + 1)),
        fits.Column("piston", "D", "nm", array=piston * 1e9),
        fits.Column("tilt_x", "D", "mas", array=tilt[:, 0] / MAS),
        fits.Column("tilt_y", "D", "mas", array=tilt[:, 1] / MAS),
    ]
    return [fits.BinTableHDU.from_columns(columns, name="WAVEFRONT")]

"""One exposure of one scene, in memory or straight into a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.cube import Cube, CubeStream, EmptyImage, FitsStream, cube_stream, headers_of
from amibayes.cube.reference_files import BIAS_KEYWORD, LINEARITY_KEYWORD
from amibayes.cube.write import int_times
from amibayes.instrument import Instrument
from amibayes.optics import scene_image
from amibayes.parallel import Executor, Journal, Progress, SerialExecutor, child_seeds, spawn
from amibayes.scene.sources import Scene
from amibayes.simulation.detector import DetectorMaps, draw_maps
from amibayes.simulation.exposure import (
    Chunk,
    Exposure,
    Pointings,
    Recorder,
    draw_pointings,
    make_recorder,
    record,
)
from amibayes.simulation.observation import Observation
from amibayes.simulation.ramps import linearity_coefficients
from amibayes.simulation.truth import exposure_header, instrument_keyword, truth_tables
from amibayes.support.arguments import checks_arguments


@dataclass(frozen=True, eq=False)
class PreparedExposure:
    """An exposure about to be taken."""

    observation: Observation
    pointings: Pointings
    recorder: Recorder
    noise: np.random.SeedSequence

    def take(
        self,
        executor: Executor,
        progress: Progress | None = None,
        journal: Journal | None = None,
    ) -> Iterator[Chunk]:
        """Give the integrations, some at a time, in order; a journal keeps what is finished."""
        return record(self.recorder, self.pointings, self.noise, executor, progress, journal)


def prepare_exposure(
    observation: Observation, seed: np.random.SeedSequence, maps: DetectorMaps
) -> PreparedExposure:
    """Point the telescope and form the image.

    Raises
    ------
    DataError
        Where a source lies outside the image.
    UsageError
        Where the scene saturates.
    """
    exposure, instrument = observation.exposure, observation.instrument
    of_pointing, noise = child_seeds(seed, 2)
    pointings = draw_pointings(exposure, instrument.pixel_scale_rad, of_pointing)
    image = scene_image(
        observation.scene,
        instrument,
        instrument.bandpass.channels(observation.scene.spectrum, observation.n_wavelengths),
        exposure.n_pixels,
        centre_px=(float(pointings.dither_px[0]), float(pointings.dither_px[1])),
        orientation=observation.orientation,
        reach_px=pointings.reach_px,
        wavefront=observation.wavefront,
        pixel_response=observation.detector.pixel_response,
    )
    rate = observation.rate_e_s
    recorder = make_recorder(image, rate, pointings, exposure, observation.detector, maps)
    return PreparedExposure(observation, pointings, recorder, noise)


@checks_arguments
def simulate(
    scene: Scene,
    instrument: Instrument,
    exposure: Exposure,
    rng: np.random.Generator,
    *,
    maps: DetectorMaps | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Cube:
    """Simulate one exposure, in memory.

    Parameters
    ----------
    scene, instrument, exposure : Scene, Instrument, Exposure
        What is observed, with what, and how.
    rng : numpy Generator
        Source of all randomness.
    maps : DetectorMaps, optional
        The detector's pixels, for exposures that share them; drawn anew by default.
    executor : Executor, optional
        Where the work is done; it changes nothing in the result.
    progress : Progress, optional
        Told how far it is.
    **settings
        Further fields of `Observation`: detector, orientation, wavefront, …

    Returns
    -------
    Cube
        Images in electrons per second.

    Raises
    ------
    DataError, UsageError
        Where the scene does not fit the image, or saturates.
    """
    observation = Observation(scene, instrument, exposure, **settings)
    of_maps, of_exposure = spawn(rng, 2)
    n = exposure.n_pixels
    if maps is None:
        maps = draw_maps(observation.detector, (n, n), np.random.default_rng(of_maps))
    prepared = prepare_exposure(observation, of_exposure, maps)
    chunks = list(prepared.take(executor or SerialExecutor(), progress))
    return replace(
        blank_cube(prepared),
        images=np.concatenate([chunk.images for chunk in chunks]),
        error=np.concatenate([chunk.error for chunk in chunks]),
        dq=np.concatenate([chunk.dq for chunk in chunks]),
        mjd=observation.mid_times_mjd,
    )


def blank_cube(prepared: PreparedExposure) -> Cube:
    """Everything of the cube but its images."""
    observation = prepared.observation
    n = observation.exposure.n_pixels
    empty = np.empty((0, n, n))
    exposure = observation.exposure
    return Cube(
        images=empty,
        pixel_scale_rad=observation.instrument.pixel_scale_rad,
        instrument=instrument_keyword(observation.instrument.name),
        filter=observation.instrument.bandpass.name,
        orientation=observation.orientation,
        error=empty,
        integration_time_s=exposure.n_groups * observation.detector.frame_time_s,
        # Only where pixels are known can another mask be told from other pixels.
        pixels_known=observation.instrument.mask.is_mapped,
        header=exposure_header(observation, prepared.pointings, prepared.recorder.rate_e_s),
    )


def write_exposure(
    path: Path,
    prepared: PreparedExposure,
    executor: Executor,
    *,
    history: tuple[str, ...] = (),
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> None:
    """Take an exposure straight into a ``calints`` file, a few integrations at a time.

    The file carries the truth: the scene and the seed in its header, the sources, the
    wavefront and the pointing of every integration in tables. Where the reads are kept,
    they go to a file of their own beside it, named ``…_ramp.fits``, with the flags that the
    slopes were fitted with.

    Parameters
    ----------
    path : Path
        ``…_calints.fits``.
    prepared : PreparedExposure
        From `prepare_exposure`.
    executor : Executor
        Where the work is done.
    history : tuple of str
        Lines for the header.
    progress : Progress, optional
        Told how far it is.
    journal : Journal, optional
        Keeps finished integrations, for a run that is cut off.

    Raises
    ------
    RunError
        Where a file cannot be written.
    """
    with _files(path, prepared, history) as (cube, ramps):
        for chunk in prepared.take(executor, progress, journal):
            cube.write(chunk.start, chunk.images, chunk.error, chunk.dq)
            if ramps is not None and chunk.ramps is not None and chunk.group_dq is not None:
                ramps.write("SCI", chunk.start, chunk.ramps)
                ramps.write("GROUPDQ", chunk.start, chunk.group_dq)


@contextmanager
def _files(
    path: Path, prepared: PreparedExposure, history: tuple[str, ...]
) -> Iterator[tuple[CubeStream, FitsStream | None]]:
    observation = prepared.observation
    n = observation.exposure.n_integrations
    template = blank_cube(prepared)
    tables = truth_tables(observation, prepared.pointings)
    with ExitStack() as stack:
        mid = observation.mid_times_mjd
        cube = stack.enter_context(
            cube_stream(path, template, n, mjd=mid, history=history, tables=tables)
        )
        ramps = None
        if observation.exposure.keep_ramps:
            hdus = _ramp_hdus(prepared)
            if observation.detector.adc_nonlinearity > 0.0:
                _write_references(path, prepared, hdus[0].header)
            ramps = stack.enter_context(FitsStream.create(ramp_path(path), hdus))
        yield cube, ramps


def ramp_path(path: Path) -> Path:
    """Name of the reads' file beside a ``calints`` file."""
    return path.with_name(path.name.replace("_calints", "_ramp"))


def _write_references(path: Path, prepared: PreparedExposure, header: fits.Header) -> None:
    """Write what the ramps went through as JWST's reference files have it, and name them."""
    bias = prepared.recorder.maps.bias_dn
    linear = linearity_coefficients(prepared.observation.detector, bias.shape)
    for keyword, kind, name, values in (
        (BIAS_KEYWORD, "superbias", "SCI", bias),
        (LINEARITY_KEYWORD, "linearity", "COEFFS", linear),
    ):
        file = path.with_name(path.name.replace("_calints", f"_{kind}"))
        image = fits.ImageHDU(values.astype(np.float32), name=name)
        with FitsStream.create(file, [fits.PrimaryHDU(), image]):
            pass
        header[keyword] = file.name


def _ramp_hdus(prepared: PreparedExposure) -> list[Any]:
    """What a file of ramps holds; SCI and GROUPDQ are streamed."""
    observation = prepared.observation
    exposure = observation.exposure
    # What a reader of slopes asks of a header, a reader of ramps asks too.
    template = replace(blank_cube(prepared), unit="electron")
    primary, science = headers_of(template, exposure.n_integrations)
    if "DATAMODL" in primary:
        primary["DATAMODL"] = "RampModel"
    # Groups of ramps are what SCI holds, the read after the reset included where it is kept.
    reads = observation.detector.n_reads(exposure.n_groups)
    primary["NGROUPS"] = reads
    shape = (exposure.n_integrations, reads, exposure.n_pixels, exposure.n_pixels)
    return [
        fits.PrimaryHDU(header=primary),
        EmptyImage("SCI", shape, "float32", science),
        fits.ImageHDU(prepared.recorder.maps.dq, name="PIXELDQ"),
        EmptyImage("GROUPDQ", shape, "uint8"),
        int_times(observation.mid_times_mjd, template.integration_time_s or 0.0),
    ]

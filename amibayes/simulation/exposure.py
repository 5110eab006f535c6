"""One exposure: pieces of integrations that any worker computes to the same bits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.errors import UsageError
from amibayes.optics import ShiftedImage
from amibayes.parallel import Executor, Journal, Progress, child_seeds, run_job, slices
from amibayes.simulation.detector import Detector, DetectorMaps
from amibayes.simulation.ramps import read_ramps
from amibayes.simulation.slopes import SlopeFit, group_flags
from amibayes.support.arguments import checks_arguments
from amibayes.units import MAS, FloatArray

PIECE = 32
"""Integrations of a piece; part of what a seed means, so it does not change."""

MAX_INTEGRATIONS = 10000
"""More than this does not fit in one JWST exposure."""


MAX_SIGMA = 4.0
"""Frames that point farther than so many standard deviations are drawn in."""

MAX_SIMULATED = 1_000_000
"""Integrations of the largest file that is simulated, a hundred full exposures."""


def refuse_too_many(n_integrations: int) -> None:
    """Refuse an exposure that would fill the disk.

    Raises
    ------
    UsageError
    """
    if n_integrations > MAX_SIMULATED:
        raise UsageError(
            f"n_integrations is {n_integrations:.4g}; at most {MAX_SIMULATED} are simulated",
            remedy="fewer photons or a brighter star",
        )


@checks_arguments
@dataclass(frozen=True)
class Exposure:
    """How an exposure is taken.

    Parameters
    ----------
    n_groups : int
        Groups (frames) of a ramp, two or more.
    n_integrations : int
        Ramps.
    jitter_rad : float
        Pointing error of each integration, rms per axis.
    dither_rad : float
        Pointing error of the exposure, rms per axis.
    n_pixels : int
        Side of the image.
    keep_ramps : bool
        Keep the reads as well.
    frame_jitter_rad : float
        Pointing error of each frame about that of its integration, rms per axis.

    Raises
    ------
    UsageError
        Naming the number that makes no sense.
    """

    n_groups: int
    n_integrations: int
    jitter_rad: float = 7.0 * MAS
    dither_rad: float = 15.0 * MAS
    n_pixels: int = 80
    keep_ramps: bool = False
    frame_jitter_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.n_groups < 2:
            raise UsageError(
                f"n_groups is {self.n_groups}; a slope needs 2",
                remedy="more groups; a fainter star or a narrower filter if it saturates",
            )
        if self.n_integrations < 1:
            raise UsageError(f"n_integrations is {self.n_integrations}; it must be 1 or more")
        refuse_too_many(self.n_integrations)
        if self.n_pixels < 8:
            raise UsageError(f"n_pixels is {self.n_pixels}; it must be 8 or more")
        for name in ("jitter_rad", "dither_rad", "frame_jitter_rad"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{name[:-4]} is {getattr(self, name):g}; it must be at least 0")


@dataclass(frozen=True, eq=False)
class Pointings:
    """Where an exposure and each of its integrations points.

    Parameters
    ----------
    dither_px : (2,) array
        Offset (x, y) of the whole exposure.
    jitter_px : (n_int, 2) array
        Offsets about that.
    frame_px : float
        Rms of the offsets of single frames about those, per axis.
    """

    dither_px: FloatArray
    jitter_px: FloatArray
    frame_px: float = 0.0

    @property
    def reach_px(self) -> float:
        """Largest jitter along an axis, that of frames included."""
        return float(np.abs(self.jitter_px).max()) + MAX_SIGMA * self.frame_px


def draw_pointings(exposure: Exposure, pixel_rad: float, seed: np.random.SeedSequence) -> Pointings:
    """Draw dither and jitter, each from a stream of its own."""
    of_dither, of_jitter = (np.random.default_rng(child) for child in child_seeds(seed, 2))
    return Pointings(
        exposure.dither_rad / pixel_rad * of_dither.standard_normal(2),
        exposure.jitter_rad / pixel_rad * of_jitter.standard_normal((exposure.n_integrations, 2)),
        exposure.frame_jitter_rad / pixel_rad,
    )


@dataclass(frozen=True, eq=False)
class Chunk:
    """Consecutive integrations from number ``start`` on; arrays (n, ny, nx).

    ``ramps`` (n, n_reads, ny, nx) are the reads in electrons, where they were kept, and
    ``group_dq`` their flags (`amibayes.simulation.slopes.group_flags`).
    """

    start: int
    images: NDArray[np.float32]
    error: NDArray[np.float32]
    dq: NDArray[np.uint32]
    ramps: NDArray[np.float32] | None
    group_dq: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Recorder:
    """Computes pieces of one exposure; it travels to the workers once.

    Parameters
    ----------
    exposure, detector, maps : Exposure, Detector, DetectorMaps
        What is recorded, with what.
    image : ShiftedImage
        Image of the scene at any jitter, per electron of the star.
    rate_e_s : float
        Electrons per second of the star.
    fit : SlopeFit
        Slopes from ramps.
    frame_px : float
        Rms of the pointing of single frames, per axis.
    """

    exposure: Exposure
    detector: Detector
    maps: DetectorMaps
    image: ShiftedImage
    rate_e_s: float
    fit: SlopeFit
    frame_px: float = 0.0

    def light(self, jitter_px: FloatArray) -> FloatArray:
        """(…, ny, nx) electrons per second at some pointings (…, 2)."""
        images = self.image.at(jitter_px.reshape(-1, 2))
        shape = (*jitter_px.shape[:-1], *images.shape[1:])
        light = np.maximum(self.rate_e_s * images, 0.0) * self.maps.sensitivity
        return np.asarray(light.reshape(shape))

    def __call__(self, piece: tuple[FloatArray, np.random.SeedSequence]) -> dict[str, Any]:
        """Simulate the integrations of some jitters (n, 2), in pixels, with a seed."""
        jitter, seed = piece
        rng = np.random.default_rng(seed)
        if self.frame_px > 0.0:
            shape = (self.exposure.n_groups, *jitter.shape)
            moved = rng.spawn(1)[0].standard_normal(shape).clip(-MAX_SIGMA, MAX_SIGMA)
            jitter = jitter + self.frame_px * moved
        light, n_groups = self.light(jitter), self.exposure.n_groups
        ramps = read_ramps(light, self.detector, n_groups, rng, self.maps.bias_dn)
        slopes = self.fit(ramps)
        result: dict[str, Any] = {
            "images": slopes.images.astype(np.float32),
            "error": np.sqrt(slopes.variance).astype(np.float32),
            "dq": slopes.dq,
        }
        if self.exposure.keep_ramps:
            result["ramps"] = np.swapaxes(ramps.reads, 0, 1).astype(np.float32)
            result["group_dq"] = group_flags(ramps, slopes)
        return result


def make_recorder(
    image: ShiftedImage,
    rate_e_s: float,
    pointings: Pointings,
    exposure: Exposure,
    detector: Detector,
    maps: DetectorMaps,
) -> Recorder:
    """Prepare an exposure: its expected image gives the weights of the slope fit.

    Raises
    ------
    UsageError
        Where the brightest pixel saturates before its second group.
    """
    expected = np.maximum(rate_e_s * image.mean(pointings.jitter_px), 0.0) * maps.sensitivity
    peak = float(expected.max()) * detector.frame_time_s
    if 2.0 * peak > detector.full_well_e:
        raise UsageError(
            f"the scene saturates: a slope needs 2 groups, which collect {2.0 * peak:.0f} "
            f"electrons in the brightest pixel, and {detector.full_well_e:.0f} fill it",
            remedy="a fainter star or a narrower filter",
        )
    fit = SlopeFit(expected, detector, maps, exposure.n_groups)
    return Recorder(exposure, detector, maps, image, rate_e_s, fit, pointings.frame_px)


def record(
    recorder: Recorder,
    pointings: Pointings,
    seed: np.random.SeedSequence,
    executor: Executor,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> Iterator[Chunk]:
    """Take the exposure, a few integrations at a time, in order.

    Parameters
    ----------
    recorder : Recorder
        From `make_recorder`.
    pointings : Pointings
        Of every integration.
    seed : SeedSequence
        Of the noise; each piece has a child of it.
    executor : Executor
        Where pieces are computed; it changes nothing in the result.
    progress : Progress, optional
        Told, in integrations, after each piece.
    journal : Journal, optional
        Keeps finished pieces.

    Yields
    ------
    Chunk
    """
    parts = slices(recorder.exposure.n_integrations, PIECE)
    jitter = pointings.jitter_px
    children = child_seeds(seed, len(parts))
    pieces = [(jitter[part], child) for part, child in zip(parts, children, strict=True)]
    told = None if progress is None else _counting(progress, recorder.exposure.n_integrations)
    results = run_job(recorder, pieces, executor, journal=journal, progress=told)
    for part, result in zip(parts, results, strict=True):
        kept = (result.get(name) for name in ("ramps", "group_dq"))
        yield Chunk(part.start, result["images"], result["error"], result["dq"], *kept)


def _counting(progress: Progress, n_integrations: int) -> Progress:
    """Count integrations, not pieces."""

    def tell(done: int, total: int) -> None:
        progress(min(done * PIECE, n_integrations), n_integrations)

    return tell

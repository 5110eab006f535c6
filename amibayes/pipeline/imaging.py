"""From files to a reconstructed image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from amibayes.imaging import ReconstructedImage, reconstruct_image
from amibayes.imaging.warnings import warnings_of
from amibayes.parallel import Progress
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.prepare import prepare
from amibayes.pipeline.run import Announce, Run, silent


@dataclass(frozen=True)
class ImagingOptions:
    """Everything a reconstruction depends on beside its files.

    Parameters
    ----------
    search : SearchOptions
        How data are read, calibrated and selected.
    regulariser : {"tv", "entropy"}
    weight : float, optional
        By cross-validation where absent.
    field_mas, pixel_mas : float, optional
    star : bool
        A star in the middle is no part of the image.
    """

    search: SearchOptions = field(default_factory=SearchOptions)
    regulariser: str = "tv"
    weight: float | None = None
    field_mas: float | None = None
    pixel_mas: float | None = None
    star: bool = True


@dataclass(frozen=True, eq=False)
class ImagingReport:
    """An image and what it was made of."""

    image: ReconstructedImage
    options: ImagingOptions
    targets: tuple[str, ...]
    calibrators: tuple[str, ...]
    warnings: tuple[str, ...]
    timing_s: dict[str, float]


def make_image(
    targets: Sequence[str | Path],
    calibrators: Sequence[str | Path] = (),
    options: ImagingOptions | None = None,
    *,
    announce: Announce = silent,
    progress: Progress | None = None,
) -> ImagingReport:
    """Read, calibrate and reconstruct.

    Raises
    ------
    DataError
        Where a file cannot be read or holds nothing to make an image of.
    UsageError
        Where the request makes no sense.
    """
    options = options or ImagingOptions()
    run = Run(announce, progress)
    seeds = np.random.SeedSequence(options.search.seed).spawn(2)
    first, second = (np.random.default_rng(s) for s in seeds)
    with threadpool_limits(1):
        search = replace(options.search, limits=False, posterior=False)
        ready = prepare(targets, calibrators, search, first, run)
        data = ready.observables.only(search.observables)
        with run.stage("image"):
            image = reconstruct_image(
                data,
                regulariser=options.regulariser,
                weight=options.weight,
                field_mas=options.field_mas,
                pixel_mas=options.pixel_mas,
                star=options.star,
                diameter_mas=search.diameter,
                rng=second,
                progress=progress,
            )
    return ImagingReport(
        image,
        options,
        tuple(str(p) for p in targets),
        tuple(str(p) for p in calibrators),
        tuple(dict.fromkeys((*warnings_of(image), *ready.warnings, *data.notes))),
        run.seconds,
    )

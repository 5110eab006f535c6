"""From files to one calibrated table: read, vet the calibrators, calibrate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from amibayes.calibration import (
    Calibration,
    calibrate,
    diameters_of,
    reduce_data,
    without_disc,
)
from amibayes.calibration.library import read_library
from amibayes.calibration.transfer import Diameter
from amibayes.data.joining import different_targets, in_order, refuse_twice, unused
from amibayes.data.observables import Observables, join
from amibayes.errors import DataError, UsageError
from amibayes.extraction.charge import CubeMigration
from amibayes.extraction.reading import (
    charge_of,
    check_together,
    of_one_visit,
    read_observations,
    uncalibrated_images,
)
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.run import Run
from amibayes.pipeline.vetting import Vetting, agreement_of_two, vet
from amibayes.pipeline.warnings import (
    calibration_warnings,
    calibrator_warnings,
    unused_calibrators,
    vetting_warnings,
)
from amibayes.support.options import VETTING_ALPHA
from amibayes.support.shared_results import shared

MIN_TO_VET = 3
"""Of two calibrators that disagree the bad one cannot be known."""

VETTING_DRAWS = 1000


@dataclass(frozen=True, eq=False)
class Prepared:
    """Calibrated observables, and what was done to get them.

    Parameters
    ----------
    observables : Observables
        All targets together.
    references : tuple of Observables
        Each calibrator as read.
    calibration : Calibration, optional
    vetting : Vetting, optional
    warnings : tuple of str
    charge_migration : CubeMigration, optional
        What was done about it in the first image cube, or as the first file says.
    serving : tuple of Observables
        Calibrators that the targets were calibrated with.
    diameters_mas : tuple of (diameter, error)
        Of each of these.
    """

    observables: Observables
    references: tuple[Observables, ...] = ()
    calibration: Calibration | None = None
    vetting: Vetting | None = None
    warnings: tuple[str, ...] = ()
    charge_migration: CubeMigration | None = None
    serving: tuple[Observables, ...] = ()
    diameters_mas: tuple[Diameter, ...] = ()

    @property
    def exchangeable(self) -> list[tuple[Observables, Diameter]]:
        """Calibrators of one population, with their discs: none where they drift with time."""
        if self.calibration is None or self.calibration.method == "population":
            return []
        return list(zip(self.serving, self.diameters_mas, strict=True))


def prepare(
    targets: Sequence[str | Path],
    calibrators: Sequence[str | Path],
    options: SearchOptions,
    rng: np.random.Generator,
    run: Run,
) -> Prepared:
    """Read every file, vet the calibrators and calibrate all targets together.

    Raises
    ------
    DataError
        Where a file cannot be read or vetting leaves no calibrator.
    UsageError
        Where no target is given, or one of them twice under two names.
    """
    if not targets:
        raise UsageError("no target given", remedy="name at least one file")
    together = check_together(targets, calibrators)
    with run.stage("read"):
        images = of_one_visit([*targets, *calibrators], options.images)
        parts = read(targets, replace(options, images=images))
        references = read(calibrators, replace(options, images=images), one_star=False)
    parts = in_order(parts)
    joined = (
        *together,
        *refuse_twice(parts),
        *unused(parts, options.observables),
        *different_targets(parts),
    )
    ready = _calibrated(parts, references, options, rng, run)
    warnings = (
        *vetting_warnings(ready.vetting),
        *calibration_warnings(ready.calibration),
        *_two_that_disagree(ready),
        *calibrator_warnings(
            [part.only(options.observables) for part in parts],
            ready.serving,
            sized=options.calibrator_diameters is not None,
        ),
        *unused_calibrators(ready.calibration, [r.source for r in references]),
        *(uncalibrated_images(targets) if ready.calibration is None else ()),
        *joined,
    )
    charge = charge_of([*targets, *calibrators], images)
    return replace(ready, references=tuple(references), warnings=warnings, charge_migration=charge)


def read(
    paths: Sequence[str | Path], options: SearchOptions, *, one_star: bool = True
) -> list[Observables]:
    """Read files of any format, one table for each exposure, as the options ask."""
    found = read_observations(
        paths,
        options.images,
        one_star=one_star,
        insname=options.insname,
        target=options.target,
        closure_covariance=options.closure_covariance,
    )
    return [
        reduce_data(
            each,
            flag=options.flag,
            polarisations=options.average_polarisations,
            channels=options.bin_channels,
            # Calibrators are averaged key by key, whenever they were observed.
            epochs_days=options.merge_epochs_days if one_star else None,
        )
        for each in found
    ]


def _calibrated(
    parts: list[Observables],
    references: list[Observables],
    options: SearchOptions,
    rng: np.random.Generator,
    run: Run,
) -> Prepared:
    """Vet the calibrators and calibrate all targets together, or take these as calibrated."""
    if not references and options.library is None:
        return Prepared(join(parts))
    vetting, serving = None, references
    diameters = diameters_of(options.calibrator_diameters, references)
    sizes = diameters or [(0.0, 0.0)] * len(references)
    if len(references) >= MIN_TO_VET and not options.keep_all:
        with run.stage("vet"):
            vetting = _vetted(references, sizes, options)
            serving = _kept(references, vetting)
    kept = {id(reference) for reference in serving}
    sizes = [d for r, d in zip(references, sizes, strict=True) if id(r) in kept]
    method = options.calibration
    if options.library is not None:
        stored = read_library(options.library).without([*references, *parts])
        serving, sizes = [*serving, *stored.observables], [*sizes, *stored.diameters_mas]
        method = method or "population"
    with run.stage("calibrate"):
        calibration = calibrate(
            parts, serving, method=method, clip=options.clip, diameters_mas=sizes, rng=rng
        )
    return Prepared(
        calibration.observables,
        calibration=calibration,
        vetting=vetting,
        serving=tuple(serving),
        diameters_mas=tuple(sizes),
    )


def _two_that_disagree(ready: Prepared) -> list[str]:
    """Warn of two calibrators, too few to be vetted, that disagree."""
    if len(ready.serving) != 2 or ready.vetting is not None:
        return []
    each = zip(ready.serving, ready.diameters_mas, strict=True)
    first, second = (without_disc(data, *size) for data, size in each)
    p = agreement_of_two(first, second)
    if p is None or p >= VETTING_ALPHA:
        return []
    return [
        f"the calibrators {first.source} and {second.source} disagree (p = {p:.1g}): one of them "
        "may be no point, and which cannot be told (see amibayes vet, and give a third)"
    ]


def _vetted(
    references: list[Observables], sizes_mas: list[Diameter], options: SearchOptions
) -> Vetting:
    """Vet the calibrators, once for all targets of a survey that have the same ones."""
    points = [without_disc(r, *size) for r, size in zip(references, sizes_mas, strict=True)]
    vetted = partial(
        vet,
        points,
        separation_mas=options.separation_mas,
        null_draws=VETTING_DRAWS,
        limits=False,
        fewest=MIN_TO_VET,
        seed=options.seed,
    )
    return shared(vetted, "vetting", points, options.separation_mas, options.seed)


def _kept(references: list[Observables], vetting: Vetting) -> list[Observables]:
    """The calibrators that vetting kept.

    Raises
    ------
    DataError
        Where it kept none.
    """
    kept = [r for r, v in zip(references, vetting.calibrators, strict=True) if v.kept]
    if not kept:
        raise DataError(
            f"no calibrator is left: {vetting.calibrators[0].path} "
            f"{vetting.calibrators[0].reason}, and so on",
            source="--cal",
            remedy="give other calibrators, or --keep-all",
        )
    return kept

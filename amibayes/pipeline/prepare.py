"""From files to one calibrated table: read, vet the calibrators, calibrate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

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
    OIFITS,
    charge_of,
    check_together,
    first_file,
    format_of,
    of_one_visit,
    read_observations,
    uncalibrated_images,
)
from amibayes.oifits import open_oifits
from amibayes.oifits.setups import names_of_targets
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
from amibayes.support.shared_results import shared, shared_of_file
from amibayes.support.terminal import equals

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
        references = read_calibrators(calibrators, replace(options, images=images), parts)
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
            sized=_sized(ready, options),
            drifting=ready.calibration is not None and ready.calibration.method == "population",
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
    target = options.target if one_star else None
    found = read_observations(
        paths, options.images, one_star=one_star, target=target, **_of_oifits(options)
    )
    return [_reduced(each, options, one_star) for each in found]


def read_calibrators(
    paths: Sequence[str | Path], options: SearchOptions, targets: Sequence[Observables] = ()
) -> list[Observables]:
    """Read calibrators as `read` does; each star of a file that holds several is one.

    Parameters
    ----------
    paths : sequence of path
    options : SearchOptions
        ``cal_target`` chooses stars of files that hold several.
    targets : sequence of Observables
        What is calibrated: no calibrator, where ``cal_target`` chooses none.

    Returns
    -------
    list of Observables
        In the order of the files, and of the stars in each; the source of a star out of several
        is ``FILE (STAR)``.

    Raises
    ------
    UsageError
        Where a star that was chosen is in no file, or none is left of a file.
    """
    given = [str(path) for path in paths]
    stars = {path: stars_of(path) for path in given}
    several = [path for path in given if len(stars[path]) > 1]
    known = {name.casefold() for path in given for name in stars[path]}
    lost = [name for name in options.cal_target if name.casefold() not in known]
    if lost:
        raise UsageError(
            f"no calibrator file holds {', '.join(lost)}",
            source="--cal-target",
            remedy=f"files of several stars hold {', '.join(x for p in several for x in stars[p])}"
            if several
            else "leave it out: every file is of one star",
        )
    found = read([path for path in given if path not in several], options, one_star=False)
    placed = [(first_file(each, given), each) for each in found]
    own = {s.target.casefold() for part in targets for s in part.setups}
    for path in several:
        chosen = _chosen(path, stars[path], options.cal_target, own)
        placed += [(given.index(path), _star(path, name, options)) for name in chosen]
    return [each for _, each in sorted(placed, key=lambda pair: pair[0])]


def stars_of(path: str | Path) -> list[str]:
    """Names of the targets that an OIFITS file has data of; none of a file of another format."""
    if format_of(path) is not OIFITS:
        return []
    return shared_of_file(lambda: names_of_targets(open_oifits(path)), path, "stars")


def _chosen(path: str, stars: list[str], wanted: Sequence[str], targets: set[str]) -> list[str]:
    asked = {name.casefold() for name in wanted}
    chosen = [s for s in stars if (s.casefold() in asked if asked else s.casefold() not in targets)]
    if not chosen:
        raise UsageError(
            "holds no calibrator that is asked for",
            source=path,
            remedy=f"it has {', '.join(stars)}: choose with --cal-target",
        )
    return chosen


def _star(path: str, name: str, options: SearchOptions) -> Observables:
    """One star of a file that holds several, named after both."""
    (found,) = read_observations(path, options.images, target=name, **_of_oifits(options))
    setups = tuple(replace(s, source=f"{path} ({name})") for s in found.setups)
    return _reduced(replace(found, setups=setups), options, False)


def _of_oifits(options: SearchOptions) -> dict[str, Any]:
    return {"insname": options.insname, "closure_covariance": options.closure_covariance}


def _reduced(each: Observables, options: SearchOptions, one_star: bool) -> Observables:
    return reduce_data(
        each,
        flag=options.flag,
        polarisations=options.average_polarisations,
        channels=options.bin_channels,
        # Calibrators are averaged key by key, whenever they were observed.
        epochs_days=options.merge_epochs_days if one_star else None,
    )


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


def _sized(ready: Prepared, options: SearchOptions) -> bool:
    """Whether sizes of calibrators are stated, by an option or by a library for all of them."""
    stored = [diameter > 0.0 for diameter, _ in ready.diameters_mas]
    return options.calibrator_diameters is not None or (bool(stored) and all(stored))


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
        f"the calibrators {first.source} and {second.source} disagree (p {equals(p)}): one of them "
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

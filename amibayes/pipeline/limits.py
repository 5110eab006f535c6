"""The job of `amibayes limits`: what a target's data would have shown, and with what chance."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from amibayes.calibration import Calibration
from amibayes.companion_search.result import SearchResult
from amibayes.comparison.compare import ModelComparison
from amibayes.comparison.limits import LimitsBeside
from amibayes.data.observables import Observables
from amibayes.detection.false_alarm import Significance, draws_needed, reachable
from amibayes.errors import DataError, UsageError
from amibayes.extraction.charge import CubeMigration
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.limits.analytic import analytic_limit
from amibayes.limits.completeness import detection_limit
from amibayes.limits.limit import Limit
from amibayes.limits.mass_table import MassTable
from amibayes.parallel import (
    Executor,
    ForkExecutor,
    Journals,
    Progress,
    run_job,
)
from amibayes.pipeline.false_alarm import false_alarm
from amibayes.pipeline.field import FieldSearch, search_field
from amibayes.pipeline.models import compare_stage, limits_stage, models_warnings
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.prepare import Prepared, prepare
from amibayes.pipeline.run import Announce, Run, silent
from amibayes.pipeline.warnings import search_warnings
from amibayes.posterior.priors import default_prior
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Rows, Shown
from amibayes.support.options import (
    LIMITS_NULL_DRAWS,
    LIMITS_SEPARATIONS,
    LIMITS_TRIALS,
    LimitCriterion,
)

Kinds = tuple[str, ...]

KINDS: tuple[Kinds, ...] = (("vis2", "cp"), ("vis2",), ("cp",))
"""What limits are drawn for, if nothing else is asked: all data, and each kind by itself."""

NAMES: dict[Kinds, str] = {("vis2", "cp"): "V² + CP", ("vis2",): "V²", ("cp",): "CP"}
"""Choices of observables, for readers."""


@checks_arguments
@dataclass(frozen=True)
class LimitsOptions:
    """What is asked of `measure_limits`.

    Parameters
    ----------
    search : SearchOptions
        How the data are read and searched; null draws, α and seed.
    criterion : {"injection", "absil", "candid", "posterior", "closure-phase"}
    observables : tuple of {"vis2", "cp"}, optional
        One limit from these; by default one from all data and one from each kind.
    n_separations : int
        Rings from the inner to the outer edge of the field.
    trials : int
        Companions injected per separation.
    masses : MassTable, optional
        For an axis of masses.
    """

    search: SearchOptions = field(default_factory=SearchOptions)
    criterion: LimitCriterion = "injection"
    observables: Kinds | None = None
    n_separations: int = LIMITS_SEPARATIONS
    trials: int = LIMITS_TRIALS
    masses: MassTable | None = None


@dataclass(frozen=True, eq=False)
class MeasuredLimit:
    """The limit from one choice of observables.

    Parameters
    ----------
    observables : tuple of {"vis2", "cp"}
    found : FieldSearch
        The search whose limit it is.
    significance : Significance or None
    limit : Limit
    """

    observables: Kinds
    found: FieldSearch
    significance: Significance | None
    limit: Limit

    @property
    def result(self) -> SearchResult:
        """Of the search."""
        return self.found.result

    @property
    def noise(self) -> ExtraNoise:
        """That the search fitted."""
        return self.found.noise


@dataclass(frozen=True, eq=False, repr=False)
class LimitsReport(Shown):
    """Everything `measure_limits` found; the first of ``limits`` is the main one."""

    options: LimitsOptions
    targets: tuple[str, ...]
    calibrators: tuple[str, ...]
    observables: Observables
    calibration: Calibration | None
    limits: tuple[MeasuredLimit, ...]
    warnings: tuple[str, ...]
    timing_s: dict[str, float] = field(default_factory=dict)
    models: ModelComparison | None = None
    beside: LimitsBeside | None = None
    charge_migration: CubeMigration | None = None

    def rows(self) -> Rows:
        """What an interpreter shows."""
        return [
            ("targets", ", ".join(self.targets)),
            ("calibrators", ", ".join(self.calibrators) or "none"),
            ("criterion", self.options.criterion),
            *((NAMES[one.observables], repr(one.limit)) for one in self.limits),
            *(("warning", text) for text in self.warnings),
        ]

    @property
    def main(self) -> MeasuredLimit:
        """The limit from all the observables that were asked for."""
        return self.limits[0]


@checks_arguments
def measure_limits(
    targets: Sequence[str | Path],
    calibrators: Sequence[str | Path] = (),
    options: LimitsOptions | None = None,
    *,
    journals: Journals | None = None,
    announce: Announce = silent,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> LimitsReport:
    """Measure what companions the data would have shown.

    Parameters
    ----------
    targets, calibrators : sequence of path
        OIFITS files or image cubes, as for `amibayes.search_companion`.
    options : LimitsOptions, optional
    journals : Journals, optional
        Keep finished pieces, so that a run that was cut off goes on.
    announce, progress, executor : optional
        As for `amibayes.search_companion`.

    Raises
    ------
    DataError
        Where a file cannot be read or the data cannot carry the fit.
    UsageError
        Where the request makes no sense.
    """
    options = options or LimitsOptions()
    _refuse(options)
    seeds = np.random.SeedSequence(options.search.seed).spawn(5 + len(KINDS))
    run = Run(announce, progress, executor, journals)
    # One BLAS thread: the same bits on every machine and for any number of workers.
    with threadpool_limits(1):
        # The fourth stream, as in the main job: the same calibration for the same seed.
        rng = np.random.default_rng(seeds[3])
        ready = run.keep("data", lambda: prepare(targets, calibrators, options.search, rng, run))
        limits, notes = _all_limits(ready, options, seeds[5:], run)
        models, beside = beside_models(
            limits[0], options.search, np.random.default_rng(seeds[4]), run
        )
    return LimitsReport(
        options,
        tuple(str(p) for p in targets),
        tuple(str(p) for p in calibrators),
        ready.observables,
        ready.calibration,
        limits,
        (*ready.warnings, *notes, *models_warnings(models)),
        run.seconds,
        models,
        beside,
        ready.charge_migration,
    )


def beside_models(
    main: MeasuredLimit,
    search: SearchOptions,
    rng: np.random.Generator,
    run: Run,
) -> tuple[ModelComparison | None, LimitsBeside | None]:
    """Compare models of the sky where they were asked for, and limits beside a stated disc."""
    if search.models is None:
        return None, None
    search = replace(search, observables=main.observables)
    grid = main.result.grid
    prior = default_prior(main.result.likelihood, grid.inner_mas, grid.outer_mas)
    models = compare_stage(main.found, prior, search, rng, run)
    return models, limits_stage(models, main.found, search, rng, run)


def _refuse(options: LimitsOptions) -> None:
    alpha, draws = options.search.alpha, options.search.null_draws
    few = draws is not None and not reachable(alpha, draws)
    if options.criterion == "injection" and few:
        raise UsageError(
            f"{draws} null draws cannot measure a false-alarm probability of {alpha:g}",
            source="--null-draws",
            remedy=f"give {draws_needed(alpha)} or more, or another --criterion",
        )
    if options.criterion == "closure-phase" and options.observables not in (None, ("cp",)):
        raise UsageError("uses closure phases alone", source="--criterion closure-phase")


@dataclass(frozen=True, eq=False)
class _Choice:
    """One choice of observables: its options, random numbers and run, and its search once done."""

    search: SearchOptions
    seed: np.random.SeedSequence
    run: Run
    found: FieldSearch | None = None

    @property
    def name(self) -> str:
        return NAMES[self.search.observables]

    def searched(self, data: Observables) -> FieldSearch:
        """Search the field, unless that is done."""
        return self.found or self.run.keep_stage(
            "search", lambda: search_field(data, self.search), f"search {self.name}"
        )


def _all_limits(
    ready: Prepared,
    options: LimitsOptions,
    seeds: Sequence[np.random.SeedSequence],
    run: Run,
) -> tuple[tuple[MeasuredLimit, ...], list[str]]:
    """Measure the main limit, and the others over the field and with the disc of the main one.

    They need its search only: then all are measured at a time, each in a process of its own, which
    two cores share evenly. Where there are more cores than limits each limit has all of them.
    """
    data = ready.observables
    choices = [
        _Choice(replace(options.search, observables=kinds), seed, run.under("-".join(kinds)))
        for kinds, seed in zip(_kinds(data, options), seeds, strict=False)
    ]
    main = choices[0].searched(data)
    data = main.observables  # the same rows for all
    alike = [replace(c, search=_alike(c.search, main.result)) for c in choices[1:]]
    choices = [replace(choices[0], found=main), *alike]
    workers = run.executor.workers if isinstance(run.executor, ForkExecutor) else 0
    if 1 < workers <= len(choices):
        alone = [replace(c, run=c.run.alone()) for c in choices]
        work = partial(_measured, data, options, alone)
        executor = ForkExecutor(len(choices), first_here=False)
        with run.stage("limits"), closing(executor):
            done = list(run_job(work, range(len(choices)), executor))
    else:
        done = [_measured(data, options, choices, k) for k in range(len(choices))]
    for _, _, seconds in done:
        run.seconds.update(seconds)
    limits = tuple(limit for limit, _, _ in done if limit is not None)
    return limits, [note for _, notes, _ in done for note in notes]


def _measured(
    data: Observables, options: LimitsOptions, choices: list[_Choice], index: int
) -> tuple[MeasuredLimit | None, list[str], dict[str, float]]:
    """Measure one limit; give it, what is to be told of it, and the seconds of its stages."""
    choice = choices[index]
    try:
        limit, notes = _one_limit(data, choice, options)
    except DataError as error:
        if index == 0:
            raise
        kinds = " + ".join(choice.search.observables)
        return None, [f"no limit from {kinds} alone: {error.what}"], choice.run.seconds
    return limit, notes if index == 0 else [], choice.run.seconds


def _kinds(data: Observables, options: LimitsOptions) -> list[Kinds]:
    """List the choices of observables, the main one first."""
    if options.observables is not None:
        return [options.observables]
    if options.criterion == "closure-phase":
        return [("cp",)]
    present = {"vis2": data.n_vis2 > 0, "cp": data.n_closure_phases > 0}
    if all(present.values()):
        return list(KINDS)
    return [tuple(kind for kind, there in present.items() if there) or KINDS[0]]


def _alike(search: SearchOptions, main: SearchResult) -> SearchOptions:
    """Keep to the main limit's field; what one kind of data cannot fit is held at its value."""
    field = main.grid.inner_mas, main.grid.outer_mas
    search = replace(search, separation_mas=field, keep_outliers=True)
    if "vis2" in search.observables:
        return search
    return replace(
        search,
        diameter=main.nuisance("diameter_mas"),
        limb_darkening=main.nuisance("limb_darkening"),
        background=main.nuisance("background"),
        companion_diameter=main.nuisance("companion_diameter_mas"),
    )


def _one_limit(
    data: Observables, choice: _Choice, options: LimitsOptions
) -> tuple[MeasuredLimit, list[str]]:
    run, name = choice.run, choice.name
    streams = [np.random.default_rng(k) for k in choice.seed.spawn(2)]

    found = choice.searched(data)
    tested, search = None, _with_draws(found.result, choice.search)
    if search.null_draws != 0:
        with run.stage(f"null searches {name}"):
            tested = false_alarm(
                found.result, search, streams[0], run.executor, run.progress,
                journal=run.journal("null"),
            )  # fmt: skip
    with run.stage(f"limits {name}"):
        limit = _limit(found, tested, options, streams[1], run)
    measured = MeasuredLimit(search.observables, found, tested, limit)
    notes = search_warnings(found.observables, found.result, found.noise, tested, None)
    return measured, [*found.warnings, *notes]


NULL_WORK = 5e10
"""Positions times data of the null searches of one limit: two seconds of one core."""


def _with_draws(result: SearchResult, search: SearchOptions) -> SearchOptions:
    """Ask for so many null searches as a threshold needs and as can be afforded, unless given."""
    if search.null_draws is not None:
        return search
    afforded = int(NULL_WORK / (len(result.grid) * result.likelihood.n_independent))
    draws = max(min(LIMITS_NULL_DRAWS, afforded), draws_needed(search.alpha))
    return replace(search, null_draws=draws)


def _limit(
    found: FieldSearch,
    tested: Significance | None,
    options: LimitsOptions,
    rng: np.random.Generator,
    run: Run,
) -> Limit:
    if options.criterion != "injection":
        remove = tested is not None and bool(tested.detected)
        return analytic_limit(
            found.result, options.criterion, n_separations=options.n_separations, remove=remove
        )
    assert tested is not None
    return detection_limit(
        found.result,
        tested,
        rng,
        n_separations=options.n_separations,
        trials=options.trials,
        noise=found.noise,
        executor=run.executor,
        progress=run.progress,
        journals=run.journals,
    )

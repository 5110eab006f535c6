"""The main job: prepare, search, significance, limits, posterior, report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.second_companion import TwoCompanions, search_second
from amibayes.companion_search.with_extra_noise import noise_averaged, with_errors_of
from amibayes.comparison.compare import ModelComparison
from amibayes.comparison.hypotheses import extended_parameters
from amibayes.comparison.limits import LimitsBeside
from amibayes.detection.false_alarm import Significance, beside_bright
from amibayes.detection.splits import Consistency
from amibayes.detection.verdict import Verdict
from amibayes.likelihood.averaged_noise import NoisePosterior
from amibayes.likelihood.likelihood import single_likelihood
from amibayes.limits.completeness import detection_limit
from amibayes.limits.limit import DetectionLimit
from amibayes.parallel import Executor, Journals, Progress
from amibayes.pipeline.false_alarm import false_alarm, second_false_alarm, verdict_of
from amibayes.pipeline.field import FieldSearch, search_field
from amibayes.pipeline.models import (
    compare_stage,
    limits_stage,
    with_models,
)
from amibayes.pipeline.options import SearchOptions, noise_prior
from amibayes.pipeline.prepare import Prepared, prepare
from amibayes.pipeline.report_types import SearchReport
from amibayes.pipeline.run import Announce, Run, silent
from amibayes.pipeline.warnings import consistency_warnings, search_warnings
from amibayes.posterior.bootstrap import Bootstrap, bootstrap
from amibayes.posterior.ensemble import Posterior, sample
from amibayes.posterior.evidence import Evidence, compare_models
from amibayes.posterior.grid import GridPosterior, affordable, grid_posterior
from amibayes.posterior.priors import Prior, default_prior, edit_prior
from amibayes.support.arguments import checks_arguments

MAX_NOISE_SAMPLES, NOISE_RESIDUALS = 2000, 20_000_000
"""Samples of the posterior that the noise is averaged over: its median is then known to 2 % of
its width. Fewer of many data, whose residuals fill the memory; 200 know it to 6 %."""

Streams = dict[str, np.random.Generator]


@checks_arguments
def search_companion(
    targets: Sequence[str | Path],
    calibrators: Sequence[str | Path] = (),
    options: SearchOptions | None = None,
    *,
    chain: str | Path | None = None,
    resume: bool = False,
    journals: Journals | None = None,
    announce: Announce = silent,
    progress: Progress | None = None,
    executor: Executor | None = None,
    early: Callable[[SearchReport], None] | None = None,
) -> SearchReport:
    """Find and measure a companion, with its false-alarm probability: the main job.

    Parameters
    ----------
    targets, calibrators : sequence of path
        OIFITS files or image cubes. Targets are fitted together; without calibrators they
        are taken as calibrated. A file of several stars may be one of both
        (``options.target``, ``options.cal_target``).
    options : SearchOptions, optional
    chain, resume : optional
        HDF5 file for the chain of the posterior, and whether to go on from it.
    journals : Journals, optional
        Keep finished null draws and injections, so that a run that was cut off goes on.
    announce : callable
        Called with the name of each stage as it begins.
    progress : callable, optional
        Called with (done, expected) within the longer stages.
    executor : Executor, optional
        Where null draws and limits are computed; the result does not depend on it.
    early : callable, optional
        Called with what there is of the report before the posterior begins.

    Raises
    ------
    DataError
        Where a file cannot be read or the data cannot carry the fit.
    UsageError
        Where the request makes no sense.
    """
    options = options or SearchOptions()
    run = Run(announce, progress, executor, journals)
    rng = _streams(options.seed)
    # One BLAS thread: the same bits on every machine and for any number of workers.
    with threadpool_limits(1):
        ready = run.keep(
            "data", lambda: prepare(targets, calibrators, options, rng["calibration"], run)
        )
        found = run.keep("search", lambda: _searched(ready, options, run))
        tests = _tested(ready, found, options, rng, run)
        limits = run.keep("limits", lambda: _limits(found, tests, options, rng["limits"], run))
        if early is not None and options.posterior:
            ended = _report(options, ready, found, tests, limits, Inference())
            early(_named(ended, targets, calibrators, run))
        posterior = _inferred(found, options, rng, run, (chain, resume))
        models, beside = run.keep("models", lambda: _compared(found, options, rng, run))
    report = with_models(_report(options, ready, found, tests, limits, posterior), models, beside)
    return _named(report, targets, calibrators, run)


def _named(
    report: SearchReport, targets: Sequence[str | Path], calibrators: Sequence[str | Path], run: Run
) -> SearchReport:
    """Put in the names of the files, and how long the stages took."""
    return replace(
        report,
        targets=tuple(str(p) for p in targets),
        calibrators=tuple(str(p) for p in calibrators),
        timing_s=run.seconds,
    )


def _compared(
    found: Found, options: SearchOptions, rng: Streams, run: Run
) -> tuple[ModelComparison | None, LimitsBeside | None]:
    """Compare models of the sky, and measure limits beside a disc; None where not asked for."""
    prior = _prior(found.result, options)
    models = compare_stage(found, prior, options, rng["models"], run)
    return models, limits_stage(models, found, options, rng["models"], run)


def _streams(seed: int) -> Streams:
    """Independent random numbers for every stage that draws some."""
    first = ("significance", "posterior", "limits", "calibration", "evidence", "second")
    # New ones at the end: the others keep their numbers.
    stages = (*first, "verdict", "bootstrap", "models")
    seeds = np.random.SeedSequence(seed).spawn(len(stages))
    return {s: np.random.default_rng(k) for s, k in zip(stages, seeds, strict=True)}


@dataclass(frozen=True, eq=False)
class Found(FieldSearch):
    """The search stage: the field, and a second companion where one was asked for."""

    two: TwoCompanions | None = None


def _searched(ready: Prepared, options: SearchOptions, run: Run) -> Found:
    with run.stage("search"):
        field = search_field(ready.observables, options)
    two = None
    if 2 in _counts(options):
        with run.stage("second companion"):
            two = search_second(field.result)
    return Found(field.result, field.noise, field.warnings, field.observables, field.left_out, two)


@dataclass(frozen=True)
class Tests:
    """The significance stage: of the companion, and of the second one; None where not tested."""

    first: Significance | None = None
    second: Significance | None = None
    verdict: Verdict | None = None
    splits: tuple[Consistency, ...] = ()


def _tested(ready: Prepared, found: Found, options: SearchOptions, rng: Streams, run: Run) -> Tests:
    if options.null_draws == 0:
        return Tests()
    first, second = run.keep("significance", lambda: _significance(found, options, rng, run))
    if first.detected is None:
        return Tests(first, second)

    verdict, splits = run.keep_stage(
        "verdict",
        lambda: verdict_of(
            found, first, options, rng["verdict"], run.executor,
            ready.exchangeable,
        ),
    )  # fmt: skip
    return Tests(first, second, verdict, splits)


def _significance(
    found: Found, options: SearchOptions, rng: Streams, run: Run
) -> tuple[Significance, Significance | None]:
    """Of the companion, and of a second one where it was searched for."""
    with run.stage("significance"):
        first = false_alarm(
            found.result, options, rng["significance"], run.executor, run.progress,
            journal=run.journal("null"),
        )  # fmt: skip
        first = beside_bright(first, found.result, found.noise)
    if found.two is None:
        return first, None
    with run.stage("significance of the second"):
        return first, second_false_alarm(
            found.result, options, rng["second"], run.executor, run.progress
        )


def _limits(
    found: Found, tests: Tests, options: SearchOptions, rng: np.random.Generator, run: Run
) -> DetectionLimit | None:
    """Measure the detection limits; None where unwanted or without null draws."""
    if tests.first is None or tests.first.detected is None or not options.limits:
        return None
    with run.stage("limits"):
        return detection_limit(
            found.result,
            tests.first,
            rng,
            noise=found.noise,
            executor=run.executor,
            progress=run.progress,
            journals=run.under("limits").journals,
        )


@dataclass(frozen=True, eq=False)
class Inference:
    """The posterior stage; None where a part is unwanted."""

    samples: Posterior | None = None
    grid: GridPosterior | None = None
    evidence: Evidence | None = None
    noise: dict[str, NoisePosterior] | None = None
    resampled: Bootstrap | None = None
    best: SearchResult | None = None


def _inferred(
    found: Found,
    options: SearchOptions,
    rng: Streams,
    run: Run,
    chain: tuple[str | Path | None, bool],
) -> Inference:
    """Posterior and evidence, averaged over the unknown extra noise."""
    result, two = noise_averaged(
        found.result,
        found.two,
        found.observables.only(options.observables),
        extra_noise=options.extra_noise,
        per_file=options.file_noise is not False,
        noise=found.noise,
        prior=noise_prior(found.observables.only(options.observables), options),
    )
    prior, counts = _prior(result, options), _counts(options)
    grid = samples = evidence = resampled = None
    if (options.posterior or counts) and affordable(result.likelihood, prior):
        grid = run.keep_stage("integrate", lambda: grid_posterior(result.likelihood, prior))
    if options.posterior:
        path, resume = chain
        samples = run.keep_stage(
            "posterior",
            lambda: sample(
                result, prior, rng["posterior"], path=path, resume=resume, grid=grid,
                progress=run.progress,
            ),
        )  # fmt: skip
    if counts:
        evidence = run.keep_stage(
            "evidence",
            lambda: compare_models(
                result, prior, rng["evidence"], companions=counts, grid=grid, two=two,
                method=options.evidence_method,
            ),
        )  # fmt: skip
    if options.bootstrap:
        resampled = run.keep_stage(
            "bootstrap",
            lambda: bootstrap(
                found.result, found.noise, options.bootstrap, rng["bootstrap"],
                progress=run.progress,
            ),
        )  # fmt: skip
    best = with_errors_of(found.result, result)
    return Inference(samples, grid, evidence, _noise_posterior(result, samples), resampled, best)


def _noise_posterior(
    averaged: SearchResult, posterior: Posterior | None
) -> dict[str, NoisePosterior] | None:
    likelihood = averaged.likelihood
    if posterior is None or not likelihood.noise.parameters:
        return None
    # Spread over the whole chain: its beginning alone is not the posterior.
    most = min(MAX_NOISE_SAMPLES, NOISE_RESIDUALS // likelihood.observables.covariance.size + 1)
    every = max(1, len(posterior.samples) // most)
    residual = likelihood.difference(posterior.samples[::every])
    return dict(likelihood.noise.posterior(residual))


def _report(
    options: SearchOptions,
    ready: Prepared,
    found: Found,
    tests: Tests,
    limits: DetectionLimit | None,
    posterior: Inference,
) -> SearchReport:
    """Put the results of the stages together."""
    return SearchReport(
        options=options,
        targets=(),
        calibrators=(),
        observables=found.observables,
        calibration=ready.calibration,
        references=ready.references,
        vetting=ready.vetting,
        result=posterior.best or found.result,
        noise=found.noise,
        left_out=found.left_out,
        significance=tests.first,
        second_significance=tests.second,
        verdict=tests.verdict,
        consistency=tests.splits,
        limits=limits,
        posterior=posterior.samples,
        grid=posterior.grid,
        evidence=posterior.evidence,
        noise_posterior=posterior.noise,
        bootstrap=posterior.resampled,
        charge_migration=ready.charge_migration,
        warnings=_warnings(ready, found, tests, posterior),
    )


def _warnings(ready: Prepared, found: Found, tests: Tests, posterior: Inference) -> tuple[str, ...]:
    statement = None if tests.verdict is None else tests.verdict.statement
    warnings = search_warnings(
        found.observables, found.result, found.noise, tests.first, posterior.samples,
        stated=statement in (None, "companion"),
    )  # fmt: skip
    told = statement == "inconsistent data"
    splits = [] if told else consistency_warnings(tests.splits)
    return (*ready.warnings, *found.warnings, *splits, *warnings)


def _prior(result: SearchResult, options: SearchOptions) -> Prior:
    likelihood = result.likelihood
    prior = default_prior(likelihood, result.grid.inner_mas, result.grid.outer_mas)
    others = extended_parameters(options.models or ())
    names = single_likelihood(likelihood).parameters.names
    return edit_prior(prior, options.settings[0], names, others)


def _counts(options: SearchOptions) -> tuple[int, ...]:
    """Numbers of companions to compare."""
    if options.companions is None:
        return (0, 1) if options.posterior else ()
    return options.companions

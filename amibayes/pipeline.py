"""The main job, as a reader would tell it: read, calibrate, search, weigh, sample."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from amibayes.calibration import Calibration, calibrate
from amibayes.errors import DataError, UsageError
from amibayes.extraction.reading import read_observations
from amibayes.inference.bank import TemplateBank
from amibayes.inference.evidence import Evidence, weigh_models
from amibayes.inference.grid_posterior import GridPosterior, affordable, grid_posterior
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.limits import detection_limit
from amibayes.inference.model import BinaryModel
from amibayes.inference.multiplicity import search_second
from amibayes.inference.noise import ExtraNoise, search_with_noise
from amibayes.inference.posterior import Posterior, modes_to_sample, sample
from amibayes.inference.priors import Prior, default_prior, edit_prior
from amibayes.inference.refine import single_likelihood
from amibayes.inference.results import SearchResult
from amibayes.inference.search import look_outside, resolves_stars, search
from amibayes.inference.significance import Significance, bank_statistic, significance
from amibayes.job import SearchOptions, SearchReport
from amibayes.observables import Observables, join
from amibayes.parallel import Executor, Progress
from amibayes.vetting import Vetting, doubts, vet

Stage = Callable[[str], None]


FEWEST_TO_VET = 3
"""Of two calibrators that disagree nothing says which is the bad one."""

VETTING_DRAWS = 1000

MOST_FIELDS = 3
"""How often the default field is widened."""


class _Clock:
    """Times the stages and announces them."""

    def __init__(self, announce: Stage) -> None:
        self.seconds: dict[str, float] = {}
        self._announce = announce

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._announce(name)
        begin = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - begin


def search_companion(
    targets: Sequence[str | Path],
    calibrators: Sequence[str | Path] = (),
    options: SearchOptions | None = None,
    *,
    chain: str | Path | None = None,
    resume: bool = False,
    announce: Stage = lambda name: None,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> SearchReport:
    """Find, weigh and measure a companion: the main job.

    Parameters
    ----------
    targets, calibrators : sequence of path
        OIFITS files or image cubes. Targets are fitted together; without calibrators they
        are taken as calibrated.
    options : SearchOptions, optional
    chain : path, optional
        HDF5 file for the chain of the posterior.
    resume : bool
        Go on from ``chain``.
    announce : callable
        Told the name of each stage as it begins.
    progress : callable, optional
        Told (done, expected) within the longer stages.
    executor : Executor, optional
        Where null draws and limits are computed; the result does not depend on it.

    Raises
    ------
    DataError
        Where a file cannot be read or the data cannot carry the fit.
    UsageError
        Where the request makes no sense.
    """
    options = options or SearchOptions()
    if not targets:
        raise UsageError("no target given", remedy="name at least one file")
    streams = [np.random.default_rng(k) for k in np.random.SeedSequence(options.seed).spawn(5)]
    clock = _Clock(announce)
    weight, posterior, limits = None, None, None
    # One BLAS thread: the same bits on every machine and for any number of workers.
    with threadpool_limits(1):
        with clock.stage("read"):
            parts = [_read(path, options) for path in targets]
            references = [_read(path, options) for path in calibrators]
        vetting, calibration, observables = _calibrated(
            parts, references, options, streams[3], clock
        )
        with clock.stage("search"):
            result, noise, widened = _searched(observables, options)
        if options.null_draws:
            with clock.stage("significance"):
                weight = _weigh(result, options, streams[0], executor, progress)
        if options.limits and weight is not None:
            with clock.stage("limits"):
                limits = detection_limit(
                    result, weight, streams[2], executor=executor, progress=progress
                )
        prior = _prior(result, options)
        grid = _integrated(result, prior, options, clock)
        if options.posterior:
            onward = _Chain(chain, resume, progress)
            posterior = _sampled(result, prior, grid, streams[1], onward, clock)
        evidence = _compared(result, prior, grid, options, streams[4], clock)
    said = [*_vetting_warnings(vetting), *widened, *_different_targets(parts)]
    return SearchReport(
        options,
        tuple(str(p) for p in targets),
        tuple(str(p) for p in calibrators),
        observables,
        calibration,
        tuple(references),
        vetting,
        result,
        noise,
        weight,
        posterior,
        limits,
        (*said, *_warnings(observables, result, noise, weight, posterior)),
        grid,
        evidence,
        clock.seconds,
    )


@dataclass(frozen=True)
class _Chain:
    """Where the chain of a posterior is kept, and who is told how far it is."""

    path: str | Path | None
    resume: bool
    progress: Progress | None


def _sampled(
    result: SearchResult,
    prior: Prior,
    grid: GridPosterior | None,
    rng: np.random.Generator,
    chain: _Chain,
    clock: _Clock,
) -> Posterior:
    with clock.stage("posterior"):
        return sample(
            result,
            prior,
            rng,
            path=chain.path,
            resume=chain.resume,
            grid=grid,
            progress=chain.progress,
        )


def _calibrated(
    parts: list[Observables],
    references: list[Observables],
    options: SearchOptions,
    rng: np.random.Generator,
    clock: _Clock,
) -> tuple[Vetting | None, Calibration | None, Observables]:
    """Vet the calibrators and calibrate all targets together, or take these as calibrated."""
    if not references:
        return None, None, join(parts)
    vetting, believed = None, references
    if len(references) >= FEWEST_TO_VET and not options.keep_all:
        with clock.stage("vet"):
            vetting = vet(
                references,
                separation_mas=options.separation_mas,
                null_draws=VETTING_DRAWS,
                limits=False,
                seed=options.seed,
            )
            believed = _believed(references, vetting)
    with clock.stage("calibrate"):
        calibration = calibrate(
            parts, believed, method=options.calibration, clip=options.clip, rng=rng
        )
    return vetting, calibration, calibration.observables


def _searched(
    observables: Observables, options: SearchOptions
) -> tuple[SearchResult, ExtraNoise, list[str]]:
    """Search the field; the default one is widened where something around it fits better."""
    likelihood = Likelihood(observables.only(options.observables))
    likelihood = likelihood.with_model(_model(likelihood, options))
    field, said = options.separation_mas, []
    for _ in range(MOST_FIELDS):
        if options.extra_noise:
            result, noise = search_with_noise(likelihood, field)
        else:
            result, noise = search(likelihood, field), ExtraNoise()
        place = None if options.separation_mas else look_outside(result)
        if place is None:
            break
        field = (result.grid.inner_mas, 1.5 * place)
        said = [
            f"the field was widened to {field[1]:.1f} mas: near {place:.1f} mas, outside the "
            "default one, a companion fits better than anywhere inside"
        ]
    return result, noise, said


def _different_targets(parts: list[Observables]) -> list[str]:
    names = dict.fromkeys(s.target for p in parts for s in p.setups if s.target)
    if len(names) < 2:
        return []
    return [f"targets of different names are fitted as one: {', '.join(names)}"]


def _read(path: str | Path, options: SearchOptions) -> Observables:
    return read_observations(
        path,
        options.images,
        insname=options.insname,
        target=options.target,
        closure_covariance=options.closure_covariance,
    )


def _believed(references: list[Observables], vetting: Vetting) -> list[Observables]:
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


def _vetting_warnings(vetting: Vetting | None) -> list[str]:
    if vetting is None:
        return []
    dropped = [
        f"calibrator {v.path} dropped: {v.reason}" for v in vetting.calibrators if not v.kept
    ]
    return dropped + [
        f"calibrator {v.path} {doubt}"
        for v in vetting.calibrators
        for doubt in doubts(v, vetting.alpha)
    ]


def _model(likelihood: Likelihood, options: SearchOptions) -> BinaryModel:
    diameter = options.diameter
    if diameter is None:
        diameter = "free" if resolves_stars(likelihood) else 0.0
    return BinaryModel(1, diameter, options.background, options.smearing)


def _prior(result: SearchResult, options: SearchOptions) -> Prior:
    prior = default_prior(result.likelihood, result.grid.inner_mas, result.grid.outer_mas)
    return edit_prior(prior, options.prior, result.likelihood.parameters[3:])


def _integrated(
    result: SearchResult, prior: Prior, options: SearchOptions, clock: _Clock
) -> GridPosterior | None:
    """Integrate the posterior over a grid where something needs it and it is cheap enough."""
    wanted = options.posterior or _counts(options)
    if not wanted or not affordable(result.likelihood, prior):
        return None
    with clock.stage("integrate"):
        return grid_posterior(result.likelihood, prior)


def _compared(
    result: SearchResult,
    prior: Prior,
    grid: GridPosterior | None,
    options: SearchOptions,
    rng: np.random.Generator,
    clock: _Clock,
) -> Evidence | None:
    """Weigh the asked numbers of companions against each other."""
    counts = _counts(options)
    if not counts:
        return None
    with clock.stage("evidence"):
        return weigh_models(
            result,
            prior,
            rng,
            companions=counts,
            grid=grid,
            two=search_second(result) if 2 in counts else None,
            method=options.evidence_method,
        )


def _counts(options: SearchOptions) -> tuple[int, ...]:
    """Numbers of companions to compare."""
    if options.companions is None:
        return (0, 1) if options.posterior else ()
    return options.companions


def _weigh(
    result: SearchResult,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None,
    progress: Progress | None,
) -> Significance:
    """Weigh the search; unless errors are to be trusted, by a statistic free of their scale.

    Whether noise was added depends on the data, and a false companion can hide that it
    should have been: a statistic that does not know the scale needs no such decision.
    """
    bank = TemplateBank(result.likelihood, result.grid, result.single_theta)
    residuals = single_likelihood(result.likelihood).residuals(result.single_theta)
    statistic = float(bank_statistic(bank, residuals, free_scale=options.extra_noise)[0])
    return significance(
        bank,
        statistic,
        options.null_draws,
        rng,
        options.alpha,
        free_scale=options.extra_noise,
        executor=executor,
        progress=progress,
    )


def _warnings(
    observables: Observables,
    result: SearchResult,
    noise: ExtraNoise,
    weight: Significance | None,
    posterior: Posterior | None,
) -> tuple[str, ...]:
    found = [*result.warnings, *observables.notes]
    if noise.any:
        found.append(
            f"the stated errors do not explain the residuals: noise of {noise.vis2:.2g} in V2 and "
            f"{np.degrees(noise.closure_phase_rad):.2g} deg in closure phase was added in "
            "quadrature; chi2 and errors include it"
        )
    elif result.chi2_binary / result.ndof > 2.0:
        found.append(
            f"reduced chi2 is {result.chi2_binary / result.ndof:.1f} with the companion: the "
            "errors are too small or the model is incomplete, and significance and errors are "
            "too optimistic"
        )
    if weight is not None and weight.detected is None:
        found.append(
            f"{weight.n_draws} null draws cannot tell a false-alarm probability below "
            f"{weight.alpha:g}: nothing is said to be detected or not (raise --null-draws)"
        )
    elif weight is not None and weight.tail is not None:
        found.append(
            f"none or few of the {weight.n_draws} null draws reach the observed statistic: the "
            f"false-alarm probability is below about {weight.interval[1]:.1g}; anything smaller "
            "is extrapolated"
        )
    if posterior is not None and len(posterior.mode_probability) > 1:
        share = posterior.mode_probability[0]
        if share < 0.99 and len(modes_to_sample(result)) == 1:
            found.append(
                f"the posterior is that of the reported position, whose probability among "
                f"{len(posterior.mode_probability)} modes is {share:.2f} ({posterior.mode_method})"
            )
    if posterior is not None and not posterior.converged:
        found.append(
            f"the posterior has NOT converged: {posterior.n_steps} steps, autocorrelation time "
            f"{posterior.autocorrelation_time:.0f}, split R-hat {posterior.split_rhat:.3f}"
        )
    return tuple(found)

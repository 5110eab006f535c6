"""The main job, as a reader would tell it: read, calibrate, search, weigh, sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.robust import search_robust
from amibayes.companion_search.search import (
    SURELY_NOT_NOISE,
    look_inside,
    look_outside,
    resolves_stars,
    search,
)
from amibayes.companion_search.second_companion import TwoCompanions, search_second
from amibayes.companion_search.with_extra_noise import noise_averaged, search_with_noise
from amibayes.data.observables import Observables
from amibayes.detection.false_alarm import Significance
from amibayes.likelihood.averaged_noise import NoisePosterior
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.joint import joint_likelihood
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.limits.completeness import detection_limit
from amibayes.limits.limit import DetectionLimit
from amibayes.models.binary import BinaryModel
from amibayes.parallel import Executor, Progress
from amibayes.pipeline.false_alarm import false_alarm, second_false_alarm
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.prepare import Clock, Stage, prepare
from amibayes.pipeline.report_types import SearchReport
from amibayes.pipeline.warnings import search_cautions
from amibayes.posterior.ensemble import Posterior, sample
from amibayes.posterior.evidence import Evidence, compare_models
from amibayes.posterior.grid import GridPosterior, affordable, grid_posterior
from amibayes.posterior.priors import Prior, default_prior, edit_prior

MAX_NOISE_SAMPLES = 2000
"""Samples of the posterior that the noise is averaged over."""

MAX_FIELDS = 3
"""How often the default field is widened."""


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
    run = _Run(options, Clock(announce), _streams(options.seed), executor, progress, chain, resume)
    # One BLAS thread: the same bits on every machine and for any number of workers.
    with threadpool_limits(1):
        return run.report(targets, calibrators)


def _streams(seed: int) -> dict[str, np.random.Generator]:
    """Independent random numbers for every stage that draws some."""
    stages = ("significance", "posterior", "limits", "calibration", "evidence", "second")
    seeds = np.random.SeedSequence(seed).spawn(len(stages))
    return {s: np.random.default_rng(k) for s, k in zip(stages, seeds, strict=True)}


@dataclass(frozen=True)
class _Run:
    """One run of the main job: what all of its stages share, and the stages in their order."""

    options: SearchOptions
    clock: Clock
    streams: dict[str, np.random.Generator]
    executor: Executor | None
    progress: Progress | None
    chain: str | Path | None
    resume: bool

    def report(
        self, targets: Sequence[str | Path], calibrators: Sequence[str | Path]
    ) -> SearchReport:
        """Tell the whole story, from the files to the evidence."""
        options = self.options
        ready = prepare(targets, calibrators, options, self.streams["calibration"], self.clock)
        with self.clock.stage("search"):
            result, noise, widened = search_field(ready.observables, options)
        weight = self.weighed(result)
        limits = self.limits(result, weight)
        prior = _prior(result, options)
        two, second = self.second(result)
        averaged, two = noise_averaged(
            result,
            two,
            ready.observables.only(options.observables),
            extra_noise=options.extra_noise,
            per_file=options.file_noise is not False,
        )
        grid = self.integrated(averaged, prior)
        posterior = self.sampled(averaged, prior, grid)
        evidence = self.compared(averaged, two, prior, grid)
        cautions = search_cautions(ready.observables, result, noise, weight, posterior)
        return SearchReport(
            options=options,
            targets=tuple(str(p) for p in targets),
            calibrators=tuple(str(p) for p in calibrators),
            observables=ready.observables,
            calibration=ready.calibration,
            references=ready.references,
            vetting=ready.vetting,
            result=result,
            noise=noise,
            significance=weight,
            posterior=posterior,
            limits=limits,
            warnings=(*ready.cautions, *widened, *cautions),
            grid=grid,
            evidence=evidence,
            noise_posterior=_noise_posterior(averaged, posterior),
            second_significance=second,
            timing_s=self.clock.seconds,
        )

    def weighed(self, result: SearchResult) -> Significance | None:
        """Weigh the best companion against noise; None without null draws."""
        if not self.options.null_draws:
            return None
        with self.clock.stage("significance"):
            rng = self.streams["significance"]
            return false_alarm(result, self.options, rng, self.executor, self.progress)

    def limits(self, result: SearchResult, weight: Significance | None) -> DetectionLimit | None:
        """Measure the detection limits; None where unwanted or without null draws."""
        if weight is None or not self.options.limits:
            return None
        with self.clock.stage("limits"):
            rng = self.streams["limits"]
            return detection_limit(
                result, weight, rng, executor=self.executor, progress=self.progress
            )

    def second(self, result: SearchResult) -> tuple[TwoCompanions | None, Significance | None]:
        """Search for a second companion where two are to be compared, and weigh it."""
        if 2 not in _counts(self.options):
            return None, None
        with self.clock.stage("second companion"):
            two = search_second(result)
        if not self.options.null_draws:
            return two, None
        with self.clock.stage("significance of the second"):
            rng = self.streams["second"]
            return two, second_false_alarm(result, self.options, rng, self.executor, self.progress)

    def integrated(self, result: SearchResult, prior: Prior) -> GridPosterior | None:
        """Integrate the posterior over a grid where something needs it and it is cheap enough."""
        wanted = self.options.posterior or _counts(self.options)
        if not wanted or not affordable(result.likelihood, prior):
            return None
        with self.clock.stage("integrate"):
            return grid_posterior(result.likelihood, prior)

    def sampled(
        self, result: SearchResult, prior: Prior, grid: GridPosterior | None
    ) -> Posterior | None:
        """Sample the posterior; None where it is not wanted."""
        if not self.options.posterior:
            return None
        with self.clock.stage("posterior"):
            return sample(
                result,
                prior,
                self.streams["posterior"],
                path=self.chain,
                resume=self.resume,
                grid=grid,
                progress=self.progress,
            )

    def compared(
        self,
        result: SearchResult,
        two: TwoCompanions | None,
        prior: Prior,
        grid: GridPosterior | None,
    ) -> Evidence | None:
        """Weigh the asked numbers of companions against each other."""
        counts = _counts(self.options)
        if not counts:
            return None
        with self.clock.stage("evidence"):
            return compare_models(
                result,
                prior,
                self.streams["evidence"],
                companions=counts,
                grid=grid,
                two=two,
                method=self.options.evidence_method,
            )


def _noise_posterior(
    averaged: SearchResult, posterior: Posterior | None
) -> dict[str, NoisePosterior] | None:
    likelihood = averaged.likelihood
    if posterior is None or not likelihood.noise.parameters:
        return None
    residual = likelihood.difference(posterior.samples[:MAX_NOISE_SAMPLES])
    return dict(likelihood.noise.posterior(residual))


def search_field(
    observables: Observables, options: SearchOptions
) -> tuple[SearchResult, ExtraNoise, list[str]]:
    """Search the field; the default one is widened where something around it fits better."""
    likelihood = Likelihood(observables.only(options.observables))
    likelihood = joint_likelihood(
        likelihood.with_model(_model(likelihood, options)),
        contrast=options.contrast,
        motion=options.motion,
        fastest_mas_yr=options.fastest_mas_yr,
    )
    apart = options.file_noise is not False
    field, said = options.separation_mas, []
    for _ in range(MAX_FIELDS):
        if options.robust:
            result, noise = search_robust(
                likelihood, field, free_scale=options.extra_noise, per_file=apart
            )
        elif options.extra_noise:
            result, noise = search_with_noise(likelihood, field, per_file=apart)
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
    return result, noise, said + (_beyond(result) if options.separation_mas else [])


def _beyond(result: SearchResult) -> list[str]:
    """Say where a field that was asked for seems to leave the companion out."""
    found, grid = [], result.grid
    if (place := look_inside(result)) is not None:
        found.append(
            f"the field begins at {grid.inner_mas:.4g} mas: near {place:.1f} mas, nearer the "
            "star, a companion fits as well or better, and this may be an alias of it"
        )
    rho = result.companion.separation_mas
    if result.delta_chi2 > SURELY_NOT_NOISE and (
        rho < grid.inner_mas + 0.25 * grid.step_mas or rho > grid.outer_mas - 0.25 * grid.step_mas
    ):
        found.append(
            f"the best fit lies at {rho:.4g} mas, on the edge of the field that was asked for: "
            "the companion may be outside it"
        )
    return found


def _model(likelihood: Likelihood, options: SearchOptions) -> BinaryModel:
    diameter = options.diameter
    if diameter is None:
        diameter = "free" if resolves_stars(likelihood) else 0.0
    return BinaryModel(1, diameter, options.background, options.smearing)


def _prior(result: SearchResult, options: SearchOptions) -> Prior:
    likelihood = result.likelihood
    prior = default_prior(likelihood, result.grid.inner_mas, result.grid.outer_mas)
    return edit_prior(prior, options.prior, single_likelihood(likelihood).parameters.names)


def _counts(options: SearchOptions) -> tuple[int, ...]:
    """Numbers of companions to compare."""
    if options.companions is None:
        return (0, 1) if options.posterior else ()
    return options.companions

"""The false-alarm probability of a search, and of a second companion beside the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.data.observables import Observables
from amibayes.detection.consistency import Consistency, consistency
from amibayes.detection.false_alarm import Significance, significance
from amibayes.detection.randomised import randomised
from amibayes.detection.statistic import statistic_of
from amibayes.detection.verdict import Verdict, verdict
from amibayes.detection.whiteness import correlated
from amibayes.parallel import Executor, Journal, Progress, spawn
from amibayes.pipeline.field import noise_prior
from amibayes.pipeline.options import SearchOptions

MAX_RANDOMISED = 5000
"""Randomised data sets: enough for an upper bound of 7e-4 where none is above."""


STRUCTURE_DRAWS = 2000
"""Null draws of the structure that a fit leaves: a probability of 5e-4 is enough to reject."""


def false_alarm(
    result: SearchResult,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> Significance:
    """Find the chance that noise alone gives what the search found.

    Unless ``options`` take the stated errors for right, by a statistic free of their scale.
    """
    test = statistic_of(result, stated_errors=not options.extra_noise)
    spawned = np.random.default_rng(spawn(rng, 1)[0])
    found = significance(
        test,
        options.null_draws,
        rng,
        options.alpha,
        executor=executor,
        progress=progress,
        journal=journal,
    )
    if correlated(result) is not None:
        # Laws fitted to draws that are too good say nothing of what lies beyond them.
        found = replace(found, tail=None)
    draws = min(options.null_draws, MAX_RANDOMISED)
    check = randomised(test, draws, spawned, executor=executor, progress=progress)
    return replace(found, field=test.field(test.observed)).beside(check)


def second_false_alarm(
    result: SearchResult,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Significance:
    """Find the chance that noise alone gives a second companion beside the first.

    All that the first companion can do by moving or brightening is projected out, of the
    data and of the null sets.
    """
    test = statistic_of(result, stated_errors=not options.extra_noise, beside=True)
    return significance(
        test, options.null_draws, rng, options.alpha, executor=executor, progress=progress
    )


def structure(
    result: SearchResult,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
) -> Significance:
    """Find the chance that noise alone leaves as much structure beside the best fit.

    That of a second companion, with fewer draws, and randomised residuals where they say
    something.
    """
    test = statistic_of(result, stated_errors=not options.extra_noise, beside=True)
    draws = min(options.null_draws, STRUCTURE_DRAWS)
    found = significance(test, draws, rng, options.alpha, executor=executor)
    return found.beside(randomised(test, draws, rng, executor=executor))


def verdict_of(
    result: SearchResult,
    tested: Significance,
    stated: Observables,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
) -> tuple[Verdict, tuple[Consistency, ...]]:
    """Give the verdict of a search, and how its parts agree where a companion is detected."""
    splits: tuple[Consistency, ...] = ()
    if tested.detected:
        data = stated.only(options.observables) if options.extra_noise else None
        splits = consistency(result, rng, stated=data, prior=noise_prior(stated, options))
    rest = structure(result, options, rng, executor)
    return verdict(result, tested, rest, splits), splits

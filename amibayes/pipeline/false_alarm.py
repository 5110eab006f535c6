"""The false-alarm probability of a search, and of a second companion beside the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.detection.false_alarm import Significance, significance
from amibayes.detection.randomised import randomised
from amibayes.detection.statistic import statistic_of
from amibayes.detection.whiteness import correlated
from amibayes.parallel import Executor, Journal, Progress, spawn
from amibayes.pipeline.options import SearchOptions

MAX_RANDOMISED = 5000
"""Randomised data sets: enough for an upper bound of 7e-4 where none is above."""


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

"""The false-alarm probability of a search, and of a second companion beside the first."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.joint_bank import bank_of
from amibayes.companion_search.result import SearchResult, null_likelihood
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.false_alarm import (
    Significance,
    bank_statistic,
    significance,
    statistic_field,
)
from amibayes.likelihood.likelihood import single_likelihood
from amibayes.likelihood.student import SymmetricWhitening
from amibayes.parallel import Executor, Journal, Progress
from amibayes.pipeline.options import SearchOptions
from amibayes.units import FloatArray


def weigh(
    result: SearchResult,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None,
    progress: Progress | None,
    journal: Journal | None = None,
) -> Significance:
    """Weigh the search; unless errors are to be trusted, by a statistic free of their scale.

    Whether noise was added depends on the data, and a false companion can hide that it
    should have been: a statistic that does not know the scale needs no such decision.
    """
    likelihood, frame = null_likelihood(result)
    bank = bank_of(likelihood, result.grid, result.single_theta)
    residuals = single_likelihood(likelihood).residuals(result.single_theta)
    run = _Nulls(frame, options.extra_noise or frame is not None, executor, progress, journal)
    weight = run.judge(bank, residuals, options, rng)
    field = statistic_field(bank, residuals[:, 0], free_scale=run.free_scale, frame=frame)
    return replace(weight, field=field)


def second_false_alarm(
    result: SearchResult,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Significance:
    """Weigh what the first companion leaves: the chance that noise alone gives a second one.

    All that the first companion can do by moving or brightening is projected out, of the
    data and of the null sets.
    """
    likelihood, frame = null_likelihood(result)
    bank = bank_of(likelihood, result.grid, result.single_theta, beside=result.theta)
    residuals = likelihood.residuals(result.theta)
    run = _Nulls(frame, options.extra_noise or frame is not None, executor, progress, None)
    return run.judge(bank, residuals, options, rng)


@dataclass(frozen=True)
class _Nulls:
    """How null searches are run."""

    frame: SymmetricWhitening | None
    free_scale: bool
    executor: Executor | None
    progress: Progress | None
    journal: Journal | None

    def judge(
        self,
        bank: TemplateBank,
        residuals: FloatArray,
        options: SearchOptions,
        rng: np.random.Generator,
    ) -> Significance:
        """Place the statistic of residuals (n_data, 1) among null searches."""
        statistic = bank_statistic(bank, residuals, free_scale=self.free_scale, frame=self.frame)
        return significance(
            bank,
            float(statistic[0]),
            options.null_draws,
            rng,
            options.alpha,
            free_scale=self.free_scale,
            frame=self.frame,
            executor=self.executor,
            progress=self.progress,
            journal=self.journal,
        )

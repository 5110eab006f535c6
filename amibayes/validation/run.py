"""All trials of a plan, wherever they are computed and however often interrupted."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from amibayes.parallel import (
    Executor,
    Journal,
    Progress,
    SerialExecutor,
    child_seeds,
    run_job,
)
from amibayes.support.request import digest
from amibayes.validation.plan import QUICK, ValidationPlan
from amibayes.validation.tally import Validation, tally
from amibayes.validation.trial import run_trial


def validate(
    plan: ValidationPlan = QUICK,
    seed: int = 1,
    *,
    executor: Executor | None = None,
    journal: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> Validation:
    """Validate the whole way from photons to limits on simulated exposures.

    Parameters
    ----------
    plan : ValidationPlan
        `QUICK` or `FULL`, or one's own.
    seed : int
    executor : Executor, optional
        Where the trials are computed; the result does not depend on it.
    journal : path, optional
        Folder for the finished trials.
    resume : bool
        Go on from the trials that are there.
    progress : callable, optional
        Called with (trials done, trials in all).

    Returns
    -------
    Validation

    Raises
    ------
    RunError
        Where the analysis of a simulated star fails.
    """
    kinds = plan.kinds
    seeds = child_seeds(np.random.SeedSequence(seed), len(kinds))
    pieces = [(k, kind, s) for k, (kind, s) in enumerate(zip(kinds, seeds, strict=True))]
    book = None if journal is None else Journal(journal, digest(plan, seed), resume=resume)
    answers = list(
        run_job(
            partial(run_trial, plan),
            pieces,
            executor or SerialExecutor(),
            journal=book,
            progress=progress,
        )
    )
    if book is not None:
        book.remove()
    return tally(plan, seed, answers)

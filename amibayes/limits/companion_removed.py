"""The null distribution as it were, had the companion that was detected not been there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.joint_bank import bank_of
from amibayes.companion_search.result import SearchResult, null_likelihood
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.false_alarm import Significance, null_maxima
from amibayes.limits.injection import spawned
from amibayes.parallel import Executor, Journals


def without_companion(
    result: SearchResult,
    significance: Significance,
    rng: np.random.Generator,
    executor: Executor | None,
    journals: Journals | None,
) -> tuple[TemplateBank, Significance]:
    """Bank and null draws of data that do not hold the companion which was detected in these.

    Null sets of an estimated covariance are rotations of the data, and would hold it as noise:
    right for the test whether there is one, not for what would be seen where there is none.
    """
    likelihood, frame = null_likelihood(result)
    bank = bank_of(likelihood, result.grid, result.single_theta)
    if bank.estimate is None or not significance.detected:
        return bank, significance
    bank = bank.beside(likelihood.residuals(result.theta)[:, 0])
    null = null_maxima(
        bank,
        significance.n_draws,
        spawned(rng),
        free_scale=significance.free_scale,
        frame=frame,
        executor=executor,
        journal=journals.of("threshold") if journals else None,
    )
    return bank, replace(significance, null=np.sort(null))

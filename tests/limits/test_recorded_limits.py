"""Numbers of limits as they were recorded: a change of any of them is seen, and asked about.

`pytest tests/limits/test_recorded_limits.py --force-regen` records them anew.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.companion_search.search import search
from amibayes.detection.false_alarm import significance
from amibayes.detection.statistic import statistic_of
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.analytic import analytic_limit
from amibayes.limits.completeness import detection_limit


@pytest.mark.parametrize("contrast", [0.0, 0.02])
def test_limits_are_those_recorded(contrast: float, num_regression) -> None:
    """Around a single star and beside a companion, by injection and by closed criteria."""
    data = simulated(niriss(), [150.0, 90.0, contrast], np.random.default_rng(1))
    result = search(Likelihood(data), (50.0, 400.0))
    rng = np.random.default_rng(2)
    weight = significance(statistic_of(result), 3000, rng, alpha=0.01)
    limit = detection_limit(result, weight, rng, separation_mas=[100.0, 220.0, 390.0], trials=60)
    numbers = {
        "contrast": limit.contrast,
        "contrast_50": limit.contrast_50,
        "log_error": limit.log_error,
        "log_error_50": limit.log_error_50,
        "spread": limit.spread.ravel(),
        "by_detection": limit.by_detection.astype(float),
        "ambiguous": limit.ambiguous,
        "located": limit.located.ravel().astype(float),
        "detected": limit.detected.ravel().astype(float),
        "level": limit.level.ravel(),
        "threshold": np.array([limit.threshold]),
    }
    for method in ("absil", "candid", "posterior"):
        closed = analytic_limit(result, method, n_separations=4, remove=contrast > 0.0)
        numbers[method] = closed.contrast
        numbers[f"{method}_spread"] = closed.spread.ravel()
    num_regression.check(numbers, default_tolerance={"rtol": 1e-4, "atol": 1e-9})

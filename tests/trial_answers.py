"""Answers of a correct validation, and of ones with a known fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.detection.verdict import STATEMENTS
from amibayes.validation import QUICK
from amibayes.validation.plan import ValidationPlan

PLAN = replace(QUICK, per_range=100, n_alone=400)


def answers(plan: ValidationPlan, seed: int = 1, **spoilt: float):
    """Answers of a correct validation; ``spoilt`` names what is wrong with it, and how much."""
    rng = np.random.default_rng(seed)
    for kind in plan.kinds:
        alarm = rng.random() ** spoilt.get("alarm", 1.0)
        if kind == "alone":
            star = "companion" if rng.random() < spoilt.get("verdict", 0.002) else "no companion"
            yield {"false_alarm_probability": alarm, "statement": STATEMENTS.index(star)}
            continue
        rank = rng.random(3) ** np.array([1.0, 1.0, spoilt.get("contrast", 1.0)])
        chance = rng.random()
        yield {
            "false_alarm_probability": alarm,
            "truth": np.array([100.0, 50.0, 0.01]),
            "rank": rank,
            "covered": rng.random((3, 2)) < spoilt.get("coverage", 1.0) * np.array([0.68, 0.95]),
            "found": rng.random() < chance * spoilt.get("found", 1.0),
            "expected": chance,
            "statement": STATEMENTS.index("companion"),
            "second": rng.random() ** spoilt.get("second", 1.0),
        }

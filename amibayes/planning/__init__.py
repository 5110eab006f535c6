"""How to observe: groups, integrations, time, and what that lets one see."""

from amibayes.planning.budget import PAPER, Plan, PlanOptions, make_plan
from amibayes.planning.expectation import ContrastCurve, Expectation, expect

__all__ = [
    "PAPER",
    "ContrastCurve",
    "Expectation",
    "Plan",
    "PlanOptions",
    "expect",
    "make_plan",
]

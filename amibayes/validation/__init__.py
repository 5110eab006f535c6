"""Coverage and error rates of the whole analysis, on exposures whose truth is known."""

from amibayes.validation.plan import FULL, QUICK, SimulatedExposure, ValidationPlan
from amibayes.validation.run import validate
from amibayes.validation.tally import Check, Validation

__all__ = [
    "FULL",
    "QUICK",
    "Check",
    "SimulatedExposure",
    "Validation",
    "ValidationPlan",
    "validate",
]

"""Coverage and error rates of the whole analysis, on exposures whose truth is known."""

from amibayes.validation.images import SimulatedExposure
from amibayes.validation.plan import FULL, QUICK, ValidationPlan
from amibayes.validation.run import validate
from amibayes.validation.tables import SimulatedTable
from amibayes.validation.tally import Check, Validation

__all__ = [
    "FULL",
    "QUICK",
    "Check",
    "SimulatedExposure",
    "SimulatedTable",
    "Validation",
    "ValidationPlan",
    "validate",
]

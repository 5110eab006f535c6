"""amibayes: Bayesian inference for aperture masking interferometry.

Public names are loaded when they are first used (PEP 562), so that importing the
package, and starting the command line, costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from amibayes.calibration import Calibration, calibrate
    from amibayes.errors import AmibayesError, DataError, RunError, UsageError
    from amibayes.inference.bank import TemplateBank
    from amibayes.inference.likelihood import Likelihood
    from amibayes.inference.limits import DetectionLimit, detection_limit
    from amibayes.inference.model import BinaryModel
    from amibayes.inference.posterior import Posterior, sample
    from amibayes.inference.priors import Prior
    from amibayes.inference.results import Companion, SearchResult
    from amibayes.inference.search import search
    from amibayes.inference.significance import Significance, significance
    from amibayes.observables import Observables, join
    from amibayes.oifits import OIFits, open_oifits, read_oifits, write_oifits
    from amibayes.pipeline import SearchOptions, SearchReport, search_companion
    from amibayes.synthetic import point_source

_HOME = {
    "AmibayesError": "amibayes.errors",
    "BinaryModel": "amibayes.inference.model",
    "Calibration": "amibayes.calibration",
    "Companion": "amibayes.inference.results",
    "DataError": "amibayes.errors",
    "DetectionLimit": "amibayes.inference.limits",
    "Likelihood": "amibayes.inference.likelihood",
    "OIFits": "amibayes.oifits",
    "Observables": "amibayes.observables",
    "Posterior": "amibayes.inference.posterior",
    "Prior": "amibayes.inference.priors",
    "RunError": "amibayes.errors",
    "SearchOptions": "amibayes.pipeline",
    "SearchReport": "amibayes.pipeline",
    "SearchResult": "amibayes.inference.results",
    "Significance": "amibayes.inference.significance",
    "TemplateBank": "amibayes.inference.bank",
    "UsageError": "amibayes.errors",
    "calibrate": "amibayes.calibration",
    "detection_limit": "amibayes.inference.limits",
    "join": "amibayes.observables",
    "open_oifits": "amibayes.oifits",
    "point_source": "amibayes.synthetic",
    "read_oifits": "amibayes.oifits",
    "sample": "amibayes.inference.posterior",
    "search": "amibayes.inference.search",
    "search_companion": "amibayes.pipeline",
    "significance": "amibayes.inference.significance",
    "write_oifits": "amibayes.oifits",
}

__all__ = [
    "AmibayesError",
    "BinaryModel",
    "Calibration",
    "Companion",
    "DataError",
    "DetectionLimit",
    "Likelihood",
    "OIFits",
    "Observables",
    "Posterior",
    "Prior",
    "RunError",
    "SearchOptions",
    "SearchReport",
    "SearchResult",
    "Significance",
    "TemplateBank",
    "UsageError",
    "__version__",
    "calibrate",
    "detection_limit",
    "join",
    "open_oifits",
    "point_source",
    "read_oifits",
    "sample",
    "search",
    "search_companion",
    "significance",
    "write_oifits",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'amibayes' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)

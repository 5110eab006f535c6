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
    from amibayes.oifits import (
        OIFits,
        OITable,
        observables_of,
        open_oifits,
        read_oifits,
        write_oifits,
    )

_HOME = {
    "AmibayesError": "amibayes.errors",
    "Calibration": "amibayes.calibration",
    "DataError": "amibayes.errors",
    "RunError": "amibayes.errors",
    "UsageError": "amibayes.errors",
    "calibrate": "amibayes.calibration",
    "OIFits": "amibayes.oifits",
    "OITable": "amibayes.oifits",
    "observables_of": "amibayes.oifits",
    "open_oifits": "amibayes.oifits",
    "read_oifits": "amibayes.oifits",
    "write_oifits": "amibayes.oifits",
}

__all__ = [
    "AmibayesError",
    "Calibration",
    "DataError",
    "OIFits",
    "OITable",
    "RunError",
    "UsageError",
    "__version__",
    "calibrate",
    "observables_of",
    "open_oifits",
    "read_oifits",
    "write_oifits",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'amibayes' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)

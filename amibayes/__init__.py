"""amibayes: Bayesian inference for aperture masking interferometry.

Public names are loaded when they are first used (PEP 562), so that importing the
package, and starting the command line, costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from amibayes.errors import AmibayesError, DataError, RunError, UsageError
    from amibayes.instrument import Instrument, instrument_names, load_instrument
    from amibayes.oifits import (
        OIFits,
        OITable,
        observables_of,
        open_oifits,
        read_oifits,
        write_oifits,
    )
    from amibayes.optics import FringeBasis, Wavefront, fringe_basis, psf
    from amibayes.orientation import Orientation

_HOME = {
    "AmibayesError": "amibayes.errors",
    "DataError": "amibayes.errors",
    "FringeBasis": "amibayes.optics",
    "Instrument": "amibayes.instrument",
    "OIFits": "amibayes.oifits",
    "OITable": "amibayes.oifits",
    "Orientation": "amibayes.orientation",
    "RunError": "amibayes.errors",
    "UsageError": "amibayes.errors",
    "Wavefront": "amibayes.optics",
    "fringe_basis": "amibayes.optics",
    "instrument_names": "amibayes.instrument",
    "load_instrument": "amibayes.instrument",
    "observables_of": "amibayes.oifits",
    "open_oifits": "amibayes.oifits",
    "psf": "amibayes.optics",
    "read_oifits": "amibayes.oifits",
    "write_oifits": "amibayes.oifits",
}

__all__ = [
    "AmibayesError",
    "DataError",
    "FringeBasis",
    "Instrument",
    "OIFits",
    "OITable",
    "Orientation",
    "RunError",
    "UsageError",
    "Wavefront",
    "__version__",
    "fringe_basis",
    "instrument_names",
    "load_instrument",
    "observables_of",
    "open_oifits",
    "psf",
    "read_oifits",
    "write_oifits",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'amibayes' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)

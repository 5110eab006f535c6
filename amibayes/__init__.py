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
    from amibayes.optics import FringeBasis, PupilMap, Wavefront, fringe_basis, psf, scene_image
    from amibayes.orientation import Orientation
    from amibayes.scene import Scene
    from amibayes.scene_file import load_scene

_HOME = {
    "AmibayesError": "amibayes.errors",
    "DataError": "amibayes.errors",
    "FringeBasis": "amibayes.optics",
    "Instrument": "amibayes.instrument",
    "Orientation": "amibayes.orientation",
    "PupilMap": "amibayes.optics",
    "RunError": "amibayes.errors",
    "Scene": "amibayes.scene",
    "UsageError": "amibayes.errors",
    "Wavefront": "amibayes.optics",
    "fringe_basis": "amibayes.optics",
    "instrument_names": "amibayes.instrument",
    "load_instrument": "amibayes.instrument",
    "load_scene": "amibayes.scene_file",
    "psf": "amibayes.optics",
    "scene_image": "amibayes.optics",
}

__all__ = [
    "AmibayesError",
    "DataError",
    "FringeBasis",
    "Instrument",
    "Orientation",
    "PupilMap",
    "RunError",
    "Scene",
    "UsageError",
    "Wavefront",
    "__version__",
    "fringe_basis",
    "instrument_names",
    "load_instrument",
    "load_scene",
    "psf",
    "scene_image",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'amibayes' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)

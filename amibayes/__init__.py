"""amibayes: Bayesian inference for aperture masking interferometry.

Public names are loaded when they are first used (PEP 562), so that importing the
package, and starting the command line, costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from amibayes.cube import Cube, open_cube, read_cube, write_cube
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
    from amibayes.optics import FringeBasis, PupilMap, Wavefront, fringe_basis, psf, scene_image
    from amibayes.orientation import Orientation
    from amibayes.parallel import open_executor
    from amibayes.planning import expect, make_plan
    from amibayes.scene import Scene
    from amibayes.scene_file import load_scene
    from amibayes.simulation import Detector, Exposure, Observation, simulate

_HOME = {
    "AmibayesError": "amibayes.errors",
    "Cube": "amibayes.cube",
    "DataError": "amibayes.errors",
    "Detector": "amibayes.simulation",
    "Exposure": "amibayes.simulation",
    "FringeBasis": "amibayes.optics",
    "Instrument": "amibayes.instrument",
    "OIFits": "amibayes.oifits",
    "OITable": "amibayes.oifits",
    "Observation": "amibayes.simulation",
    "Orientation": "amibayes.orientation",
    "PupilMap": "amibayes.optics",
    "RunError": "amibayes.errors",
    "Scene": "amibayes.scene",
    "UsageError": "amibayes.errors",
    "Wavefront": "amibayes.optics",
    "expect": "amibayes.planning",
    "fringe_basis": "amibayes.optics",
    "instrument_names": "amibayes.instrument",
    "load_instrument": "amibayes.instrument",
    "load_scene": "amibayes.scene_file",
    "make_plan": "amibayes.planning",
    "observables_of": "amibayes.oifits",
    "open_cube": "amibayes.cube",
    "open_executor": "amibayes.parallel",
    "open_oifits": "amibayes.oifits",
    "psf": "amibayes.optics",
    "read_cube": "amibayes.cube",
    "read_oifits": "amibayes.oifits",
    "scene_image": "amibayes.optics",
    "simulate": "amibayes.simulation",
    "write_cube": "amibayes.cube",
    "write_oifits": "amibayes.oifits",
}

__all__ = [
    "AmibayesError",
    "Cube",
    "DataError",
    "Detector",
    "Exposure",
    "FringeBasis",
    "Instrument",
    "OIFits",
    "OITable",
    "Observation",
    "Orientation",
    "PupilMap",
    "RunError",
    "Scene",
    "UsageError",
    "Wavefront",
    "__version__",
    "expect",
    "fringe_basis",
    "instrument_names",
    "load_instrument",
    "load_scene",
    "make_plan",
    "observables_of",
    "open_cube",
    "open_executor",
    "open_oifits",
    "psf",
    "read_cube",
    "read_oifits",
    "scene_image",
    "simulate",
    "write_cube",
    "write_oifits",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'amibayes' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)

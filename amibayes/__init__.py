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
    from amibayes.cube import Cube, open_cube, read_cube, write_cube
    from amibayes.errors import AmibayesError, DataError, RunError, UsageError
    from amibayes.extraction import extract
    from amibayes.inference.analytic_limits import AnalyticLimit, analytic_limit
    from amibayes.inference.bank import TemplateBank
    from amibayes.inference.by_file import file_residuals
    from amibayes.inference.evidence import Evidence, weigh_models
    from amibayes.inference.grid_posterior import GridPosterior, grid_posterior
    from amibayes.inference.injection import Criterion, MeasuredStar, make_criterion, measure_star
    from amibayes.inference.joint import joint_likelihood
    from amibayes.inference.joint_bank import bank_of
    from amibayes.inference.likelihood import Likelihood
    from amibayes.inference.limits import DetectionLimit, detection_limit
    from amibayes.inference.model import BinaryModel
    from amibayes.inference.multiplicity import TwoCompanions, search_second
    from amibayes.inference.posterior import Posterior, sample
    from amibayes.inference.priors import Prior
    from amibayes.inference.recovery import Recovery, recover
    from amibayes.inference.results import Companion, SearchResult
    from amibayes.inference.search import search
    from amibayes.inference.significance import Significance, significance
    from amibayes.instrument import Instrument, instrument_names, load_instrument
    from amibayes.job import SearchOptions, SearchReport
    from amibayes.limits_job import LimitsOptions, LimitsReport, measure_limits
    from amibayes.observables import Observables, join
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
    from amibayes.pipeline import search_companion
    from amibayes.planning import expect, make_plan
    from amibayes.scene import Scene
    from amibayes.scene_file import load_scene
    from amibayes.simulation import Detector, Exposure, Observation, simulate
    from amibayes.synthetic import point_source

_HOME = {
    "AmibayesError": "amibayes.errors",
    "AnalyticLimit": "amibayes.inference.analytic_limits",
    "BinaryModel": "amibayes.inference.model",
    "Calibration": "amibayes.calibration",
    "Companion": "amibayes.inference.results",
    "Cube": "amibayes.cube",
    "Criterion": "amibayes.inference.injection",
    "DataError": "amibayes.errors",
    "DetectionLimit": "amibayes.inference.limits",
    "Detector": "amibayes.simulation",
    "Evidence": "amibayes.inference.evidence",
    "Exposure": "amibayes.simulation",
    "FringeBasis": "amibayes.optics",
    "GridPosterior": "amibayes.inference.grid_posterior",
    "Instrument": "amibayes.instrument",
    "Likelihood": "amibayes.inference.likelihood",
    "LimitsOptions": "amibayes.limits_job",
    "LimitsReport": "amibayes.limits_job",
    "MeasuredStar": "amibayes.inference.injection",
    "OIFits": "amibayes.oifits",
    "OITable": "amibayes.oifits",
    "Observables": "amibayes.observables",
    "Observation": "amibayes.simulation",
    "Orientation": "amibayes.orientation",
    "Posterior": "amibayes.inference.posterior",
    "Prior": "amibayes.inference.priors",
    "PupilMap": "amibayes.optics",
    "Recovery": "amibayes.inference.recovery",
    "RunError": "amibayes.errors",
    "Scene": "amibayes.scene",
    "SearchOptions": "amibayes.job",
    "SearchReport": "amibayes.job",
    "SearchResult": "amibayes.inference.results",
    "Significance": "amibayes.inference.significance",
    "TemplateBank": "amibayes.inference.bank",
    "TwoCompanions": "amibayes.inference.multiplicity",
    "UsageError": "amibayes.errors",
    "Wavefront": "amibayes.optics",
    "analytic_limit": "amibayes.inference.analytic_limits",
    "bank_of": "amibayes.inference.joint_bank",
    "calibrate": "amibayes.calibration",
    "detection_limit": "amibayes.inference.limits",
    "expect": "amibayes.planning",
    "extract": "amibayes.extraction",
    "file_residuals": "amibayes.inference.by_file",
    "fringe_basis": "amibayes.optics",
    "grid_posterior": "amibayes.inference.grid_posterior",
    "instrument_names": "amibayes.instrument",
    "join": "amibayes.observables",
    "joint_likelihood": "amibayes.inference.joint",
    "load_instrument": "amibayes.instrument",
    "load_scene": "amibayes.scene_file",
    "make_criterion": "amibayes.inference.injection",
    "make_plan": "amibayes.planning",
    "measure_star": "amibayes.inference.injection",
    "measure_limits": "amibayes.limits_job",
    "observables_of": "amibayes.oifits",
    "open_cube": "amibayes.cube",
    "open_executor": "amibayes.parallel",
    "open_oifits": "amibayes.oifits",
    "point_source": "amibayes.synthetic",
    "psf": "amibayes.optics",
    "read_cube": "amibayes.cube",
    "read_oifits": "amibayes.oifits",
    "recover": "amibayes.inference.recovery",
    "sample": "amibayes.inference.posterior",
    "scene_image": "amibayes.optics",
    "search": "amibayes.inference.search",
    "search_companion": "amibayes.pipeline",
    "search_second": "amibayes.inference.multiplicity",
    "significance": "amibayes.inference.significance",
    "simulate": "amibayes.simulation",
    "weigh_models": "amibayes.inference.evidence",
    "write_cube": "amibayes.cube",
    "write_oifits": "amibayes.oifits",
}

__all__ = [
    "AmibayesError",
    "AnalyticLimit",
    "BinaryModel",
    "Calibration",
    "Companion",
    "Criterion",
    "Cube",
    "DataError",
    "DetectionLimit",
    "Detector",
    "Evidence",
    "Exposure",
    "FringeBasis",
    "GridPosterior",
    "Instrument",
    "Likelihood",
    "LimitsOptions",
    "LimitsReport",
    "MeasuredStar",
    "OIFits",
    "OITable",
    "Observables",
    "Observation",
    "Orientation",
    "Posterior",
    "Prior",
    "PupilMap",
    "Recovery",
    "RunError",
    "Scene",
    "SearchOptions",
    "SearchReport",
    "SearchResult",
    "Significance",
    "TemplateBank",
    "TwoCompanions",
    "UsageError",
    "Wavefront",
    "__version__",
    "analytic_limit",
    "bank_of",
    "calibrate",
    "detection_limit",
    "expect",
    "extract",
    "file_residuals",
    "fringe_basis",
    "grid_posterior",
    "instrument_names",
    "join",
    "joint_likelihood",
    "load_instrument",
    "load_scene",
    "make_criterion",
    "make_plan",
    "measure_limits",
    "measure_star",
    "observables_of",
    "open_cube",
    "open_executor",
    "open_oifits",
    "point_source",
    "psf",
    "read_cube",
    "read_oifits",
    "recover",
    "sample",
    "scene_image",
    "search",
    "search_companion",
    "search_second",
    "significance",
    "simulate",
    "weigh_models",
    "write_cube",
    "write_oifits",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'amibayes' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)

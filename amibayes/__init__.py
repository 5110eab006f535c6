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
    from amibayes.companion_search.joint_bank import bank_of
    from amibayes.companion_search.residuals_by_file import file_residuals
    from amibayes.companion_search.result import Companion, SearchResult
    from amibayes.companion_search.search import search
    from amibayes.companion_search.second_companion import TwoCompanions, search_second
    from amibayes.companion_search.template_bank import TemplateBank
    from amibayes.cube import Cube, open_cube, read_cube, write_cube
    from amibayes.data.observables import Observables, join
    from amibayes.data.point_source import point_source
    from amibayes.detection.false_alarm import Significance, significance
    from amibayes.errors import AmibayesError, DataError, RunError, UsageError
    from amibayes.extraction import extract
    from amibayes.instrument import Instrument, instrument_names, load_instrument
    from amibayes.likelihood.joint import joint_likelihood
    from amibayes.likelihood.likelihood import Likelihood
    from amibayes.limits.analytic import AnalyticLimit, analytic_limit
    from amibayes.limits.completeness import DetectionLimit, detection_limit
    from amibayes.limits.image_injection import (
        Criterion,
        MeasuredStar,
        make_criterion,
        measure_star,
    )
    from amibayes.limits.injection import Recovery, recover
    from amibayes.models.components import BinaryModel
    from amibayes.oifits import (
        OIFits,
        OITable,
        observables_of,
        open_oifits,
        read_oifits,
        write_oifits,
    )
    from amibayes.optics import FringeBasis, PupilMap, Wavefront, fringe_basis, psf, scene_image
    from amibayes.parallel import open_executor
    from amibayes.pipeline.limits import LimitsOptions, LimitsReport, measure_limits
    from amibayes.pipeline.options import SearchOptions
    from amibayes.pipeline.planning import expect, make_plan
    from amibayes.pipeline.report_types import SearchReport
    from amibayes.pipeline.search import search_companion
    from amibayes.posterior.ensemble import Posterior, sample
    from amibayes.posterior.evidence import Evidence, compare_models
    from amibayes.posterior.grid import GridPosterior, grid_posterior
    from amibayes.posterior.priors import Prior
    from amibayes.scene.file import load_scene
    from amibayes.scene.orientation import Orientation
    from amibayes.scene.sources import Scene
    from amibayes.simulation import Detector, Exposure, Observation, simulate

_HOME = {
    "AmibayesError": "amibayes.errors",
    "AnalyticLimit": "amibayes.limits.analytic",
    "BinaryModel": "amibayes.models.components",
    "Calibration": "amibayes.calibration",
    "Companion": "amibayes.companion_search.result",
    "Cube": "amibayes.cube",
    "Criterion": "amibayes.limits.image_injection",
    "DataError": "amibayes.errors",
    "DetectionLimit": "amibayes.limits.completeness",
    "Detector": "amibayes.simulation",
    "Evidence": "amibayes.posterior.evidence",
    "Exposure": "amibayes.simulation",
    "FringeBasis": "amibayes.optics",
    "GridPosterior": "amibayes.posterior.grid",
    "Instrument": "amibayes.instrument",
    "Likelihood": "amibayes.likelihood.likelihood",
    "LimitsOptions": "amibayes.pipeline.limits",
    "LimitsReport": "amibayes.pipeline.limits",
    "MeasuredStar": "amibayes.limits.image_injection",
    "OIFits": "amibayes.oifits",
    "OITable": "amibayes.oifits",
    "Observables": "amibayes.data.observables",
    "Observation": "amibayes.simulation",
    "Orientation": "amibayes.scene.orientation",
    "Posterior": "amibayes.posterior.ensemble",
    "Prior": "amibayes.posterior.priors",
    "PupilMap": "amibayes.optics",
    "Recovery": "amibayes.limits.injection",
    "RunError": "amibayes.errors",
    "Scene": "amibayes.scene.sources",
    "SearchOptions": "amibayes.pipeline.options",
    "SearchReport": "amibayes.pipeline.options",
    "SearchResult": "amibayes.companion_search.result",
    "Significance": "amibayes.detection.false_alarm",
    "TemplateBank": "amibayes.companion_search.template_bank",
    "TwoCompanions": "amibayes.companion_search.second_companion",
    "UsageError": "amibayes.errors",
    "Wavefront": "amibayes.optics",
    "analytic_limit": "amibayes.limits.analytic",
    "bank_of": "amibayes.companion_search.joint_bank",
    "calibrate": "amibayes.calibration",
    "detection_limit": "amibayes.limits.completeness",
    "expect": "amibayes.pipeline.planning",
    "extract": "amibayes.extraction",
    "file_residuals": "amibayes.likelihood.residuals",
    "fringe_basis": "amibayes.optics",
    "grid_posterior": "amibayes.posterior.grid",
    "instrument_names": "amibayes.instrument",
    "join": "amibayes.data.observables",
    "joint_likelihood": "amibayes.likelihood.joint",
    "load_instrument": "amibayes.instrument",
    "load_scene": "amibayes.scene.file",
    "make_criterion": "amibayes.limits.image_injection",
    "make_plan": "amibayes.pipeline.planning",
    "measure_star": "amibayes.limits.image_injection",
    "measure_limits": "amibayes.pipeline.limits",
    "observables_of": "amibayes.oifits",
    "open_cube": "amibayes.cube",
    "open_executor": "amibayes.parallel",
    "open_oifits": "amibayes.oifits",
    "point_source": "amibayes.data.point_source",
    "psf": "amibayes.optics",
    "read_cube": "amibayes.cube",
    "read_oifits": "amibayes.oifits",
    "recover": "amibayes.limits.injection",
    "sample": "amibayes.posterior.ensemble",
    "scene_image": "amibayes.optics",
    "search": "amibayes.companion_search.search",
    "search_companion": "amibayes.pipeline.search",
    "search_second": "amibayes.companion_search.second_companion",
    "significance": "amibayes.detection.false_alarm",
    "simulate": "amibayes.simulation",
    "compare_models": "amibayes.posterior.evidence",
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
    "compare_models",
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
    "write_cube",
    "write_oifits",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'amibayes' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)

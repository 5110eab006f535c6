"""The public names and where each stands: read by `amibayes.__init__` and by type checkers.

A new public name is one line here, and one in ``docs/reference/api.md``.
"""

from .calibration import Calibration as Calibration, calibrate as calibrate
from .detection.residuals import file_residuals as file_residuals
from .companion_search.result import Companion as Companion, SearchResult as SearchResult
from .companion_search.search import search as search
from .companion_search.second_companion import (
    TwoCompanions as TwoCompanions,
    search_second as search_second,
)
from .companion_search.template_bank import TemplateBank as TemplateBank
from .cube import (
    Cube as Cube,
    open_cube as open_cube,
    read_cube as read_cube,
    write_cube as write_cube,
)
from .data.joining import join as join
from .data.observables import Observables as Observables
from .data.point_source import point_source as point_source
from .detection.false_alarm import Significance as Significance, significance as significance
from .detection.statistic import (
    BankStatistic as BankStatistic,
    Hits as Hits,
    Statistic as Statistic,
    statistic_of as statistic_of,
)
from .errors import (
    AmibayesError as AmibayesError,
    DataError as DataError,
    RunError as RunError,
    UsageError as UsageError,
)
from .extraction import extract as extract
from .imaging import (
    ReconstructedImage as ReconstructedImage,
    reconstruct_image as reconstruct_image,
)
from .instrument import (
    Instrument as Instrument,
    instrument_names as instrument_names,
    load_instrument as load_instrument,
)
from .likelihood.likelihood import joint_likelihood as joint_likelihood
from .likelihood.likelihood import Likelihood as Likelihood
from .likelihood.noise import FittedNoise as FittedNoise, NoiseModel as NoiseModel
from .limits.analytic import AnalyticLimit as AnalyticLimit, analytic_limit as analytic_limit
from .limits.completeness import detection_limit as detection_limit
from .limits.image_injection import (
    Criterion as Criterion,
    MeasuredStar as MeasuredStar,
    make_criterion as make_criterion,
    measure_star as measure_star,
)
from .limits.injection import Recovery as Recovery, recover as recover
from .limits.limit import DetectionLimit as DetectionLimit
from .models.binary import BinaryModel as BinaryModel
from .models.parameters import Parameter as Parameter
from .models.source import Component as Component, Slope as Slope, Source as Source
from .oifits import (
    OIFits as OIFits,
    OITable as OITable,
    observables_of as observables_of,
    open_oifits as open_oifits,
    read_oifits as read_oifits,
    write_oifits as write_oifits,
)
from .optics import (
    FringeBasis as FringeBasis,
    PupilMap as PupilMap,
    Wavefront as Wavefront,
    fringe_basis as fringe_basis,
    psf as psf,
    scene_image as scene_image,
)
from .parallel import open_executor as open_executor
from .pipeline.limits import (
    LimitsOptions as LimitsOptions,
    LimitsReport as LimitsReport,
    measure_limits as measure_limits,
)
from .pipeline.options import SearchOptions as SearchOptions
from .pipeline.planning import expect as expect, make_plan as make_plan
from .pipeline.report_types import SearchReport as SearchReport
from .pipeline.search import search_companion as search_companion
from .posterior.ensemble import Posterior as Posterior, sample as sample
from .posterior.evidence import Evidence as Evidence, compare_models as compare_models
from .posterior.grid import GridPosterior as GridPosterior, grid_posterior as grid_posterior
from .posterior.priors import Prior as Prior
from .posterior.sampler import Draws as Draws, Sampler as Sampler
from .scene.file import load_scene as load_scene
from .scene.orientation import Orientation as Orientation
from .scene.sources import Scene as Scene
from .simulation import (
    Detector as Detector,
    Exposure as Exposure,
    Observation as Observation,
    simulate as simulate,
)

__version__: str

"""From a scene to what the detector records of it."""

from amibayes.simulation.detector import PRESETS, Detector, DetectorMaps, detector_preset, draw_maps
from amibayes.simulation.exposure import Exposure
from amibayes.simulation.observation import Observation
from amibayes.simulation.observe import prepare_exposure, simulate, write_exposure
from amibayes.simulation.wavefront import WavefrontErrors

__all__ = [
    "PRESETS",
    "Detector",
    "DetectorMaps",
    "Exposure",
    "Observation",
    "WavefrontErrors",
    "detector_preset",
    "draw_maps",
    "prepare_exposure",
    "simulate",
    "write_exposure",
]

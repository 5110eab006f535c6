"""From a scene to what the detector records of it."""

from amibayes.simulation.detector import PRESETS, Detector, DetectorMaps, detector_preset, draw_maps
from amibayes.simulation.exposure import Exposure

__all__ = ["PRESETS", "Detector", "DetectorMaps", "Exposure", "detector_preset", "draw_maps"]

"""Calibration: what the instrument did to a target, learnt from calibrators and taken away."""

from amibayes.calibration.calibrate import Calibration, CalibratorUse, Method, calibrate

__all__ = ["Calibration", "CalibratorUse", "Method", "calibrate"]

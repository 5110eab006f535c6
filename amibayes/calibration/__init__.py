"""Calibration: the instrument's response, measured on calibrators and divided out."""

from amibayes.calibration.binning import average_polarisations, bin_channels, merge_epochs
from amibayes.calibration.calibrate import Calibration, CalibratorUse, calibrate
from amibayes.calibration.diameters import diameters_of, without_disc
from amibayes.calibration.flagging import flag_by_rule
from amibayes.calibration.reduction import reduce_data

__all__ = [
    "Calibration",
    "CalibratorUse",
    "average_polarisations",
    "bin_channels",
    "calibrate",
    "diameters_of",
    "flag_by_rule",
    "merge_epochs",
    "reduce_data",
    "without_disc",
]

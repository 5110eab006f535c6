"""Instruments as data: masks, filters, pixel scales, zero points."""

from amibayes.instrument.bandpass import Bandpass, Channels
from amibayes.instrument.catalogue import (
    ChargeMigration,
    Distortion,
    HeaderRules,
    Instrument,
    Planning,
    header_rules,
    instrument_names,
    load_instrument,
)
from amibayes.instrument.mask import Mask

__all__ = [
    "Bandpass",
    "Channels",
    "ChargeMigration",
    "Distortion",
    "HeaderRules",
    "Instrument",
    "Mask",
    "Planning",
    "header_rules",
    "instrument_names",
    "load_instrument",
]

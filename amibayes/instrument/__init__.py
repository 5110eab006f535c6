"""Instruments as data: masks, filters, pixel scales, zero points."""

from amibayes.instrument.bandpass import Bandpass, Channels
from amibayes.instrument.catalogue import (
    ChargeMigration,
    Distortion,
    Instrument,
    Planning,
    header_rules,
    instrument_names,
    load_instrument,
    recognised,
)
from amibayes.instrument.header_rules import HeaderRules
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
    "recognised",
]

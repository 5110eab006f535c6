"""The table that keeps what an extraction lets through of light off the axis.

It is no part of the standard; programs that do not know it pass over it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.observables import Setup
from amibayes.oifits.layout import Layout
from amibayes.oifits.tables import OWN_KEY, OIFits
from amibayes.response import EXPONENTS, REVERSED

RESPONSE = "AMIBAYES_RESPONSE"


def response_tables(layout: Layout, setups: tuple[Setup, ...]) -> list[Any]:
    """One table for each setup that has a response."""
    tables = []
    for number, setup in enumerate(setups):
        if setup.response is None:
            continue
        n = len(setup.stations)
        first, second = np.triu_indices(n)
        index = np.asarray(layout.station_index(number))
        pairs = np.stack([index[first], index[second]], axis=1)
        width = setup.response.shape[2]
        table = fits.BinTableHDU.from_columns(
            [
                fits.Column("STA_INDEX", "2I", array=pairs),
                fits.Column("COEFF", f"{width}D", array=setup.response[first, second]),
            ],
            name=RESPONSE,
        )
        table.header["INSNAME"] = layout.insnames[layout.channel[number]]
        table.header["ARRNAME"] = layout.arrnames[layout.array[number]]
        table.header[f"HIERARCH {OWN_KEY} SETUP"] = number + 1
        _explain(table)
        tables.append(table)
    return tables


def _explain(table: Any) -> None:
    powers = " ".join(f"{i},{j}" for i, j in EXPONENTS)
    for line in (
        "Response to light off the axis: visibility of a pair of stations, and flux",
        "(a station with itself). ln(response) = sum of COEFF east^i north^j, radians,",
        "times the imaginary unit where i + j is odd.",
        f"i,j = {powers}.",
    ):
        table.header["COMMENT"] = line


def with_response(oifits: OIFits, setup: Setup, own: int) -> Setup:
    """Give a setup the response that the file holds for it, if it does."""
    found = [t for t in oifits.tables if t.name == RESPONSE]
    found = [t for t in found if own and t.header.get(f"{OWN_KEY} SETUP", 0) == own]
    if not found or not {"STA_INDEX", "COEFF"} <= set(found[0].columns):
        return setup
    index, coefficients = found[0].columns["STA_INDEX"], found[0].columns["COEFF"]
    if coefficients.shape[1:] != (len(EXPONENTS),) or not np.isfinite(coefficients).all():
        return setup
    place = {int(k): i for i, k in enumerate(setup.station_index)}
    response = np.zeros((len(setup.stations), len(setup.stations), len(EXPONENTS)))
    for (a, b), row in zip(index, coefficients, strict=True):
        if int(a) in place and int(b) in place:
            i, j = place[int(a)], place[int(b)]
            response[j, i] = row * REVERSED
            response[i, j] = row
    return replace(setup, response=response)

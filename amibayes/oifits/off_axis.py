"""The table that keeps what an extraction lets through of light off the axis.

It is no part of the standard; programs that do not know it pass over it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.data.off_axis_response import BSPLINE_NODES, OffAxisResponse
from amibayes.data.setup import Setup
from amibayes.oifits.layout import Layout
from amibayes.oifits.tables import OWN_KEY, OIFits
from amibayes.units import FloatArray

RESPONSE = "AMIBAYES_RESPONSE"

LATTICE = ("NODE_XE", "NODE_XN", "NODE_YE", "NODE_YN", "POINT_E", "POINT_N")
"""Keywords of the matrix from east and north to the lattice, and of the mean pointing."""


def response_tables(layout: Layout, setups: tuple[Setup, ...]) -> list[Any]:
    """One table for each setup that has a response."""
    tables = []
    for number, setup in enumerate(setups):
        if setup.response is None:
            continue
        n, size = len(setup.stations), setup.response.n_nodes**2
        first, second = np.triu_indices(n)
        index = np.asarray(layout.station_index(number))
        pairs = np.stack([index[first], index[second]], axis=1)
        kept = setup.response.coefficients[first, second].reshape(len(first), size)
        if setup.response.symmetric:
            kept = kept[:, : size // 2 + 1]
        table = fits.BinTableHDU.from_columns(
            [
                fits.Column("STA_INDEX", "2I", array=pairs),
                fits.Column("COEFF", f"{kept.shape[1]}C", array=kept),
            ],
            name=RESPONSE,
        )
        table.header["INSNAME"] = layout.insnames[layout.channel[number]]
        table.header["ARRNAME"] = layout.arrnames[layout.array[number]]
        table.header[f"HIERARCH {OWN_KEY} SETUP"] = number + 1
        numbers = (*setup.response.to_node.ravel(), *setup.response.pointing)
        for key, value in zip(LATTICE, numbers, strict=True):
            table.header[f"HIERARCH {OWN_KEY} {key}"] = float(value)
        table.header[f"HIERARCH {OWN_KEY} SYMMETRIC"] = setup.response.symmetric
        table.header[f"HIERARCH {OWN_KEY} SINGLE"] = setup.response.single
        table.header[f"HIERARCH {OWN_KEY} METHOD"] = setup.response.method
        _explain(table, setup.response.n_nodes)
        tables.append(table)
    return tables


def _explain(table: Any, n_nodes: int) -> None:
    for line in (
        "Response to light off the axis: visibility of a pair of stations, and flux",
        "(a station with itself). COEFF are coefficients of cubic B-splines on a square",
        f"lattice of {n_nodes} x {n_nodes} places (x, y), y running faster; the middle one is the",
        "axis. With SYMMETRIC, up to there: opposite ones are conjugate. x and y are steps:",
        "x = XE east + XN north, y = YE east + YN north, from east and north in radians.",
        "The light of the star and its companions had its centre at POINT_E, POINT_N.",
        "SINGLE is F where V2 sums the powers of several samples.",
    ):
        table.header["COMMENT"] = line


def with_response(oifits: OIFits, setup: Setup, own: int) -> Setup:
    """Give a setup the response that the file holds for it, if it does."""
    found = [t for t in oifits.tables if t.name == RESPONSE]
    found = [t for t in found if own and t.header.get(f"{OWN_KEY} SETUP", 0) == own]
    if not found or not {"STA_INDEX", "COEFF"} <= set(found[0].columns):
        return setup
    index, whole = found[0].columns["STA_INDEX"], found[0].columns["COEFF"]
    lattice = _lattice(found[0].header)
    if lattice is None or whole.ndim != 2 or not np.iscomplexobj(whole):
        return setup
    if found[0].header.get(f"{OWN_KEY} SYMMETRIC", True):
        whole = np.concatenate([whole, whole[:, -2::-1].conj()], axis=1)
    n_nodes = round(np.sqrt(whole.shape[1]))
    if n_nodes <= BSPLINE_NODES or n_nodes**2 != whole.shape[1] or not np.isfinite(whole).all():
        return setup
    single = bool(found[0].header.get(f"{OWN_KEY} SINGLE", True))
    method = str(found[0].header.get(f"{OWN_KEY} METHOD", ""))
    place = {int(k): i for i, k in enumerate(setup.station_index)}
    n = len(setup.stations)
    response = np.zeros((n, n, n_nodes, n_nodes), dtype=np.complex64)
    for (a, b), row in zip(index, whole.reshape(-1, n_nodes, n_nodes), strict=True):
        if int(a) in place and int(b) in place:
            i, j = place[int(a)], place[int(b)]
            response[j, i] = row.conj()
            response[i, j] = row
    return replace(setup, response=OffAxisResponse(response, *lattice, single, method))


def _lattice(header: Any) -> tuple[FloatArray, FloatArray] | None:
    """Matrix from east and north to the lattice, and pointing, where the header has them."""
    values = [header.get(f"{OWN_KEY} {key}") for key in LATTICE]
    numbers = [float(v) for v in values if isinstance(v, int | float)]
    if len(numbers) < len(LATTICE) or not np.isfinite(numbers).all():
        return None
    return np.array(numbers[:4]).reshape(2, 2), np.array(numbers[4:])

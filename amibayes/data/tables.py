"""Results as a notebook shows them, and as astropy tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from astropy.table import QTable

from amibayes.support.arguments import one_of
from amibayes.support.notebook import html_table

if TYPE_CHECKING:
    from amibayes.data.observables import Observables


def quantity_table(
    columns: Mapping[str, Any], units: Mapping[str, str], meta: Mapping[str, Any] | None = None
) -> QTable:
    """Make an astropy table of columns; those that ``units`` names carry one."""
    known = {name: unit for name, unit in units.items() if name in columns}
    return QTable(dict(columns), units=known, meta=dict(meta or {}))


UNITS = {
    "separation_mas": "mas", "east_mas": "mas", "north_mas": "mas", "diameter_mas": "mas",
    "position_angle_deg": "deg", "delta_mag": "mag",
}  # fmt: skip
"""Units of the quantities of a companion, by the names of their columns."""


def pretty(name: str) -> str:
    """Name of a column as a reader wants it: ``separation_mas`` is 'separation (mas)'."""
    for ending in ("_mas", "_deg"):
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} ({ending[1:]})"
    return name.replace("_", " ")


KINDS = ("vis2", "closure_phase")
"""Kinds of data that have a table."""


def observables_table(observables: Observables, kind: Literal["vis2", "closure_phase"]) -> QTable:
    """One kind of data, a row each, with errors, places in the (u, v) plane and stations."""
    one_of("Observables.to_table", "kind", kind, KINDS)
    number = KINDS.index(kind)
    m, error = (observables.vis2, observables.closure_phase)[number], observables.errors[number]
    setups = observables.setups
    sides = [f"{i + 1}" for i in range(m.u_m.shape[1])] if number else [""]
    columns = {
        kind: m.value,
        "error": error,
        **{f"u{side}": m.u_m[:, i] for i, side in enumerate(sides)},
        **{f"v{side}": m.v_m[:, i] for i, side in enumerate(sides)},
        "wavelength": m.wavelength_m,
        "mjd": m.mjd,
        "stations": [
            "-".join(setups[k].stations[j] for j in row)
            for k, row in zip(m.setup, m.stations, strict=True)
        ],
        "flag": m.flag,
    }
    units = {name: "m" for name in columns if name[0] in "uvw" and name != kind}
    units |= {kind: "rad", "error": "rad"} if number else {}
    return quantity_table(columns, units | {"mjd": "d"}, {"source": observables.source})


def observables_html(observables: Observables) -> str:
    """What a data set holds."""
    wavelengths = np.concatenate([setup.wavelength_m for setup in observables.setups])
    rows = [
        ("squared visibilities", observables.n_vis2),
        ("closure phases", observables.n_closure_phases),
        ("independent numbers", observables.n_independent),
        ("covariance", observables.covariance_kind),
        ("instruments", ", ".join(dict.fromkeys(s.insname for s in observables.setups))),
        ("targets", ", ".join(dict.fromkeys(s.target for s in observables.setups if s.target))),
        ("wavelengths (µm)", f"{wavelengths.min() * 1e6:.4g} to {wavelengths.max() * 1e6:.4g}"),
        ("source", observables.source),
        *(("note", note) for note in observables.notes),
    ]
    return html_table("Observables", (), rows)

"""What the interactive part of a report shows: maps of the field, and data with their models.

Everything is measured before, or read off the template bank once more with one kind of data; the
script of the page (`templates/explorer.js`) only draws it.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import Any

import numpy as np

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.measurements import Measurements
from amibayes.detection.false_alarm import Significance
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.pipeline.report_types import SearchReport
from amibayes.plots.fit import longest_baseline_m
from amibayes.plots.maps import chance_of_places, told_by_draws
from amibayes.units import FloatArray, IntArray

Json = dict[str, Any]

MAX_SIDE = 160
"""Positions along a side of a map of the page: eight maps of them are a megabyte."""

MAX_POINTS = 2000
"""Data of one kind on the page; beyond, one in so many is."""

MAX_WORK = 3e8
"""Positions times data up to which the maps of one kind of data are made: a second or two."""

MAX_MODELS = 6
"""Models beside the data: as many as there are colours."""


def explorer_data(report: SearchReport) -> Json:
    """Gather what the interactive part of a report shows, in JSON's types.

    Parameters
    ----------
    report : SearchReport
    """
    result, tested = report.result, report.significance
    lattice = _Lattice(result)
    return {
        "step_mas": lattice.step_mas,
        "half": lattice.half,
        "inner_mas": result.grid.inner_mas,
        "outer_mas": result.grid.outer_mas,
        "fringe_mas": resolution_mas(result.likelihood),
        "n_draws": 0 if tested is None else tested.n_draws,
        "detected": None if tested is None else tested.detected,
        "alpha": None if tested is None else tested.alpha,
        "least_probability": None if tested is None else told_by_draws(tested),
        "maps": {name: lattice.encoded(layers) for name, layers in _maps(result, tested)},
        "marks": _marks(result),
        "data": _data(report),
    }


class _Lattice:
    """Maps on the lattice of a search, the best position of so many where there are too many."""

    def __init__(self, result: SearchResult) -> None:
        grid = result.grid
        self.factor = -(-(2 * grid.half_width + 1) // MAX_SIDE)
        self.half = grid.half_width // self.factor
        self.step_mas = grid.step_mas * self.factor
        rows, columns = (self._cell(part) for part in (grid.rows, grid.columns))
        self.cell: IntArray = rows * (2 * self.half + 1) + columns

    def _cell(self, index: IntArray) -> IntArray:
        near = np.rint(index / self.factor).astype(np.intp)
        return np.clip(near, -self.half, self.half) + self.half

    def encoded(self, layers: dict[str, FloatArray]) -> dict[str, str]:
        """Maps (n_grid,) as little-endian float32 in base64, those of the best gain of a cell."""
        order = np.argsort(layers["delta_chi2"], kind="stable")
        return {name: _encoded(self._image(values, order)) for name, values in layers.items()}

    def _image(self, values: FloatArray, order: IntArray) -> FloatArray:
        out = np.full((2 * self.half + 1) ** 2, np.nan)
        out[self.cell[order]] = values[order]  # of several the last one stays: the best
        return out


def _encoded(values: FloatArray) -> str:
    return base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")


def _maps(
    result: SearchResult, tested: Significance | None
) -> Iterator[tuple[str, dict[str, FloatArray]]]:
    """Maps of all data, with probabilities, then of each kind alone where there are two."""
    whole = {
        "delta_chi2": result.bank_delta_chi2,
        "contrast": result.bank_contrast,
        "error": result.bank_sigma,
    }
    if tested is not None and tested.field is not None:
        chance = np.maximum(chance_of_places(result, tested), told_by_draws(tested))
        whole |= {"log_probability": np.log10(chance)}
    yield "all data", whole
    data = result.likelihood.observables
    if not (data.n_vis2 and data.n_closure_phases):
        return
    if len(result.grid) * result.likelihood.n_independent > MAX_WORK:
        return
    for name, kind in (("V²", "vis2"), (f"{data.phase_name}s", "cp")):
        yield name, _one_kind(result, kind)


def _one_kind(result: SearchResult, kind: str) -> dict[str, FloatArray]:
    """Maps of one kind of data with its noise, about the fit of all without a companion."""
    part = Likelihood(result.likelihood.observables.only([kind]), result.likelihood.model)
    bank = TemplateBank(part, result.grid, result.single_theta)
    found = bank.survey(single_likelihood(part).residuals(result.single_theta)[:, 0])
    return {"delta_chi2": found.gain, "contrast": found.contrast, "error": found.sigma}


def _marks(result: SearchResult) -> list[Json]:
    """Best fit and other distinct solutions, with what is said of them."""
    out = []
    for k, mode in enumerate(result.modes):
        alias = mode in result.aliases
        kind = "best" if k == 0 else "alias" if alias else "mode"
        east, north = mode.place
        out.append({"kind": kind, "east": east, "north": north, "delta_chi2": mode.delta_chi2})
    return out


def _data(report: SearchReport) -> list[Json]:
    """Each kind of data against baseline, with every model."""
    likelihood = report.result.likelihood
    data, models = likelihood.observables, dict(_models(report))
    sigma, n2 = np.sqrt(data.covariance.variance), data.n_vis2
    one_period = data.phase_name == "closure phase"
    first = np.arange(len(data.data)) < n2
    kinds = (
        ("V²", "Baseline (Mλ)", "", data.vis2, first, 1.0),
        (f"{data.phase_name}s", "Longest baseline (Mλ)", "°", data.closure_phase, ~first, DEGREES),
    )
    found = []
    for name, axis, unit, m, mask, scale in kinds:
        at = np.flatnonzero(mask)
        if not len(at):
            continue
        at = at[:: -(-len(at) // MAX_POINTS)]
        within = at - (0 if mask is first else n2)
        frequency = longest_baseline_m(m)[within] / m.wavelength_m[within] / 1e6
        found.append(
            {
                "name": name,
                "axis": axis,
                "unit": unit,
                "n": int(mask.sum()),
                "period": 360.0 if unit and one_period else 0.0,
                "x": _rounded(frequency),
                "y": _rounded(scale * data.data[at]),
                "error": _rounded(scale * sigma[at]),
                "label": [_label(report.result, m, int(k)) for k in within],
                "models": {name: _rounded(scale * value[at]) for name, value in models.items()},
            }
        )
    return found


DEGREES = float(np.degrees(1.0))


def _models(report: SearchReport) -> Iterator[tuple[str, FloatArray]]:
    """What models predict of the data, by name: star, companion, then those compared."""
    result = report.result
    alone = single_likelihood(result.likelihood)
    yield "star alone", alone.predict(np.atleast_2d(result.single_theta))[:, 0]
    yield "with companion", result.likelihood.predict(result.theta)[:, 0]
    others = [] if report.models is None else report.models.models
    for one in [m for m in others if m.name not in ("star", "companion")][: MAX_MODELS - 2]:
        name = "two companions" if one.name == "two" else one.name
        yield name, one.fit.model.likelihood.predict(one.theta)[:, 0]
    left = 0 if others else MAX_MODELS - 2
    for mode in result.modes[1 : 1 + left]:
        where = f"{mode.separation_mas:.4g} mas, {mode.position_angle_deg:.0f}°"
        yield f"companion at {where}", result.likelihood.predict(np.array(mode.theta))[:, 0]


def _label(result: SearchResult, m: Measurements, k: int) -> str:
    setup = result.likelihood.observables.setups[m.setup[k]]
    names = "-".join(setup.stations[j] for j in m.stations[k])
    return f"{names}, {1e6 * m.wavelength_m[k]:.4g} µm"


def _rounded(values: FloatArray) -> list[float]:
    """Numbers of six digits, for JSON."""
    return [float(f"{value:.6g}") for value in values]

"""Posteriors of models of the sky as numbers: medians, intervals, derived quantities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.comparison.compare import Compared
from amibayes.units import FloatArray, position_angle_deg, separation

LEVELS = (0.16, 0.5, 0.84)


@dataclass(frozen=True)
class Interval:
    """A quantity of a model: best fit, median and 68 % interval.

    Parameters
    ----------
    best, median, lower, upper : float
        An angle's median lies in its range, the limits on both sides of it.
    """

    best: float
    median: float
    lower: float
    upper: float


def intervals(model: Compared) -> dict[str, Interval]:
    """Every parameter of a model, and the separations, angles and inclinations that follow."""
    best, samples = model.theta[None], model.draws.samples
    units = {p.name: p.unit for p in model.fit.model.likelihood.parameters}
    found = {}
    for name, (one, many) in (derived(model, best, samples)).items():
        turn = 0.0
        if units.get(name) == "deg" or name.startswith("position_angle_deg"):
            turn = 180.0 if name.endswith("_position_angle_deg") else 360.0
        found[name] = _interval(float(one[0]), many, model.draws.weights, turn)
    return found


def derived(model: Compared, *sets: FloatArray) -> dict[str, tuple[FloatArray, ...]]:
    """Columns of parameter sets (n, n_dim) by name, followed by what is derived from them."""
    parameters = model.fit.model.likelihood.parameters
    found = {name: tuple(s[:, k] for s in sets) for k, name in enumerate(parameters.names)}
    for k in range(1, parameters.companions + 1):
        suffix = "" if k == 1 else f"_{k}"
        places = [s[:, parameters.place(k)].T for s in sets]
        found[f"separation_mas{suffix}"] = tuple(separation(*p) for p in places)
        found[f"position_angle_deg{suffix}"] = tuple(position_angle_deg(*p) for p in places)
    for name in parameters.names:
        if name.endswith("_axis_ratio"):
            label = name.replace("_axis_ratio", "_inclination_deg")
            found[label] = tuple(np.degrees(np.arccos(x)) for x in found[name])
    return found


def _interval(best: float, values: FloatArray, weights: FloatArray, turn: float) -> Interval:
    """Median and limits of weighted values; of angles, cut opposite their mean."""
    cut = 0.0
    if turn:
        mean = np.angle(weights @ np.exp(2j * np.pi * values / turn)) * turn / (2.0 * np.pi)
        cut = float(mean) - 0.5 * turn
        values = (values - cut) % turn
    low, mid, high = weighted_quantile(values, weights, LEVELS) + cut
    whole = turn * (mid // turn) if turn else 0.0
    return Interval(best, float(mid - whole), float(low - whole), float(high - whole))


def weighted_quantile(
    values: FloatArray, weights: FloatArray, levels: tuple[float, ...]
) -> FloatArray:
    """Values below which shares of the weight lie, (n_levels,)."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    reached = (reached - 0.5 * weights[order]) / reached[-1]
    return np.asarray(np.interp(levels, reached, values[order]))

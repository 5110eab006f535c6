"""All limits and all companions of a survey in one picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from amibayes.plots.contrast_curve import magnitude_axis
from amibayes.plots.style import (
    BLACK,
    DASHES,
    GREY,
    SERIES,
    VERMILLION,
    marker_of,
    new_figure,
    styled,
)
from amibayes.units import FloatArray

MAX_NAMED = 12
"""With more targets than this single curves cannot be distinguished: they are drawn grey."""

WIDE = 15.0
"""Ratio of the largest and the smallest separation above which their axis is logarithmic."""


@dataclass(frozen=True, eq=False)
class LimitCurve:
    """Limit of a target: separations (n,) in mas, magnitude differences (n,), NaN for none."""

    separation_mas: FloatArray
    delta_mag: FloatArray


@dataclass(frozen=True)
class Found:
    """A companion that was detected, with its 1σ errors."""

    separation_mas: float
    delta_mag: float
    separation_error_mas: float
    delta_mag_error: float


@styled()
def survey_plot(curves: Mapping[str, LimitCurve], found: Mapping[str, Found]) -> Figure:
    """Draw limits and companions of many targets against separation.

    Parameters
    ----------
    curves : mapping of str to LimitCurve
        By the name of the target.
    found : mapping of str to Found
        Detected companions, by the name of the target.

    Returns
    -------
    matplotlib.figure.Figure
    """
    names = list(dict.fromkeys([*curves, *found]))
    named = len(names) <= MAX_NAMED
    figure = new_figure(5.2 + (0.16 * ((len(names) + 2) // 3) if named else 0.0))
    ax = figure.subplots()
    for k, name in enumerate(names):
        colour, marker = marker_of(k) if named else (GREY, "o")
        if name in curves:
            _draw_curve(ax, name, curves[name], k, colour, marker, named)
        if name in found:
            _draw_companion(ax, name, found[name], colour if named else VERMILLION, marker, named)
    if not named:
        _draw_median(ax, curves)
    _scale(ax, curves, found)
    magnitude_axis(ax)
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)))
    return figure


def _draw_curve(
    ax: Axes, name: str, curve: LimitCurve, k: int, colour: str, marker: str, named: bool
) -> None:
    if not named:
        ax.plot(curve.separation_mas, curve.delta_mag, color=GREY, lw=0.8, alpha=0.6)
        return
    dash = DASHES[(k // len(SERIES)) % len(DASHES)]
    # A limit that exists at one separation only is a point: markers show it.
    ax.plot(
        curve.separation_mas,
        curve.delta_mag,
        color=colour,
        ls=dash,
        marker=marker,
        markersize=3.5,
        label=f"{name}, limit",
    )


def _draw_companion(
    ax: Axes, name: str, found: Found, colour: str, marker: str, named: bool
) -> None:
    errors = [found.delta_mag_error, found.separation_error_mas]
    up, along = [e if np.isfinite(e) else None for e in errors]
    ax.errorbar(
        found.separation_mas,
        found.delta_mag,
        yerr=up,
        xerr=along,
        fmt=marker if named else "*",
        color=colour,
        markeredgecolor=BLACK,
        markeredgewidth=1.2,
        markersize=10,
        label=f"{name}, companion" if named else None,
    )
    if not named:
        place = (found.separation_mas, found.delta_mag)
        ax.annotate(name, place, (-7, 4), textcoords="offset points", ha="right")


def _draw_median(ax: Axes, curves: Mapping[str, LimitCurve]) -> None:
    """Median over the targets that have a limit, where at least half of them have."""
    if not curves:
        return
    low, high = _range(curves)
    grid = np.geomspace(low, high, 100)
    values = np.array([_interpolated(grid, c) for c in curves.values()])
    usable = np.isfinite(values).mean(axis=0) >= 0.5
    middle = np.array([np.nanmedian(column) for column in values.T[usable]])
    ax.plot(grid[usable], middle, color=BLACK, lw=2.5, label=f"median of {len(curves)} limits")


def _interpolated(grid: FloatArray, curve: LimitCurve) -> FloatArray:
    return np.interp(grid, curve.separation_mas, curve.delta_mag, left=np.nan, right=np.nan)


def _range(curves: Mapping[str, LimitCurve]) -> tuple[float, float]:
    every = np.concatenate([c.separation_mas for c in curves.values()])
    return float(every.min()), float(every.max())


def _scale(ax: Axes, curves: Mapping[str, LimitCurve], found: Mapping[str, Found]) -> None:
    places = [c.separation_mas for c in curves.values()]
    places += [np.array([f.separation_mas]) for f in found.values()]
    every = np.concatenate(places)
    if every.min() > 0.0 and every.max() > WIDE * every.min():
        ax.set_xscale("log")

"""Pictures of a survey: limits and companions, false alarms, completeness, frequency."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from amibayes.plots.contrast_curve import magnitude_axis
from amibayes.plots.style import (
    BLACK,
    BLUE,
    DASHES,
    GREY,
    LIGHT_GREY,
    SEQUENTIAL,
    SERIES,
    VERMILLION,
    marker_of,
    new_figure,
    save,
    styled,
)
from amibayes.survey.false_alarms import BAND, expected_quantiles
from amibayes.units import BoolArray, FloatArray

Json = dict[str, Any]

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


def limits_and_companions(content: Json) -> Figure | None:
    """Draw the limits and companions of ``survey.json``; None where there is neither."""
    done = {e["name"]: e for e in content["targets"] if e["status"] == "done"}
    drawn = {name: _curve(entry) for name, entry in done.items()}
    curves = {n: c for n, c in drawn.items() if c is not None and np.isfinite(c.delta_mag).any()}
    found = {
        n: _found(e)
        for n, e in done.items()
        if e.get("detected") and e.get("separation_mas") is not None
    }
    return survey_plot(curves, found) if curves or found else None


def _curve(entry: Json) -> LimitCurve | None:
    limits = entry.get("limits")
    if not limits:
        return None
    values = [math.nan if x is None else x for x in limits["delta_mag"]]
    return LimitCurve(np.array(limits["separation_mas"]), np.array(values, dtype=float))


def _found(entry: Json) -> Found:
    names = ("separation_mas", "delta_mag", "separation_error_mas", "delta_mag_error")
    return Found(*(math.nan if entry.get(n) is None else float(entry[n]) for n in names))


def false_alarms_picture(content: Json) -> Figure | None:
    """Draw the quantiles of the false-alarm probabilities; None where none were computed."""
    tested = [e for e in content["targets"] if e.get("false_alarm_probability") is not None]
    if len(tested) < 2:
        return None
    alarms = content["false_alarms"]
    p = np.array([e["false_alarm_probability"] for e in tested])
    listed = np.isin([e["name"] for e in tested], alarms["discovered"])
    return quantile_plot(p, listed, alarms["false_discovery_level"])


@styled()
def quantile_plot(probability: FloatArray, listed: BoolArray, level: float) -> Figure:
    """Draw false-alarm probabilities in order against those that noise alone would give.

    Targets that are listed have a place among all, the others one among themselves: companions
    at the head of the order would push the stars without them out of the band.

    Parameters
    ----------
    probability : (m,) float array
        Above 0.
    listed : (m,) bool array
        Companions at the level of the false-discovery rate.
    level : float

    Returns
    -------
    matplotlib.figure.Figure
    """
    m, order = len(probability), np.argsort(probability, kind="stable")
    middle = expected_quantiles(m)[0]
    p, hit = probability[order], listed[order]
    figure = new_figure(5.6)
    ax = figure.subplots()
    others, low, high = expected_quantiles(int((~hit).sum()))
    ax.fill_between(others, low, high, color=LIGHT_GREY, lw=0, label=f"{BAND:.0%} of noise")
    ax.plot(middle, middle, color=BLACK, lw=1.2, label="noise alone")
    ax.plot(
        middle,
        level * np.arange(1, m + 1) / m,
        color=BLACK,
        ls="--",
        lw=1.2,
        label=f"false-discovery rate {level:g}",
    )
    ax.plot(
        others, p[~hit], "o", color=BLUE, ms=4.5, label="other targets" if hit.any() else "targets"
    )
    if hit.any():
        ax.plot(
            middle[hit], p[hit], "*", color=VERMILLION, mec=BLACK, mew=0.6, ms=10,
            label="listed as companions",
        )  # fmt: skip
    ax.set(xscale="log", yscale="log", xlim=(0.5 * middle[0], 1.3))
    ax.set(ylim=(0.4 * min(p[0], *low[:1], level / m), 1.6))
    ax.set_xlabel("False-alarm probability expected of noise alone, in order")
    ax.set_ylabel("False-alarm probability of the targets")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


@styled()
def stacked_completeness(stacked: Json) -> Figure:
    """Draw the mean probability of detection of ``completeness`` or ``completeness_au``."""
    in_au, in_mass = "separation_au" in stacked, "mass" in stacked
    rho = np.array(stacked["separation_au" if in_au else "separation_mas"])
    depth = np.array(stacked["mass" if in_mass else "delta_mag"])
    mean = np.array(stacked["mean"])
    figure = new_figure(5.2)
    ax = figure.subplots()
    mesh = ax.pcolormesh(rho, depth, mean.T, cmap=SEQUENTIAL, vmin=0.0, vmax=1.0, shading="nearest")
    levels = [0.1, 0.5, 0.9]
    if mean.min() < levels[-1] and mean.max() > levels[0]:
        ax.contour(rho, depth, mean.T, levels, colors="white", linewidths=3.5)
        lines = ax.contour(rho, depth, mean.T, levels, colors=BLACK, linewidths=1.5)
        ax.clabel(lines, fmt=lambda share: f"{share:.0%}", fontsize=10)
    ax.set_xscale("log")
    _plain_marks(ax.xaxis, rho)
    if in_mass:
        ax.set_yscale("log")
        _plain_marks(ax.yaxis, depth)
        ax.set_ylabel(f"Mass ({stacked['mass_unit']})")
    else:
        magnitude_axis(ax, limits=(float(depth[0]), float(depth[-1])))
    ax.set_xlabel("Projected separation (au)" if in_au else "Separation (mas)")
    n = stacked["n_targets"]
    label = f"Probability of detection, mean of {n} target{'' if n == 1 else 's'}"
    figure.colorbar(mesh, ax=ax, label=label, location="top", aspect=35)
    return figure


def _plain_marks(axis: Axis, values: FloatArray) -> None:
    """Mark a logarithmic axis at round numbers, written as they are."""
    decades = 10.0 ** np.arange(np.floor(np.log10(values.min())), np.log10(values.max()) + 1)
    marks = np.outer(decades, [1.0, 2.0, 5.0]).ravel()
    axis.set_major_locator(FixedLocator(marks[(marks >= values.min()) & (marks <= values.max())]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))


@styled()
def frequency_plot(frequency: Json) -> Figure:
    """Draw the posterior of the companion frequency."""
    f, density = np.array(frequency["frequency"]), np.array(frequency["density"])
    low, high = frequency["interval_68"]
    (inner, outer), (_, faint) = frequency["separation_mas"], frequency["delta_mag"]
    # Jeffreys' density has no bound at 0 and 1: the picture ends at that of its 0.5 % point.
    shown = density[(f > 0.005) & (f < 0.995)]
    figure = new_figure(4.2)
    ax = figure.subplots()
    inside = (f >= low) & (f <= high)
    ax.fill_between(f[inside], density[inside], color=LIGHT_GREY, lw=0, label="68 % interval")
    ax.plot(f, density, color=BLUE)
    ax.axvline(frequency["median"], color=BLACK, ls="--", lw=1.2, label="median")
    top = 1.0 if frequency["interval_95"][1] > 0.5 else 1.6 * frequency["interval_95"][1]
    ax.set(xlim=(0.0, top), ylim=(0.0, 1.15 * float(shown.max())))
    ax.set_xlabel(
        f"Share of stars with a companion at {inner:.3g} to {outer:.3g} mas, down to "
        f"{faint:.3g} mag"
    )
    ax.set_ylabel("Posterior density")
    ax.legend()
    return figure


def _of(key: str, draw: Callable[[Json], Figure]) -> Callable[[Json], Figure | None]:
    """Draw one part of ``survey.json``; None where it is null."""

    def drawn(content: Json) -> Figure | None:
        return draw(content[key]) if content.get(key) else None

    return drawn


SURVEY_PICTURES: dict[str, Callable[[Json], Figure | None]] = {
    "survey.png": limits_and_companions,
    "survey_false_alarms.png": false_alarms_picture,
    "survey_completeness.png": _of("completeness", stacked_completeness),
    "survey_completeness_au.png": _of("completeness_au", stacked_completeness),
    "survey_frequency.png": _of("companion_frequency", frequency_plot),
}


def save_survey_pictures(content: Json, folder: Path) -> list[str]:
    """Draw what ``survey.json`` has into a folder; what cannot be drawn leaves no older picture.

    Returns
    -------
    list of str
        Names of the files.
    """
    names = []
    for name, draw in SURVEY_PICTURES.items():
        figure = draw(content)
        if figure is None:
            (folder / name).unlink(missing_ok=True)
        else:
            save(figure, folder / name)
            names.append(name)
    return names

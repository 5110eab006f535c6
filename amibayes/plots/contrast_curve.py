"""Detection limits against separation, and how complete a search is below them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import ArrayLike

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.result import Companion
from amibayes.limits.limit import Limit
from amibayes.limits.mass_table import MassTable
from amibayes.parallel import Executor, SerialExecutor
from amibayes.pipeline.limits import NAMES, LimitsReport
from amibayes.plots.charge_migration import migration_plot
from amibayes.plots.style import (
    BLACK,
    DASHES,
    GREY,
    SEQUENTIAL,
    SERIES,
    VERMILLION,
    new_figure,
    save,
    styled,
)
from amibayes.units import BoolArray, FloatArray, contrast_to_delta_mag


@dataclass(frozen=True, eq=False)
class Curve:
    """A limit against separation.

    Parameters
    ----------
    delta_mag : (n,) float array
        NaN where there is none.
    low, high : (n,) float array, optional
        Spread with position angle, or an interval.
    by_detection : (n,) bool array, optional
        Where a companion counts wherever it is seen, as its place cannot be measured.
    """

    delta_mag: FloatArray
    low: FloatArray | None = None
    high: FloatArray | None = None
    by_detection: BoolArray | None = None


@styled()
def limits_plot(
    separation_mas: FloatArray,
    curves: Mapping[str, Curve],
    companion: Companion | None = None,
    *,
    fringe_mas: float | None = None,
    masses: MassTable | None = None,
) -> Figure:
    """Draw limiting magnitude differences against separation, fainter downward.

    Parameters
    ----------
    separation_mas : (n,) float array
    curves : mapping of str to Curve
        By the name that the legend gives: method, and false-positive rate or completeness.
    companion : Companion, optional
        One that was found, with its errors.
    fringe_mas : float, optional
        λ/B of the longest baseline, for an axis in its units above.
    masses : MassTable, optional
        For a second axis on the right.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = new_figure(4.9 if fringe_mas is None else 5.3)
    ax = figure.subplots()
    for i, (name, curve) in enumerate(curves.items()):
        colour, dash = SERIES[i % len(SERIES)], DASHES[i % len(DASHES)]
        ax.plot(separation_mas, curve.delta_mag, color=colour, ls=dash, lw=2.0, label=name)
        if curve.low is not None and curve.high is not None:
            ax.fill_between(separation_mas, curve.low, curve.high, color=colour, alpha=0.2, lw=0)
    _mark_ambiguous(ax, separation_mas, list(curves.values()))
    if companion is not None:
        _mark_companion(ax, companion)
    magnitude_axis(ax)
    if fringe_mas is not None:
        _fringe_axis(ax, fringe_mas)
    if masses is not None:
        _mass_axis(ax, masses)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(2, len(labels)))
    return figure


@styled()
def completeness_map(
    separation_mas: FloatArray,
    delta_mag: FloatArray,
    fraction: FloatArray,
    c50: FloatArray | None = None,
    c95: FloatArray | None = None,
) -> Figure:
    """Draw the share of injected companions that the search finds.

    Parameters
    ----------
    separation_mas : (n_sep,) float array
        Increasing.
    delta_mag : (n_mag,) or (n_sep, n_mag) float array
        Magnitude differences injected, increasing; the same at every separation or not.
    fraction : (n_sep, n_mag) float array
        Between 0 and 1; NaN where nothing was injected.
    c50, c95 : (n_sep,) float array, optional
        Magnitude difference of 50 and 95 % completeness.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = new_figure(5.0)
    ax = figure.subplots()
    rows = [_edges(row) for row in np.broadcast_to(delta_mag, fraction.shape)]
    sides = _edges(separation_mas)
    for i, (row, found) in enumerate(zip(rows, fraction, strict=True)):
        cells = np.ma.masked_invalid(found[:, None])
        mesh = ax.pcolormesh(sides[i : i + 2], row, cells, cmap=SEQUENTIAL, vmin=0.0, vmax=1.0)
    # As in `limits_plot` of a search: the limit itself is the solid line.
    for values, dash, name in [(c95, "-", "95 % recovered"), (c50, "--", "50 % recovered")]:
        if values is not None:
            ax.plot(separation_mas, values, color="white", lw=4.0)
            ax.plot(separation_mas, values, color=BLACK, ls=dash, lw=2.0, label=name)
    magnitude_axis(ax, limits=(float(np.min(rows)), float(np.max(rows))))
    figure.colorbar(
        mesh, ax=ax, label="Share of injected companions recovered", location="top", aspect=35
    )
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _edges(centres: FloatArray) -> FloatArray:
    """Borders of the cells about increasing centres."""
    if len(centres) == 1:
        return np.array([centres[0] - 0.5, centres[0] + 0.5])
    middle = 0.5 * (centres[1:] + centres[:-1])
    first, last = 2.0 * centres[0] - middle[0], 2.0 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def _mark_ambiguous(ax: Axes, separation_mas: FloatArray, curves: Sequence[Curve]) -> None:
    """Put a cross on every point of a curve where a companion's place cannot be measured."""
    label: str | None = "seen, but its place is ambiguous"
    for i, curve in enumerate(curves):
        marked = curve.by_detection
        if marked is None or not (marked & np.isfinite(curve.delta_mag)).any():
            continue
        at = (separation_mas[marked], curve.delta_mag[marked])
        ax.plot(*at, "x", color=SERIES[i % len(SERIES)], markersize=7, mew=1.8, zorder=3)
        if label:
            ax.plot([], [], "x", color=GREY, markersize=7, mew=1.8, label=label)
            label = None


def _fringe_axis(ax: Axes, fringe_mas: float) -> None:
    def inward(x: ArrayLike) -> FloatArray:
        return np.asarray(x, dtype=float) / fringe_mas

    def outward(x: ArrayLike) -> FloatArray:
        return np.asarray(x, dtype=float) * fringe_mas

    top = ax.secondary_xaxis("top", functions=(inward, outward))
    top.set_xlabel("Separation (λ/B of the longest baseline)")


def _mass_axis(ax: Axes, masses: MassTable) -> None:
    """Label round masses at their magnitudes, right of the contrasts."""
    faint, bright = ax.get_ylim()
    span = masses.mass_at(np.clip([bright, faint], *masses.delta_mag[[0, -1]]))
    decades = 10.0 ** np.arange(np.floor(np.log10(span[1])), np.ceil(np.log10(span[0])) + 1)
    round_ones = np.outer(decades, [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0]).ravel()
    marks = masses.delta_mag_at(round_ones)
    shown = (marks >= bright) & (marks <= faint)
    right = ax.secondary_yaxis(1.19)
    right.yaxis.set_major_locator(FixedLocator(marks[shown].tolist()))
    right.yaxis.set_minor_locator(NullLocator())
    right.yaxis.set_major_formatter(FuncFormatter(lambda m, _: f"{masses.mass_at(m):.3g}"))
    right.set_ylabel(f"Mass ({masses.unit})")


def _mark_companion(ax: Axes, companion: Companion) -> None:
    errors = [companion.delta_mag_error, companion.separation_error_mas]
    up, along = [e if np.isfinite(e) else None for e in errors]
    ax.errorbar(
        companion.separation_mas,
        companion.delta_mag,
        yerr=up,
        xerr=along,
        fmt="*",
        color=VERMILLION,
        markeredgecolor=BLACK,
        markersize=15,
        label="companion found",
    )


def magnitude_axis(ax: Axes, limits: tuple[float, float] | None = None) -> None:
    """Label the axes: magnitudes left, growing downward, decades of contrast right."""
    low, high = limits or ax.get_ylim()
    ax.set_ylim(high, low)
    ax.set_xlabel("Separation (mas)")
    ax.set_ylabel("Magnitude difference")
    right = ax.secondary_yaxis("right")
    right.yaxis.set_major_locator(FixedLocator(contrast_marks(low, high)))
    right.yaxis.set_minor_locator(NullLocator())
    right.yaxis.set_major_formatter(FuncFormatter(_contrast_text))
    right.set_ylabel("Contrast (flux ratio)")


def contrast_marks(low: float, high: float) -> list[float]:
    """Magnitudes of round contrasts in a range: the shorter it is, the more of each decade."""
    room = high - low
    steps = np.array([1.0, 2.0, 5.0]) if room < 7.5 else np.array([1.0])
    steps = np.arange(1.0, 10.0) if room < 1.5 else steps
    decades = 10.0 ** np.arange(np.floor(-0.4 * high), np.ceil(-0.4 * low) + 1)
    marks = -2.5 * np.log10(np.outer(decades, steps).ravel())
    return sorted(marks[(marks >= low) & (marks <= high)].tolist())


def _contrast_text(delta_mag: float, _: object) -> str:
    mantissa, exponent = f"{10.0 ** (-0.4 * delta_mag):.0e}".split("e")
    if int(exponent) == 0:
        return mantissa
    power = f"10$^{{{int(exponent)}}}$"
    return power if mantissa == "1" else f"{mantissa}×{power}"


def completeness_picture(limits: Limit) -> Figure:
    """Draw the completeness map of a limit by injection."""
    cells = limits.cells()
    assert cells is not None
    magnitude, share = np.array(cells["delta_mag"]), np.array(cells["completeness"])
    low, high = float(magnitude.min()), float(magnitude.max())
    regular = np.linspace(low, high, 60)
    fraction = np.array(
        [
            np.interp(regular, mag, s, left=np.nan, right=np.nan)
            for mag, s in zip(magnitude[:, ::-1], share[:, ::-1], strict=True)
        ]
    )
    return completeness_map(
        limits.separation_mas,
        regular,
        fraction,
        c50=limits.columns()["delta_mag_50"],
        c95=limits.delta_mag,
    )


MIGRATION = "charge_migration.png"
"""Drawn where charge migration was fitted to ramps."""


def limits_picture_names(method: str) -> list[str]:
    """List the files that `save_limits_pictures` will write."""
    return ["limits.png", "completeness.png"] if method == "injection" else ["limits.png"]


def save_limits_pictures(
    report: LimitsReport, folder: Path, executor: Executor | None = None
) -> None:
    """Draw the curves of all limits, the completeness map of the main one, and what ramps tell.

    All at a time where there are workers.
    """
    names = ["limits.png"] + ["completeness.png"] * (report.main.limit.cells() is not None)
    charge = report.charge_migration
    names += [MIGRATION] * (charge is not None and charge.fit is not None)
    list((executor or SerialExecutor()).map(partial(_save_picture, report, folder), names))


def _save_picture(report: LimitsReport, folder: Path, name: str) -> None:
    charge = report.charge_migration
    if name == MIGRATION and charge is not None and charge.fit is not None:
        figure = migration_plot(charge.fit)
    else:
        curves = name == "limits.png"
        figure = limits_picture(report) if curves else completeness_picture(report.main.limit)
    save(figure, folder / name)


def limits_picture(report: LimitsReport) -> Figure:
    """Draw all limits in one picture, with their spread over the position angle."""
    curves = {}
    for measured in report.limits:
        limit = measured.limit
        low, _, high = contrast_to_delta_mag(limit.spread).T
        share = limit.facts()["completeness"]
        told = limit.method if share is None else f"{100.0 * share:.0f} % recovered"
        curves[f"{NAMES[measured.observables]}, {told}"] = Curve(
            limit.delta_mag, low, high, limit.by_detection
        )
    tested, main = report.main.significance, report.main.result
    found = main.companion if tested is not None and tested.detected else None
    return limits_plot(
        report.main.limit.separation_mas,
        curves,
        found,
        fringe_mas=resolution_mas(main.likelihood),
        masses=report.options.masses,
    )

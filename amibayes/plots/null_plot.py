"""What noise alone reaches anywhere in the field, beside what the data show."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import beta

from amibayes.plots.style import (
    BLACK,
    BLUE,
    DASHES,
    GREEN,
    LIGHT_GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    new_figure,
    styled,
)
from amibayes.units import FloatArray

TAILS = (ORANGE, GREEN, PURPLE)
FAR = 1.5
"""An observed value this many times the largest null value is pointed at, not drawn to scale."""


@styled()
def null_plot(
    maxima: FloatArray,
    observed: float,
    tails: Mapping[str, tuple[FloatArray, FloatArray]] | None = None,
    alpha: float | None = None,
    statistic: str = "Largest Δχ² anywhere in the field",
) -> Figure:
    """Draw the distribution of the statistic over null data sets with the observed value.

    Parameters
    ----------
    maxima : (n,) float array
        Statistic of each null data set.
    observed : float
        The same statistic of the data.
    tails : mapping of str to (statistic, survival), optional
        Fitted extreme-value tails: values, increasing, and the probability to exceed each
        (a single one is drawn as a point).
    alpha : float, optional
        False-alarm probability below which a companion counts as detected.
    statistic : str
        Label of the axis.

    Returns
    -------
    matplotlib.figure.Figure
        Histogram above; below, the probability to exceed a value, its 68 % band, the fits
        (past the last draw they are extrapolations) and the threshold.
    """
    null = np.sort(np.asarray(maxima, dtype=float))
    figure = new_figure(7.4)
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.0, 1.6]})
    upper.hist(null, bins="auto", color=SKY, edgecolor=BLUE, lw=0.5)
    upper.set_ylabel("Null data sets per bin")
    _survival(lower, null)
    end = _point_at(upper, lower, observed, null)
    seen = {name: (x, p) for name, (x, p) in (tails or {}).items() if (x <= end).any()}
    _extrapolate(lower, seen, float(null[-1]), end)
    if alpha is not None:
        lower.axhline(alpha, color=BLACK, ls=":", lw=1.5, label=f"detection threshold, {alpha:g}")
    lower.set_yscale("log")
    lower.set_ylim(_floor(len(null), alpha, seen, end), 1.5)
    lower.set_ylabel("Probability to exceed")
    lower.set_xlabel(statistic)
    upper.set_title(f"{len(null)} null data sets; in the data: {observed:.1f}")
    handles, labels = lower.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _extrapolate(
    ax: Axes, tails: Mapping[str, tuple[FloatArray, FloatArray]], largest: float, end: float
) -> None:
    """Draw the fits, and shade where there is nothing but them."""
    for (name, (x, p)), colour, dash in zip(tails.items(), TAILS, DASHES[1:], strict=False):
        marker = "D" if len(x) == 1 else ""
        ax.plot(x, p, color=colour, ls=dash, lw=2.0, marker=marker, label=name)
    if tails:
        style: dict[str, Any] = {"color": LIGHT_GREY, "alpha": 0.45, "lw": 0.0, "zorder": 0}
        ax.axvspan(largest, max(end, largest), **style, label="beyond the draws: extrapolated")
    ax.set_xlim(right=end)


def _survival(ax: Axes, null: FloatArray) -> None:
    """Share of the draws at least as large as each, with its Clopper–Pearson band."""
    n = len(null)
    count = n - np.arange(n)
    low = beta.ppf(0.16, count, n - count + 1)
    high = np.where(count < n, beta.ppf(0.84, count + 1, np.maximum(n - count, 1)), 1.0)
    ax.fill_between(null, low, high, step="pre", color=BLUE, alpha=0.25, lw=0)
    ax.step(null, count / n, where="pre", color=BLUE, lw=2.0, label="null data sets, 68 % band")


def _floor(
    n: int, alpha: float | None, tails: Mapping[str, tuple[FloatArray, FloatArray]], end: float
) -> float:
    """Lowest probability shown: some way below the draws, and below what else is drawn."""
    lowest = 0.1 / n
    if alpha is not None:
        lowest = min(lowest, 0.3 * alpha)
    fitted = [p[(p > 0) & (x <= end)].min(initial=1.0) for x, p in tails.values()]
    return float(max(min([lowest, *fitted]), 1e-12))


def _point_at(upper: Axes, lower: Axes, observed: float, null: FloatArray) -> float:
    """Mark the observed value by a line, or by an arrow where it lies far beyond the draws.

    Returns the end of the axis.
    """
    largest = float(null[-1])
    room = 0.15 * (largest - float(null[0])) or 1.0
    lower.set_xlim(left=null[0] - 0.3 * room)
    if observed <= FAR * largest:
        for ax in (upper, lower):
            ax.axvline(observed, color=VERMILLION, lw=2.0, label=f"data, {observed:.1f}")
        return max(observed, largest) + room
    arrow = {"arrowstyle": "->", "color": VERMILLION, "lw": 2.0}
    upper.annotate(
        f"data at {observed:.1f},\noff the scale",
        xy=(0.995, 0.5),
        xytext=(0.74, 0.5),
        xycoords="axes fraction",
        textcoords="axes fraction",
        ha="center",
        va="center",
        color=VERMILLION,
        arrowprops=arrow,
    )
    return largest + room

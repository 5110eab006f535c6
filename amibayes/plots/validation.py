"""Pictures of a validation: ranks, coverage, false alarms, completeness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from amibayes.plots.style import BLACK, BLUE, DASHES, LIGHT_GREY, SERIES, new_figure, styled
from amibayes.units import FloatArray

BAND = 0.95
N_BINS = 6


@styled()
def rank_plot(ranks: Mapping[str, FloatArray], names: Sequence[str]) -> Figure:
    """Draw how far the ranks of truths stray from a uniform distribution.

    Parameters
    ----------
    ranks : mapping of str to (n, k) array
        By kind of truth.
    names : sequence of k str

    Returns
    -------
    matplotlib.figure.Figure
        One panel for each quantity: share of ranks below each value, less that value. The
        band holds 95 % of the curves of a correct implementation, whole (Kolmogorov–Smirnov).
    """
    figure = new_figure(0.9 + 2.1 * len(names))
    axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for k, (ax, name) in enumerate(zip(axes, names, strict=True)):
        for (kind, values), colour, dash in zip(ranks.items(), SERIES, DASHES, strict=False):
            _wander(ax, values[:, k], colour, dash, f"{kind} ({len(values)})")
        ax.set(title=name, xlim=(0.0, 1.0))
    figure.supylabel("Share of ranks below, less that of a uniform distribution", fontsize=11.0)
    axes[-1].set_xlabel("Rank of the truth in its posterior")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@styled()
def alarm_plot(probability: FloatArray) -> Figure:
    """Draw the share of stars without a companion against the stated false-alarm probability.

    Parameters
    ----------
    probability : (n,) array

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = new_figure(4.6, 5.4)
    ax = figure.subplots()
    n = len(probability)
    x = np.sort(probability)
    count = np.arange(1, n + 1)
    grid = np.geomspace(min(0.5 / n, float(x[0])), 1.0, 200)
    low, high = stats.binom.ppf([[0.025], [0.975]], n, grid) / n
    ax.fill_between(grid, low, high, color=LIGHT_GREY, lw=0, label="95 % if correct")
    ax.plot(grid, grid, color=BLACK, ls=":", label="stated = measured")
    ax.step(x, count / n, where="post", color=BLUE, lw=2.0, label=f"{n} stars")
    ax.set(xscale="log", yscale="log", ylim=(0.3 / n, 1.3))
    ax.set_xlabel("Stated false-alarm probability")
    ax.set_ylabel("Share of stars that reach it")
    ax.legend(loc="upper left")
    return figure


@styled()
def completeness_plot(chance: FloatArray, found: FloatArray) -> Figure:
    """Draw the share of companions found against the completeness that the limits state.

    Parameters
    ----------
    chance, found : (n,) array
        Stated probability that each companion is found; 1 where it was.

    Returns
    -------
    matplotlib.figure.Figure
        In bins of the stated completeness, with its error bars.
    """
    figure = new_figure(4.8, 5.4)
    _stated(figure.subplots(), chance, found)
    return figure


@styled()
def coverage_plot(coverage: Mapping[str, tuple[float, float, float]]) -> Figure:
    """Draw how many intervals hold the truth.

    Parameters
    ----------
    coverage : mapping of str to (stated, measured, error)

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = new_figure(0.9 + 0.45 * len(coverage))
    _covered(figure.subplots(), coverage)
    return figure


def _wander(ax: Axes, ranks: FloatArray, colour: str, dash: str, label: str) -> None:
    n = len(ranks)
    reach = float(stats.kstwo.ppf(BAND, n)) if n else 0.0
    ax.axhspan(-reach, reach, color=colour, alpha=0.07, lw=0)
    for edge in (-reach, reach):
        ax.axhline(edge, color=colour, ls=dash, lw=0.7)
    x = np.concatenate([[0.0], np.sort(ranks), [1.0]])
    share = np.concatenate([[0.0], np.arange(1, n + 1) / max(n, 1), [1.0]])
    ax.step(x, share - x, where="post", color=colour, ls=dash, label=label)


def _stated(ax: Axes, chance: FloatArray, found: FloatArray) -> None:
    known = np.isfinite(chance)
    chance, found = chance[known], found[known]
    place = np.clip((chance * N_BINS).astype(int), 0, N_BINS - 1)
    count = np.bincount(place, minlength=N_BINS)
    filled = count > 0
    x = np.bincount(place, chance, N_BINS)[filled] / count[filled]
    y = np.bincount(place, found, N_BINS)[filled] / count[filled]
    spread = np.bincount(place, chance * (1.0 - chance), N_BINS)[filled]
    error = np.sqrt(spread) / count[filled]
    ax.plot([0, 1], [0, 1], color=BLACK, ls=":", label="stated = found")
    ax.errorbar(x, y, error, fmt="o", color=BLUE, capsize=3, label=f"{len(chance)} companions")
    for xx, yy, k in zip(x, y, count[filled], strict=True):
        ax.annotate(f"{k}", (xx, yy), xytext=(6, -10), textcoords="offset points", fontsize=9)
    ax.set(xlim=(-0.04, 1.08), ylim=(-0.08, 1.08))
    ax.set_xlabel("Probability of being found, by the limits")
    ax.set_ylabel("Share found")
    ax.legend(loc="upper left")


def _covered(ax: Axes, coverage: Mapping[str, tuple[float, float, float]]) -> None:
    for k, (stated, measured, error) in enumerate(coverage.values()):
        ax.plot([stated, stated], [k - 0.35, k + 0.35], color=BLACK, lw=2.0)
        ax.errorbar(measured, k, xerr=error, fmt="o", color=BLUE, capsize=3)
    ax.set_yticks(range(len(coverage)), list(coverage))
    ax.invert_yaxis()
    ax.set_xlim(0.3, 1.03)
    ax.set_xlabel("Share of intervals that hold the truth (bar: stated)")

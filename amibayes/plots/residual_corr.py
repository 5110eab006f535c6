"""Correlations of the errors of a data set, and the errors themselves."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from amibayes.data.observables import Observables
from amibayes.plots.style import BLACK, BLUE, DIVERGING, VERMILLION, new_figure, styled
from amibayes.units import FloatArray, IntArray

MAX_DATA = 160
"""Data of a matrix drawn whole; of larger sets the first groups of each kind are drawn."""


@styled()
def correlation_plot(observables: Observables) -> Figure:
    """Draw the correlation matrix of the unflagged data, V² first, and their 1σ errors.

    Parameters
    ----------
    observables : Observables

    Returns
    -------
    matplotlib.figure.Figure
        Of more than 160 data the first are drawn, correlated ones beside each other, and
        the title has it.
    """
    data = observables.unflagged()
    vis2, closure = _chosen(data)
    covariance = data.covariance.select(np.concatenate([vis2, closure]))
    sigma = np.sqrt(covariance.variance)
    figure = new_figure(8.2)
    upper, lower = figure.subplots(2, 1, gridspec_kw={"height_ratios": [4.6, 1.0]})
    _draw_matrix(figure, upper, covariance.dense() / np.outer(sigma, sigma), len(vis2))
    _draw_errors(lower, sigma, len(vis2))
    all_of = "" if len(sigma) == len(data.data) else f" of {len(data.data)}"
    figure.suptitle(
        f"{observables.covariance_kind.capitalize()} covariance: {len(sigma)}{all_of} data, "
        f"{covariance.rank} independent"
    )
    return figure


def _chosen(data: Observables) -> tuple[IntArray, IntArray]:
    """Places of the V² and of the closure phases that are drawn."""
    order = np.arange(len(data.data))
    if len(order) > MAX_DATA:
        order = np.concatenate([stack.index.ravel() for stack in data.covariance.stacks])
    vis2, closure = order[order < data.n_vis2], order[order >= data.n_vis2]
    half = max(MAX_DATA // 2, MAX_DATA - len(closure))
    return vis2[:half], closure[: MAX_DATA - min(half, len(vis2))]


def _draw_matrix(figure: Figure, ax: Axes, correlation: FloatArray, n_vis2: int) -> None:
    n = len(correlation)
    edges = (0.5, n + 0.5, n + 0.5, 0.5)
    image = ax.imshow(correlation, cmap=DIVERGING, vmin=-1.0, vmax=1.0, extent=edges)
    if 0 < n_vis2 < n:
        ax.axhline(n_vis2 + 0.5, color=BLACK, lw=1.0)
        ax.axvline(n_vis2 + 0.5, color=BLACK, lw=1.0)
    ax.set_xlabel(_which(n_vis2, n - n_vis2))
    ax.set_ylabel("Number of the datum")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(7, integer=True))
    figure.colorbar(image, ax=ax, label="Correlation", location="bottom", aspect=35, shrink=0.85)
    ax.set_anchor("N")  # what the square leaves free goes below it, not under the title


def _which(n_vis2: int, n_closure: int) -> str:
    spans = [("V²", 1, n_vis2), ("closure phases", n_vis2 + 1, n_vis2 + n_closure)]
    parts = [f"{name}: {a}–{b}" if b > a else f"{name}: {a}" for name, a, b in spans if b >= a]
    return f"Number of the datum ({', '.join(parts)})"


def _draw_errors(ax: Axes, sigma: FloatArray, n_vis2: int) -> None:
    """V² on the left scale, degrees on the right one."""
    number = 1 + np.arange(len(sigma))
    right = ax.twinx()
    sides = [
        (ax, slice(None, n_vis2), 1.0, "σ of V²", "o", BLUE),
        (right, slice(n_vis2, None), 180.0 / np.pi, "σ of closure\nphase (°)", "s", VERMILLION),
    ]
    for side, part, unit, label, marker, colour in sides:
        if not len(sigma[part]):
            side.yaxis.set_visible(False)
            continue
        side.plot(number[part], unit * sigma[part], marker, color=colour, markersize=3)
        side.set_ylabel(f"{label} ({'●' if marker == 'o' else '■'})", color=colour)
        side.set_ylim(0.0, 1.15 * unit * sigma[part].max())
    ax.set_xlim(0.5, len(sigma) + 0.5)
    ax.set_xlabel("Number of the datum")
    ax.xaxis.set_major_locator(MaxNLocator(7, integer=True))

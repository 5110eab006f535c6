"""A posterior: marginal distributions, one by one and in pairs, and the chain step by step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from amibayes.models.bands import band_name
from amibayes.plots.style import BLACK, BLUE, LIGHT_GREY, VERMILLION, new_figure, styled
from amibayes.units import FloatArray

NAMES = {
    "east_mas": "East (mas)",
    "north_mas": "North (mas)",
    "contrast": "Contrast",
    "log_contrast": "ln contrast",
    "diameter_mas": "Diameter (mas)",
    "background": "Background",
    "east_rate_mas_yr": "East rate (mas/yr)",
    "north_rate_mas_yr": "North rate (mas/yr)",
    "separation_mas": "Separation (mas)",
    "position_angle_deg": "PA (°)",
    "delta_mag": "Δmag",
}

CONTOUR_POINTS = 10_000
"""Samples per pair of panels below which points are drawn beside the contours."""


def label_of(name: str) -> str:
    """Name of a parameter as an axis label, with its unit; unknown names as they are.

    That of a band, as ``contrast[NIRISS_4.82um]``, is written on a second line.
    """
    name, _, band = name.partition("[")
    if band:
        return f"{label_of(name)},\n{band_name(band.rstrip(']'))}"
    base, _, number = name.rpartition("_")
    if number.isdigit() and base in NAMES:
        return f"{NAMES[base]}, {number}"
    return NAMES.get(name, name)


@styled()
def corner_plot(
    samples: FloatArray,
    labels: Sequence[str],
    truths: ArrayLike | None = None,
    best: ArrayLike | None = None,
) -> Figure:
    """Draw the corner plot of a posterior, with medians and 68 % intervals as titles.

    Parameters
    ----------
    samples : (n, n_dim) float array
    labels : sequence of str
        Names of the parameters; those that amibayes knows get their unit.
    truths, best : (n_dim,) float array, optional
        True values (dashed lines), best fit (solid lines with squares).

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ValueError
        Where samples are not finite, fewer than dimensions, or do not match the labels, and where
        there is no parameter.
    """
    # corner loads ArviZ, where that is installed: half a second that most runs need not spend.
    import corner

    draws = np.array(samples, dtype=float)
    matched = draws.ndim == 2 and 0 < draws.shape[1] == len(labels)
    if not matched or len(draws) <= draws.shape[1]:
        raise ValueError(f"samples of shape {draws.shape} for {len(labels)} labels")
    if not np.isfinite(draws).all():
        raise ValueError("samples that are not finite")
    factor, names = _scales(draws, labels)
    draws = draws * factor
    size = max(6.4, 1.0 + 1.75 * draws.shape[1])
    figure = new_figure(size, size, layout=None)
    corner.corner(
        draws,
        fig=figure,
        labels=names,
        range=_ranges(draws),
        quantiles=(0.16, 0.5, 0.84),
        color=BLACK,
        bins=30,
        max_n_ticks=4,
        **_density(len(draws)),
    )
    # Room for two-line titles and for labels beyond slanted numbers, in inches.
    figure.subplots_adjust(0.95 / size, 0.95 / size, 1.0 - 0.12 / size, 1.0 - 0.55 / size)
    _title(figure, draws, names)
    for values, colour, dash, marker in [(best, BLUE, "-", "s"), (truths, VERMILLION, "--", "o")]:
        if values is not None:
            _mark(figure, np.asarray(values, dtype=float) * factor, colour, dash, marker)
    return figure


def _mark(figure: Figure, at: FloatArray, colour: str, dash: str, marker: str) -> None:
    """Draw lines through values of the parameters (n_dim,), and points where they cross."""
    import corner

    if len(at) == 1:  # corner overplots figures of two and more parameters only
        figure.axes[0].axvline(float(at[0]), color=colour, linestyle=dash, linewidth=1.2)
        return
    corner.overplot_lines(figure, at, color=colour, linestyle=dash, linewidth=1.2)
    corner.overplot_points(figure, at[None], color=colour, marker=marker, markersize=5)


def _scales(draws: FloatArray, labels: Sequence[str]) -> tuple[FloatArray, list[str]]:
    """Powers of a thousand that make small numbers readable, and labels with them."""
    largest = np.abs(draws).max(axis=0)
    power = np.where(
        (largest > 0) & (largest < 0.02), -np.floor(np.log10(np.maximum(largest, 1e-300)) / 3), 0
    )
    names = [_scaled(label_of(name), 3 * int(p)) for name, p in zip(labels, power, strict=True)]
    return np.asarray(10.0 ** (3 * power)), names


def _scaled(label: str, power: int) -> str:
    """Write the power of ten that the numbers are multiplied by, in the first line."""
    name, comma, band = label.partition(",\n")
    return f"{name} × 10$^{{{power}}}${comma}{band}" if power else label


def _ranges(draws: FloatArray) -> list[tuple[float, float]]:
    """Limits of the axes; a parameter that never moves gets some room."""
    low, high = np.quantile(draws, [0.0005, 0.9995], axis=0)
    room = np.maximum(0.05 * (high - low), 1e-9 * np.maximum(np.abs(high), 1e-3))
    return list(zip((low - room).tolist(), (high + room).tolist(), strict=True))


def _density(n: int) -> dict[str, object]:
    """Contours hold 68 and 95 % of two dimensions; few samples show as points."""
    many = n >= CONTOUR_POINTS
    return {
        "levels": (0.68, 0.95),
        "smooth": 1.0,
        "plot_datapoints": not many,
        "plot_contours": n >= 200,
        "plot_density": n >= 200,
        "no_fill_contours": n < 200,
        "data_kwargs": {"alpha": 0.25, "ms": 1.5},
        "quiet": True,
    }


def _title(figure: Figure, draws: FloatArray, names: Sequence[str]) -> None:
    n = draws.shape[1]
    for i, name in enumerate(names):
        low, mid, high = np.quantile(draws[:, i], [0.16, 0.5, 0.84])
        figure.axes[i * n + i].set_title(
            f"{name}\n{interval_text(mid, mid - low, high - mid)}", fontsize=10, pad=5
        )


def interval_text(mid: float, below: float, above: float) -> str:
    """Median and distances to the ends of the interval, two digits of the smaller one."""
    least = min(x for x in (below, above, np.inf) if x > 0)
    digits = int(np.clip(1 - np.floor(np.log10(least)), 0, 9)) if np.isfinite(least) else 3
    return rf"${mid:.{digits}f}_{{-{below:.{digits}f}}}^{{+{above:.{digits}f}}}$"


MAX_WALKERS, MAX_STEPS = 64, 2000


@styled()
def trace_plot(
    chain: FloatArray,
    labels: Sequence[str],
    burn_in: int = 0,
    log_prob: FloatArray | None = None,
) -> Figure:
    """Draw each parameter of every walker against the step, with the burn-in marked.

    Parameters
    ----------
    chain : (n_steps, n_walkers, n_dim) float array
    labels : sequence of str
        Names of the parameters.
    burn_in : int
        Number of first steps that the posterior leaves out.
    log_prob : (n_steps, n_walkers) float array, optional
        Drawn below the parameters.

    Returns
    -------
    matplotlib.figure.Figure
        With at most 64 walkers and 2000 steps of each drawn, as the title states.
    """
    steps, walkers, _ = chain.shape
    every, apart = -(-steps // MAX_STEPS), -(-walkers // MAX_WALKERS)
    rows = [chain[:, :, i] for i in range(chain.shape[2])]
    names = [label_of(name) for name in labels]
    if log_prob is not None:
        rows, names = [*rows, log_prob], [*names, "ln posterior"]
    figure = new_figure(0.8 + 1.55 * len(rows))
    axes = np.atleast_1d(figure.subplots(len(rows), 1, sharex=True))
    at = np.arange(0, steps, every)
    for ax, values, name in zip(axes, rows, names, strict=True):
        few = values[::every, ::apart].T
        lines = np.stack([np.broadcast_to(at, few.shape), few], axis=2)
        opacity = float(np.clip(6.0 / len(few), 0.15, 0.8))
        ax.add_collection(LineCollection(list(lines), colors=BLUE, lw=0.5, alpha=opacity))
        ax.plot(at, np.median(values[::every], axis=1), color=BLACK, lw=1.2, label="median")
        ax.axvspan(0, burn_in, color=LIGHT_GREY, alpha=0.6, lw=0, label="burn-in, left out")
        ax.axvline(burn_in, color=VERMILLION, ls="--", lw=1.2)
        ax.autoscale_view()
        ax.set_ylabel(name)
        ax.margins(x=0.0)
    axes[-1].set_xlabel("Step")
    axes[0].set_title(_what_is_drawn(steps, walkers, every, apart))
    handles, texts = axes[0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=2)
    return figure


def _what_is_drawn(steps: int, walkers: int, every: int, apart: int) -> str:
    shown = len(range(0, walkers, apart))
    text = f"{walkers} walkers" if apart == 1 else f"{shown} of {walkers} walkers"
    return f"{text}, {steps} steps" + ("" if every == 1 else f" (1 in {every} drawn)")

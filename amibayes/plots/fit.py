"""The data against the models with and without the companion, and what is left over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator, ScalarFormatter

from amibayes.companion_search.result import SearchResult
from amibayes.data.measurements import Measurements
from amibayes.detection.residuals import FileResiduals
from amibayes.likelihood.likelihood import single_likelihood
from amibayes.plots.style import (
    BLACK,
    BLUE,
    GREY,
    LIGHT_GREY,
    VERMILLION,
    new_figure,
    styled,
)
from amibayes.support.atomic_files import short_names
from amibayes.units import FloatArray

MAX_BARS = 1500
"""Points of one kind drawn with error bars and models; beyond, one in so many is."""

LINEAR_TO = 12.0
"""Residuals beyond this many σ make the scale logarithmic."""


@dataclass(frozen=True, eq=False)
class _Kind:
    """Data of one kind and their models, in increasing order of spatial frequency."""

    name: str
    axis: str
    frequency_mega: FloatArray
    observed: FloatArray
    sigma: FloatArray
    single: FloatArray
    binary: FloatArray
    wraps: float | None = None

    def residual(self, model: FloatArray) -> FloatArray:
        """(data − model)/σ, angles the short way round."""
        left = self.observed - model
        if self.wraps is not None:
            left = left - self.wraps * np.rint(left / self.wraps)
        return np.asarray(left / self.sigma)


@styled()
def fit_plot(result: SearchResult) -> Figure:
    """Draw V² and closure phases with the single-star and binary models and residuals.

    Parameters
    ----------
    result : SearchResult

    Returns
    -------
    matplotlib.figure.Figure
        For each kind of data that there is, values above residuals in units of each
        datum's own error. Closure phases are drawn at the longest baseline of their triangle.
    """
    kinds = [k for k in _kinds(result) if len(k.observed)]
    figure = new_figure(0.6 + 4.6 * len(kinds))
    axes = np.atleast_1d(
        figure.subplots(2 * len(kinds), 1, gridspec_kw={"height_ratios": [2.1, 1.1] * len(kinds)})
    )
    for kind, upper, lower in zip(kinds, axes[::2], axes[1::2], strict=True):
        shown = _shown(len(kind.observed))
        _draw_data(upper, kind, shown)
        _draw_residuals(lower, kind)
        lower.sharex(upper)
        upper.tick_params(labelbottom=False)
        lower.set_xlabel(kind.axis)
    axes[0].set_title(
        f"Reduced χ²: single star {result.chi2_single / result.ndof:.3g}, "
        f"with companion {result.chi2_binary / result.ndof:.3g} (ndof {result.ndof})"
    )
    handles, labels = axes[0].get_legend_handles_labels()
    # Error bars come last of themselves; the data belong first.
    figure.legend(
        handles[-1:] + handles[:-1], labels[-1:] + labels[:-1], loc="outside lower center", ncols=3
    )
    return figure


def _kinds(result: SearchResult) -> tuple[_Kind, _Kind]:
    data = result.likelihood.observables
    single = single_likelihood(result.likelihood).predict(np.atleast_2d(result.single_theta))[:, 0]
    binary = result.likelihood.predict(np.atleast_2d(result.theta))[:, 0]
    sigma, n2 = np.sqrt(data.covariance.variance), data.n_vis2
    columns = np.stack([data.data, sigma, single, binary])
    degrees = np.degrees(columns[:, n2:])
    alone = data.phase_name == "kernel phase"  # a real sum, without a period
    axis = "Baseline of the largest share (Mλ)" if alone else "Longest baseline (Mλ)"
    wraps = None if data.phase_name != "closure phase" else 360.0
    return (
        _sorted("V²", "Baseline length (Mλ)", data.vis2, columns[:, :n2]),
        _sorted(f"{data.phase_name} (°)", axis, data.closure_phase, degrees, wraps),
    )


def _sorted(
    name: str, axis: str, m: Measurements, columns: FloatArray, wraps: float | None = None
) -> _Kind:
    frequency = longest_baseline_m(m) / m.wavelength_m / 1e6
    order = np.argsort(frequency, kind="stable")
    observed, sigma, single, binary = columns[:, order]
    return _Kind(name, axis, frequency[order], observed, sigma, single, binary, wraps)


def longest_baseline_m(m: Measurements) -> FloatArray:
    """Length of the baseline, or of the longest one of the triangle, (n,), metres."""
    length = np.hypot(m.u_m, m.v_m)
    if m.u_m.shape[1] == 2:
        third = np.hypot(m.u_m.sum(axis=1), m.v_m.sum(axis=1))
        length = np.column_stack([length, third])
    return np.asarray(length.max(axis=1, initial=0.0))


def _shown(n: int) -> slice:
    return slice(0, None, -(-n // MAX_BARS))


def _draw_data(ax: Axes, kind: _Kind, shown: slice) -> None:
    x, n = kind.frequency_mega[shown], len(kind.observed)
    size = 5.0 if len(x) <= 200 else 2.5
    ax.errorbar(
        x,
        kind.observed[shown],
        kind.sigma[shown],
        fmt="o",
        color=BLACK,
        ecolor=GREY if len(x) <= 200 else LIGHT_GREY,
        elinewidth=1.0,
        markersize=0.7 * size,
        zorder=1,
        label="data, 1σ",
    )
    open_square: dict[str, Any] = {"fillstyle": "none", "markeredgewidth": 1.0, "markersize": size}
    ax.plot(x, kind.single[shown], "s", color=VERMILLION, **open_square, label="single star")
    ax.plot(x, kind.binary[shown], "D", color=BLUE, markersize=0.8 * size, label="with companion")
    ax.set_ylabel(kind.name[0].upper() + kind.name[1:])
    if shown.step > 1:
        _note(ax, f"1 in {shown.step} of {n} data drawn here, all residuals below")


def _draw_residuals(ax: Axes, kind: _Kind) -> None:
    few = len(kind.observed) <= 200
    ax.axhspan(-1.0, 1.0, color=LIGHT_GREY, alpha=0.5, lw=0, zorder=0)
    ax.axhline(0.0, color=GREY, lw=0.8, zorder=0)
    size = 5.0 if few else 2.5 if len(kind.observed) <= MAX_BARS else 1.0
    x = kind.frequency_mega
    ax.plot(x, kind.residual(kind.single), "s", color=VERMILLION, fillstyle="none", markersize=size)
    ax.plot(x, kind.residual(kind.binary), "D", color=BLUE, markersize=0.8 * size)
    _scale_residuals(ax, 1.08 * float(np.abs(ax.get_ylim()).max()))
    ax.set_ylabel("Residual (σ)")


def _scale_residuals(ax: Axes, top: float) -> None:
    """Symmetric; where a model is far off, linear to ±3 and logarithmic beyond."""
    if top > LINEAR_TO:
        ax.set_yscale("symlog", linthresh=3.0, linscale=1.0)
        steps = np.array([1.0, 3.0]) if top < 100.0 else np.array([1.0])
        decades = np.outer(10.0 ** np.arange(1, np.floor(np.log10(top)) + 1), steps).ravel()
        marks = [*-decades[::-1], -3.0, 0.0, 3.0, *decades]
        ax.set_yticks(marks, [f"{m:g}".replace("-", "−") for m in marks])
        ax.yaxis.set_minor_locator(NullLocator())
        top = 1.3 * top
    ax.set_ylim(-top, top)


def _note(ax: Axes, text: str) -> None:
    box = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 2.0}
    ax.text(0.01, 0.02, text, transform=ax.transAxes, fontsize=9.0, va="bottom", bbox=box)


@styled()
def file_residuals_plot(files: Sequence[FileResiduals]) -> Figure:
    """Draw the reduced χ² of every file, V² and closure phases, with and without companion.

    Parameters
    ----------
    files : sequence of FileResiduals
        In the order they are drawn, from the top.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = new_figure(2.4 + 0.45 * len(files))
    axes = figure.subplots(1, 2, sharey=True)
    rows = np.arange(len(files))
    kinds = [("V²", "vis2", "n_vis2"), ("closure phase", "closure_phase", "n_closure_phases")]
    for ax, (title, name, count) in zip(axes, kinds, strict=True):
        with_one = np.array([getattr(f, name) for f in files])
        without = np.array([getattr(f, f"single_{name}") for f in files])
        open_square = {"fillstyle": "none", "markersize": 7}
        ax.hlines(rows, with_one, without, color=GREY, lw=0.8, zorder=0)
        ax.plot(without, rows, "s", color=VERMILLION, **open_square, label="single star")
        ax.plot(with_one, rows, "D", color=BLUE, markersize=5, label="with companion")
        ax.axvline(1.0, color=GREY, ls="--", lw=1.0)
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(ScalarFormatter())
        ax.xaxis.set_minor_formatter(NullFormatter())
        total = sum(getattr(f, count) for f in files)
        ax.set_xlabel(f"Reduced χ² of\n{total} {title}{'s' if total != 1 and 'p' in title else ''}")
    axes[0].set_yticks(rows, [name or "data" for name in short_names([f.source for f in files])])
    axes[0].set_ylim(len(files) - 0.5, -0.5)
    figure.suptitle("Residuals of each file under the joint fit")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure

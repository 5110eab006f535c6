"""How well each file of a joint fit is fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

from amibayes.companion_search.residuals_by_file import FileResiduals
from amibayes.plots.style import BLUE, GREY, VERMILLION, new_figure, styled
from amibayes.support.atomic_files import short_names


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

"""The walkers of a Markov chain, step by step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from amibayes.plots.corner_plot import label_of
from amibayes.plots.style import BLACK, BLUE, LIGHT_GREY, VERMILLION, new_figure, styled
from amibayes.units import FloatArray

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

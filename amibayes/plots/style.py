"""What all pictures share: size, type, colours that the colour-blind can distinguish, and saving.

Pictures are drawn on the Agg canvas without pyplot, so that nothing needs a screen and no
state outlives the call. A picture does not depend on the user's own matplotlib settings.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from amibayes.support.atomic_files import atomic_path

WIDTH_IN = 6.4
"""Type of 10 to 11 points on this width can still be read on a telephone."""

DPI = 160

COMPRESSION = 3
"""Of PNG files, out of 9: half of the time of the usual 6, for files that are 5 % larger."""

BLACK, GREY, LIGHT_GREY = "#000000", "#6e6e6e", "#c8c8c8"
PALE = "#fff3a0"
"""Text on dark colours; a report in dark mode turns what is grey, white included, and not this."""

BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#e69f00",
    "#cc79a7",
    "#56b4e9",
)
"""Okabe & Ito's palette, which the common forms of colour blindness leave distinct."""

SERIES = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")
DASHES = ("-", "--", "-.", ":")
"""Series differ in colour and in marker or dash, never in colour alone."""

SEQUENTIAL, DIVERGING = "viridis", "RdBu_r"

SETTINGS: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 11.0,
    "axes.titlesize": 11.0,
    "figure.titlesize": 11.0,
    "axes.labelsize": 11.0,
    "xtick.labelsize": 10.0,
    "ytick.labelsize": 10.0,
    "legend.fontsize": 9.5,
    "legend.framealpha": 0.9,
    "lines.linewidth": 1.5,
    "axes.formatter.use_mathtext": True,
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw with matplotlib's defaults and `SETTINGS`, and leave the user's own alone.

    Serves as a decorator too.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(SETTINGS)
        yield


def new_figure(
    height_in: float, width_in: float = WIDTH_IN, *, layout: str | None = "constrained"
) -> Figure:
    """Make an empty figure on an Agg canvas.

    Square maps need a height that leaves the width as their limit: the constrained layout
    does not count the labels of an axis that the aspect ratio has shortened.
    """
    figure = Figure(figsize=(width_in, height_in), layout=layout, dpi=DPI)  # type: ignore[arg-type]
    FigureCanvasAgg(figure)
    return figure


@styled()
def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, whole or not at all; the same figure gives the same bytes.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    path : str or path

    Raises
    ------
    RunError
        Where the file cannot be written.
    """
    _plain_numbers(figure)
    # Every drawing would lay out anew and move the axes a little further: the figure keeps this.
    if (engine := figure.get_layout_engine()) is not None:
        ticks = _ticks(figure)
        engine.execute(figure)
        # Room for ticks that the first pass has chosen, and for labels of axes that it shortened.
        square = any(axes.get_aspect() != "auto" for axes in figure.axes)
        if square or _ticks(figure) != ticks:
            engine.execute(figure)
        figure.set_layout_engine("none")
    with atomic_path(path) as temporary:
        figure.savefig(
            temporary,
            format="png",
            dpi=DPI,
            metadata={"Software": None},
            pil_kwargs={"compress_level": COMPRESSION},
        )


def _plain_numbers(figure: Figure) -> None:
    """Write numbers of axes as text, where no power of ten stands beside them.

    As mathematics, which such a power needs, they look the same and take a fifth of the time of
    all pictures.
    """
    for axis in _axes(figure):
        numbers = axis.get_major_formatter()
        if isinstance(numbers, ScalarFormatter):
            numbers.format_ticks(axis.get_majorticklocs().tolist())
            if not numbers.get_offset():
                numbers.set_useMathText(False)


def _ticks(figure: Figure) -> list[list[float]]:
    """Where the ticks of every axis are."""
    return [np.asarray(axis.get_majorticklocs(), dtype=float).tolist() for axis in _axes(figure)]


def _axes(figure: Figure) -> list[Axis]:
    return [axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)]


def marker_of(index: int) -> tuple[str, str]:
    """Colour and marker of the series number ``index``; 36 of them before one comes back."""
    turn = index // len(SERIES)
    return SERIES[index % len(SERIES)], MARKERS[(index + turn) % len(MARKERS)]

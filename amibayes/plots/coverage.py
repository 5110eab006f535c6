"""The (u, v) coverage, in metres and in wavelengths."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from amibayes.data.observables import Observables
from amibayes.models.uv_sums import phase_sums
from amibayes.plots.style import BLACK, BLUE, GREY, SEQUENTIAL, new_figure, styled
from amibayes.units import FloatArray

MICRON = 1e-6


@styled()
def coverage_plot(observables: Observables) -> Figure:
    """Draw the points of the (u, v) plane that the unflagged data sample.

    Parameters
    ----------
    observables : Observables

    Returns
    -------
    matplotlib.figure.Figure
        Metres above, millions of wavelengths below, each point with its mirror image, u to
        the east and east to the left. Where there are several wavelengths they colour the
        points below (in metres they lie on top of each other). Circles are V², crosses the
        baselines of closure phases.
    """
    data = observables.unflagged()
    limits = _limits(data)
    figure = new_figure(13.3 if limits else 12.7)
    for ax, scaled in zip(figure.subplots(2, 1), (False, True), strict=True):
        colours = limits if scaled else None
        for points, marker in [(_of_phases(data), "x"), (_of_vis2(data), "o")]:
            if points.shape[1]:
                drawn = _scatter(ax, _both(points, scaled), marker, colours)
        _frame(ax, "Mλ" if scaled else "m")
        if colours:
            figure.colorbar(drawn, ax=ax, label="Wavelength (µm)", location="bottom", aspect=35)
    _explain(figure, data)
    return figure


def _all_wavelengths(data: Observables) -> FloatArray:
    return np.concatenate([data.vis2.wavelength_m, data.closure_phase.wavelength_m])


def _limits(data: Observables) -> tuple[float, float] | None:
    """Shortest and longest wavelength in µm; none where there is only one."""
    wavelength = _all_wavelengths(data) / MICRON
    if np.ptp(wavelength) == 0.0:
        return None
    return float(wavelength.min()), float(wavelength.max())


def _of_vis2(data: Observables) -> FloatArray:
    """u, v and wavelength of V², metres, (3, n)."""
    return np.stack([data.vis2.u_m[:, 0], data.vis2.v_m[:, 0], data.vis2.wavelength_m])


def _of_phases(data: Observables) -> FloatArray:
    """Those of the points whose phases are summed."""
    sums = phase_sums(data)
    return np.stack([sums.u_m, sums.v_m, data.closure_phase.wavelength_m[sums.owner]])


def _both(points: FloatArray, scaled: bool) -> FloatArray:
    """Distinct u, v and wavelength in µm, (3, n), mirror images included."""
    u, v, wavelength = points
    unit = 1e6 * wavelength if scaled else 1.0
    half = np.stack([u / unit, v / unit, wavelength / MICRON])
    both = np.concatenate([half, half * [[-1.0], [-1.0], [1.0]]], axis=1)
    return np.unique(np.round(both, 6), axis=1)


def _scatter(
    ax: Axes, points: FloatArray, marker: str, limits: tuple[float, float] | None
) -> PathCollection:
    u, v, wavelength = points
    # A cross shows around and beneath the circle at the same point.
    few, circle = len(u) <= 400, marker == "o"
    size = (34.0 if few else 9.0) * (1.0 if circle else 2.6 if few else 1.6)
    style: dict[str, Any] = {
        "s": size,
        "marker": marker,
        "linewidths": 0.0 if circle else 0.9 if few else 0.5,
    }
    if limits:
        style |= {"c": wavelength, "cmap": SEQUENTIAL, "vmin": limits[0], "vmax": limits[1]}
    else:
        style["color"] = BLUE if circle else BLACK
    return ax.scatter(u, v, **style)


def _frame(ax: Axes, unit: str) -> None:
    ax.axhline(0.0, color=GREY, lw=0.5, zorder=0)
    ax.axvline(0.0, color=GREY, lw=0.5, zorder=0)
    reach = 1.05 * max(np.abs([*ax.get_xlim(), *ax.get_ylim()]))
    ax.set_xlim(reach, -reach)
    ax.set_ylim(-reach, reach)
    ax.set_aspect("equal")
    ax.set_xlabel(f"u, to the east ({unit})")
    ax.set_ylabel(f"v, to the north ({unit})")


def _explain(figure: Figure, data: Observables) -> None:
    setups = "1 setup" if len(data.setups) == 1 else f"{len(data.setups)} setups"
    phases = f"{data.phase_name}s (crosses): {data.n_closure_phases}"
    figure.suptitle(f"V² (circles): {data.n_vis2}, {phases}, {setups}")

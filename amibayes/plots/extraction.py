"""Pictures of an extraction: the frame, its power spectrum, the fit, the observables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm, LogNorm
from matplotlib.figure import Figure

from amibayes.extraction import Extraction
from amibayes.extraction.table import series
from amibayes.plots.residual_corr import correlation_plot
from amibayes.plots.style import (
    BLACK,
    BLUE,
    DIVERGING,
    GREY,
    LIGHT_GREY,
    SEQUENTIAL,
    VERMILLION,
    new_figure,
    styled,
)
from amibayes.units import FloatArray

MAX_LINES = 35
"""Closure phases drawn against time."""


@styled()
def frame_plot(extraction: Extraction) -> Figure:
    """Draw the clean reference frame, with the star's place and pixels that are never used."""
    operator = extraction.operators[0]
    view = operator.view
    image = operator.reference.image
    figure = new_figure(5.6)
    ax = figure.subplots()
    top = float(image.max())
    shown = ax.imshow(image, origin="lower", cmap=SEQUENTIAL, norm=AsinhNorm(1e-3 * top, vmax=top))
    y, x = np.nonzero(~operator.reference.good)
    if len(x):
        ax.plot(x, y, "x", color=VERMILLION, label=f"{len(x)} bad pixels")
    middle = [0.5 * (s.start + s.stop - 1) for s in (view.columns, view.rows)]
    ax.plot(
        middle[0] + view.centre_px[0],
        middle[1] + view.centre_px[1],
        "+",
        color=BLACK,
        markersize=14,
        label="star",
    )
    ax.legend(loc="upper right")
    ax.set_xlabel("x (pixels)")
    ax.set_ylabel("y (pixels)")
    ax.set_title(f"{view.instrument.name} {view.instrument.bandpass.name}, median of integrations")
    bar = figure.colorbar(shown, ax=ax, label="Signal (unit of the cube)")
    # Powers of ten nearer to zero would be written over its own tick.
    bar.set_ticks([0.0, *10.0 ** np.arange(np.ceil(np.log10(4e-3 * top)), np.log10(top))])
    bar.minorticks_off()
    return figure


@styled()
def power_plot(extraction: Extraction) -> Figure:
    """Draw the power spectrum of the reference frame, and where the splodges are searched for."""
    operator = extraction.operators[0]
    view = operator.view
    image = operator.reference.image[view.rows, view.columns]
    side = max(image.shape)
    power = np.abs(np.fft.fftshift(np.fft.fft2(image, (side, side)))) ** 2
    power /= power.max()
    edge = 0.5 * (1.0 + (side % 2 == 0) / side)
    low = max(float(np.percentile(power, 5.0)), 1e-12)
    figure = new_figure(5.6)
    ax = figure.subplots()
    extent = (-edge, 1.0 - edge, -edge, 1.0 - edge)
    norm = LogNorm(low, 1.0)
    shown = ax.imshow(power, origin="lower", cmap=SEQUENTIAL, norm=norm, extent=extent)
    for sign, marker in ((1.0, "o"), (-1.0, "s")):
        u, v = sign * view.frequency_px.T
        label = "+(u, v)" if sign > 0 else "−(u, v)"
        ax.plot(u, v, marker, mfc="none", color=VERMILLION, markersize=11, label=label)
    ax.legend(loc="upper right")
    ax.set_xlabel("Horizontal frequency (cycles per pixel)")
    ax.set_ylabel("Vertical frequency (cycles per pixel)")
    figure.colorbar(shown, ax=ax, label="Power (zero frequency = 1)")
    return figure


@styled()
def fit_images(extraction: Extraction) -> Figure:
    """Draw image, model and residual of the fringe fit to the reference frame."""
    operator = extraction.operators[0]
    view = operator.view
    part = (view.rows, view.columns)
    image = np.where(operator.reference.good, operator.reference.image, np.nan)[part]
    pixels = operator.reference.image[part].reshape(1, -1)
    model = (operator.fit.solve(pixels) @ operator.fit.design.T).reshape(view.shape)
    top = float(np.nanmax(image))
    rest = 100.0 * (image - model) / top
    reach = float(np.nanpercentile(np.abs(rest), 99.8))
    figure = new_figure(7.6)
    axes = figure.subplots(2, 2).ravel()
    norm = AsinhNorm(1e-3 * top, vmin=0.0, vmax=top)
    for ax, shown, title in zip(axes, (image, model), ("Image", "Model"), strict=False):
        drawn = ax.imshow(shown, origin="lower", cmap=SEQUENTIAL, norm=norm)
        ax.set_title(title)
        bar = figure.colorbar(drawn, ax=ax, label="Share of the peak", location="bottom")
        bar.set_ticks([0.0, 1e-2 * top, 0.1 * top, top], labels=["0", "0.01", "0.1", "1"])
        bar.minorticks_off()
    drawn = axes[2].imshow(rest, origin="lower", cmap=DIVERGING, vmin=-reach, vmax=reach)
    axes[2].set_title("Residual")
    figure.colorbar(drawn, ax=axes[2], label="% of the peak", location="bottom")
    axes[3].hist(rest[np.isfinite(rest)], 60, color=BLUE)
    axes[3].set_yscale("log")
    axes[3].set_xlabel("Residual (% of the peak)")
    axes[3].set_ylabel("Pixels")
    for ax in axes[:3]:
        ax.set_xlabel("x (pixels)")
        ax.set_ylabel("y (pixels)")
    return figure


@styled()
def observables_plot(extraction: Extraction) -> Figure:
    """Draw mean V² and closure phases with their errors, and those that photons would make."""
    data = extraction.observables
    n = len(data.vis2)
    count = int(extraction.frames.used.sum())
    photons = np.sqrt(np.diag(extraction.physical) / count)
    sigma = data.errors
    figure = new_figure(7.2)
    upper, lower = figure.subplots(2, 1)
    _errors(upper, data.vis2.baseline_m, data.vis2.value, sigma[0], photons[:n])
    upper.set_xlabel("Baseline (m)")
    upper.set_ylabel("V²")
    number = np.linspace(1.0, len(data.closure_phase), len(data.closure_phase))
    degrees = _degrees
    _errors(
        lower, number, degrees(data.closure_phase.value), degrees(sigma[1]), degrees(photons[n:])
    )
    lower.axhline(0.0, color=GREY, lw=1.0)
    lower.set_xlabel("Number of the triangle")
    lower.set_ylabel("Closure phase (°)")
    lower.legend(loc="best")
    upper.set_title(f"{count} integrations, method {extraction.options.method}")
    return figure


def _degrees(angle_rad: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(angle_rad))


def _errors(
    ax: Axes, x: FloatArray, value: FloatArray, sigma: FloatArray, expected: FloatArray
) -> None:
    ax.errorbar(x, value, expected, fmt="none", ecolor=LIGHT_GREY, elinewidth=5, label="photons")
    ax.errorbar(x, value, sigma, fmt="o", color=BLUE, markersize=4, label="measured")


@styled()
def time_plot(extraction: Extraction) -> Figure:
    """Draw closure phases and V² of every integration in use about their means."""
    vis2, closure = series(extraction)
    frames = extraction.frames
    number = 1 + np.flatnonzero(frames.used)
    figure = new_figure(7.6)
    upper, lower = figure.subplots(2, 1, sharex=True)
    rest = np.degrees(closure - extraction.average.closure_phase)
    upper.plot(number, rest[:, :MAX_LINES], ".", color=BLUE, markersize=3)
    upper.plot(number, rest.std(axis=1), "s-", color=VERMILLION, markersize=4, label="rms")
    upper.set_ylabel("Closure phase − mean (°)")
    upper.legend(loc="upper right")
    lower.plot(number, vis2 - extraction.average.vis2, ".", color=BLUE, markersize=3)
    lower.set_ylabel("V² − mean")
    lower.set_xlabel("Number of the integration")
    for k in 1 + np.flatnonzero(~frames.used):
        for ax in (upper, lower):
            ax.axvline(k, color=GREY, ls=":")
    lost = int((~frames.used).sum())
    upper.set_title(f"{len(number)} integrations used, {lost} left out (dotted lines)")
    return figure


def correlations(extraction: Extraction) -> Figure:
    """Draw the correlation matrix of the mean."""
    return correlation_plot(extraction.observables)


PICTURES: dict[str, Callable[[Extraction], Any]] = {
    "frame": frame_plot,
    "power": power_plot,
    "fit": fit_images,
    "observables": observables_plot,
    "time": time_plot,
    "correlation": correlations,
}
"""Names of the pictures and the functions that draw them."""

"""Picture of charge migration: what changes along the ramps, against what the fit predicts."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from amibayes.plots.style import (
    BLACK,
    BLUE,
    DIVERGING,
    GREY,
    LIGHT_GREY,
    VERMILLION,
    new_figure,
    styled,
)
from amibayes.ramps.curvature import Curvature
from amibayes.ramps.fit import MigrationFit
from amibayes.units import FloatArray

HALF_SIDE = 12
"""Pixels about the brightest that are drawn: fringes farther out change by less than noise."""

BINS = 12
"""Groups of pixels of like prediction, each with as much of the information as the others."""


@styled()
def migration_plot(fit: MigrationFit) -> Figure:
    """Draw the change of the current in every pixel, measured and predicted, and along the ramp."""
    best = max(fit.exposures, key=lambda e: float((fit.predicted(e)[e.used] ** 2).sum()))
    predicted = fit.predicted(best)
    of_converter = fit.migration.of_converter is not None
    figure = new_figure(8.6 if of_converter else 6.4)
    grid = figure.add_gridspec(2 + of_converter, 2)
    first, second, third, fourth = (figure.add_subplot(grid[k // 2, k % 2]) for k in range(4))
    limit = float(np.abs(predicted).max()) or 1.0
    for ax, image, title in (
        (first, np.where(best.used, best.change, np.nan), "measured"),
        (second, predicted, "predicted"),
    ):
        shown = _image(ax, image, best, limit, title)
    bar = figure.colorbar(shown, ax=[first, second], shrink=0.9)
    bar.set_label("Change of the current (e⁻ s⁻²)")
    _per_pixel(third, fit)
    _along_ramp(fourth, fit)
    if of_converter:
        _of_converter(figure.add_subplot(grid[2, :]), fit)
    value, error = fit.migration.mean
    figure.suptitle(
        f"Charge migration {1e7 * value:.2f} ± {1e7 * error:.2f} · 10⁻⁷ pixels per electron, "
        f"p = {fit.p_value:.2g}"
    )
    return figure


def _image(ax: Axes, image: FloatArray, exposure: Curvature, limit: float, title: str) -> AxesImage:
    """Draw the pixels about the star."""
    y, x = np.unravel_index(int(exposure.current.argmax()), exposure.current.shape)
    shown = ax.imshow(image, origin="lower", cmap=DIVERGING, vmin=-limit, vmax=limit)
    ax.set_facecolor(LIGHT_GREY)
    ax.set_xlim(x - HALF_SIDE - 0.5, x + HALF_SIDE + 0.5)
    ax.set_ylim(y - HALF_SIDE - 0.5, y + HALF_SIDE + 0.5)
    ax.set_xlabel("x (pixels)")
    ax.set_ylabel("y (pixels)")
    ax.set_title(title)
    return shown


def _per_pixel(ax: Axes, fit: MigrationFit) -> None:
    """Draw measured against predicted change, in groups of pixels of all exposures."""
    parts = zip(*(_pixels(fit, e) for e in fit.exposures), strict=True)
    _binned(ax, *(np.concatenate(a) for a in parts))
    ax.set_xlabel("Predicted (e⁻ s⁻²)")
    ax.set_ylabel("Measured (e⁻ s⁻²)")


def _of_converter(ax: Axes, fit: MigrationFit) -> None:
    """Draw what the converter makes of single differences, beside all that changes linearly."""
    parts = zip(*(_differences(fit, e) for e in fit.exposures if e.waves), strict=True)
    _binned(ax, *(np.concatenate(a) for a in parts))
    ax.set_xlabel("Current of one difference, by the converter's errors: predicted (e⁻ s⁻¹)")
    ax.set_ylabel("Measured (e⁻ s⁻¹)")


def _differences(
    fit: MigrationFit, exposure: Curvature
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Prediction, measurement and weight of the differences of the pixels of an exposure."""
    converter, used = fit.migration.of_converter, exposure.used
    assert converter is not None
    assert exposure.waves is not None
    lag = exposure.lag_s[:, None, None]
    of_waves = np.tensordot(converter.value, exposure.waves.departure, axes=1)
    linear = np.tensordot(converter.value, exposure.waves.change, axes=1)
    found = exposure.departure - lag * (fit.predicted(exposure) - linear)
    # A slope over these times is known to sigma: one of them to that times √Σ lag².
    weight = np.broadcast_to(exposure.sigma**-2 / (exposure.lag_s**2).sum(), found.shape)
    return of_waves[:, used].ravel(), found[:, used].ravel(), weight[:, used].ravel()


def _binned(ax: Axes, p: FloatArray, m: FloatArray, w: FloatArray) -> None:
    """Draw measured against predicted numbers, in groups of like prediction."""
    order = np.argsort(p)
    share = np.cumsum((w * p**2)[order])
    group = np.minimum((BINS * share / max(share[-1], 1e-300)).astype(int), BINS - 1)
    total = np.bincount(group, w[order], BINS)
    seen = total > 0.0
    x, y = (np.bincount(group, (w * a)[order], BINS)[seen] / total[seen] for a in (p, m))
    ends = np.array([x.min(), x.max()])
    ax.plot(ends, ends, color=GREY, label="prediction")
    ax.errorbar(x, y, 1.0 / np.sqrt(total[seen]), fmt="o", color=BLUE, label="groups of pixels")
    ax.legend(loc="lower right")


def _pixels(fit: MigrationFit, exposure: Curvature) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Prediction, measurement and weight of the pixels of an exposure."""
    used = exposure.used
    return fit.predicted(exposure)[used], exposure.change[used], exposure.sigma[used] ** -2


def _along_ramp(ax: Axes, fit: MigrationFit) -> None:
    """Draw how much of the predicted pattern is in the current, from difference to difference."""
    for exposure in fit.exposures:
        pattern = fit.predicted(exposure)[exposure.used]
        weight = pattern * exposure.sigma[exposure.used] ** -2
        size = float(weight @ pattern)
        if not size > 0.0:
            continue
        found = exposure.departure[:, exposure.used] @ weight / size
        # A slope over these times is known to 1/√size; even weights share that out.
        error = float(np.sqrt((exposure.lag_s**2).sum() / size))
        ax.errorbar(
            exposure.time_s + exposure.lag_s, found, error, fmt="o", color=VERMILLION, alpha=0.6
        )
    times = np.concatenate([e.time_s + e.lag_s for e in fit.exposures])
    middle = fit.exposures[0].time_s
    ends = np.array([times.min(), times.max()])
    ax.plot(ends, ends - middle, color=BLACK, label="prediction")
    ax.set_xlabel("Time from the reset (s)")
    ax.set_ylabel("Pattern in the current (s)")
    ax.legend(loc="upper left")

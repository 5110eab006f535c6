"""Picture of charge migration: what changes along the ramps, against what the fit predicts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
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
from amibayes.support.terminal import equals
from amibayes.units import FloatArray, IntArray

HALF_SIDE = 12
"""Pixels about the brightest that are drawn: fringes farther out change by less than noise."""

BINS = 12
"""Groups of pixels of like prediction, none with more of the information than this part of it,
but for single pixels that have more."""


@styled()
def migration_plot(fit: MigrationFit) -> Figure:
    """Draw the change of the current, measured and predicted.

    In every pixel, across the fringes through the brightest one, against the prediction, and
    along the ramp; where the converter's errors were fitted, what they make as well.
    """
    best = max(fit.exposures, key=lambda e: float((fit.predicted(e)[e.used] ** 2).sum()))
    of_converter = fit.migration.of_converter is not None
    heights = [2.9, 3.0, 2.9] + [2.4] * of_converter
    figure = new_figure(sum(heights) + 0.3)
    # Rows are laid out apart: the bar of the images would make all others narrower.
    rows = [
        row[0] for row in figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
    ]
    _images(rows[0], rows[0].subplots(1, 2), fit, best)
    _across_fringes(rows[1].subplots(), fit, best)
    per_pixel, along_ramp = rows[2].subplots(1, 2)
    _per_pixel(per_pixel, fit)
    _along_ramp(along_ramp, fit)
    if of_converter:
        _of_converter(rows[3].subplots(), fit)
    value, error = fit.migration.mean
    figure.suptitle(
        f"Charge migration {1e7 * value:.2f} ± {1e7 * error:.2f} · 10⁻⁷ pixels per electron, "
        f"p {equals(fit.p_value)}"
    )
    return figure


def _images(
    figure: SubFigure, axes: Sequence[Axes], fit: MigrationFit, exposure: Curvature
) -> None:
    """Draw the change of every pixel about the star, measured and predicted, on one scale."""
    predicted = fit.predicted(exposure)
    limit = float(np.abs(predicted).max()) or 1.0
    measured = np.where(exposure.used, exposure.change, np.nan)
    for ax, image, title in zip(
        axes, (measured, predicted), ("measured", "predicted"), strict=True
    ):
        shown = _image(ax, image, exposure, limit, title)
    bar = figure.colorbar(shown, ax=list(axes), shrink=0.9)
    bar.set_label("Change of the current\n(e⁻ s⁻²)")


def _image(ax: Axes, image: FloatArray, exposure: Curvature, limit: float, title: str) -> AxesImage:
    """Draw the pixels about the star."""
    y, x = _brightest(exposure)
    shown = ax.imshow(image, origin="lower", cmap=DIVERGING, vmin=-limit, vmax=limit)
    ax.set_facecolor(LIGHT_GREY)
    ax.set_xlim(x - HALF_SIDE - 0.5, x + HALF_SIDE + 0.5)
    ax.set_ylim(y - HALF_SIDE - 0.5, y + HALF_SIDE + 0.5)
    ax.set_xlabel("x (pixels)")
    ax.set_ylabel("y (pixels)")
    ax.set_title(title)
    return shown


def _brightest(exposure: Curvature) -> tuple[int, int]:
    """Row and column of the brightest pixel."""
    row, column = np.unravel_index(int(exposure.current.argmax()), exposure.current.shape)
    return int(row), int(column)


def _across_fringes(ax: Axes, fit: MigrationFit, exposure: Curvature) -> None:
    """Draw the change along the row and the column through the brightest pixel.

    Bright fringes lose current to the dark ones beside them. Amplitudes of the baselines would
    have the noise of all pixels in them, where a few have what migration does.
    """
    predicted, (row, column) = fit.predicted(exposure), _brightest(exposure)
    lines = (
        ("x", np.s_[row, :], column, BLUE, "o", "-", -0.12),
        ("y", np.s_[:, column], row, VERMILLION, "s", "--", 0.12),
    )
    for name, line, middle, colour, marker, dash, aside in lines:
        place = np.arange(len(predicted[line])) - middle
        near = np.abs(place) <= HALF_SIDE
        seen = near & exposure.used[line]
        ax.plot(
            place[near], predicted[line][near], color=colour, linestyle=dash,
            label=f"prediction along {name}",
        )  # fmt: skip
        # Beside each other, for points of both lines at one place to be told apart.
        ax.errorbar(
            place[seen] + aside, exposure.change[line][seen], exposure.sigma[line][seen],
            fmt=marker, markersize=4.0, elinewidth=1.0, color=colour,
            label=f"measured along {name}",
        )  # fmt: skip
    ax.set_xlabel("Place across the fringes, from the brightest pixel (pixels)")
    ax.set_ylabel("Change (e⁻ s⁻²)")
    _legend_above(ax, 2)


def _legend_above(ax: Axes, columns: int) -> None:
    """Put the legend above the axes: anywhere within it might hide a datum."""
    ax.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, frameon=False,
        columnspacing=1.0,
    )  # fmt: skip


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
    group = _groups(p, w)
    total = np.bincount(group, w)
    x, y = (np.bincount(group, w * a) / total for a in (p, m))
    ends = np.array([x.min(), x.max()])
    ax.plot(ends, ends, color=GREY, label="prediction")
    ax.errorbar(x, y, 1.0 / np.sqrt(total), fmt="o", color=BLUE, label="groups of pixels")
    _legend_above(ax, 2)


def _groups(p: FloatArray, w: FloatArray) -> IntArray:
    """Number the groups of like prediction (n,) that numbers of weights (n,) are pooled in.

    A number that has more of the information than a group may have stands alone, and no
    group reaches over it.
    """
    order = np.argsort(p)
    told = (w * p**2)[order]
    told = told / max(float(told.sum()), 1e-300)
    alone = told > 1.0 / BINS
    rest = np.where(alone, 0.0, told)
    # By the middle of each number's share: by its end the last of a group would be the next's.
    part = (BINS * (np.cumsum(rest) - 0.5 * rest)).astype(int)
    begins = alone.copy()
    begins[1:] |= alone[:-1] | (np.diff(part) > 0)
    begins[0] = False
    group = np.empty(len(p), dtype=np.intp)
    group[order] = np.cumsum(begins)
    return group


def _pixels(fit: MigrationFit, exposure: Curvature) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Prediction, measurement and weight of the pixels of an exposure."""
    used = exposure.used
    return fit.predicted(exposure)[used], exposure.change[used], exposure.sigma[used] ** -2


def _along_ramp(ax: Axes, fit: MigrationFit) -> None:
    """Draw how much of the predicted pattern is in the current, from difference to difference."""
    labelled = False
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
            exposure.time_s + exposure.lag_s, found, error, fmt="o", color=VERMILLION, alpha=0.6,
            label="" if labelled else "exposures",
        )  # fmt: skip
        labelled = True
    times = np.concatenate([e.time_s + e.lag_s for e in fit.exposures])
    middle = fit.exposures[0].time_s
    ends = np.array([times.min(), times.max()])
    ax.plot(ends, ends - middle, color=BLACK, label="prediction")
    ax.set_xlabel("Time from the reset (s)")
    ax.set_ylabel("Pattern in the current (s)")
    _legend_above(ax, 2)

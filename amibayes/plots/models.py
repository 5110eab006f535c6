"""Models of the sky beside each other: images, visibilities, residuals, odds and confusion."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from amibayes.companion_search.field import resolution_mas
from amibayes.comparison.compare import Compared, ModelComparison
from amibayes.models.brightness import brightness, points
from amibayes.models.extended import Extended
from amibayes.models.light_points import light_points
from amibayes.models.parameters import parameter_words
from amibayes.plots.corner_plot import corner_plot
from amibayes.plots.style import (
    BLACK,
    GREY,
    LIGHT_GREY,
    PALE,
    SEQUENTIAL,
    marker_of,
    new_figure,
    styled,
)
from amibayes.units import BoolArray, FloatArray

PIXELS = 121
"""Pixels along a side of a model's image."""

COLUMNS = 3
"""Images beside each other; two where that fills the rows."""

TICKS = np.array([3, 10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000])
"""Of scales that are linear up to the first one."""

CORNER_SAMPLES = 20_000


def sources_of(model: Compared) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points of all that is around the star in the best fit: east, north (mas), light."""
    parts = [np.array(_companions(model))]
    parts += [np.array(light_points(part, values)) for part, values in _extended(model)]
    east, north, light = np.concatenate(parts, axis=1)
    return east, north, light


def _companions(model: Compared) -> tuple[FloatArray, FloatArray, FloatArray]:
    """East, north (mas) and contrast of each companion."""
    parameters, theta = model.fit.model.likelihood.parameters, model.theta
    found = [
        (*theta[parameters.place(k)], theta[parameters.columns("flux", component=k)[0]])
        for k in range(1, parameters.companions + 1)
    ]
    east, north, contrast = np.array(found).reshape(-1, 3).T
    return east, north, contrast


def _extended(model: Compared) -> Iterator[tuple[Extended, FloatArray]]:
    """Each disc or ring around the star, with its best parameters."""
    parameters = model.fit.model.likelihood.parameters
    for part in model.fit.model.likelihood.model.surroundings:
        if isinstance(part, Extended):
            yield part, model.theta[[parameters.index(p.name) for p in part.parameters]]


def image_of(model: Compared, reach: float, beam: float) -> FloatArray:
    """Light per beam around the star in the best fit, (north, east reversed), out to ``reach``."""
    grid = np.linspace(-reach, reach, PIXELS)
    parts = [points(*_companions(model))]
    parts += [brightness(part, values, beam) for part, values in _extended(model)]
    image = sum((part.through(beam, grid) for part in parts), np.zeros((PIXELS, PIXELS)))
    return np.asarray(image[:, ::-1])


@styled()
def model_images(found: ModelComparison) -> Figure:
    """Draw the best fit of every model without its star, with the beam.

    Light is convolved with a Gaussian of FWHM λ/2B; colours give it per beam, in units of the
    star's. All have one field, but those whose light lies mostly outside of it.
    """
    beam = 0.5 * resolution_mas(found.models[0].fit.model.likelihood)
    shares = found.probability
    # The field is that of models that count.
    extents = np.array([_extent(*sources_of(m), 0.95) for m in found.models])
    reach = max(3.0 * beam, 1.3 * float(extents[shares > 0.01].max(initial=0.0)))
    middle = np.array([_extent(*sources_of(m), 0.5) for m in found.models])
    fields = np.where(middle > reach, 1.3 * extents, reach)
    images = [image_of(m, field, beam) for m, field in zip(found.models, fields, strict=True)]
    scale = PowerNorm(0.5, 0.0, max(float(i.max()) for i in images) or 1.0)
    columns = 2 if len(images) in (2, 4) else min(len(images), COLUMNS)
    rows = int(np.ceil(len(images) / columns))
    figure = new_figure(1.1 + (3.5 if columns == 2 else 2.7) * rows)
    axes = figure.subplots(rows, columns, squeeze=False)
    each = zip(axes.ravel(), found.models, images, shares, fields, extents, strict=False)
    for ax, model, image, share, field, extent in each:
        drawn = _draw_image(ax, image, field, beam, scale)
        ax.set_title(
            f"{model.name}: {_percent(share)}\nχ² {model.chi2:.4g}, {model.ndof} dof", fontsize=9.5
        )
        notes = _notes(model, extent, field, own=field != reach)
        ax.text(0.5, 0.97, notes, transform=ax.transAxes, **NOTE)
    _label_axes(axes, fields == reach)
    bar = figure.colorbar(drawn, ax=axes, location="bottom", shrink=0.8, aspect=35)
    bar.locator = MaxNLocator(4)
    bar.update_ticks()
    bar.set_label("Light per beam (star = 1)")
    return figure


def _label_axes(axes: Any, common: BoolArray) -> None:
    """Number the first panel of each row and the last of each column that have the common field."""
    shown = np.zeros(axes.shape, dtype=bool)
    shown.ravel()[: len(common)] = common
    for i, j in np.ndindex(*axes.shape):
        ax = axes[i, j]
        if i * axes.shape[1] + j >= len(common):
            ax.axis("off")
        elif not shown[i, j]:
            ax.set_xticks([])
            ax.set_yticks([])
        else:
            left, lowest = not shown[i, :j].any(), not shown[i + 1 :, j].any()
            ax.tick_params(labelleft=left, labelbottom=lowest)
            ax.set_ylabel("North (mas)" if left else "")
            ax.set_xlabel("East (mas)" if lowest else "")


NOTE: dict[str, Any] = {
    "color": PALE,
    "ha": "center",
    "va": "top",
    "fontsize": 7.5,
    "bbox": {"fc": BLACK, "alpha": 0.5, "ec": "none", "pad": 1.5},
}
"""How a note is written in a panel."""


def _draw_image(ax: Axes, image: FloatArray, field: float, beam: float, scale: Any) -> AxesImage:
    """One image, its star and the beam; imshow puts the first column at the left: east."""
    extent = (field, -field, -field, field)
    drawn = ax.imshow(image, origin="lower", extent=extent, cmap=SEQUENTIAL, norm=scale)
    ax.plot(0.0, 0.0, "*", color="white", mec=BLACK, ms=10)
    ax.add_patch(Circle((0.8 * field, -0.8 * field), 0.5 * beam, fill=False, ec=PALE))
    return drawn


def _notes(model: Compared, extent: float, field: float, *, own: bool) -> str:
    """What an image does not show: light farther out, light without a shape, or that there is none.

    A field of its own is told too.
    """
    likelihood, notes = model.fit.model.likelihood, []
    if "background" in likelihood.parameters.names:
        halo = float(model.theta[likelihood.parameters.index("background")])
        notes.append(f"+ {100.0 * halo:.1f} % over-resolved")
    elif extent == 0.0:
        notes.append("nothing around")
    if own:
        notes.append(f"field of ±{field:.3g} mas")
    elif extent > 1.2 * field:
        notes.append(f"light out to {extent:.3g} mas")
    return "\n".join(notes)


def _extent(east: FloatArray, north: FloatArray, light: FloatArray, share: float) -> float:
    """Radius that holds a share of the light."""
    if not light.sum() > 0.0:
        return 0.0
    radius = np.hypot(east, north)
    order = np.argsort(radius)
    reached = np.cumsum(light[order]) / light.sum()
    return float(radius[order][np.searchsorted(reached, share)])


def _percent(share: float) -> str:
    if share > 0.9995:
        return "> 99.9 %"
    if share < 1e-3:
        return "< 0.1 %"
    # Two digits, but three where the second one would make it certain.
    return f"{100.0 * share:.{3 if share >= 0.995 else 2}g} %"


@styled()
def model_visibilities(found: ModelComparison) -> Figure:
    """Draw V² against the position angle of the baseline, and closure phases, with all models."""
    likelihood = found.models[0].fit.model.likelihood
    data, n2 = likelihood.observables, likelihood.observables.n_vis2
    shown = [m for m in _by_probability(found)[:5]]
    kinds = [k for k, n in (("vis2", n2), ("cp", data.n_closure_phases)) if n]
    figure = new_figure(0.8 + 3.4 * len(kinds))
    axes = np.atleast_1d(figure.subplots(len(kinds), 1))
    sigma = np.sqrt(likelihood.noise.covariance.variance)
    predicted = [m.fit.model.predict(m.fit.cube[:1])[:, 0] for m in shown]
    for ax, kind in zip(axes, kinds, strict=True):
        part = slice(0, n2) if kind == "vis2" else slice(n2, None)
        unit = 1.0 if kind == "vis2" else 180.0 / np.pi
        x = _baseline_angle(found) if kind == "vis2" else np.arange(data.n_closure_phases) + 1.0
        values = data.data[part] * unit
        ax.errorbar(x, values, sigma[part] * unit, fmt="none", ecolor=BLACK, lw=1.2, label="data")
        for k, (model, value) in enumerate(zip(shown, predicted, strict=True)):
            colour, marker = marker_of(k)
            ax.plot(x, value[part] * unit, marker, color=colour, mfc="none", ms=5, label=model.name)
        ax.margins(y=0.08)
    # Above the data: inside there is no place that is free for every data set.
    axes[0].legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.01))
    if "vis2" in kinds:
        axes[0].set_xlabel("Position angle of the baseline (° east of north)")
        axes[0].set_ylabel("V²")
        axes[0].set_xticks(np.arange(0, 181, 30))
    if "cp" in kinds:
        axes[-1].set_xlabel("Triangle")
        axes[-1].set_ylabel("Closure phase (°)")
    return figure


def _by_probability(found: ModelComparison) -> list[Compared]:
    order = np.argsort(-found.probability, kind="stable")
    return [found.models[k] for k in order]


def _baseline_angle(found: ModelComparison) -> FloatArray:
    """Position angle of each V²'s baseline, 0 to 180 degrees."""
    vis2 = found.models[0].fit.model.likelihood.observables.vis2
    return np.asarray(np.degrees(np.arctan2(vis2.u_m[:, 0], vis2.v_m[:, 0])) % 180.0)


@styled()
def model_residuals(found: ModelComparison) -> Figure:
    """Draw the residuals of each model's best fit, in units of the errors."""
    data = found.models[0].fit.model.likelihood.observables
    n2, count = data.n_vis2, len(found.models)
    figure = new_figure(0.9 + 1.35 * count)
    axes = np.atleast_1d(figure.subplots(count, 1, sharex=True))
    for ax, model in zip(axes, found.models, strict=True):
        cube = model.fit.model
        sigma = np.sqrt(cube.likelihood.noise.covariance.variance)
        predicted = cube.predict(model.fit.cube[:1])
        left = cube.difference(predicted, data.data[:, None])[:, 0] / sigma
        for k, part in enumerate((slice(0, n2), slice(n2, None))):
            colour, marker = marker_of(k)
            at = np.arange(len(left))[part] + 1
            ax.plot(at, left[part], marker, color=colour, ms=3.5)
        ax.axhline(0.0, color=GREY, lw=0.8)
        ax.axhspan(-1.0, 1.0, color=LIGHT_GREY, alpha=0.5, lw=0)
        _symmetric(ax, float(np.abs(left).max(initial=1.0)))
        ax.set_title(f"{model.name}, χ² {model.chi2:.4g} for {model.ndof}", fontsize=10)
    figure.supylabel("Residual (σ)", fontsize=11)
    axes[-1].set_xlabel(f"Datum: V² to {n2}, then closure phases")
    return figure


def _symmetric(ax: Axes, largest: float) -> None:
    """Scale residuals: linear where all are small, else logarithmic past 3σ."""
    end = 1.3 * max(largest, 2.0)
    if end > 8.0:
        ax.set_yscale("symlog", linthresh=3.0)
        inside = TICKS[end > TICKS][:: 2 if end > 40.0 else 1]
        ticks = [*(-inside[::-1]), 0, *inside]
        ax.set_yticks(ticks, [f"{t:g}".replace("-", "−") for t in ticks])
        ax.minorticks_off()
    ax.set_ylim(-end, end)


@styled()
def model_odds(found: ModelComparison) -> Figure:
    """Draw ln Z of each model below the best, and the confusion matrix."""
    confusion = found.confusion
    names = [m.name for m in found.models]
    wide = 0.45 * len(names) + 1.5
    figure = new_figure(wide + (0.0 if confusion is None else wide + 0.6))
    if confusion is None:
        _draw_odds(figure.subplots(), found)
        return figure
    upper, lower = figure.subplots(2, 1, gridspec_kw={"height_ratios": [1.0, 1.2]})
    _draw_odds(upper, found)
    columns, share = confusion.taken_for()
    drawn = lower.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    size = float(np.clip(90.0 / len(columns), 6.0, 11.0))  # as wide as a column
    for (i, j), value in np.ndenumerate(share):
        colour = PALE if value > 0.6 else BLACK
        lower.text(j, i, f"{value:.2f}", ha="center", va="center", color=colour, fontsize=size)
    lower.set_xticks(range(len(columns)), columns, rotation=45, ha="right", rotation_mode="anchor")
    lower.set_yticks(range(len(names)), names)
    lower.set_xlabel("taken for")
    lower.set_ylabel("simulated")
    lower.set_title(f"{confusion.n_draws} data sets of each model")
    figure.colorbar(drawn, ax=lower, label="share")
    return figure


def _draw_odds(ax: Axes, found: ModelComparison) -> None:
    log_z = np.array([m.log_z for m in found.models])
    error = np.array([m.log_z_error for m in found.models])
    place = np.arange(len(log_z))[::-1]
    below = log_z - log_z.max()
    ax.errorbar(below, place, xerr=error, fmt="o", color=BLACK, capsize=3)
    for x, y, share in zip(below, place, found.probability, strict=True):
        ax.annotate(_percent(share), (x, y), (0, 7), textcoords="offset points", ha="center")
    ax.axvline(-np.log(19.0), color=GREY, ls=":", label="odds of 19 to 1")
    ax.set_xscale("symlog", linthresh=3.0)
    end = max(6.0, 2.0 * float(-below.min()))
    ticks = [*(-TICKS[end > TICKS][::-1]), 0]
    ax.set_xticks(ticks, [f"{t:g}".replace("-", "−") for t in ticks])
    ax.minorticks_off()
    ax.set_xlim(-end, 2.0)
    ax.set_ylim(-0.6, len(log_z) - 0.3)
    ax.set_yticks(place, [m.name for m in found.models])
    ax.set_xlabel("ln Z below the most probable model's")
    ax.set_title(f"Verdict: {found.verdict.statement}")
    ax.legend(loc="best")


def model_corner(found: ModelComparison) -> Figure:
    """Draw the corner plot of the most probable model that has parameters."""
    model = next(m for m in _by_probability(found) if m.names)
    rng = np.random.default_rng(0)  # which draws are shown; no number of the result
    samples = model.draws.resampled(CORNER_SAMPLES, rng)
    parameters = model.fit.model.likelihood.parameters
    logs = [k for k, p in enumerate(parameters) if p.role == "flux" or p.name.endswith("_flux")]
    best = np.array(model.theta)
    samples[:, logs], best[logs] = np.log10(samples[:, logs]), np.log10(best[logs])
    labels = [_label(n, k in logs) for k, n in enumerate(model.names)]
    return corner_plot(samples, labels, best=best.tolist())


def _label(name: str, logarithmic: bool) -> str:
    words = parameter_words(name).replace("position angle", "PA")
    # On two lines: a panel is no wider than a few words.
    words = re.sub(r" (of companion \d+)( \(.*\))?$", r"\2\n\1", words)
    return f"log10 {words}" if logarithmic else words

"""Maps of the search: how much a companion at each position would explain, and how bright."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy.io import fits
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.grid import Grid
from amibayes.companion_search.result import SearchResult
from amibayes.detection.false_alarm import Significance
from amibayes.detection.tails import clopper_pearson
from amibayes.likelihood.chi2 import candid_n_sigma
from amibayes.plots.style import (
    BLACK,
    DIVERGING,
    GREY,
    ORANGE,
    SEQUENTIAL,
    VERMILLION,
    new_figure,
    styled,
)
from amibayes.support.atomic_files import atomic_path
from amibayes.units import BoolArray, FloatArray

Quantity = Literal["sqrt_delta_chi2", "delta_chi2"]
ContrastKind = Literal["signed", "positive"]

MAP_TITLES = {
    "sqrt_delta_chi2": "√Δχ² of the best companion at each position",
    "delta_chi2": "Δχ² of the best companion at each position",
}

HALO = [withStroke(linewidth=3.5, foreground="white")]
"""Markers that can be seen on dark and on bright parts of a map."""


@styled()
def detection_map(
    result: SearchResult,
    *,
    quantity: Quantity = "sqrt_delta_chi2",
    contrast: ContrastKind | None = None,
) -> Figure:
    """Draw the gain in χ² over the field, north up and east left, with what was found.

    Parameters
    ----------
    result : SearchResult
    quantity : {"sqrt_delta_chi2", "delta_chi2"}
        What the colours show, for the best positive contrast of the template bank.
    contrast : {"signed", "positive"}, optional
        Adds the map of the best contrast below.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = new_figure(6.1 if contrast is None else 11.6)
    axes = figure.subplots(1 if contrast is None else 2, 1, squeeze=False)[:, 0]
    gain = result.bank_delta_chi2
    values = np.sqrt(gain) if quantity == "sqrt_delta_chi2" else gain
    _paint(figure, axes[0], result.grid, values, MAP_TITLES[quantity], cmap=SEQUENTIAL, vmin=0.0)
    if contrast is not None:
        _paint_contrast(figure, axes[1], result, contrast)
    for ax in axes:
        _mark(ax, result)
    figure.suptitle(_headline(result))
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


@styled()
def sky_map(
    result: SearchResult, values: FloatArray, label: str, *, vmin: float | None = None
) -> Figure:
    """Draw any quantity over the field with what the search found.

    Parameters
    ----------
    result : SearchResult
    values : (n_grid,) float array
        One value per position of ``result.grid``, such as `local_n_sigma`.
    label : str
        Name of the quantity, with its unit.
    vmin : float, optional
        Lowest value of the colours.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = new_figure(6.1)
    ax = figure.subplots()
    _paint(figure, ax, result.grid, values, label, cmap=SEQUENTIAL, vmin=vmin)
    _mark(ax, result)
    figure.suptitle(_headline(result))
    figure.legend(loc="outside lower center", ncols=2)
    return figure


GREY_ENDS = 0.95
"""Power of ten, as a share of the threshold's, whose grey is surely not of the colours below it."""


@styled()
def false_alarm_map(result: SearchResult, tested: Significance) -> Figure:
    """Draw the probability that noise reaches the statistic of each position, anywhere.

    Parameters
    ----------
    result : SearchResult
    tested : Significance
        Of the same search, with its ``field``.

    Returns
    -------
    matplotlib.figure.Figure
        The global probability: grey down to the threshold of a detection, coloured below it, and
        of one colour below `told_by_draws`. The local one, of a position
        by itself, is small at some of thousands of positions whatever the data are: it would
        look like detections, and is in ``maps.fits`` only.
    """
    figure = new_figure(6.1)
    ax = figure.subplots()
    lowest = told_by_draws(tested)
    value = np.log10(np.maximum(chance_of_places(result, tested), lowest))
    if tested.detected:  # the search claims one position; what else is left is structure
        least = GREY_ENDS * float(np.log10(tested.alpha))
        value = np.where(near_best(result), value, np.maximum(value, least))
    low = float(np.log10(lowest))
    label = "False-alarm probability anywhere in the field"
    label += ",\ncompanion taken out elsewhere" if tested.detected else ""
    colours = _chance_colours(low, float(np.log10(tested.alpha)))
    style: dict[str, Any] = {"cmap": colours, "vmin": low, "vmax": 0.0, "extend": "min"}
    bar = _paint(figure, ax, result.grid, value, label, **style)
    powers = np.arange(np.ceil(low), 1.0)
    bar.set_ticks([low, *powers[powers > low + 0.3]])
    bar.set_ticklabels([f"≤ {lowest:.2g}", *(f"{10.0**p:g}" for p in powers[powers > low + 0.3])])
    _mark(ax, result)
    figure.suptitle(_headline(result))
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def chance_of_places(result: SearchResult, tested: Significance) -> FloatArray:
    """Global false-alarm probability of every position, (n_grid,).

    Where a companion was detected, noise reaches the sidelobes of its fringes nowhere either: away
    from it (λ/2B) the probability is that of the data without it.
    """
    found = probability_maps(tested)["global"]
    if not tested.detected or tested.test is None:
        return found
    test = tested.test
    white = test.likelihood.residuals(result.theta)[:, 0]
    # Noise that is measured in what a star alone leaves would hold the companion.
    without = tested.survival(test.with_noise_of(white).field(white))
    return np.where(near_best(result), found, without)


def near_best(result: SearchResult) -> BoolArray:
    """Whether a position is within λ/2B of the best fit, (n_grid,)."""
    best, grid = result.companion, result.grid
    apart = np.hypot(grid.east_mas - best.east_mas, grid.north_mas - best.north_mas)
    return np.asarray(apart <= 0.5 * resolution_mas(result.likelihood))


def _chance_colours(low: float, threshold: float) -> LinearSegmentedColormap:
    """Grey down to the threshold of a detection, orange to red below it, by powers of ten."""
    edge = float(np.clip(1.0 - threshold / low, 0.01, 0.99))
    marks = [(0.0, VERMILLION), (edge, ORANGE), (edge, "#8a8a8a"), (1.0, "#f2f2f2")]
    return LinearSegmentedColormap.from_list("chance", marks)


def told_by_draws(tested: Significance) -> float:
    """Smallest probability that so many null draws can tell, with 95 % confidence."""
    return clopper_pearson(0, tested.n_draws)[1]


def probability_maps(tested: Significance) -> dict[str, FloatArray]:
    """Local and global false-alarm probability at every position, (n_grid,) each.

    Raises
    ------
    ValueError
        Where the significance holds no field.
    """
    if tested.field is None or tested.test is None:
        raise ValueError("this significance holds no statistic per position")
    return {
        "local": tested.test.local_survival(tested.field),
        "global": tested.survival(tested.field),
    }


def _headline(result: SearchResult) -> str:
    c = result.companion
    return (
        f"Best fit: {c.separation_mas:.4g} mas, PA {c.position_angle_deg:.1f}°, "
        f"contrast {100.0 * c.contrast:.3g} %, Δχ² {result.delta_chi2:.1f}"
    )


def _paint(
    figure: Figure, ax: Axes, grid: Grid, values: FloatArray, label: str, **options: Any
) -> Colorbar:
    """Show values over the grid with a colour bar; the first column is the westernmost."""
    extend = options.pop("extend", "neither")
    edge = (grid.half_width + 0.5) * grid.step_mas
    reach = 1.04 * max(edge, grid.outer_mas)
    image = ax.imshow(
        grid.image(values), origin="lower", extent=(-edge, edge, -edge, edge), **options
    )
    ax.set_xlim(reach, -reach)
    ax.set_ylim(-reach, reach)
    ax.set_xlabel("East offset (mas)")
    ax.set_ylabel("North offset (mas)")
    return figure.colorbar(image, ax=ax, label=label, extend=extend, shrink=0.85, pad=0.02)


def _paint_contrast(figure: Figure, ax: Axes, result: SearchResult, kind: ContrastKind) -> None:
    percent = 100.0 * result.bank_contrast
    # Near the star the error of the contrast has no bound: let the scale leave it out.
    top = max(1.1 * 100.0 * result.companion.contrast, float(np.quantile(np.abs(percent), 0.95)))
    if kind == "signed":
        style = {"cmap": DIVERGING, "vmin": -top, "vmax": top, "extend": "both"}
    else:
        percent = np.where(percent > 0.0, percent, np.nan)
        style = {"cmap": SEQUENTIAL, "vmin": 0.0, "vmax": top, "extend": "max"}
    _paint(figure, ax, result.grid, percent, f"Best contrast at each position (%), {kind}", **style)


def _mark(ax: Axes, result: SearchResult) -> None:
    """Draw star, companion, other modes, edges of the field, resolution and compass."""
    plot: dict[str, Any] = {"linestyle": "none", "fillstyle": "none", "path_effects": HALO}
    ax.plot(0.0, 0.0, "*", color=BLACK, markersize=11, linestyle="none", label="star")
    best = result.companion
    ax.plot(
        best.east_mas,
        best.north_mas,
        "o",
        color=VERMILLION,
        markersize=15,
        markeredgewidth=2.2,
        label="best fit",
        **plot,
    )
    others = np.array([m.place for m in result.modes[1:]]).reshape(-1, 2)
    if len(others):
        ax.plot(
            *others.T,
            "s",
            color=BLACK,
            markersize=9,
            markeredgewidth=1.5,
            clip_on=False,
            label="modes within Δχ² 25",
            **plot,
        )
    _edges(ax, result.grid)
    _scale(ax, result)
    _compass(ax)


def _edges(ax: Axes, grid: Grid) -> None:
    label = f"field searched, {grid.inner_mas:.3g}–{grid.outer_mas:.3g} mas"
    for radius, name in [(grid.outer_mas, label), (grid.inner_mas, None)]:
        ax.add_patch(Circle((0.0, 0.0), radius, fill=False, ls="--", lw=1.2, ec=GREY))
        ax.plot([], [], ls="--", lw=1.2, color=GREY, label=name)


def _scale(ax: Axes, result: SearchResult) -> None:
    """A circle as wide as λ/B_max in the lower left corner."""
    width, edge = resolution_mas(result.likelihood), ax.get_ylim()[1]
    place = edge - max(0.6 * width, 0.03 * edge)
    ax.add_patch(
        Circle(
            (place, -place),
            0.5 * width,
            fill=False,
            ec=BLACK,
            lw=1.5,
            path_effects=HALO,
        )
    )
    name = f"λ/B$_{{max}}$ = {width:.3g} mas, circle lower left"
    ax.plot([], [], "o", ls="none", color=BLACK, fillstyle="none", markersize=12, label=name)


def _compass(ax: Axes) -> None:
    arrow = {"arrowstyle": "<-", "color": BLACK, "lw": 1.2, "shrinkA": 0.0, "shrinkB": 0.0}
    for name, tip in [("N", (0.965, 0.975)), ("E", (0.855, 0.875))]:
        ax.annotate(
            name,
            xy=(0.965, 0.875),
            xytext=tip,
            xycoords="axes fraction",
            textcoords="axes fraction",
            ha="center",
            va="center",
            arrowprops=arrow,
        )


def local_n_sigma(result: SearchResult) -> FloatArray:
    """CANDID's nσ of the best positive contrast at every position of the grid, (n_grid,)."""
    chi2 = result.chi2_single - result.bank_gain
    return candid_n_sigma(result.chi2_single, chi2, result.ndof)


def save_maps_fits(
    path: str | Path, result: SearchResult, extra: Mapping[str, FloatArray] | None = None
) -> None:
    """Write the maps of a search as FITS images with celestial coordinates, east left.

    Parameters
    ----------
    path : str or path
    result : SearchResult
    extra : mapping of str to (n_grid,) float array, optional
        Further maps by extension name, such as a false-alarm probability.

    Raises
    ------
    ValueError
        Where a further map does not have one value per position of the grid.
    RunError
        Where the file cannot be written.

    Notes
    -----
    Extensions DCHI2, CONTRAST (best signed contrast), CONTRAST_ERR (its 1σ error) and
    NSIGMA (CANDID's local nσ); NaN outside the field. Coordinates are a tangent-plane
    projection about the target where its coordinates are known, else offsets in mas.
    """
    maps = {
        "DCHI2": result.bank_delta_chi2,
        "CONTRAST": result.bank_contrast,
        "CONTRAST_ERR": result.bank_sigma,
        "NSIGMA": local_n_sigma(result),
    } | {name.upper(): np.asarray(values) for name, values in (extra or {}).items()}
    for name, values in maps.items():
        if values.shape != (len(result.grid),):
            raise ValueError(f"map {name} needs {len(result.grid)} values, one per position")
    header = _sky_header(result)
    images = [
        fits.ImageHDU(result.grid.image(v)[:, ::-1], header, name=name) for name, v in maps.items()
    ]
    with atomic_path(path) as temporary:
        fits.HDUList([fits.PrimaryHDU(), *images]).writeto(temporary, overwrite=True)


def _sky_header(result: SearchResult) -> fits.Header:
    setup, grid = result.likelihood.observables.setups[0], result.grid
    ra, dec = setup.right_ascension_deg, setup.declination_deg
    header = fits.Header()
    header["OBJECT"] = setup.target
    if ra or dec:
        step, axes, unit, centre = grid.step_mas / 3.6e6, ("RA---TAN", "DEC--TAN"), "deg", (ra, dec)
        header["RADESYS"] = "ICRS"
    else:
        step, axes, unit, centre = grid.step_mas, ("EAST", "NORTH"), "mas", (0.0, 0.0)
    for i, sign in [(0, -1.0), (1, 1.0)]:
        header[f"CTYPE{i + 1}"] = axes[i]
        header[f"CUNIT{i + 1}"] = unit
        header[f"CRPIX{i + 1}"] = (grid.half_width + 1.0, "the star")
        header[f"CRVAL{i + 1}"] = centre[i]
        header[f"CDELT{i + 1}"] = sign * step
    return header

"""A reconstructed image: as it is, with the beam, as the points show it, and what is left."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import CenteredNorm, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from amibayes.imaging import ReconstructedImage
from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.warnings import warnings_of
from amibayes.plots.fit import longest_baseline_m
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

LINE = 90
"""Letters of a line of the title."""


@styled()
def image_plot(image: ReconstructedImage) -> Figure:
    """Draw the image, the image with a Gaussian beam, the dirty image, residuals and the choice.

    Parameters
    ----------
    image : ReconstructedImage

    Returns
    -------
    matplotlib.figure.Figure
        Six panels. The dirty image is what the sampled points make of the image, without its
        star; back-projected residuals beyond ±4 σ are structure that the image has not.
    """
    figure = new_figure(11.6, 7.4)
    axes = figure.subplots(3, 2, height_ratios=[1.35, 1.35, 1.0])
    top = float(image.light.max()) or 1.0
    blurred, dirty = image.convolved(), image.dirty_image()
    norm = PowerNorm(0.5, 0.0, top)
    _sky(figure, axes[0, 0], image, image.light, "Flux per pixel", cmap=SEQUENTIAL, norm=norm)
    axes[0, 0].set_title("Reconstruction (root scale)")
    norm = PowerNorm(0.5, 0.0, float(blurred.max()) or 1.0)
    _sky(figure, axes[0, 1], image, blurred, "Flux per pixel", cmap=SEQUENTIAL, norm=norm)
    axes[0, 1].set_title("with a beam of λ/2B (root scale)")
    reach = 0.5 * image.grid.n * image.grid.pixel_mas
    place, radius = (0.82 * reach, -0.82 * reach), 0.5 * image.beam_mas
    axes[0, 1].add_patch(Circle(place, radius, fill=False, ec="white", lw=1.5))
    symmetric: dict[str, Any] = {"cmap": DIVERGING, "norm": CenteredNorm()}
    _sky(figure, axes[1, 0], image, dirty, "Flux per dirty beam", **symmetric)
    axes[1, 0].set_title("Dirty image of it")
    back = {"cmap": DIVERGING, "norm": CenteredNorm(halfrange=max(4.0, _most(image)))}
    _sky(figure, axes[1, 1], image, image.back_projected, "σ", **back)
    axes[1, 1].set_title("Residuals, projected back")
    _residuals(axes[2, 0], image)
    _choice(axes[2, 1], image)
    star = f", star apart, {image.flux:.3g} of its flux around" if image.star else ""
    warned = [warning.split(":")[0] for warning in warnings_of(image)]
    lines = textwrap.wrap(f"Warning: {'; '.join(warned)}" if warned else "", LINE)
    figure.suptitle(
        f"For looking: {'total variation' if image.regulariser == 'tv' else 'maximum entropy'}, "
        f"weight {image.weight:.3g}{star}\nχ² {image.chi2:.4g} of {image.n_independent} numbers"
        + "".join(f"\n{line}" for line in lines)
    )
    return figure


def _most(image: ReconstructedImage) -> float:
    return float(np.abs(image.back_projected).max())


def _sky(
    figure: Figure,
    ax: Axes,
    image: ReconstructedImage,
    values: FloatArray,
    label: str,
    **style: Any,
) -> None:
    """Draw an image with east to the left and the star's place."""
    reach = 0.5 * image.grid.n * image.grid.pixel_mas
    drawn = ax.imshow(
        values[:, ::-1], origin="lower", extent=(reach, -reach, -reach, reach), **style
    )
    if image.star:
        ax.plot(0.0, 0.0, "*", color="white", mec=BLACK, ms=11)
    ax.set_xlabel("East (mas)")
    ax.set_ylabel("North (mas)")
    low, high = drawn.get_clim()
    ticks, power = _colour_ticks(
        low or 0.0, high or 1.0, lambda value: float(np.asarray(drawn.norm(np.array(value))).item())
    )
    label += f" (10{str(power).translate(RAISED)})" if power else ""
    bar = figure.colorbar(drawn, ax=ax, label=label, location="bottom", shrink=0.7, aspect=30)
    names = [f"{round(t / 10.0**power, 6) + 0.0:.3g}".replace("-", "−") for t in ticks]
    bar.set_ticks(ticks, labels=names)


RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

APART = 0.24
"""Least distance of two numbers beside a colour bar, as part of its length."""


def _colour_ticks(
    low: float, high: float, norm: Callable[[float], float]
) -> tuple[list[float], int]:
    """Values beside a colour bar, far enough apart, and the power of ten that they share."""
    kept: list[float] = []
    for value in map(float, MaxNLocator(5).tick_values(low, high)):
        inside = low <= value <= high
        if inside and (not kept or norm(value) - norm(kept[-1]) >= APART):
            kept.append(value)
    most = max(abs(low), abs(high))
    power = int(np.floor(np.log10(most))) if most > 0.0 else 0
    return kept, power if not -1 <= power <= 2 else 0


def _residuals(ax: Axes, image: ReconstructedImage) -> None:
    """Residuals in units of each datum's own error against the baseline."""
    data = image.observables
    left = DataTerm.of(data, image.samples).residual(image.visibility)
    sigma, n = np.sqrt(data.covariance.variance), data.n_vis2
    white = left / sigma
    length = data.vis2.frequency / 1e6
    ax.axhspan(-1.0, 1.0, color=LIGHT_GREY, alpha=0.5, lw=0, zorder=0)
    ax.axhline(0.0, color=GREY, lw=0.8, zorder=0)
    if n:
        ax.plot(length, white[:n], "o", color=BLUE, ms=4, label="V²")
    if len(white) > n:
        m = data.closure_phase
        longest = longest_baseline_m(m) / m.wavelength_m / 1e6
        ax.plot(longest, white[n:], "x", color=VERMILLION, ms=5, label=f"{data.phase_name}s")
    ax.set_xlabel("(Longest) baseline (Mλ)")
    ax.set_ylabel("Residual (σ)")
    most = 1.1 * max(float(np.abs(white).max(initial=0.0)), 2.0)
    ax.set_ylim(-most, 1.35 * most)
    ax.legend(loc="upper left", ncols=2, fontsize=8)


def _choice(ax: Axes, image: ReconstructedImage) -> None:
    """Deviance of data left out against the weight of the regulariser."""
    if not len(image.weights):
        ax.axis("off")
        ax.text(0.5, 0.5, "weight given", ha="center", transform=ax.transAxes)
        return
    ax.errorbar(image.weights, image.scores, image.score_errors, fmt="o-", color=BLACK, ms=4)
    ax.axvline(image.weight, color=VERMILLION, ls="--", label="chosen")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("Weight of the regulariser")
    ax.set_ylabel("χ² per datum left out")
    ax.legend(fontsize=8)

"""Mask, (u, v) plane and point spread function of an instrument, side by side."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from amibayes.instrument import Channels, Instrument
from amibayes.optics import psf
from amibayes.plots.style import BLACK, BLUE, LIGHT_GREY, SEQUENTIAL, new_figure, styled

_FAINTEST = 1e-4
"""Lowest level of the point spread function shown, as a fraction of its peak."""


@styled()
def instrument_picture(instrument: Instrument, channels: Channels | None = None) -> Figure:
    """Draw an instrument.

    Parameters
    ----------
    instrument : Instrument
        The instrument, with its filter.
    channels : Channels, optional
        Wavelengths of the point spread function; the filter's own unless given.

    Returns
    -------
    matplotlib.figure.Figure
        Three panels, in the image's own axes (x right, y up).
    """
    figure = new_figure(8.6)
    panels = figure.subplot_mosaic([["mask", "uv"], ["psf", "psf"]], height_ratios=[3, 5])
    figure.suptitle(f"{instrument.mask.name}, filter {instrument.bandpass.name}")
    _draw_mask(panels["mask"], instrument)
    _draw_uv(panels["uv"], instrument)
    _draw_psf(figure, panels["psf"], instrument, channels or instrument.bandpass.channels())
    return figure


def _draw_mask(axes: Axes, instrument: Instrument) -> None:
    mask = instrument.mask
    outlines = mask.holes_m[:, None, :] + mask.corners_m
    axes.add_collection(PolyCollection(list(outlines), facecolor=LIGHT_GREY, edgecolor=BLACK))
    for number, (x, y) in enumerate(mask.holes_m, 1):
        axes.text(x, y, str(number), ha="center", va="center", fontsize="small")
    axes.set(xlabel="x (m)", ylabel="y (m)", title="Holes on the mirror", aspect="equal")
    axes.autoscale_view()


def _draw_uv(axes: Axes, instrument: Instrument) -> None:
    uv, pivot_um = instrument.mask.uv_m, instrument.bandpass.pivot_m * 1e6
    low, high = (edge * 1e6 for edge in instrument.bandpass.half_power_m)
    for sign, marker, label in ((1, "o", "i to j, i < j"), (-1, "+", "conjugate")):
        axes.plot(*(sign * uv.T / pivot_um), marker, color=BLUE, label=label, ls="none", ms=3)
        ends = sign * np.stack([uv / low, uv / high])
        axes.plot(ends[..., 0], ends[..., 1], color=LIGHT_GREY, lw=3.0, zorder=0)
    axes.set(xlabel="u (Mλ)", ylabel="v (Mλ)", aspect="equal")
    axes.set_title(f"{len(uv)} baselines at {pivot_um:.3f} µm")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, frameon=False)


def _draw_psf(figure: Figure, axes: Axes, instrument: Instrument, channels: Channels) -> None:
    image = psf(instrument, channels)
    arcsec = np.degrees(instrument.pixel_scale_rad) * 3600.0
    half = 0.5 * len(image) * arcsec
    peak = image.max()
    shown = axes.imshow(
        np.maximum(image, _FAINTEST * peak) / peak,
        origin="lower",
        extent=(-half, half, -half, half),
        norm=LogNorm(_FAINTEST, 1.0),
        cmap=SEQUENTIAL,
    )
    figure.colorbar(shown, ax=axes, label="photons per pixel / peak")
    axes.set(xlabel="x (arcsec)", ylabel="y (arcsec)")
    axes.set_title(f"Point source: {100.0 * peak:.2f} % in the brightest pixel")

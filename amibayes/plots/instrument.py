"""Mask, (u, v) plane and point spread function of an instrument, side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from amibayes.instrument import Channels, Instrument
from amibayes.optics import psf

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FAINTEST = 1e-4
"""Lowest level of the point spread function shown, as a fraction of its peak."""


def plot_instrument(instrument: Instrument, channels: Channels | None = None) -> Figure:
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
        Three panels, in the image's own axes (x right, y up); save it with ``savefig``.
    """
    figure = Figure(figsize=(14.0, 5.2), layout="constrained")
    mask, uv, image = figure.subplots(1, 3)
    figure.suptitle(f"{instrument.name}, {instrument.bandpass.name}: {instrument.mask.name}")
    _draw_mask(mask, instrument)
    _draw_uv(uv, instrument)
    _draw_psf(figure, image, instrument, channels or instrument.bandpass.channels())
    return figure


def _draw_mask(axes: Axes, instrument: Instrument) -> None:
    mask = instrument.mask
    outlines = mask.holes_m[:, None, :] + mask.corners_m
    axes.add_collection(PolyCollection(list(outlines), facecolor="0.85", edgecolor="black"))
    for number, (x, y) in enumerate(mask.holes_m, 1):
        axes.text(x, y, str(number), ha="center", va="center")
    axes.set(xlabel="x (m)", ylabel="y (m)", title="Holes on the primary mirror", aspect="equal")
    axes.autoscale_view()


def _draw_uv(axes: Axes, instrument: Instrument) -> None:
    uv, pivot_um = instrument.mask.uv_m, instrument.bandpass.pivot_m * 1e6
    low, high = (edge * 1e6 for edge in instrument.bandpass.half_power_m)
    for sign, marker, label in ((1, "o", "hole i to j, i < j"), (-1, "+", "conjugate")):
        axes.plot(*(sign * uv.T / pivot_um), marker, color="black", label=label, ls="none", ms=4)
        ends = sign * np.stack([uv / low, uv / high])
        axes.plot(ends[..., 0], ends[..., 1], color="0.55", lw=3.0, zorder=0)
    axes.set(xlabel="u (Mλ)", ylabel="v (Mλ)", aspect="equal")
    axes.set_title(f"{len(uv)} baselines at {pivot_um:.3f} µm (grey: the band)")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, frameon=False)


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
        cmap="viridis",
    )
    figure.colorbar(shown, ax=axes, label="photons per pixel / peak")
    axes.set(xlabel="x (arcsec)", ylabel="y (arcsec)")
    axes.set_title(f"Point source: {100.0 * peak:.2f} % in the brightest pixel")

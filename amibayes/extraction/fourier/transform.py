"""The Fourier-plane methods: the transform of a windowed image where the splodges are.

Window, background and transform are linear, hence one matrix. The background is the level
that a ring far from the star and the window's own sum agree on, the star's light in both
accounted for by the model of the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.extraction.fourier.patches import Patches
from amibayes.extraction.fourier.sampling import OneEach, Sampling
from amibayes.extraction.fourier.splodges import Splodges
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.view import View
from amibayes.optics import FringeBasis
from amibayes.units import ComplexArray, FloatArray

RING = 0.8
"""The background is taken outside this fraction of the half width of the image."""

DEFAULT_WINDOW = 0.45
"""Half-power radius of the window in units of the image's side."""

SQUARE, GAUSS = 1, 2
"""Half widths, in cells, of the patches of these methods."""

GAUSS_SIGMA = 1.2
"""Cells."""

FAINTEST, BRIGHT = 0.3, 0.6
"""Cells below the first fraction of the modelled splodge's peak are not sampled, and those
above the second in full. Farther out the feet of neighbouring splodges overlap."""


def fourier_sampling(
    view: View, fringes: FringeBasis, fit: object, options: ExtractOptions
) -> Sampling:
    """Make the operator of one of the Fourier methods; ``fringes`` is the view's basis."""
    star = fringes.image().ravel()
    level = _Levels.of(view, options, star)
    if options.method == "unique":
        return _unique(view, level, star)
    half_width = _half_width(view, options.method)
    if options.method == "matched":
        return _matched(view, half_width, level, fringes.matrix)
    side = np.arange(-half_width, half_width + 1)
    gain = np.ones((len(side), len(side)))
    if options.method == "gauss":
        gain = np.exp(-0.25 * (side[:, None] ** 2 + side**2) / GAUSS_SIGMA**2)
    if options.method == "fft":
        patches = Patches.of(view, view.frequency_px, half_width)
        flat = patches.transform(level.window.reshape(view.shape))
        gain = _trimmed(_brightness(_own(view, patches, level, fringes.matrix, flat)))
    linear = np.column_stack([level.flux, level.background])
    return Splodges(view, linear, level.window, gain, star)


def _half_width(view: View, method: str) -> int:
    if method in ("square", "gauss"):
        return SQUARE if method == "square" else GAUSS
    size = 2.0 / np.sqrt(3.0) * view.instrument.mask.size_m
    return int(
        np.ceil(size * view.instrument.pixel_scale_rad / view.wavelength_m * max(view.shape))
    )


def _brightness(own: ComplexArray) -> FloatArray:
    """Share (k, k) of the splodge at every cell: 0 outside it, 1 well inside.

    It is the same for all baselines, and rises evenly towards the middle: what a target
    and its calibrator are sampled with does not depend on a cell that just is or is not
    bright enough.
    """
    mean = np.abs(own).mean(axis=0)
    mean = 0.5 * (mean + mean[::-1, ::-1])
    return np.asarray(np.clip((mean / mean.max() - FAINTEST) / (BRIGHT - FAINTEST), 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class _Levels:
    """The window, and the linear functionals for flux and background, (n_pixels,)."""

    window: FloatArray
    flux: FloatArray
    background: FloatArray

    @classmethod
    def of(cls, view: View, options: ExtractOptions, star: FloatArray) -> _Levels:
        x, y = view.axes_px()
        r2 = y[:, None] ** 2 + x**2
        side = min(view.shape)
        radius = DEFAULT_WINDOW * side if options.window_px is None else options.window_px
        window = (
            np.ones(view.shape) if radius == 0.0 else np.exp(-np.log(2.0) * (r2 / radius**2) ** 2)
        )
        ring = (r2 > (RING * 0.5 * side) ** 2).astype(float)
        both = np.stack([window.ravel(), ring.ravel()])
        system = np.stack([both @ star, both.sum(axis=1)], axis=1)
        flux, background = np.linalg.solve(system, both)
        return cls(window.ravel(), flux, background)


def _unique(view: View, level: _Levels, star: FloatArray) -> OneEach:
    """One sample per baseline, at its frequency; a point source makes it 1."""
    patches = Patches.of(view, view.frequency_px, 0)
    x, y = patches.along_x[:, 0], patches.along_y[:, 0]
    wave = (y[:, :, None] * x[:, None, :]).reshape(len(x), -1) * level.window
    wave -= np.outer(wave.sum(axis=1), level.background)
    # Feet of other splodges turn a sample: a point source is to have phase 0.
    wave /= (wave @ star)[:, None]
    rows = np.concatenate([level.flux[None], wave.real, wave.imag, level.background[None]])
    return OneEach.of(rows.T, view.instrument.mask, view.frequency_px)


def _matched(view: View, half_width: int, level: _Levels, basis: FloatArray) -> OneEach:
    """One sample per baseline: cells weighted with the splodge that is expected there.

    The outskirts of neighbouring splodges overlap; what each sample sees of the others is
    known from the model and taken out.
    """
    patches = Patches.of(view, view.frequency_px, half_width)
    flat = patches.transform(level.window.reshape(view.shape))
    own = _own(view, patches, level, basis, flat)
    share = (own * _brightness(own)).conj()
    level_of = np.sum(share * flat, axis=(1, 2))
    weights = np.concatenate([share, -1j * share])
    twice = np.tile(np.arange(len(share)), 2)
    waves = patches.select(twice).combined(weights).reshape(len(weights), -1)
    waves *= level.window
    rows = np.concatenate([level.flux[None], waves, level.background[None]])
    mixed = np.eye(len(rows))
    mixed[1:-1, -1] = -np.concatenate([level_of.real, level_of.imag])
    seen = (mixed @ (rows @ basis))[:-1]
    scale = np.abs(seen).max(axis=1)
    mixed[:-1] = np.linalg.inv(seen / scale[:, None]) / scale @ mixed[:-1]
    return OneEach.of((mixed @ rows).T, view.instrument.mask, view.frequency_px)


def _own(
    view: View, patches: Patches, level: _Levels, basis: FloatArray, flat: ComplexArray
) -> ComplexArray:
    """Transform (n_baselines, k, k) of every baseline's own fringe, less its background.

    ``flat`` is that of a background of 1.
    """
    n = basis.shape[1] // 2
    background = (level.background @ basis)[1:].reshape(2, n)
    fringes = (basis.T[1:] * level.window).reshape(2, n, *view.shape)
    real, imaginary = (patches.transform(f) for f in fringes)
    below = background[0] - 1j * background[1]
    return np.asarray(real - 1j * imaginary - below[:, None, None] * flat)


def _trimmed(gain: FloatArray) -> FloatArray:
    """The middle of a symmetric patch, outside which it is 0."""
    lit = np.flatnonzero(gain.any(axis=0) | gain.any(axis=1))
    part = slice(int(lit[0]), int(lit[-1]) + 1)
    return np.asarray(gain[part, part])

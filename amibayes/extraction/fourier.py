"""The Fourier-plane methods: the transform of a windowed image where the splodges are.

Window, background and transform are linear, hence one matrix. The background is the level
that a ring far from the star and the window's own sum agree on, the star's light in both
accounted for by the model of the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.sampling import BoolArray, IntArray, Sampling, closing_products
from amibayes.extraction.view import View
from amibayes.optics import FringeBasis
from amibayes.optics.psf import ComplexArray
from amibayes.units import FloatArray

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


@dataclass(frozen=True, eq=False)
class _Cells:
    """Samples: baseline, offset from its frequency in whole cells, frequency."""

    baseline: IntArray
    offset: IntArray
    frequency_px: FloatArray

    def select(self, keep: BoolArray) -> _Cells:
        return _Cells(self.baseline[keep], self.offset[keep], self.frequency_px[keep])


def fourier_sampling(view: View, fringes: FringeBasis, options: ExtractOptions) -> Sampling:
    """Make the operator of one of the Fourier methods; ``fringes`` is the view's basis."""
    mask = view.instrument.mask
    star = fringes.image().ravel()
    level = _Levels.of(view, options, star)
    if options.method == "unique":
        cells = _Cells(np.arange(mask.n_baselines), np.zeros((0, 2), np.intp), view.frequency_px)
        closing, triangle = mask.triangle_baselines, np.arange(len(mask.triangles))
        return _assembled(view, cells, level, star, np.ones(len(cells.baseline)), closing, triangle)
    half_width = _half_width(view, options.method)
    if options.method == "matched":
        return _matched(view, _Patches.of(view, half_width), level, fringes.matrix)
    cells = _lattice(view, half_width)
    gain = np.ones(len(cells.baseline))
    if options.method == "gauss":
        away = cells.frequency_px - view.frequency_px[cells.baseline]
        gain = np.exp(-0.25 * np.sum((away * max(view.shape) / GAUSS_SIGMA) ** 2, axis=1))
    if options.method == "fft":
        own = _own(_Patches.of(view, half_width), level, fringes.matrix)
        gain = np.tile(_brightness(own).ravel(), mask.n_baselines)
        cells, gain = cells.select(gain > 0.0), gain[gain > 0.0]
    closing, triangle = closing_products(mask.triangle_baselines, cells.offset, cells.baseline)
    return _assembled(view, cells, level, star, gain, closing, triangle)


def _half_width(view: View, method: str) -> int:
    if method in ("square", "gauss"):
        return SQUARE if method == "square" else GAUSS
    size = 2.0 / np.sqrt(3.0) * view.instrument.mask.size_m
    return int(
        np.ceil(size * view.instrument.pixel_scale_rad / view.wavelength_m * max(view.shape))
    )


def _lattice(view: View, half_width: int) -> _Cells:
    """Cells about every splodge, as far apart as those of an FFT of the image.

    Each baseline has them about its own frequency. Frequencies close, hence offsets that
    close are closing products, and a patch has no side on which it sees more of its
    splodge than on the other: the phase of a companion's fringe is that of its baseline.
    """
    step = 1.0 / max(view.shape)
    n = view.instrument.mask.n_baselines
    side = np.arange(-half_width, half_width + 1)
    patch = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    frequency = view.frequency_px[:, None, :] + patch * step
    return _Cells(
        np.repeat(np.arange(n), len(patch)), np.tile(patch, (n, 1)), frequency.reshape(-1, 2)
    )


@dataclass(frozen=True, eq=False)
class _Patches:
    """Waves along either axis, (n_baselines, n_x, k) and (n_baselines, n_y, k)."""

    along_x: ComplexArray
    along_y: ComplexArray

    @classmethod
    def of(cls, view: View, half_width: int) -> _Patches:
        side = np.arange(-half_width, half_width + 1) / max(view.shape)
        x, y = (
            np.exp(-2j * np.pi * axis[:, None] * (f[:, None] + side)[:, None, :])
            for axis, f in zip(view.axes_px(), view.frequency_px.T, strict=True)
        )
        return cls(x, y)

    def transform(self, images: ComplexArray | FloatArray) -> ComplexArray:
        """Transform (n_baselines, k, k) of an image (…, n_y, n_x) for each baseline."""
        return np.asarray(self.along_y.swapaxes(1, 2) @ images @ self.along_x)

    def combined(self, weight: ComplexArray) -> ComplexArray:
        """Sum (n_baselines, n_y, n_x) of the waves with weights (n_baselines, k, k)."""
        return np.asarray(self.along_y @ weight @ self.along_x.swapaxes(1, 2))


def _brightness(own: ComplexArray) -> FloatArray:
    """Share (k, k) of the splodge at every cell: 0 outside it, 1 well inside.

    It is the same for all baselines, and rises evenly towards the middle: what a target
    and its calibrator are sampled with does not hang on a cell that just is or is not
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

    def transform(self, view: View, frequency_px: FloatArray) -> ComplexArray:
        """Operator (n_pixels, n) from pixels to the transform less the background's."""
        x, y = view.axes_px()
        along_x = np.exp(-2j * np.pi * np.outer(x, frequency_px[:, 0]))
        along_y = np.exp(-2j * np.pi * np.outer(y, frequency_px[:, 1]))
        wave = (along_y[:, None, :] * along_x).reshape(-1, len(frequency_px))
        wave *= self.window[:, None]
        return np.asarray(wave - np.outer(self.background, wave.sum(axis=0)))


def _matched(view: View, patches: _Patches, level: _Levels, basis: FloatArray) -> Sampling:
    """One sample per baseline: cells weighted with the splodge that is expected there.

    The outskirts of neighbouring splodges overlap; what each sample sees of the others is
    known from the model and taken out.
    """
    mask = view.instrument.mask
    n = mask.n_baselines
    own = _own(patches, level, basis)
    share = (own * _brightness(own)).conj()
    window = level.window.reshape(view.shape)
    level_of = np.sum(share * patches.transform(window), axis=(1, 2))
    operator = (window * patches.combined(share)).reshape(n, -1).T
    operator = operator - np.outer(level.background, level_of)
    matrix = np.column_stack([level.flux, operator.real, operator.imag])
    seen = basis.T @ matrix
    scale = np.abs(seen).max(axis=0)
    alone = np.linalg.solve((seen / scale).T, (matrix / scale).T).T
    return Sampling.one_each(alone, mask, view.frequency_px)


def _own(patches: _Patches, level: _Levels, basis: FloatArray) -> ComplexArray:
    """Transform (n_baselines, k, k) of every baseline's own fringe, less its background."""
    n = basis.shape[1] // 2
    fringe = (basis[:, 1 : 1 + n] - 1j * basis[:, 1 + n :]).T
    shape = patches.along_y.shape[1], patches.along_x.shape[1]
    window = level.window.reshape(shape)
    background = fringe @ level.background
    return np.asarray(
        patches.transform(window * fringe.reshape(n, *shape))
        - background[:, None, None] * patches.transform(window)
    )


def _assembled(
    view: View,
    cells: _Cells,
    level: _Levels,
    star: FloatArray,
    gain: FloatArray,
    closing: IntArray,
    triangle: IntArray,
) -> Sampling:
    """Samples as they are, normalised so that a point source has V² = 1."""
    operator = level.transform(view, cells.frequency_px) * np.sqrt(gain)
    reference = star @ operator
    # Feet of other splodges turn a sample: a point source is to have phase 0.
    operator *= reference.conj() / np.abs(reference)
    reference = np.abs(reference).astype(complex)
    total = np.bincount(cells.baseline, reference.real**2)
    return Sampling(
        np.column_stack([level.flux, operator.real, operator.imag]),
        cells.baseline,
        1.0 / total[cells.baseline],
        closing,
        triangle,
        cells.frequency_px,
        reference,
    )

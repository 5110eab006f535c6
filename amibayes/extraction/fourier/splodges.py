"""Methods that take many samples of every splodge: a patch of cells about its frequency.

Frequencies of the baselines close, and so do whole numbers of cells from them: the sum of
the products of all cells of three splodges that close (Monnier 2007) is the sum, over the
points of a small image, of the product of what the three patches alone make there. A
splodge of k × k cells needs (3k − 1)/2 points along an axis, where products would be k⁴.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from amibayes.extraction.fourier.patches import Patches, waves
from amibayes.extraction.fourier.sampling import PixelArray
from amibayes.extraction.view import View
from amibayes.units import ComplexArray, FloatArray


@dataclass(frozen=True, eq=False)
class Splodges:
    """Samples of a patch of cells about every baseline's frequency.

    Parameters
    ----------
    view : View
    linear : (n_pixels, 2) array
        Images times this are flux and background.
    window : (n_pixels,) array
    gain : (k, k) array
        Weight of each cell, the same for all baselines and symmetric.
    star : (n_pixels,) array
        Image of a point source of unit flux at the centre.
    """

    view: View
    linear: FloatArray
    window: FloatArray
    gain: FloatArray
    star: FloatArray

    @cached_property
    def patches(self) -> Patches:
        """The waves of all cells."""
        return Patches.of(self.view, self.view.frequency_px, len(self.gain) // 2)

    @property
    def n_baselines(self) -> int:
        """How many baselines."""
        return len(self.view.frequency_px)

    @property
    def n_samples(self) -> int:
        """How many complex samples."""
        return self.n_baselines * self.gain.size

    @cached_property
    def _level(self) -> ComplexArray:
        """Transform (n_baselines, k, k) of a background of 1."""
        return self._transform(np.ones_like(self.window))

    @cached_property
    def _own(self) -> ComplexArray:
        """Transform of the point source, less its background."""
        return self._transform(self.star) - (self.star @ self.linear[:, 1]) * self._level

    @cached_property
    def _factor(self) -> ComplexArray:
        """Gain, and what gives a point source phase 0 in every cell and V² = 1.

        Feet of other splodges turn a cell.
        """
        size = np.abs(self._own)
        return np.asarray(np.sqrt(self.gain) / self._norm * self._own.conj() / size)

    @cached_property
    def _norm(self) -> FloatArray:
        """Root (n_baselines, 1, 1) of the point source's power."""
        power = (self.gain * np.abs(self._own) ** 2).sum(axis=(1, 2), keepdims=True)
        return np.asarray(np.sqrt(power))

    @cached_property
    def _reference(self) -> FloatArray:
        """Samples (n_baselines, k·k) of the point source."""
        return (self._factor * self._own).real.reshape(self.n_baselines, -1)

    def _transform(self, image: FloatArray) -> ComplexArray:
        """Transform (n_baselines, k, k) of one windowed image (n_pixels,)."""
        return self.patches.transform((self.window * image).reshape(self.view.shape))

    def apply(self, pixels: PixelArray) -> tuple[FloatArray, ComplexArray]:
        """Flux (n,) and samples (n, n_samples) of images (n, n_pixels)."""
        return self.completed(pixels @ self.linear.astype(pixels.dtype), pixels)

    def completed(self, numbers: PixelArray, pixels: PixelArray) -> tuple[FloatArray, ComplexArray]:
        """Flux and samples of images whose flux and background are known."""
        windowed = pixels * self.window.astype(pixels.dtype)
        samples = self.patches.of_many(windowed.reshape(-1, *self.view.shape))
        level, factor = (a.astype(samples.dtype) for a in (self._level, self._factor))
        samples -= numbers[:, 1, None, None, None].astype(pixels.dtype) * level
        samples *= factor
        return np.asarray(numbers[:, 0], dtype=float), samples.reshape(len(pixels), -1)

    def _split(self, samples: NDArray[Any]) -> NDArray[Any]:
        """Samples (n, n_baselines, k·k)."""
        return samples.reshape(len(samples), self.n_baselines, -1)

    def power(self, samples: ComplexArray) -> FloatArray:
        """V² times flux², (n, n_baselines), with its noise bias."""
        parts = self._split(samples)
        real, imaginary = parts.real.astype(float), parts.imag.astype(float)
        return np.asarray((real**2 + imaginary**2).sum(axis=2))

    def fringes(self, samples: ComplexArray) -> ComplexArray:
        """One number per baseline, (n, n_baselines): V·flux, summed with the phases kept."""
        return np.asarray(np.einsum("nbk,bk->nb", self._split(samples), self._reference))

    @cached_property
    def for_fringes(self) -> FloatArray:
        """(n_pixels, 1 + 2·n_baselines): images times this are flux and `fringes`, as `split`."""
        weight = self._reference.reshape(self._factor.shape).astype(complex)
        # The imaginary part is the real one of −i times it.
        rows = [self.linear.T[:1], self._pulled(weight), self._pulled(np.asarray(-1j * weight))]
        return np.concatenate(rows).T

    @cached_property
    def _points(self) -> ComplexArray:
        """Waves (k·k, m·m) from the cells of a patch to the points of its image.

        So many that cells which do not close do not seem to.
        """
        half = len(self.gain) // 2
        m = 3 * half + 1
        wave = np.exp(2j * np.pi / m * np.outer(np.arange(-half, half + 1), np.arange(m)))
        return np.asarray(np.kron(wave, wave) / (m * m) ** (1.0 / 3.0))

    def _images(self, samples: ComplexArray) -> ComplexArray:
        """What every patch alone makes at the points, (n, n_baselines, m·m)."""
        points = self._points.astype(samples.dtype)
        images = samples.reshape(-1, len(points)) @ points
        return np.asarray(images.reshape(len(samples), self.n_baselines, -1))

    def bispectrum(self, samples: ComplexArray) -> ComplexArray:
        """Sum of the closing products, (n, n_triangles)."""
        scale = max(float(np.abs(samples).max(initial=0.0)), 1e-300)
        images = self._images(samples / samples.real.dtype.type(scale))
        ij, jk, ik = self.view.instrument.mask.triangle_baselines.T
        both = images[:, ij] * images[:, jk]
        products = np.einsum("ntp,ntp->nt", both, images.conj()[:, ik])
        return np.asarray(products.astype(complex) * scale**3)

    def centred(self, samples: ComplexArray, shift_px: FloatArray) -> ComplexArray:
        """Sum (n_samples,) over images, the star of each moved back by shifts (n, 2)."""
        half, turn = len(self.gain) // 2, 2j * np.pi
        steps = shift_px[:, :, None] * np.arange(-half, half + 1) / max(self.view.shape)
        x, y = np.exp(turn * steps).swapaxes(0, 1)
        cell = (y[:, :, None] * x[:, None, :]).reshape(len(shift_px), 1, -1)
        baseline = np.exp(turn * shift_px @ self.view.frequency_px.T)[:, :, None]
        turned = self._split(samples) * cell.astype(samples.dtype)
        return np.asarray(np.einsum("nbk,nbo->bk", turned, baseline)).ravel()

    def bias(self, variance: FloatArray) -> tuple[float, FloatArray]:
        """What noise of independent pixels (n_pixels,) adds to flux² and to the power."""
        flux, background = self.linear.T
        # Cells and background see the same noise.
        both = self._transform(variance * background) * self._level.conj()
        each = float(variance @ self.window**2) - 2.0 * both.real
        each += float(variance @ background**2) * np.abs(self._level) ** 2
        extra = (np.abs(self._factor) ** 2 * each).sum(axis=(1, 2))
        return float(variance @ flux**2), np.asarray(extra)

    @property
    def determines_model(self) -> bool:
        """No: flux and background alone are linear in the image before the transform."""
        return False

    def expected_covariance(
        self, flux: float, samples: ComplexArray, variance: FloatArray, skewness: FloatArray
    ) -> FloatArray:
        """First order of both observables, and second order of V²."""
        slopes = self.slopes(flux, samples) * np.sqrt(variance)
        total = slopes @ slopes.T
        second = self.squares(flux, samples, variance)
        total[: len(second), : len(second)] += second
        return np.asarray(total)

    def slopes(self, flux: float, samples: ComplexArray) -> FloatArray:
        """Derivatives (n_baselines + n_triangles, n_pixels) of V² and closure phase."""
        power = self.power(samples[None])[0]
        by_vis2 = self._pulled(2.0 / flux**2 * samples.conj().reshape(self._factor.shape))
        by_vis2 -= 2.0 / flux**3 * np.outer(power, self.linear[:, 0])
        triangles = self.view.instrument.mask.triangle_baselines
        by_closure = np.zeros((len(triangles), len(self.window)))
        for leg, slope in zip(triangles.T, self._closure_slopes(samples), strict=True):
            by_closure += self._pulled(slope, leg)
        return np.concatenate([by_vis2, by_closure])

    def _pulled(self, slope: ComplexArray, leg: Any = slice(None)) -> FloatArray:
        """Derivatives (m, n_pixels) of Re Σ slope·sample, slopes (m, k, k) of baselines ``leg``."""
        weight = slope * self._factor[leg]
        light = self.patches.select(leg).combined(weight)
        level = (weight * self._level[leg]).sum(axis=(1, 2)).real
        return light.reshape(len(weight), -1) * self.window - np.outer(level, self.linear[:, 1])

    def _closure_slopes(self, samples: ComplexArray) -> list[ComplexArray]:
        """Slopes (n_triangles, k, k) of the closure phases by the three legs' samples."""
        images = self._images(samples[None])[0]
        a, b, c = images[self.view.instrument.mask.triangle_baselines.T]
        total = (a * b * c.conj()).sum(axis=1)[:, None]
        by_leg = (b * c.conj() / total, a * c.conj() / total, -(a * b / total).conj())
        shape = (-1, *self.gain.shape)
        # The phase is Im of the logarithm: a turn by −i makes it a real part.
        return [(-1j * slope @ self._points.T).reshape(shape) for slope in by_leg]

    def squares(self, flux: float, samples: ComplexArray, variance: FloatArray) -> FloatArray:
        """Covariance (n_baselines, n_baselines) of what is of second order in V².

        The noise of the background, the same in all cells and small, is left out of the
        covariance of two cells.
        """
        power, (own, background) = self.power(samples[None])[0] / flux**2, self.linear.T
        common = self._transform(variance * own)
        common -= float(variance @ (own * background)) * self._level
        with_flux = np.sum(np.abs(self._factor * common) ** 2, axis=(1, 2))
        crossed = 2.0 * np.outer(power, with_flux)
        total = self._between(variance) - crossed - crossed.T
        total += 2.0 * np.outer(power, power) * float(variance @ own**2) ** 2
        return np.asarray(total / flux**4)

    def _between(self, variance: FloatArray) -> FloatArray:
        """Covariance (n_baselines, n_baselines) of the noise powers of two splodges.

        That of two cells is the transform of the variance at the difference, and at the
        sum, of their frequencies. Its square, summed over the cells, is the transform at
        those of the baselines of the variance's correlation with itself, under the squared
        transform of the gain.
        """
        image = (variance * self.window**2).reshape(self.view.shape)
        y, x = (np.arange(1.0 - n, n) for n in self.view.shape)
        side = (np.arange(len(self.gain)) - len(self.gain) // 2) / max(self.view.shape)
        gain = (waves(side, y).T @ self.gain @ waves(side, x)).real
        kernel = fftconvolve(image, image[::-1, ::-1]) * gain**2
        first, second = np.triu_indices(self.n_baselines)
        along_x, along_y = (
            np.concatenate([one[first] * one[second], one[first] * one[second].conj()])
            for one in map(waves, self.view.frequency_px.T, (x, y))
        )
        sums = np.einsum("fx,fx->f", along_y.real @ kernel, along_x.real)
        sums -= np.einsum("fx,fx->f", along_y.imag @ kernel, along_x.imag)
        norm = self._norm.ravel() ** 2
        total = np.zeros((self.n_baselines, self.n_baselines))
        total[first, second] = sums.reshape(2, -1).sum(axis=0) / (norm[first] * norm[second])
        return np.asarray(total + np.triu(total, 1).T)

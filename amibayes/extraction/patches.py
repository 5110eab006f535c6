"""Fourier transforms on small square patches of frequencies, about every splodge.

A patch is a product of few frequencies along x and as few along y, so that a transform is
one matrix product along either axis; waves are kept as cosines and sines, since images are
real.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.extraction.sampling import PixelArray
from amibayes.extraction.view import View
from amibayes.optics.psf import ComplexArray
from amibayes.units import FloatArray


@dataclass(frozen=True, eq=False)
class Patches:
    """Waves along either axis, (n_patches, k, n_x) and (n_patches, k, n_y)."""

    along_x: ComplexArray
    along_y: ComplexArray

    @classmethod
    def of(cls, view: View, frequency_px: FloatArray, half_width: int) -> Patches:
        """Patches about frequencies (n, 2), cells as far apart as those of an FFT."""
        side = np.arange(-half_width, half_width + 1) / max(view.shape)
        x, y = (
            _wave(f, axis)[:, None] * _wave(side, axis)
            for axis, f in zip(view.axes_px(), frequency_px.T, strict=True)
        )
        return cls(x, y)

    def transform(self, images: FloatArray) -> ComplexArray:
        """Transform (n_patches, k, k), rows along y, of an image for all or one for each."""
        k = self.along_y.shape[1]
        parts = self._real_y @ images
        half = parts[:, :k] + 1j * parts[:, k:]
        return np.asarray(half @ self.along_x.swapaxes(1, 2))

    def combined(self, weight: ComplexArray) -> FloatArray:
        """Real part (…, n_patches, n_y, n_x) of the waves' sum, weights (…, n_patches, k, k)."""
        half = self.along_y.swapaxes(1, 2) @ weight
        x = self.along_x
        parts = np.concatenate([half.real, -half.imag], axis=-1)
        return np.asarray(parts @ np.concatenate([x.real, x.imag], axis=1))

    def of_many(self, images: PixelArray) -> NDArray[Any]:
        """Transform (n, n_patches, k, k) of images (n, n_y, n_x), in their precision."""
        (n, n_y, n_x), (m, k, _) = images.shape, self.along_x.shape
        real_x, real_y = self._real_xy(images.dtype)
        rows = real_x @ images.reshape(n * n_y, n_x).T
        parts = rows.reshape(m, 2 * k * n, n_y) @ real_y
        parts = parts.reshape(m, 2, k, n, 2, k)
        single = images.dtype == np.float32
        out = np.empty((n, m, k, k), dtype=np.complex64 if single else complex)
        order = (2, 0, 3, 1)
        out.real = (parts[:, 0, :, :, 0] - parts[:, 1, :, :, 1]).transpose(order)
        out.imag = (parts[:, 0, :, :, 1] + parts[:, 1, :, :, 0]).transpose(order)
        return out

    def repeated(self, n: int) -> Patches:
        """The same patches, ``n`` times over."""
        return Patches(np.tile(self.along_x, (n, 1, 1)), np.tile(self.along_y, (n, 1, 1)))

    @cached_property
    def _real_y(self) -> FloatArray:
        return np.concatenate([self.along_y.real, self.along_y.imag], axis=1)

    def _real_xy(self, dtype: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        """Real waves (n_patches·2k, n_x) and (n_patches, n_y, 2k)."""
        return self._single if dtype == np.float32 else self._double

    @cached_property
    def _double(self) -> tuple[FloatArray, FloatArray]:
        x = np.concatenate([self.along_x.real, self.along_x.imag], axis=1)
        return x.reshape(-1, x.shape[2]), np.ascontiguousarray(self._real_y.swapaxes(1, 2))

    @cached_property
    def _single(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        x, y = self._double
        return x.astype(np.float32), y.astype(np.float32)


def _wave(frequency: FloatArray, axis: FloatArray) -> ComplexArray:
    return np.asarray(np.exp(-2j * np.pi * np.outer(frequency, axis)))

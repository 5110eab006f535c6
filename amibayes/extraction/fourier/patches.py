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

from amibayes.extraction.fourier.sampling import PixelArray
from amibayes.extraction.view import View
from amibayes.units import ComplexArray, FloatArray


@dataclass(frozen=True, eq=False)
class Patches:
    """Waves along either axis, (n_patches, k, n_x) and (n_patches, k, n_y).

    ``phase_x`` (n_patches, k) is what the waves along x are at the middle of the image.
    """

    along_x: ComplexArray
    along_y: ComplexArray
    phase_x: ComplexArray

    @classmethod
    def of(cls, view: View, frequency_px: FloatArray, half_width: int) -> Patches:
        """Patches about frequencies (n, 2), cells as far apart as those of an FFT."""
        side = np.arange(-half_width, half_width + 1) / max(view.shape)
        middle, x, y = (
            waves(f, axis)[:, None] * waves(side, axis)
            for axis, f in zip(
                (np.array([-view.centre_px[0]]), *view.axes_px()),
                frequency_px.T[[0, 0, 1]],
                strict=True,
            )
        )
        return cls(x, y, middle[..., 0])

    def select(self, index: Any) -> Patches:
        """Some of the patches."""
        return Patches(self.along_x[index], self.along_y[index], self.phase_x[index])

    def transform(self, images: FloatArray) -> ComplexArray:
        """Transform (n_patches, k, k), rows along y, of an image for all or one for each."""
        k = self.along_y.shape[1]
        parts = np.concatenate([self.along_y.real, self.along_y.imag], axis=1) @ images
        half = parts[:, :k] + 1j * parts[:, k:]
        return np.asarray(half @ self.along_x.swapaxes(1, 2))

    def combined(self, weight: ComplexArray) -> FloatArray:
        """Real part (n_patches, n_y, n_x) of the waves' sum, weights (n_patches, k, k)."""
        half = self.along_y.swapaxes(1, 2) @ weight
        x = self.along_x
        parts = np.concatenate([half.real, -half.imag], axis=-1)
        return np.asarray(parts @ np.concatenate([x.real, x.imag], axis=1))

    def of_many(self, images: PixelArray) -> NDArray[Any]:
        """Transform (n, n_patches, k, k) of images (n, n_y, n_x), in their precision.

        Images are folded about their middle: what is even along x sees cosines only, what
        is odd sines only, and either is half as long.
        """
        cosine, sine, waves_y, phase = self._single if images.dtype == np.float32 else self._double
        (n, n_y, n_x), (m, k) = images.shape, phase.shape
        right, left = images[..., n_x // 2 :], images[..., : n_x - n_x // 2][..., ::-1]
        even, odd = (
            (wave @ folded.reshape(n * n_y, -1).T).reshape(m, k * n, n_y) @ waves_y
            for wave, folded in ((cosine, right + left), (sine, right - left))
        )
        even, odd = (part.reshape(m, k, n, 2, k).transpose(3, 2, 0, 4, 1) for part in (even, odd))
        out = np.empty((n, m, k, k), dtype=phase.dtype)
        np.add(even[0], odd[1], out=out.real)
        np.subtract(even[1], odd[0], out=out.imag)
        out *= phase[:, None, :]
        return out

    @cached_property
    def _double(self) -> tuple[FloatArray, FloatArray, FloatArray, ComplexArray]:
        """Cosines and sines (n_patches·k, half of n_x), waves (n_patches, n_y, 2k), phases."""
        n_x = self.along_x.shape[2]
        right = (self.along_x / self.phase_x[..., None])[..., n_x // 2 :]
        cosine = right.real.copy()
        cosine[..., 0] *= 0.5 if n_x % 2 else 1.0  # the middle is on either side
        y = np.concatenate([self.along_y.real, self.along_y.imag], axis=1).swapaxes(1, 2)
        rows = (-1, right.shape[2])
        return cosine.reshape(rows), -right.imag.reshape(rows), y, self.phase_x

    @cached_property
    def _single(self) -> tuple[NDArray[Any], ...]:
        *real, phase = self._double
        return *(np.ascontiguousarray(a, dtype=np.float32) for a in real), phase.astype(
            np.complex64
        )


def waves(frequency: FloatArray, axis: FloatArray) -> ComplexArray:
    """exp(−2πi·frequency·place), (n_frequencies, n_places)."""
    return np.asarray(np.exp(-2j * np.pi * np.outer(frequency, axis)))

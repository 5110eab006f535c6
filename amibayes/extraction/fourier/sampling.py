"""What every method comes down to: a linear operator, then products of its numbers.

An integration goes in as pixels; out come its flux and complex samples, one or several
for each baseline. Sums of |sample|² are V² times flux², sums of closing products are the
bispectrum. `OneEach` is the operator of methods with one sample per baseline;
`amibayes.extraction.fourier.splodges.Splodges` that of the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amibayes.extraction.fourier.low_flux import observable_covariance, signs
from amibayes.instrument import Mask
from amibayes.units import ComplexArray, FloatArray, IntArray, SingleArray

PixelArray = NDArray[Any]
"""Images in single or in double precision: they are measured in the precision they have."""


class Sampling(Protocol):
    """A linear operator from pixels to samples, and how they are combined.

    A point source of unit flux at the centre has V² = 1 and bispectra of phase 0.
    """

    @property
    def linear(self) -> FloatArray:
        """(n_pixels, m) matrix: what `completed` needs of images before anything else."""

    @property
    def n_samples(self) -> int:
        """How many complex samples."""

    def completed(self, numbers: FloatArray, pixels: PixelArray) -> tuple[FloatArray, ComplexArray]:
        """Flux (n,) and samples (n, n_samples) of images (n, n_pixels) times `linear`."""

    def apply(self, pixels: PixelArray) -> tuple[FloatArray, ComplexArray]:
        """Flux (n,) and samples (n, n_samples) of images (n, n_pixels)."""

    def power(self, samples: ComplexArray) -> FloatArray:
        """V² times flux², (n, n_baselines), with its noise bias."""

    def bispectrum(self, samples: ComplexArray) -> ComplexArray:
        """Sum of the closing products, (n, n_triangles)."""

    def fringes(self, samples: ComplexArray) -> ComplexArray:
        """One number per baseline, (n, n_baselines): V·flux, summed with the phases kept."""

    @property
    def for_fringes(self) -> FloatArray:
        """(n_pixels, 1 + 2·n_baselines): images times this are flux and `fringes`, as `split`."""

    def centred(self, samples: ComplexArray, shift_px: FloatArray) -> ComplexArray:
        """Sum (n_samples,) over images, the star of each moved back by shifts (n, 2)."""

    @property
    def determines_model(self) -> bool:
        """Whether `linear` determines every coefficient of the fringe model."""

    def bias(self, variance: FloatArray) -> tuple[float, FloatArray]:
        """What noise of independent pixels (n_pixels,) adds to flux² and to the power."""

    def expected_covariance(
        self, flux: float, samples: ComplexArray, variance: FloatArray, skewness: FloatArray
    ) -> FloatArray:
        """Covariance of V² and closure phase of one integration.

        The covariance of (power − V²·flux²)/flux² and of Im(bispectrum/mean bispectrum), which
        is what the errors of mean power and mean bispectrum rest on.

        Parameters
        ----------
        flux : float
        samples : (n_samples,) complex array
            Their expectations.
        variance, skewness : (n_pixels,) array
            Second and third cumulant of the noise of independent pixels.

        Returns
        -------
        (n_baselines + n_triangles, n_baselines + n_triangles) array
        """


@dataclass(frozen=True, eq=False)
class OneEach:
    """One complex sample for each baseline, which a point source makes 1.

    Parameters
    ----------
    linear : (n_pixels, 2 + 2·n_baselines) array
        Images times this are flux; real parts; imaginary parts; background.
    triangles : (n_triangles, 3) int array
        Baselines ij, jk, ik of every triangle.
    frequency_px : (n_baselines, 2) array
        Cycles per pixel.
    """

    linear: FloatArray
    triangles: IntArray
    frequency_px: FloatArray

    @classmethod
    def of(cls, linear: FloatArray, mask: Mask, frequency_px: FloatArray) -> OneEach:
        """Sampling with the baselines of a mask."""
        return cls(linear, mask.triangle_baselines, frequency_px)

    @property
    def matrix(self) -> FloatArray:
        """(n_pixels, 1 + 2·n_baselines): without the background."""
        return self.linear[:, :-1]

    @property
    def n_samples(self) -> int:
        """How many complex samples."""
        return len(self.frequency_px)

    @property
    def determines_model(self) -> bool:
        """Flux, a real and an imaginary part per baseline, background: as many as it has."""
        return True

    def completed(self, numbers: FloatArray, pixels: PixelArray) -> tuple[FloatArray, ComplexArray]:
        """Flux and samples out of the numbers alone."""
        return split(numbers)

    def apply(self, pixels: PixelArray) -> tuple[FloatArray, ComplexArray]:
        """Flux (n,) and samples (n, n_samples) of images (n, n_pixels)."""
        single = pixels.dtype == np.float32
        return split(pixels @ (self.single if single else self.matrix))

    @cached_property
    def single(self) -> SingleArray:
        """`linear` in single precision, for the products that it is needed in most."""
        return np.ascontiguousarray(self.linear, dtype=np.float32)

    def power(self, samples: ComplexArray) -> FloatArray:
        """V² times flux², (n, n_baselines), with its noise bias."""
        return np.asarray(samples.real**2 + samples.imag**2)

    def bispectrum(self, samples: ComplexArray) -> ComplexArray:
        """Product around every triangle, (n, n_triangles)."""
        ij, jk, ik = self.triangles.T
        return np.asarray(samples[:, ij] * samples[:, jk] * samples[:, ik].conj())

    def fringes(self, samples: ComplexArray) -> ComplexArray:
        """The samples themselves."""
        return samples

    @property
    def for_fringes(self) -> FloatArray:
        """The `matrix` itself."""
        return self.matrix

    def centred(self, samples: ComplexArray, shift_px: FloatArray) -> ComplexArray:
        """Sum (n_samples,) over images, the star of each moved back by shifts (n, 2)."""
        turn = np.exp(2j * np.pi * shift_px @ self.frequency_px.T)
        return np.asarray(np.einsum("nb,nb->b", samples, turn))

    def covariance(self, variance: FloatArray) -> FloatArray:
        """Covariance of the numbers that independent pixels (n_pixels,) make."""
        scaled = self.matrix.T * np.sqrt(variance)
        return np.asarray(scaled @ scaled.T)

    def bias(self, variance: FloatArray) -> tuple[float, FloatArray]:
        """What noise of independent pixels (n_pixels,) adds to flux² and to the power."""
        n, diagonal = self.n_samples, variance @ self.matrix**2
        return float(diagonal[0]), diagonal[1 : 1 + n] + diagonal[1 + n :]

    def expected_covariance(
        self, flux: float, samples: ComplexArray, variance: FloatArray, skewness: FloatArray
    ) -> FloatArray:
        """All orders that matter of a faint star; see `low_flux.observable_covariance`."""
        # In units of the flux, so that single precision holds it.
        samples, noise = samples / flux, self.covariance(variance / flux**2)
        share, slope = self.shares(samples), self.jacobian(1.0, samples)
        numbers, third = self.single.T[:-1], skewness / flux**3
        return observable_covariance(samples, self.triangles, noise, share, slope, numbers, third)

    def shares(self, samples: ComplexArray) -> FloatArray:
        """V², of a flux of 1, as a sum of squares of the numbers: (n_baselines, n_numbers)."""
        each = np.eye(self.n_samples)
        return np.column_stack([-self.power(samples[None])[0], each, each])

    def jacobian(self, flux: float, samples: ComplexArray) -> FloatArray:
        """Derivatives of V² and closure phase by the numbers, at one set of samples.

        Parameters
        ----------
        flux : float
        samples : (n_samples,) array

        Returns
        -------
        (n_baselines + n_triangles, 1 + 2·n_samples) array
        """
        by_real, by_imaginary = (2.0 / flux**2 * p for p in (samples.real, samples.imag))
        by_flux = -2.0 / flux**3 * self.power(samples[None])[0]
        vis2 = np.column_stack([by_flux, np.diag(by_real), np.diag(by_imaginary)])
        # A phase turns by Im(δs/s).
        closure = signs(self.triangles, self.n_samples) / samples
        none = np.zeros(len(self.triangles))
        return np.vstack([vis2, np.column_stack([none, closure.imag, closure.real])])


def split(numbers: PixelArray) -> tuple[FloatArray, ComplexArray]:
    """Flux and samples out of real numbers (n, 1 + 2·n_samples), or more of which are ignored."""
    n, wide = (numbers.shape[1] - 1) // 2, np.asarray(numbers, dtype=float)
    return wide[:, 0], wide[:, 1 : 1 + n] + 1j * wide[:, 1 + n : 1 + 2 * n]

"""What every method comes down to: a linear operator, then products of its numbers.

An integration goes in as pixels; out come its flux and complex samples, one or several
for each baseline. Sums of |sample|² are V² times flux², sums of closing products are the
bispectrum. The methods differ in the operator and in how many samples they take.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from amibayes.instrument import Mask
from amibayes.optics.psf import ComplexArray
from amibayes.units import FloatArray, read_only

IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Sampling:
    """A linear operator from pixels to samples, and how they are combined.

    Parameters
    ----------
    matrix : (n_pixels, 1 + 2·n_samples) array
        Columns: flux; real parts; imaginary parts. Images times matrix.
    baseline : (n_samples,) int array
        Which baseline a sample belongs to.
    weight : (n_samples,) array
        Share of a sample in its baseline's V²; a point source gives Σ weight·|sample|² =
        flux² for every baseline.
    closing : (n_products, 3) int array
        Samples whose product s₁·s₂·s₃* closes.
    triangle : (n_products,) int array
        Which triangle a product belongs to, rising.
    frequency_px : (n_samples, 2) array
        Cycles per pixel.
    reference : (n_samples,) complex array
        Samples of a point source of unit flux at the centre.
    """

    matrix: FloatArray
    baseline: IntArray
    weight: FloatArray
    closing: IntArray
    triangle: IntArray
    frequency_px: FloatArray
    reference: ComplexArray

    def __post_init__(self) -> None:
        for name in ("matrix", "weight", "frequency_px"):
            read_only(self, name)

    @classmethod
    def one_each(cls, matrix: FloatArray, mask: Mask, frequency_px: FloatArray) -> Sampling:
        """Sampling of one complex sample per baseline, which a point source makes 1."""
        n = mask.n_baselines
        return cls(
            matrix,
            np.arange(n),
            np.ones(n),
            mask.triangle_baselines,
            np.arange(len(mask.triangles)),
            frequency_px,
            np.ones(n, dtype=complex),
        )

    @property
    def n_samples(self) -> int:
        """How many complex samples."""
        return len(self.baseline)

    @cached_property
    def n_baselines(self) -> int:
        """How many baselines."""
        return int(self.baseline.max()) + 1

    @property
    def single(self) -> bool:
        """Whether every baseline has one sample."""
        return self.n_samples == self.n_baselines

    def apply(self, pixels: FloatArray) -> tuple[FloatArray, ComplexArray]:
        """Flux (n,) and samples (n, n_samples) of images (n, n_pixels)."""
        return self.split(pixels @ self.matrix)

    def split(self, numbers: FloatArray) -> tuple[FloatArray, ComplexArray]:
        """Flux and samples out of the operator's real numbers (n, 1 + 2·n_samples)."""
        n = self.n_samples
        return numbers[:, 0], numbers[:, 1 : 1 + n] + 1j * numbers[:, 1 + n : 1 + 2 * n]

    def power(self, samples: ComplexArray) -> FloatArray:
        """V² times flux², (n, n_baselines), with its noise bias."""
        return np.asarray((samples.real**2 + samples.imag**2) @ self._by_baseline)

    def bispectrum(self, samples: ComplexArray) -> ComplexArray:
        """Sum of the closing products, (n, n_triangles)."""
        a, b, c = self.closing.T
        products = samples[:, a] * samples[:, b] * samples[:, c].conj()
        if self.single:
            return np.asarray(products)
        first = np.flatnonzero(np.diff(self.triangle, prepend=-1))
        return np.asarray(np.add.reduceat(products, first, axis=1))

    def fringes(self, samples: ComplexArray) -> ComplexArray:
        """One number per baseline, (n, n_baselines): V·flux, summed with the phases kept."""
        return np.asarray((samples * self.reference.conj()) @ self._by_baseline)

    @cached_property
    def _by_baseline(self) -> FloatArray:
        share = np.zeros((self.n_samples, self.n_baselines))
        share[np.arange(self.n_samples), self.baseline] = self.weight
        return share

    def bias(self, variance: FloatArray) -> tuple[float, FloatArray]:
        """What noise of independent pixels (n_pixels,) adds to flux² and to the power."""
        n, diagonal = self.n_samples, variance @ self.matrix**2
        return float(diagonal[0]), (diagonal[1 : 1 + n] + diagonal[1 + n :]) @ self._by_baseline

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
        n, power = self.n_samples, self.power(samples[None])[0]
        by_vis2 = np.zeros((len(power), 1 + 2 * n))
        by_vis2[:, 0] = -2.0 * power / flux**3
        rows = np.arange(n)
        by_vis2[self.baseline, 1 + rows] = 2.0 * self.weight * samples.real / flux**2
        by_vis2[self.baseline, 1 + n + rows] = 2.0 * self.weight * samples.imag / flux**2
        return np.vstack([by_vis2, self._closure_jacobian(samples)])

    def _closure_jacobian(self, samples: ComplexArray) -> FloatArray:
        a, b, c = self.closing.T
        sa, sb, sc = samples[a], samples[b], samples[c].conj()
        total = self.bispectrum(samples[None])[0]
        slope = np.zeros((len(total), 2, self.n_samples), dtype=complex)
        for index, value, turn in ((a, sb * sc, 1j), (b, sa * sc, 1j), (c, sa * sb, -1j)):
            np.add.at(slope[:, 0], (self.triangle, index), value)
            np.add.at(slope[:, 1], (self.triangle, index), turn * value)
        out = (slope / total[:, None, None]).imag
        return np.concatenate([np.zeros((len(total), 1)), out.reshape(len(total), -1)], axis=1)


def closing_products(
    triangle_baselines: IntArray, offsets: IntArray, baseline: IntArray
) -> tuple[IntArray, IntArray]:
    """All triples of samples that close, for samples on one lattice (Monnier 2007).

    Parameters
    ----------
    triangle_baselines : (n_triangles, 3) int array
        Baselines ij, jk, ik.
    offsets : (n_samples, 2) int array
        Place of each sample on the lattice from its splodge's reference point; reference
        points close exactly.
    baseline : (n_samples,) int array

    Returns
    -------
    closing : (n, 3) int array
    triangle : (n,) int array
    """
    place = {
        (int(b), *map(int, o)): k for k, (b, o) in enumerate(zip(baseline, offsets, strict=True))
    }
    members = [np.flatnonzero(baseline == b) for b in range(int(baseline.max()) + 1)]
    closing, triangle = [], []
    for t, (ij, jk, ik) in enumerate(triangle_baselines):
        for p, q in product(members[ij], members[jk]):
            third = place.get((int(ik), *map(int, offsets[p] + offsets[q])))
            if third is not None:
                closing.append((p, q, third))
                triangle.append(t)
    return np.array(closing, dtype=np.intp).reshape(-1, 3), np.array(triangle, dtype=np.intp)

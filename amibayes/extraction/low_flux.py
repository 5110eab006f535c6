"""What photons and read noise make of the observables of one integration, faint ones too.

V² is a quadratic form of the measured numbers and the bispectrum a product of three of
them. Where the noise of a fringe is as large as the fringe, the terms of second and third
order are as large as the first: pairs of noises with the third leg, and the product of all
three noises (the terms of Gordon & Buscher 2012, their sums over photons and read noise put
in as one covariance of the numbers, which pixels and weights may correlate as they like).
For Gaussian noise the three orders are uncorrelated once what the third has in common with
the first is counted there, and each has a closed form. Photons are not quite Gaussian: their
third cumulant correlates first and second order, by as much as the second order itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.extraction.sampling import IntArray, Sampling
from amibayes.optics.psf import ComplexArray
from amibayes.units import FloatArray


def expected_covariance(
    sampling: Sampling,
    flux: float,
    samples: ComplexArray,
    variance: FloatArray,
    skewness: FloatArray,
) -> FloatArray:
    """Covariance of V² and closure phase of one integration.

    The covariance of (power − V²·flux²)/flux² and of Im(bispectrum/mean bispectrum), which
    is what the errors of mean power and mean bispectrum rest on. Exact for Gaussian noise of
    methods with one sample per baseline, and for photons up to the second power of 1/flux; for
    closure phases of the other methods to first order.

    Parameters
    ----------
    sampling : Sampling
    flux : float
    samples : (n_samples,) complex array
        Their expectations.
    variance : (n_pixels,) array
        Of independent pixels.
    skewness : (n_pixels,) array
        Third cumulant of their noise.

    Returns
    -------
    (n_baselines + n_triangles, n_baselines + n_triangles) array
    """
    noise = sampling.matrix.T @ (sampling.matrix * variance[:, None])
    slope = sampling.jacobian(flux, samples)
    n = sampling.n_baselines
    share = _shares(sampling, flux, samples)
    if not sampling.single:
        total = slope @ noise @ slope.T
        total[:n, :n] += 2.0 * share @ noise**2 @ share.T
        return np.asarray(total)
    products = _Products.of(sampling, samples)
    curved = np.column_stack([sampling.matrix**2 @ share.T, products.of_one(sampling.matrix)])
    skewed = (sampling.matrix @ slope.T).T @ (curved * skewness[:, None])
    slope[n:] += products.slope_of_third(noise)
    total = slope @ noise @ slope.T + _second_order(share, products.curvature(), noise)
    total += skewed + skewed.T
    total[n:, n:] += products.third_order(noise)
    scale = np.concatenate([np.ones(n), 1.0 / np.abs(products.mean(noise))])
    return np.asarray(scale[:, None] * total * scale)


def _shares(sampling: Sampling, flux: float, samples: ComplexArray) -> FloatArray:
    """V² as a sum of squares of the numbers: their shares (n_baselines, n_numbers)."""
    n = sampling.n_samples
    power = sampling.power(samples[None])[0]
    share = np.zeros((len(power), 1 + 2 * n))
    share[:, 0] = -power / flux**4
    for first in (1, 1 + n):
        share[sampling.baseline, first + np.arange(n)] = sampling.weight / flux**2
    return share


def _second_order(share: FloatArray, curvature: FloatArray, noise: FloatArray) -> FloatArray:
    """Covariance ½ tr(H C H' C) of the quadratic parts of V² and of closure phase."""
    turned = curvature @ noise
    vis2 = 2.0 * share @ noise**2 @ share.T
    both = share @ np.einsum("kl,tlk->kt", noise, turned)
    flat = turned.reshape(len(turned), -1)
    closure = 0.5 * flat @ turned.swapaxes(1, 2).reshape(len(turned), -1).T
    return np.block([[vis2, both], [both.T, closure]])


@dataclass(frozen=True, eq=False)
class _Products:
    """The bispectrum over its mean as a product of three linear forms of the numbers.

    Parameters
    ----------
    numbers : (n_triangles, 6) int array
        Which of the numbers a triangle takes.
    forms : (3, n_triangles, 6) complex array
        Relative change of each leg by those numbers.
    n_numbers : int
    """

    numbers: IntArray
    forms: ComplexArray
    n_numbers: int

    @classmethod
    def of(cls, sampling: Sampling, samples: ComplexArray) -> _Products:
        n, count = sampling.n_samples, len(sampling.closing)
        forms = np.zeros((3, count, 6), dtype=complex)
        for leg, turn in enumerate((1j, 1j, -1j)):
            value = samples[sampling.closing[:, leg]]
            value = value.conj() if turn == -1j else value
            forms[leg, :, leg], forms[leg, :, 3 + leg] = 1.0 / value, turn / value
        numbers = np.concatenate([1 + sampling.closing, 1 + n + sampling.closing], axis=1)
        return cls(numbers, forms, 1 + 2 * n)

    def of_one(self, matrix: FloatArray) -> FloatArray:
        """Second order (n_pixels, n_triangles) that a unit in one pixel makes with itself."""
        full = np.zeros((3, len(self.numbers), self.n_numbers), dtype=complex)
        np.put_along_axis(full, np.broadcast_to(self.numbers, self.forms.shape), self.forms, axis=2)
        # Real times complex as one real product.
        columns = np.ascontiguousarray(full.reshape(-1, self.n_numbers).T).view(float)
        x, y, z = np.split((matrix @ columns).view(complex), 3, axis=1)
        return np.asarray((x * y + (x + y) * z).imag)

    def curvature(self) -> FloatArray:
        """Second derivatives (n_triangles, n_numbers, n_numbers) of the phase."""
        a, b, c = self.forms
        half = sum(np.einsum("ti,tj->tij", p, q) for p, q in ((a, b), (b, c), (c, a)))
        full = np.zeros((len(a), self.n_numbers, self.n_numbers))
        rows, columns = self.numbers[:, :, None], self.numbers[:, None, :]
        full[np.arange(len(a))[:, None, None], rows, columns] = np.imag(half + half.swapaxes(1, 2))
        return full

    def mean(self, noise: FloatArray) -> ComplexArray:
        """Mean bispectrum (n_triangles,) in units of the product of the mean legs.

        Noises of two legs that have photons in common do not average out.
        """
        own = noise[self.numbers[:, :, None], self.numbers[:, None, :]]
        a, b, c = self.forms
        pairs = (np.einsum("ti,tij,tj->t", p, own, q) for p, q in ((a, b), (b, c), (c, a)))
        return np.asarray(1.0 + sum(pairs))

    @cached_property
    def _third(self) -> FloatArray:
        """Third derivatives (n_triangles, 6, 6, 6)."""
        orders = ("ijk", "ikj", "jik", "jki", "kij", "kji")
        terms = (np.einsum(f"t{o[0]},t{o[1]},t{o[2]}->tijk", *self.forms) for o in orders)
        return np.asarray(sum(term.imag for term in terms))

    def slope_of_third(self, noise: FloatArray) -> FloatArray:
        """What the third order has in common with the first, as a slope by the numbers."""
        own = noise[self.numbers[:, :, None], self.numbers[:, None, :]]
        slope = np.zeros((len(self.numbers), self.n_numbers))
        part = 0.5 * np.einsum("tijk,tjk->ti", self._third, own)
        np.put_along_axis(slope, self.numbers, part, axis=1)
        return slope

    def third_order(self, noise: FloatArray) -> FloatArray:
        """Covariance (n_triangles, n_triangles) of the rest of the third order."""
        third = self._third
        between = noise[self.numbers[:, None, :, None], self.numbers[None, :, None, :]]
        turned = np.einsum("tijk,tuia->tuajk", third, between)
        turned = np.einsum("tuajk,tujb->tuabk", turned, between)
        turned = np.einsum("tuabk,tukc->tuabc", turned, between)
        return np.asarray(np.einsum("tuabc,uabc->tu", turned, third) / 6.0)

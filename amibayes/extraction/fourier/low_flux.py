"""What photons and read noise make of the observables of one integration, faint ones too.

V² is a quadratic form of the measured numbers and the bispectrum a product of three of
them. Where the noise of a fringe is as large as the fringe, the terms of second and third
order are as large as the first: pairs of noises with the third leg, and the product of all
three noises (the terms of Gordon & Buscher 2012, their sums over photons and read noise put
in as one covariance of the numbers, which pixels and weights may correlate as they like).
For Gaussian noise the three orders are uncorrelated once what the third has in common with
the first is counted there, and each is a sum of products of the covariances of two legs
(Isserlis 1918). Photons are not quite Gaussian: their third cumulant correlates first and
second order, by as much as the second order itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.units import ComplexArray, FloatArray, IntArray, SingleArray


def observable_covariance(
    samples: ComplexArray,
    triangles: IntArray,
    noise: FloatArray,
    share: FloatArray,
    slope: FloatArray,
    numbers: SingleArray,
    third: FloatArray,
) -> FloatArray:
    """Covariance of V² and closure phase of one sample per baseline, fluxes in units of one.

    Exact for Gaussian noise, and for photons up to the second power of 1/flux.

    Parameters
    ----------
    samples : (n,) complex array
        Their expectations.
    triangles : (n_triangles, 3) int array
        Baselines ij, jk, ik of every triangle.
    noise : (1 + 2n, 1 + 2n) array
        Covariance of the numbers: flux, real parts, imaginary parts.
    share : (n, 1 + 2n) array
        V² as sums of squares of the numbers.
    slope : (n + n_triangles, 1 + 2n) array
        Derivatives of V² and closure phase by the numbers.
    numbers : (1 + 2n, n_pixels) float32 array
        The numbers that a unit in each pixel makes.
    third : (n_pixels,) array
        Third cumulant of the noise of each pixel.
    """
    legs, n = _Legs.of(samples, triangles, noise), len(share)
    skewed = slope @ _curved(samples, triangles, share, numbers, third)
    slope[n:] += legs.slope_of_third()
    total = slope @ noise @ slope.T + skewed + skewed.T
    both = legs.second_order_with(share)
    total[:n, :n] += 2.0 * share @ noise**2 @ share.T
    total[:n, n:] += both
    total[n:, :n] += both.T
    total[n:, n:] += legs.second_order() + legs.third_order()
    scale = np.concatenate([np.ones(n), 1.0 / np.abs(legs.mean())])
    return np.asarray(scale[:, None] * total * scale)


def signs(triangles: IntArray, n_baselines: int) -> FloatArray:
    """Closure phases (n_triangles, n_baselines) as sums of the baselines' phases."""
    out = np.zeros((len(triangles), n_baselines))
    np.put_along_axis(out, triangles, np.array([[1.0, 1.0, -1.0]]), axis=1)
    return out


def _curved(
    samples: ComplexArray,
    triangles: IntArray,
    share: FloatArray,
    columns: SingleArray,
    third: FloatArray,
) -> FloatArray:
    """Third moments (n_numbers, n_baselines + n_triangles) of a number and a second order.

    The second order that a unit in one pixel makes with itself is Σ pairs x·y of the legs'
    changes: (Σ Re)(Σ Im) − Σ Re·Im is its imaginary part.
    """
    n = len(samples)
    of_leg = (1.0 / samples)[:, None].astype(np.complex64)
    a, b = columns[1 : 1 + n], columns[1 + n :]
    real, imaginary = a * of_leg.real - b * of_leg.imag, a * of_leg.imag + b * of_leg.real
    turned, share = signs(triangles, n).astype(np.float32), share.astype(np.float32)
    curved = np.concatenate([share @ columns**2, (np.abs(turned) @ real) * (turned @ imaginary)])
    curved[n:] -= turned @ (real * imaginary)
    curved *= third.astype(np.float32)
    return np.asarray(columns @ curved.T, dtype=float)


@dataclass(frozen=True, eq=False)
class _Legs:
    """The bispectrum over its mean as a product of three noisy legs.

    Parameters
    ----------
    forms : (3, n_triangles, n_numbers) complex array
        Relative change of each leg by the numbers.
    noise : (n_numbers, n_numbers) array
        Covariance of the numbers.
    plain, conjugate : (3, n_triangles, 3, n_triangles) complex array
        Mean of the product of two legs, and of one with the conjugate of another.
    """

    forms: ComplexArray
    noise: FloatArray
    plain: ComplexArray
    conjugate: ComplexArray

    @classmethod
    def of(cls, samples: ComplexArray, triangles: IntArray, noise: FloatArray) -> _Legs:
        n = len(samples)
        relative = np.zeros((n, 1 + 2 * n), dtype=complex)
        relative[:, 1 : 1 + n], relative[:, 1 + n :] = np.diag(1.0 / samples), np.diag(1j / samples)
        forms = relative[triangles.T]
        forms[2] = forms[2].conj()
        flat = forms.reshape(-1, 1 + 2 * n)
        noisy, shape = flat @ noise, (*forms.shape[:2], *forms.shape[:2])
        plain, conjugate = noisy @ flat.T, noisy @ flat.conj().T
        return cls(forms, noise, plain.reshape(shape), conjugate.reshape(shape))

    def _own(self) -> ComplexArray:
        """Mean products of two legs of one triangle: second and third, third and first, ..."""
        t = np.arange(self.forms.shape[1])
        return np.stack([self.plain[1, t, 2, t], self.plain[2, t, 0, t], self.plain[0, t, 1, t]])

    def mean(self) -> ComplexArray:
        """Mean bispectrum (n_triangles,) in units of the product of the mean legs.

        Noises of two legs that have photons in common do not average out.
        """
        return np.asarray(1.0 + self._own().sum(axis=0))

    def slope_of_third(self) -> FloatArray:
        """What the third order has in common with the first, as a slope by the numbers."""
        return np.asarray((self._own()[..., None] * self.forms).sum(axis=0).imag)

    def second_order_with(self, share: FloatArray) -> FloatArray:
        """Covariance (n_baselines, n_triangles) of the quadratic parts with those of V²."""
        with_leg = self.forms @ self.noise
        pairs = with_leg.sum(axis=0) ** 2 - (with_leg**2).sum(axis=0)
        return np.asarray(share @ pairs.imag.T)

    def second_order(self) -> FloatArray:
        """Covariance (n_triangles, n_triangles) of the quadratic parts of closure phases."""
        return np.asarray(0.5 * (_pairs(self.conjugate) - _pairs(self.plain)).real)

    def third_order(self) -> FloatArray:
        """Covariance (n_triangles, n_triangles) of the rest of the third order."""
        return np.asarray(0.5 * (_triples(self.conjugate) - _triples(self.plain)).real)


def _pairs(means: ComplexArray) -> ComplexArray:
    """Two different legs of one triangle with two different ones of another, either way."""
    both, squares = means.sum(axis=(0, 2)) ** 2, means**2
    same = (means.sum(axis=0) ** 2).sum(axis=1) + (means.sum(axis=2) ** 2).sum(axis=0)
    return np.asarray(0.5 * (both - same + squares.sum(axis=(0, 2))))


def _triples(means: ComplexArray) -> ComplexArray:
    """All three legs of one triangle with all three of another, in each order."""
    a, b, c = means.swapaxes(1, 2)
    orders = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
    return np.asarray(sum(a[i] * b[j] * c[k] for i, j, k in orders))

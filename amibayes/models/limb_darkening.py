"""The power-law limb-darkened disc, I(μ) = μ^α (Hestroffer 1997, A&A 327, 199)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import digamma, gammaln, j1, jv, roots_legendre

from amibayes.units import MAS, FloatArray

SERIES, LAST_TERM = 8.0, 1e-16
"""Arguments up to which the power series is summed, whose largest term is then below 430: exact to
1e-13; and the term at which it ends."""

NODES, NODES_PER_ARGUMENT = 30, 0.8
"""Of Poisson's integral: errors below 1e-13 of arguments up to 300 at least."""


def power_law_disc(
    frequency: FloatArray, diameter_mas: FloatArray, exponent: FloatArray
) -> FloatArray:
    """Visibility Γ(ν + 1) J_ν(z)/(z/2)^ν with z = πθ|u| and ν = α/2 + 1.

    Parameters
    ----------
    frequency : (…) float array
        Length of the spatial frequency, cycles per radian.
    diameter_mas, exponent : float array
        θ and α; broadcast against ``frequency``. α = 0 is the uniform disc.
    """
    z = np.pi * MAS * np.asarray(frequency, dtype=float) * diameter_mas
    return np.asarray(_disc(z, 0.5 * np.asarray(exponent, dtype=float) + 1.0, slopes=False)[0])


def power_law_with_slopes(
    frequency: FloatArray, diameter_mas: FloatArray, exponent: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`power_law_disc`, and its derivatives by the diameter (per mas) and by α.

    d/dz of J_ν(z)/z^ν is −J_{ν+1}(z)/z^ν; that by the order is of each term of the series, or of
    the integrand.
    """
    per_mas = np.pi * MAS * np.asarray(frequency, dtype=float)
    z, order = per_mas * diameter_mas, 0.5 * np.asarray(exponent, dtype=float) + 1.0
    wave, next_order, by_order = _disc(z, order, slopes=True)
    return wave, -0.5 * z / (order + 1.0) * next_order * per_mas, 0.5 * by_order


def _disc(z: FloatArray, order: FloatArray, *, slopes: bool) -> FloatArray:
    """Γ(ν + 1) J_ν(z)/(z/2)^ν, (1, …); with the same of ν + 1 and d/dν for slopes, (3, …)."""
    size = np.abs(z)
    out = _series(np.minimum(size, SERIES), order, slopes=slopes)
    far = size > SERIES
    if far.any():
        orders = np.broadcast_to(order, far.shape)
        of_order = _integral if slopes else _bessel
        for nu in np.unique(orders[far]):
            here = far & (orders == nu)
            out[:, here] = of_order(size[here], float(nu))
    return out


def _bessel(z: FloatArray, nu: float) -> FloatArray:
    """The disc (1, n) by scipy's J, of which that of a uniform disc is the fastest."""
    wave = j1(z) if nu == 1.0 else jv(nu, z)
    return np.asarray(np.exp(gammaln(nu + 1.0) - nu * np.log(0.5 * z)) * wave)[None]


def _integral(z: FloatArray, nu: float) -> FloatArray:
    """Disc, next order, slope (3, n) by Poisson's integral: ∫ (1 − t²)^(ν−½) cos zt dt from 0 to 1.

    (Abramowitz & Stegun 9.1.20.) With 1 − t = (1 − u)³ its end is smooth enough for Gauss's rule.
    All three have the cosines in common, and cost less than scipy's J.
    """
    u, weight = _gauss(int(np.ceil(NODES + NODES_PER_ARGUMENT * float(z.max()))))
    off = (1.0 - u) ** 3  # 1 − t
    fall = off * (2.0 - off)
    scale = 2.0 / np.sqrt(np.pi) * np.exp(gammaln(nu + 1.0) - gammaln(nu + 0.5))
    own = scale * fall ** (nu - 0.5) * 3.0 * (1.0 - u) ** 2 * weight
    growth = digamma(nu + 1.0) - digamma(nu + 0.5) + np.log(fall)
    weights = own * np.array([np.ones_like(fall), (nu + 1.0) / (nu + 0.5) * fall, growth])
    return np.asarray(weights @ np.cos(np.outer(1.0 - off, z)))


@lru_cache(maxsize=256)
def _gauss(n: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights of Gauss and Legendre from 0 to 1."""
    nodes, weights = roots_legendre(n)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def _series(z: FloatArray, order: FloatArray, *, slopes: bool) -> FloatArray:
    """Σ_k (−z²/4)^k/(k! (ν + 1)_k) (Abramowitz & Stegun 9.1.10), as far as the largest z needs.

    A sixth of the time of scipy's J of a broken order. With slopes as `_disc` gives them.
    """
    square = -0.25 * z * z
    largest, size, last = float(-square.min(initial=0.0)), 1.0, 0
    while size > LAST_TERM:
        last += 1
        size *= largest / last**2
    shape = np.broadcast_shapes(z.shape, order.shape)
    k = np.arange(1.0, last + 1.0).reshape(-1, *(1,) * len(shape))
    factors = [1.0 / np.cumprod(k * (order + k), axis=0)]
    if slopes:
        factors += [factors[0] * (order + 1.0) / (order + 1.0 + k)]
        factors += [-factors[0] * np.cumsum(1.0 / (order + k), axis=0)]
    first = np.ones((len(factors), *shape))
    first[2:] = 0.0
    # From the last term on.
    terms = np.array(factors)
    out = np.zeros_like(first)
    for n in range(last - 1, -1, -1):
        out += terms[:, n]
        out *= square
    return first + out

"""The power-law limb-darkened disc, I(μ) = μ^α (Hestroffer 1997, A&A 327, 199)."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaln, jv

from amibayes.units import MAS, FloatArray

SERIES, LAST_TERM = 8.0, 1e-16
"""Arguments up to which the power series is summed, whose largest term is then below 430: exact to
1e-13; and the term at which it ends."""

ORDER_STEP = 2e-3
"""Step in ν of a derivative by four points, whose error, step⁴·V⁗/30, is below 1e-12."""


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
    return _of_order(z, 0.5 * np.asarray(exponent, dtype=float) + 1.0)


def power_law_slopes(
    frequency: FloatArray, diameter_mas: FloatArray, exponent: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `power_law_disc` by the diameter (per mas) and by α.

    d/dz of J_ν(z)/z^ν is −J_{ν+1}(z)/z^ν; that by the order has no closed form.
    """
    per_mas = np.pi * MAS * np.asarray(frequency, dtype=float)
    z, order = per_mas * diameter_mas, 0.5 * np.asarray(exponent, dtype=float) + 1.0
    by_z = -0.5 * z / (order + 1.0) * _of_order(z, order + 1.0)
    h = ORDER_STEP
    near = _of_order(z, order + h) - _of_order(z, order - h)
    far = _of_order(z, order + 2.0 * h) - _of_order(z, order - 2.0 * h)
    return by_z * per_mas, 0.5 * (8.0 * near - far) / (12.0 * h)


def _of_order(z: FloatArray, order: FloatArray) -> FloatArray:
    """Γ(ν + 1) J_ν(z)/(z/2)^ν."""
    z, order = np.broadcast_arrays(z, order)
    out = _series(np.minimum(np.abs(z), SERIES), order)
    far = np.abs(z) > SERIES
    if far.any():
        at, nu = z[far], order[far]
        out[far] = np.exp(gammaln(nu + 1.0) - nu * np.log(0.5 * at)) * jv(nu, at)
    return out


def _series(z: FloatArray, order: FloatArray) -> FloatArray:
    """Σ_k (−z²/4)^k/(k! (ν + 1)_k) (Abramowitz & Stegun 9.1.10), as far as the largest z needs.

    A sixth of the time of scipy's J of a broken order.
    """
    square = -0.25 * z * z
    largest = float(-square.min(initial=0.0))
    term, out, size, k = np.ones_like(square), np.ones_like(square), 1.0, 0
    while size > LAST_TERM:
        k += 1
        size *= largest / k**2
        term = term * (square / (k * (order + k)))
        out += term
    return out

"""The power-law limb-darkened disc, I(μ) = μ^α (Hestroffer 1997, A&A 327, 199)."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaln, jv

from amibayes.units import MAS, FloatArray

SMALL = 1e-3
"""Arguments below which the series V = 1 − z²/4(ν + 1) is exact to 1e-13."""

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
    small = np.abs(z) < SMALL
    safe = np.where(small, 1.0, z)
    scale = np.exp(gammaln(order + 1.0) - order * np.log(0.5 * safe))
    return np.where(small, 1.0 - z * z / (4.0 * (order + 1.0)), scale * jv(order, safe))

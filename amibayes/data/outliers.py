"""Integrations whose observables are not those of the others."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

from amibayes.units import BoolArray, FloatArray

TO_SIGMA = 1.4826
"""From the median absolute deviation to a standard deviation, of a Gaussian: 1/Φ⁻¹(3/4)."""


def look_elsewhere(limit: float, n: int) -> float:
    """The limit that one of ``n`` exceeds as rarely as a single one exceeds ``limit``."""
    return float(-ndtri(ndtr(-limit) / max(n, 1)))


def outlying(deviation: FloatArray, expected: FloatArray, limit: float) -> BoolArray:
    """Integrations whose observables are outliers, on a robust scale, (n,).

    The statistic is the largest deviation over all observables in units of its scatter,
    and the limit allows for how many there are. The scatter of a few integrations may be
    small by chance: it is not taken below what the observables have on average, in units
    of the ``expected`` standard deviations (m,).
    """
    if len(deviation) < 5:
        return np.zeros(len(deviation), dtype=bool)
    middle = np.median(deviation, axis=0)
    scatter = TO_SIGMA * np.median(np.abs(deviation - middle), axis=0)
    # A robust scatter of few integrations is uncertain itself.
    slack = 1.0 + 3.0 / np.sqrt(len(deviation))
    scatter = np.maximum(scatter, expected * np.median(scatter / expected))
    off = np.abs(deviation - middle) / np.maximum(scatter, 1e-300)
    return np.asarray(off.max(axis=1) > slack * look_elsewhere(limit, deviation.size))

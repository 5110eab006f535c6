"""What single pixels do of their own: a current that changes with the pixel's charge, c·Q·F.

The correction for nonlinearity is measured pixel by pixel, with errors of its own. One
coefficient for every pixel cannot be told from charge migration in any one exposure: there are as
many as data. As draws of one distribution they can: its width is what bright pixels scatter by
more than noise makes them, and each pixel's own value is known as well as its data are better
than that width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import chi2 as chi2_distribution

from amibayes.units import FloatArray, IntArray, freeze

WIDEST = 3e-6
"""Per electron: 4 % at half of full well, more than any pixel that may be used is off by."""

STRANGE = 5.0
"""Standard deviations beyond twice that from which on it is not linearity that a pixel shows."""

CARRIED = 40
"""Pixels whose errors are followed into V² and closure phases: what a pixel does goes with the
fourth power of its light, and these have nearly all of it."""


@dataclass(frozen=True, eq=False)
class OwnResponse:
    """Coefficients c of the pixels of a detector, per electron.

    Parameters
    ----------
    spread : float
        Standard deviation over pixels.
    spread_error : float
    p_value : float
        Probability of so much of it, or more, where pixels have none.
    value, error : (ny, nx) arrays
        Of each pixel, its data and the spread together; `value` is 0 and `error` the spread
        where its data tell nothing.
    carried : (m, 2) int array
        Row and column of the pixels whose errors matter.
    """

    spread: float
    spread_error: float
    p_value: float
    value: FloatArray
    error: FloatArray
    carried: IntArray

    def __post_init__(self) -> None:
        freeze(self)


def own_response(
    change: Sequence[FloatArray], gain: Sequence[FloatArray], sigma: Sequence[FloatArray]
) -> OwnResponse:
    """Estimate the spread, and every pixel's value, of exposures of the same pixels.

    Parameters
    ----------
    change : sequence of (ny, nx) array
        Of the current, what all else makes of it taken off.
    gain : sequence of (ny, nx) array
        Change for a coefficient of 1.
    sigma : sequence of (ny, nx) array
        Of the change; infinite where it does not count.
    """
    weight = [np.where(np.isfinite(s), s, np.inf) ** -2.0 for s in sigma]
    known = np.sum([w * g**2 for w, g in zip(weight, gain, strict=True)], axis=0)
    right = np.sum([w * g * r for w, g, r in zip(weight, gain, change, strict=True)], axis=0)
    seen = known > 0.0
    # Far more than any pixel's linearity is off by: a jump that was not flagged, or the like.
    size = np.abs(right[seen]) / known[seen] - 2.0 * WIDEST
    seen[seen] = size < STRANGE / np.sqrt(known[seen])
    variance = 1.0 / known[seen]
    found = right[seen] * variance

    def misfit(squared: float) -> float:
        total = variance + squared
        return float((np.log(total / variance) + found**2 / total).sum())

    best = minimize_scalar(
        lambda s: misfit(s**2), bounds=(0.0, WIDEST), method="bounded", options={"xatol": 1e-11}
    )
    spread = float(best.x) if best.fun < misfit(0.0) else 0.0
    fall = max(misfit(0.0) - misfit(spread**2), 0.0)
    total = variance + spread**2
    # Of the square of the spread; of the spread itself the root of that where there is none.
    of_square = np.sqrt(2.0 / max(float((total**-2.0).sum()), 1e-300))
    spread_error = float(of_square / max(2.0 * spread, np.sqrt(of_square)))
    shrunk, error = np.zeros(known.shape), np.full(known.shape, spread)
    shrunk[seen] = found * spread**2 / total
    error[seen] = spread * np.sqrt(variance / total)
    size = sum(np.asarray(g) ** 2 for g in gain)
    order = np.argsort(-np.where(seen, size, 0.0), axis=None)[:CARRIED]
    carried = np.stack(np.unravel_index(order, known.shape), axis=1)
    p = 0.5 * float(chi2_distribution.sf(fall, 1)) if fall else 1.0
    return OwnResponse(spread, spread_error, p, shrunk, error, carried)

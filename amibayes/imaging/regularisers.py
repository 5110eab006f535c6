"""What an image should be like where the data do not say: smooth, or with edges.

Both act on the shares p = x/Σx of the light, whatever its sum: the flux of the image is left to
the data. Phases alone do not tell the flux of symmetric light, and a wide glow would make any
bump a small share: there p = x/f with a flux f that is fixed, towards which the entropy draws,
and the total variation has the sum of the light added.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from amibayes.imaging.grid import PixelGrid
from amibayes.units import FloatArray

EDGE = 0.1
"""Differences of neighbours below this part of the mean pixel count as their square: a total
variation that has a derivative everywhere."""

FLOOR = 1e-12
"""Least share of a pixel whose logarithm is taken."""

PRIOR_FWHM = 0.5
"""Width of the default image of the entropy, in units of the field."""

Regulariser = Callable[[FloatArray], tuple[float, FloatArray]]
"""Value and gradient (n_pixels,) of light (n_pixels,)."""


def default_image(grid: PixelGrid) -> FloatArray:
    """Shares (n_pixels,) of a round Gaussian half as wide as the field."""
    sigma = PRIOR_FWHM * grid.n * grid.pixel_mas / np.sqrt(8.0 * np.log(2.0))
    rho2 = grid.east_mas**2 + grid.north_mas**2
    shares = np.exp(-0.5 * rho2 / sigma**2)
    return np.asarray(shares / shares.sum())


def entropy(grid: PixelGrid, flux: float | None = None) -> Regulariser:
    """Σ p ln(p/q) − p + q against the default image q (Skilling & Bryan 1984), 0 where p is q."""
    prior = np.log(default_image(grid))

    def value(light: FloatArray) -> tuple[float, FloatArray]:
        total = max(float(light.sum()), FLOOR) if flux is None else flux
        share = light / total
        log = np.log(np.maximum(share, FLOOR)) - prior
        found = float(share @ log)
        if flux is not None:
            return found - float(share.sum()) + 1.0, log / total
        return found, (log - found) / total

    return value


def total_variation(grid: PixelGrid, flux: float | None = None) -> Regulariser:
    """Mean length of the gradient of p in units of the mean pixel (Rudin et al. 1992)."""
    n = grid.n

    def value(light: FloatArray) -> tuple[float, FloatArray]:
        total = max(float(light.sum()), FLOOR) if flux is None else flux
        image = np.pad((light / total).reshape(n, n), ((0, 1), (0, 1))) * n**2
        right, up = image[:-1, 1:] - image[:-1, :-1], image[1:, :-1] - image[:-1, :-1]
        length = np.sqrt(right**2 + up**2 + EDGE**2)
        found = float((length - EDGE).sum()) / n**2
        by = np.zeros((n + 1, n + 1))
        by[:-1, 1:] += right / length
        by[1:, :-1] += up / length
        by[:-1, :-1] -= (right + up) / length
        by_share = by[:-1, :-1].ravel()
        if flux is not None:  # light that the data do not ask for goes
            return found + float(light.sum()) / total, (by_share + 1.0) / total
        return found, (by_share - float(by_share @ light) / total) / total

    return value


REGULARISERS = {"entropy": entropy, "tv": total_variation}
"""By the names that ``--regulariser`` takes."""

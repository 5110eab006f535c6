"""Affine map of the mask: where its image says that it is, one for all exposures of a visit.

The image of a real mask is that of the drawing under an affine map: magnified by two
numbers, sheared by two more. Where the pixels are known (a WCS, or the user), what the image
says of larger or turned fringes is the mask's: baselines change, the sky does not. The map
is found by Gauss–Newton on the residual of the fringe fit, every coefficient of the fit and
the place of the star left free, with a prior from the instrument's file.

Light of a companion, and its envelope that stands elsewhere, looks a little like another
map. Every exposure counts with an error that holds this; single stars, the calibrators,
hence decide, and target and calibrators are seen through one map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amibayes.extraction.fourier.fine_image import fine_image
from amibayes.extraction.image_plane import FringeFit, FringeModel, weighted_fit
from amibayes.extraction.view import View
from amibayes.instrument import Distortion
from amibayes.units import FloatArray, read_only

STEP_PX = 0.03
"""Displacement whose effect is taken for the derivatives; they are good to a percent."""

MAX_STEPS, CONVERGED = 6, 1e-6
"""Steps of Gauss–Newton, and a last step of no consequence (1e-6 of a separation)."""

LARGEST = 0.05
"""A map farther from the prior's is none of this mask."""

FAR = 0.01
"""Larger changes of the mask's image than an optical train's: pixels or filter are others."""


@dataclass(frozen=True, eq=False)
class MapEstimate:
    """What one exposure says of the map.

    Parameters
    ----------
    value : (4,) array
        Matrix (x from x, x from y, y from x, y from y).
    covariance : (4, 4) array
    """

    value: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class MaskMap:
    """The map in use.

    Parameters
    ----------
    matrix : (2, 2) array
        Times a point of the drawing: the point of the mask that made the images.
    error : (2, 2) array
        Standard deviations, those of the prior where no image says more.
    """

    matrix: FloatArray
    error: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "matrix", "error")


def far_from_stated(found: MaskMap, stated: Distortion) -> tuple[str, ...]:
    """Say where a map is so far from the instrument's that the pixels are in doubt.

    A mask as drawn, which simulations have, is near enough.
    """
    far = float(np.abs(found.matrix - stated.matrix).max())
    if far <= max(FAR, 3.0 * stated.error):
        return ()
    return (
        f"the mask's image is {100.0 * far:.1f} % off that of the instrument's file: the header's "
        "pixel scale or filter is in doubt, and separations as much (--pixel-scale, --filter)",
    )


def estimate_map(view: View, image: FloatArray, fit: FringeFit) -> MapEstimate | None:
    """Find the map in a clean image (n_y, n_x); None where it does not tell.

    Parameters
    ----------
    view : View
        Centred, with the map to start from.
    image : (n_y, n_x) array
    fit : FringeFit
        Of that view; its weights are the inverse variances of the image.
    """
    pixels, start = image.reshape(1, -1), view.mask_map
    matrix = start
    for _ in range(MAX_STEPS):
        coefficients = fit.solve(pixels)
        slopes = map_slopes(view, coefficients[0, :-1])
        slopes = slopes - fit.solve(slopes) @ fit.design.T
        covariance = np.linalg.pinv((slopes * fit.weight) @ slopes.T)
        residual = pixels[0] - (coefficients @ fit.design.T)[0]
        step = covariance @ (slopes * fit.weight) @ residual
        matrix = (np.eye(2) + step[:4].reshape(2, 2)) @ matrix
        if not np.isfinite(matrix).all() or np.abs(matrix - start).max() > LARGEST:
            return None
        view = view.mapped(matrix).moved(step[4:])
        fit = weighted_fit(FringeModel.of(view.basis()), fit.weight)
        if np.abs(step[:4]).max() < CONVERGED:
            break
    unlike = view.unlike_a_star(coefficients[0, :-1])
    known = covariance[:4, :4] + unlike**2 * np.eye(4)
    return MapEstimate(matrix.ravel(), known)


def map_slopes(view: View, coefficients: FloatArray) -> FloatArray:
    """Derivatives of the modelled image by the four numbers of a further map, and the centre.

    An image of a mask under (1 + D) is the image at (1 + Dᵀ) times the place; averaged over
    a pixel, which stays as it is, that adds a twelfth of a second derivative.

    Returns
    -------
    (6, n_pixels) array
        By D_xx, D_xy, D_yx, D_yy, and centre x and y in pixels; to a percent.
    """
    h = STEP_PX
    corners = h * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    sides = h * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    images = fine_image(view, coefficients, 2.0 * h).moved(np.concatenate([sides, corners]))
    here, right, left, up, down, ru, rd, lu, ld = images.astype(float)
    by_x, by_y = (left - right) / (2.0 * h), (down - up) / (2.0 * h)
    by_xx, by_yy = (right + left - 2.0 * here) / h**2, (up + down - 2.0 * here) / h**2
    by_xy = (ru - rd - lu + ld) / (4.0 * h**2)
    x, y = view.axes_px()
    y = y[:, None]
    slopes = [
        x * by_x + by_xx / 12.0,
        x * by_y + by_xy / 12.0,
        y * by_x + by_xy / 12.0,
        y * by_y + by_yy / 12.0,
        -by_x,
        -by_y,
    ]
    return np.stack(slopes).reshape(6, -1)


def combined(estimates: Sequence[MapEstimate | None], prior: Distortion) -> MaskMap:
    """The map of all exposures of a visit and the prior, by inverse variances."""
    precision = np.eye(4) / prior.error**2
    total = precision @ prior.matrix.ravel()
    for estimate in estimates:
        if estimate is not None:
            own = np.linalg.inv(estimate.covariance)
            precision, total = precision + own, total + own @ estimate.value
    covariance = np.linalg.inv(precision)
    matrix = (covariance @ total).reshape(2, 2)
    return MaskMap(matrix, np.sqrt(np.diag(covariance)).reshape(2, 2))

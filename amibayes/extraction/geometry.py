"""Pixel scale and rotation of the mask, fitted once for a cube.

A pixel that is 0.2 % larger than the file says, or a mask turned by 0.1°, moves every
splodge; extracted where they are not, amplitudes fall and phases turn with the star's
place. The image itself says where they are: its residual under the fringe fit is projected
on what either error would do to the fitted image, every coefficient of the fit left free
(Gauss–Newton).

What matters most is that a target and its calibrator are seen through the same geometry:
what is left of an error then divides out, whereas noise, or a companion's light, in a
geometry of its own does not. Small differences from what the file says are therefore not
adopted, nor those that a companion could make that the visibilities leave room for, and
others are rounded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.extraction.fourier.fine_image import fine_image
from amibayes.extraction.image_plane import FringeFit, FringeModel, weighted_fit
from amibayes.extraction.mask_map import MaskMap
from amibayes.extraction.view import View
from amibayes.optics import FringeBasis
from amibayes.units import FloatArray

STEP_PX = 0.03
"""Displacement whose effect is taken for the derivatives; they are good to a percent."""

LARGEST = 0.02
"""Beyond this the header is not a little wrong: nothing is fitted."""

CONSTRAINED = 3e-3
"""A fit with larger errors says less than the header does."""

MAX_STEPS = 4

SMALLEST, SIGNIFICANT = 2.5e-4, 4.0
"""Differences from the stated geometry below this, or so many standard deviations, are left."""

ROUNDED = 1e-4
"""Others are multiples of this."""


@dataclass(frozen=True)
class Geometry:
    """Pixel scale in units of the stated one and rotation of the mask, with 1σ errors.

    ``told`` is False where the image does not tell them, or was not asked. Where the pixels
    are known the mask has a ``mask_map`` instead.
    """

    scale: float = 1.0
    rotation_rad: float = 0.0
    scale_error: float = np.inf
    rotation_error_rad: float = np.inf
    told: bool = False
    mask_map: MaskMap | None = None

    @property
    def stated(self) -> bool:
        """Whether it is what the file says."""
        return self.scale == 1.0 and self.rotation_rad == 0.0 and self.mask_map is None


@dataclass(frozen=True, eq=False)
class Solution:
    """Relative error of the pixel scale and rotation (2,), and their standard deviations.

    ``adopted`` is what is adopted of them, and ``basis`` the fringe model with that.
    """

    value: FloatArray
    error: FloatArray
    adopted: FloatArray
    basis: FringeBasis


def fit_geometry(
    view: View, image: FloatArray, fit: FringeFit, basis: FringeBasis
) -> tuple[View, Geometry, FringeBasis]:
    """Find pixel scale and rotation in an image (n_y, n_x).

    Parameters
    ----------
    view : View
        With the stated geometry, centred.
    image : (n_y, n_x) array
        Bad pixels filled.
    fit : FringeFit
        Of that view; its weights are the inverse variances of the image, what the optics
        add to noise included.
    basis : FringeBasis
        Of that view.

    Returns
    -------
    View
        With the geometry that was found, or as it was.
    Geometry
    FringeBasis
        Of that view.
    """
    solved = solve_geometry(view, image, fit, basis)
    if solved is None:
        return view, Geometry(), basis
    (scale, turn), error = solved.adopted, solved.error
    found = Geometry(1.0 + float(scale), float(turn), float(error[0]), float(error[1]), True)
    return _moved(view, solved.adopted), found, solved.basis


def solve_geometry(
    view: View, image: FloatArray, fit: FringeFit, basis: FringeBasis
) -> Solution | None:
    """Solve for pixel scale and rotation; None where the image does not tell them.

    What is adopted is tried, until what is found there is the same.
    """
    pixels = image.reshape(1, -1)
    # The place of the envelope is fitted too, but the fringes say where the star is.
    coefficients = fit.solve(pixels)[0, :-1]
    slopes = geometry_slopes(view, coefficients)
    slopes -= fit.solve(slopes) @ fit.design.T
    covariance = np.linalg.pinv((slopes * fit.weight) @ slopes.T)
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))[:2]
    if not 0.0 < error.min() <= error.max() < CONSTRAINED:
        return None
    limit = np.maximum(SIGNIFICANT * error, max(SMALLEST, view.unlike_a_star(coefficients)))
    adopted = np.zeros(2)
    for _ in range(MAX_STEPS):
        residual = pixels[0] - (fit.solve(pixels) @ fit.design.T)[0]
        step = (covariance @ (slopes * fit.weight) @ residual)[:2]
        # Scales multiply: what the slopes are linear in is their logarithm.
        scale = (1.0 + adopted[0]) * np.exp(step[0]) - 1.0
        value = np.array([scale, adopted[1] + step[1]])
        if np.abs(value).max() > LARGEST:
            return None
        rounded = np.where(np.abs(value) < limit, 0.0, ROUNDED * np.round(value / ROUNDED))
        if np.array_equal(rounded, adopted):
            break
        adopted, basis = rounded, _moved(view, rounded).basis()
        fit = weighted_fit(FringeModel.of(basis), fit.weight)
    return Solution(value, error, adopted, basis)


def geometry_slopes(view: View, coefficients: FloatArray) -> FloatArray:
    """Derivatives of the modelled image by relative scale, rotation, and centre x and y.

    A larger pixel, or a mask turned back, sees the same image from another place; a larger
    pixel also averages over more of it.

    Parameters
    ----------
    view : View
    coefficients : (1 + 2·n_baselines,) array
        Of its fringe model.

    Returns
    -------
    (4, n_pixels) array
        To a percent, and but for the flux.
    """
    step = STEP_PX * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    here, *sides = fine_image(view, coefficients, STEP_PX).moved(step).astype(float)
    right, left, up, down = sides
    by_x, by_y = (left - right) / (2.0 * STEP_PX), (down - up) / (2.0 * STEP_PX)
    bend = (sum(sides) - 4.0 * here) / STEP_PX**2
    x, y = view.axes_px()
    scale = x * by_x + y[:, None] * by_y + bend / 12.0
    turn = y[:, None] * by_x - x * by_y
    return np.stack([scale, turn, -by_x, -by_y]).reshape(4, -1)


def _moved(view: View, by: FloatArray) -> View:
    """A view with another scale (relative) and rotation."""
    scale, turn = (float(b) for b in by)
    if not (scale or turn):
        return view
    instrument = view.instrument
    pixel = instrument.pixel_scale_rad * (1.0 + scale)
    return replace(
        view,
        instrument=replace(instrument, pixel_scale_rad=pixel),
        rotation_rad=view.rotation_rad + turn,
    )

"""The image-plane fit: flux, pedestal, and a cosine and a sine for every baseline.

Least squares with weights that all integrations share is one matrix, so that a cube is
one matrix product. A pixel that is bad in one integration only is left out of it exactly:
it is given the value that the fit then predicts, for which a small system is solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from amibayes.errors import DataError
from amibayes.extraction.fourier.sampling import OneEach, PixelArray, split
from amibayes.extraction.view import CONVERGED_PX, View
from amibayes.optics import FringeBasis
from amibayes.units import BoolArray, ComplexArray, FloatArray, IntArray, SingleArray

MAX_STEPS = 12


@dataclass(frozen=True, eq=False)
class FringeModel:
    """Envelope, cosines, sines and a pedestal, as rows (2 + 2·n_baselines, n_pixels)."""

    rows: FloatArray

    @classmethod
    def of(cls, basis: FringeBasis) -> FringeModel:
        """Model of a view's basis."""
        return cls(np.concatenate([basis.matrix.T, np.ones((1, len(basis.matrix)))]))

    @cached_property
    def single(self) -> SingleArray:
        """The rows in single precision, to look at residuals."""
        return self.rows.astype(np.float32)


@dataclass(frozen=True, eq=False)
class FringeFit:
    """The weighted fit of one view.

    Parameters
    ----------
    model : FringeModel
    covariance : (2 + 2·n_baselines, 2 + 2·n_baselines) array
        Of the coefficients: inverse of the normal matrix.
    weight : (n_pixels,) array
        Inverse variances; 0 where a pixel is never used.
    """

    model: FringeModel
    covariance: FloatArray
    weight: FloatArray

    @property
    def design(self) -> FloatArray:
        """(n_pixels, n_coefficients)."""
        return self.model.rows.T

    @property
    def n_coefficients(self) -> int:
        """How many numbers are fitted."""
        return len(self.covariance)

    @cached_property
    def used(self) -> BoolArray:
        """(n_pixels,) those that are used at all."""
        return self.weight > 0.0

    @cached_property
    def inverse(self) -> FloatArray:
        """(n_pixels, n_coefficients): images times this matrix are the coefficients."""
        return np.asarray((self.covariance @ (self.design.T * self.weight)).T)

    def solve(self, pixels: PixelArray) -> FloatArray:
        """Coefficients (n, n_coefficients) of images (n, n_pixels)."""
        if pixels.dtype == np.float32:
            rows, scale = self._weighted
            return np.asarray((pixels @ rows.T).astype(float) @ self.covariance * scale)
        return np.asarray((pixels * self.weight) @ self.design @ self.covariance)

    @cached_property
    def _weighted(self) -> tuple[SingleArray, float]:
        """Weighted model in single precision, in units of the largest weight."""
        scale = float(self.weight.max())
        return self.model.single * (self.weight / scale).astype(np.float32), scale

    def fill(self, pixels: PixelArray, missing: BoolArray) -> PixelArray:
        """Give missing pixels the values that a fit without them predicts.

        Parameters
        ----------
        pixels : (n, n_pixels) array
        missing : (n, n_pixels) bool array

        Returns
        -------
        (n, n_pixels) array
            In the same precision; the very array where nothing is missing.
        """
        frame, pixel = np.nonzero(missing)
        if not len(frame):
            return pixels
        filled = pixels.copy()
        filled[frame, pixel] = 0.0
        count = np.bincount(frame, minlength=len(pixels))
        first = np.concatenate([[0], np.cumsum(count)])
        for k in np.unique(count[count > 0]):
            frames = np.flatnonzero(count == k)
            index = pixel[first[frames][:, None] + np.arange(k)]
            filled[frames[:, None], index] = self._predicted(filled[frames], index)
        return filled

    def _predicted(self, pixels: PixelArray, index: IntArray) -> FloatArray:
        """Predictions (n, k) of the pixels ``index`` (n, k), which are 0 in ``pixels``."""
        design = self.design[index]
        gain = design @ self.covariance @ (design * self.weight[index][..., None]).swapaxes(1, 2)
        start = np.einsum("nkp,np->nk", design, self.solve(pixels))
        system = np.eye(index.shape[1]) - gain
        return np.asarray(np.linalg.solve(system, start[..., None])[..., 0])


def fringe_fit(model: FringeModel, variance: FloatArray, good: BoolArray) -> FringeFit:
    """Prepare the fit: pixels of a variance (n_y, n_x), those that are ``good`` only.

    Raises
    ------
    DataError
        Where the good pixels do not determine it.
    """
    return weighted_fit(model, np.where(good, 1.0 / variance, 0.0).ravel())


def weighted_fit(model: FringeModel, weight: FloatArray) -> FringeFit:
    """Prepare the fit with the inverse variances (n_pixels,).

    Raises
    ------
    DataError
        Where they do not determine it.
    """
    weighted = model.rows * np.sqrt(weight)
    normal = weighted @ weighted.T
    # Fringes of different frequency are nearly orthogonal: columns of like size keep the
    # normal equations well conditioned.
    scale = np.sqrt(np.diag(normal))
    try:
        factor = cho_factor(normal / np.outer(scale, scale))
    except (LinAlgError, ValueError):
        raise DataError("too few good pixels to tell the fringes apart") from None
    return FringeFit(model, cho_solve(factor, np.diag(1.0 / scale)) / scale[:, None], weight)


def fringe_sampling(
    view: View, basis: FringeBasis, fit: FringeFit, options: object = None
) -> OneEach:
    """Coefficients of the fit as flux, a sample per baseline, and background."""
    return OneEach.of(fit.inverse, view.instrument.mask, view.frequency_px)


def shift_of(view: View, samples: ComplexArray, weight: FloatArray | None = None) -> FloatArray:
    """Displacement (n, 2) in pixels that the phases (n, n_baselines) of fringes tell of."""
    phase = np.angle(samples) / (2.0 * np.pi)
    w = np.ones(phase.shape[1]) if weight is None else weight
    design = view.frequency_px * w[:, None]
    return np.asarray(-np.linalg.solve(design.T @ design, design.T @ (phase * w).T).T)


def centre_on(
    view: View, image: FloatArray, good: BoolArray, source: str, basis: FringeBasis | None = None
) -> tuple[View, FringeBasis, FringeFit]:
    """Move the view's centre to the star, by Gauss–Newton on the phases of its fringes.

    Where the ``basis`` of the view is given, its centre is nearly right already.

    Returns
    -------
    View, FringeBasis, FringeFit
        The basis is that of the view, and the fit's weights are even.

    Raises
    ------
    DataError
        Where it does not converge: another mask, filter or pixel scale made the image.
    """
    pixels = np.where(good, image, 0.0)
    even = np.ones(view.shape)
    if basis is None:
        view = view.moved(_shift_of_transform(view, pixels))
    for _ in range(MAX_STEPS):
        basis = basis or view.basis()
        fit = fringe_fit(FringeModel.of(basis), even, good)
        flux, samples = split(fit.solve(pixels.reshape(1, -1)))
        step = shift_of(view, samples, np.abs(samples[0]))[0]
        if np.hypot(*step) < CONVERGED_PX and flux[0] > 0.0:
            return view, basis, fit
        view, basis = view.moved(step), None
        if not flux[0] > 0.0 or np.abs(view.centre_px).max() > 0.5 * max(view.shape):
            break
    raise DataError(
        "no fringes of this mask are found in the images",
        source=source,
        remedy="check instrument, filter and pixel scale",
    )


def _shift_of_transform(view: View, image: FloatArray) -> FloatArray:
    """Displacement (2,) that the transform of an image tells of: cheap, and nearly right."""
    (x, y), (u, v) = view.axes_px(), view.frequency_px.T
    along_x, along_y = (np.exp(-2j * np.pi * np.outer(f, a)) for f, a in ((u, x), (v, y)))
    samples = np.einsum("by,by->b", along_y, along_x @ (image - np.median(image)).T)
    return np.asarray(shift_of(view, samples[None], np.abs(samples))[0])

"""What every integration of a cube goes through: one linear operator, and its residuals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.extraction.cleaning import Reference
from amibayes.extraction.fourier.sampling import PixelArray, Sampling
from amibayes.extraction.geometry import Geometry
from amibayes.extraction.image_plane import FringeFit
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.view import View
from amibayes.units import BoolArray, ComplexArray, FloatArray, SingleArray


@dataclass(frozen=True, eq=False)
class ExtractionOperator:
    """Everything that an integration goes through.

    Parameters
    ----------
    view : View
    geometry : Geometry
    reference : Reference
    fit : FringeFit
        Also of the Fourier methods, for which it fills bad pixels.
    scatter : (n_pixels,) array
        Of the residuals of good integrations.
    sampling : Sampling
        What is measured.
    variance : (n_pixels,) array
        Of the noise of one integration; 0 where a pixel is never used.
    skewness : (n_pixels,) array
        Its third cumulant.
    options : ExtractOptions
    """

    view: View
    geometry: Geometry
    reference: Reference
    fit: FringeFit
    scatter: SingleArray
    sampling: Sampling
    variance: FloatArray
    skewness: FloatArray
    options: ExtractOptions

    @cached_property
    def bias(self) -> tuple[float, FloatArray]:
        """What noise adds to flux² and to the power of every baseline."""
        return self.sampling.bias(self.variance)

    def measure(
        self, pixels: PixelArray, workspace: SingleArray | None = None
    ) -> tuple[FloatArray, SingleArray]:
        """Measure images (n, n_pixels), with the residuals of the fringe model.

        Both are those of the reference, and those of what an image differs by from it: the
        rounding of single precision is then that of a small number.

        Parameters
        ----------
        pixels : (n, n_pixels) array
        workspace : (2, n or more, n_pixels) array, optional
            Memory to work in; ``residual`` is part of it.

        Returns
        -------
        numbers : (n, m) array
            What the sampling needs first, and perhaps the coefficients of the fit.
        residual : (n, n_pixels) array
            Residual less that of the reference.
        """
        workspace = np.empty((2, *pixels.shape), np.float32) if workspace is None else workspace
        residual, model = workspace[:, : len(pixels)]
        single = pixels.dtype == np.float32
        off = np.subtract(pixels, self._usual, out=residual if single else None)
        beyond = off @ (self._single if single else self._operator)
        if not single:
            residual[...] = off
        coefficients = (beyond @ self._to_model).astype(np.float32)
        residual -= np.matmul(coefficients, self.fit.model.single, out=model)
        return beyond + self._known, residual

    def outlying(self, residual: SingleArray) -> BoolArray:
        """Pixels (n, n_pixels) with a larger residual than in other integrations."""
        return np.asarray(np.abs(residual) > np.float32(self.options.outlier) * self.scatter)

    def image_outliers(self, images: PixelArray, bad: BoolArray) -> BoolArray:
        """Outliers (n, n_pixels) from the reference, in images of the whole detector."""
        found = self.reference.outliers(images, bad, self.options.outlier)
        return found[:, self.view.rows, self.view.columns].reshape(len(images), -1)

    def misfit(self, flux: FloatArray, residual: SingleArray) -> FloatArray:
        """Residual of images of a flux (n,) in units of the reference at that flux, rms."""
        usual = self._usual_left
        own = (residual[:, None] @ residual[:, :, None]).ravel()
        power = own + 2.0 * (residual @ usual) + usual @ usual
        size = np.abs(flux / self._known[0]) * np.sqrt(float(self._usual @ self._usual))
        return np.asarray(np.sqrt(np.maximum(power, 0.0)) / np.maximum(size, 1e-300))

    def sampled(self, numbers: FloatArray, pixels: PixelArray) -> tuple[FloatArray, ComplexArray]:
        """Flux and samples of images whose `numbers` are known."""
        return self.sampling.completed(numbers[:, : self.sampling.linear.shape[1]], pixels)

    @cached_property
    def weight(self) -> FloatArray:
        """(n_baselines,) of the phases that tell where an integration points: amplitudes."""
        _, samples = self.sampled(self._known[None], self._usual[None])
        return np.asarray(np.abs(self.sampling.fringes(samples)[0]))

    @cached_property
    def _operator(self) -> FloatArray:
        """(n_pixels, m): images times this are the numbers."""
        linear = self.sampling.linear
        return (
            linear
            if self.sampling.determines_model
            else np.concatenate([linear, self.fit.inverse], axis=1)
        )

    @cached_property
    def _to_model(self) -> FloatArray:
        """(m, n_coefficients): numbers times this are coefficients of the model."""
        if (
            self.sampling.determines_model and self.options.method != "fringes"
        ):  # which are coefficients
            return np.asarray(np.linalg.inv(self.fit.design.T @ self._operator))
        n = self.fit.n_coefficients
        return np.eye(self._operator.shape[1], n, n - self._operator.shape[1])

    @cached_property
    def _single(self) -> SingleArray:
        """`_operator` in single precision, for the product that costs most."""
        return np.ascontiguousarray(self._operator, dtype=np.float32)

    @cached_property
    def _usual(self) -> SingleArray:
        """(n_pixels,) the reference image."""
        return self.reference.image[self.view.part].ravel().astype(np.float32)

    @cached_property
    def _known(self) -> FloatArray:
        """(m,) its numbers."""
        return np.asarray(self._usual.astype(float) @ self._operator)

    @cached_property
    def _usual_left(self) -> SingleArray:
        """(n_pixels,) what the fit leaves of it."""
        coefficients = (self._known @ self._to_model).astype(np.float32)
        return np.asarray(self._usual - coefficients @ self.fit.model.single)

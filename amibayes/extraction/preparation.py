"""What all integrations of a cube go through, prepared once."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from amibayes.cube.source import Source
from amibayes.errors import DataError
from amibayes.extraction.cleaning import Reference, median_and_scatter, reference_of, without_hot
from amibayes.extraction.fourier.sampling import split
from amibayes.extraction.geometry import Geometry, fit_geometry
from amibayes.extraction.image_plane import (
    FringeFit,
    centre_on,
    fringe_fit,
    shift_of,
)
from amibayes.extraction.mask_map import MapEstimate, MaskMap, combined, estimate_map
from amibayes.extraction.noise import (
    NoiseModel,
    cropped,
    misfit_level,
    noise_model,
    scatter_about_pointing,
)
from amibayes.extraction.operator import ExtractionOperator
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.view import View, look_at
from amibayes.instrument import Distortion
from amibayes.optics import FringeBasis
from amibayes.support.options import EXTRACTION_METHODS, entry
from amibayes.units import BoolArray, FloatArray, SingleArray

MAX_RESIDUAL = 0.25
"""An image whose fit leaves a larger share of it, rms, was made by another mask or filter."""

SMOOTH_SHARE, SMOOTH_FLOOR = 0.98, 0.003
"""How far the weights follow the envelope only, and its least value in units of its peak."""

JITTER_SLACK = 0.01
"""Share of the light about a pixel by which the pointing may change its residual, 1σ."""


def maps_mask(file: Source, options: ExtractOptions) -> bool:
    """Whether what fringes say of scale and rotation is the mask's: the pixels are known."""
    return options.geometry == "fitted" and file.template.pixels_known


def map_estimate(file: Source, options: ExtractOptions) -> tuple[MapEstimate | None, Distortion]:
    """What the images of one file say of the map of the mask, and the prior of it."""
    template = file.template
    reference = reference_of(file)
    view = look_at(reference.image, template, options)
    prior = view.instrument.distortion
    reference, view, _, even = _centred(reference, view.mapped(prior.matrix))
    image = reference.image[view.part]
    return estimate_map(view, image, _fit_of_median(view, even, reference)), prior


def make_operator(
    file: Source, options: ExtractOptions, mask_map: MaskMap | None = None
) -> ExtractionOperator:
    """Prepare all that the integrations of a cube go through.

    Parameters
    ----------
    file : Source
    options : ExtractOptions
    mask_map : MaskMap, optional
        That of the visit; by default what this file alone says, where its pixels are known.
    """
    template = file.template
    if mask_map is None and maps_mask(file, options):
        estimate, prior = map_estimate(file, options)
        mask_map = combined([estimate], prior)
    reference = reference_of(file)
    view = look_at(reference.image, template, options)
    if mask_map is not None:
        view = view.mapped(mask_map.matrix)
    reference, view, basis, even = _centred(reference, view)
    image, good = reference.image[view.part], reference.good[view.part]
    geometry = Geometry(mask_map=mask_map)
    if options.geometry == "fitted" and mask_map is None:
        median = _fit_of_median(view, even, reference)
        view, geometry, basis = fit_geometry(view, image, median, basis)
    if not geometry.stated and mask_map is None:
        view, basis, even = centre_on(view, image, good, template.source, basis)
    noise, level, scatter = _noise_and_misfit(view, even, reference)
    fit = fringe_fit(even.model, _fit_variance(basis, image, noise, good) + level, good)
    make_sampling = entry(EXTRACTION_METHODS[options.method])
    sampling = make_sampling(view, basis, fit, options)
    variance, third = (np.where(good, a, 0.0).ravel() for a in (noise.variance, noise.skewness))
    return ExtractionOperator(
        view, geometry, reference, fit, scatter, sampling, variance, third, options
    )


def _centred(reference: Reference, view: View) -> tuple[Reference, View, FringeBasis, FringeFit]:
    """Move the view to the star, and leave out of the reference the pixels that are hot."""
    seen = reference.image[view.part], reference.good[view.part]
    view, basis, even = centre_on(view, *seen, reference.source)
    clean = without_hot(reference, view, even)
    if clean is not reference:
        seen = clean.image[view.part], clean.good[view.part]
        view, basis, even = centre_on(view, *seen, clean.source)
    return clean, view, basis, even


def _fit_of_median(view: View, even: FringeFit, reference: Reference) -> FringeFit:
    """Fit of the median image with its own weights, out of one with ``even`` weights."""
    image, good = reference.image[view.part], reference.good[view.part]
    residual = image - (even.design @ even.solve(image.reshape(1, -1))[0]).reshape(view.shape)
    noise = cropped(reference.noise, view.part)
    if not reference.has_errors and len(reference.sample) < 3:
        noise = noise_model(image, residual**2, good)
    variance = noise.variance * (np.pi / 2.0 / len(reference.sample))  # of a median
    return fringe_fit(even.model, variance + misfit_level(residual, variance, good), good)


def _fit_variance(
    basis: FringeBasis, image: FloatArray, noise: NoiseModel, good: BoolArray
) -> FloatArray:
    """Variance that the fit's weights are made of: that of a single star of the same light.

    The image's own fringes have no part in it. Light off the axis is let through in a way
    that depends on the weights; were those of a binary to follow its fringes, and those of its
    calibrator another pattern, a contrast of 0.4 would come out half a percent too small.
    All but a fiftieth of it is the envelope's: weights that follow the fringes have up to a
    tenth less noise, but let a companion's light through as the fringes of other baselines
    too, by some percent that depend on where in a pixel the star stands.
    """
    envelope, star = (a.reshape(image.shape) for a in (basis.matrix[:, 0], basis.image()))
    light = float(image[good].sum() / max(float(envelope[good].sum()), 1e-300))
    smooth = envelope + SMOOTH_FLOOR * envelope.max()
    shape = (1.0 - SMOOTH_SHARE) * np.maximum(star, 0.0) + SMOOTH_SHARE * smooth
    return np.asarray(noise.constant + noise.per_signal * max(light, 0.0) * shape)


def _noise_and_misfit(
    view: View, fit: FringeFit, reference: Reference
) -> tuple[NoiseModel, float, SingleArray]:
    """Noise of a pixel, and what the model cannot follow, from residuals of single fits.

    Where the cube has no errors of its own, the noise is what differs between the
    residuals: the fits, whose weights are even, have followed the pointing.
    """
    image, good = reference.image[view.part], reference.good[view.part]
    sample = reference.sample[(slice(None), *view.part)]
    missing = np.isnan(sample) | ~good
    flat = (len(sample), -1)
    pixels = fit.fill(np.where(missing, 0.0, sample).reshape(flat), missing.reshape(flat))
    coefficients = fit.solve(pixels)
    residual = pixels.astype(np.float32) - coefficients.astype(np.float32) @ fit.model.single
    mean = residual.mean(axis=0).reshape(image.shape)
    noise = cropped(reference.noise, view.part)
    _refuse_another(image, mean, noise, good, reference)
    if not reference.has_errors and len(sample) < 3:
        noise = noise_model(image, (residual[0] ** 2).reshape(image.shape), good)
    elif not reference.has_errors:
        _, samples = split(coefficients)
        spread = scatter_about_pointing(residual, shift_of(view, samples)).reshape(view.shape)
        noise = noise_model(image, spread * good.sum() / (good.sum() - fit.design.shape[1]), good)
    level = misfit_level(mean, noise.variance / len(sample), good)
    return noise, level, _scatter(residual, image, noise)


def _scatter(residual: SingleArray, image: FloatArray, noise: NoiseModel) -> SingleArray:
    """Robust scatter (n_pixels,) of the residuals (n, n_pixels) of some integrations."""
    spread = median_and_scatter(residual)[1].reshape(image.shape)
    # A scatter of few integrations may be small by chance: its surroundings have a say.
    around = np.sqrt(uniform_filter(spread**2, 5))
    slack = JITTER_SLACK * maximum_filter(np.abs(image), 3)
    scatter = np.maximum(spread, around) + np.sqrt(noise.variance) + slack
    return np.asarray(scatter.astype(np.float32).ravel())


def _refuse_another(
    image: FloatArray,
    residual: FloatArray,
    noise: NoiseModel,
    good: BoolArray,
    reference: Reference,
) -> None:
    """Refuse images that this mask and filter did not make.

    Raises
    ------
    DataError
        Where the fit leaves too much of the light.
    """
    expected = float(noise.variance[good].sum()) / len(reference.sample)
    excess = float((residual[good] ** 2).sum()) - expected
    share = np.sqrt(max(excess, 0.0) / max(float((image[good] ** 2).sum()), 1e-300))
    if share > MAX_RESIDUAL:
        raise DataError(
            f"the fringes of this mask and filter leave {100.0 * share:.0f} % of the image",
            source=reference.source,
            remedy="check instrument, filter, pixel scale; the images may be turned or mirrored",
        )

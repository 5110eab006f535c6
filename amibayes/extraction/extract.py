"""The whole way from images to observables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter
from scipy.sparse import csr_array

from amibayes.cube import Cube
from amibayes.errors import DataError
from amibayes.extraction.averaging import Average, average, standing_off
from amibayes.extraction.cleaning import (
    BoolArray,
    Reference,
    median_and_scatter,
    reference_of,
)
from amibayes.extraction.fourier import fourier_sampling
from amibayes.extraction.frames import Bench, Frames, concatenated, measure, select
from amibayes.extraction.geometry import Geometry, fit_geometry
from amibayes.extraction.image_plane import (
    FringeFit,
    SingleArray,
    centre_on,
    fringe_fit,
    fringe_sampling,
    shift_of,
)
from amibayes.extraction.low_flux import expected_covariance
from amibayes.extraction.noise import (
    NoiseModel,
    cropped,
    misfit_level,
    noise_model,
    scatter_about_pointing,
)
from amibayes.extraction.options import ExtractOptions, Method
from amibayes.extraction.response import off_axis_response, pointing_response, star_image
from amibayes.extraction.sampling import split
from amibayes.extraction.shrinkage import Shrunk, shrunk_covariance
from amibayes.extraction.source import Source, opened
from amibayes.extraction.table import independent_basis, observables_of, target_of
from amibayes.extraction.view import View, look_at
from amibayes.observables import Observables, join
from amibayes.optics import FringeBasis
from amibayes.optics.psf import ComplexArray
from amibayes.response import Response
from amibayes.units import FloatArray

MOST_LEFT = 0.25
"""An image whose fit leaves a larger share of it, rms, was made by another mask or filter."""

SMOOTH_SHARE, SMOOTH_FLOOR = 0.98, 0.003
"""How far the weights follow the envelope only, and its least value in units of its peak."""

JITTER_SLACK = 0.01
"""Share of the light about a pixel by which the pointing may change its residual, 1σ."""

NYQUIST = 0.5
"""Cycles per pixel beyond which fringes look like others."""

LARGEST_SHIFT_PX = 1.5
"""Integrations that point farther from the others are not used."""


@dataclass(frozen=True, eq=False)
class Extraction:
    """Everything that came out of the cubes of one instrument, filter and orientation.

    Parameters
    ----------
    observables : Observables
    frames : Frames
        All integrations, those that were not used too.
    average : Average
        Of those that were used.
    covariance : Shrunk
        Of one integration.
    physical : (m, m) array
        Covariance of one integration that photon and read noise make.
    benches : tuple of Bench
        One per file: view, reference image, operators.
    options : ExtractOptions
    sources : tuple of str
    """

    observables: Observables
    frames: Frames
    average: Average
    covariance: Shrunk
    physical: FloatArray
    benches: tuple[Bench, ...]
    options: ExtractOptions
    sources: tuple[str, ...]

    @property
    def rejected(self) -> list[tuple[str, int, str]]:
        """File, number and reason of the integrations that were not used."""
        frames = self.frames
        return [
            (self.sources[int(frames.file[k])], int(frames.number[k]), str(frames.reason[k]))
            for k in np.flatnonzero(~frames.used)
        ]


def extract(
    cubes: Cube | str | Path | Sequence[Cube | str | Path],
    method: Method = "fringes",
    *,
    options: ExtractOptions | None = None,
    **header: Any,
) -> Observables:
    """Measure V², closure phases and their joint covariance in images.

    Parameters
    ----------
    cubes : Cube, path, or a sequence of them
        Files of one instrument, filter and orientation are one exposure; others are laid
        side by side.
    method : {"fringes", "matched", "fft", "gauss", "square", "unique"}
        Fit of the images, or ways to sample their Fourier transform.
    options : ExtractOptions, optional
        Everything else; ``method`` goes before its own.
    **header
        ``instrument``, ``filter``, ``pixel_scale_rad``, ``position_angle_deg`` in place of
        what the files say.

    Returns
    -------
    Observables

    Raises
    ------
    DataError
        Where a file cannot be read, or nothing in it can be measured.
    """
    chosen = replace(options or ExtractOptions(), method=method)
    return join([e.observables for e in extract_all(cubes, chosen, **header)])


def extract_all(
    cubes: Cube | str | Path | Sequence[Cube | str | Path],
    options: ExtractOptions | None = None,
    **header: Any,
) -> list[Extraction]:
    """As `extract`, with everything that was found on the way, one for each exposure."""
    given = [cubes] if isinstance(cubes, Cube | str | Path) else list(cubes)
    if not given:
        raise DataError("no cube to extract", remedy="give at least one file")
    chosen = options or ExtractOptions()
    parts = [_measured(cube, index, chosen, header) for index, cube in enumerate(given)]
    groups: dict[tuple[Any, ...], list[_Part]] = {}
    for part in parts:
        t = part.template
        key = (
            target_of(t).casefold(),
            t.instrument.upper(),
            t.filter.upper(),
            t.orientation,
            round(t.pixel_scale_rad, 12),
        )
        groups.setdefault(key, []).append(part)
    return [_finished(group, chosen) for group in groups.values()]


@dataclass(frozen=True, eq=False)
class _Part:
    """One file."""

    template: Cube
    bench: Bench
    frames: Frames
    physical: FloatArray
    response: Response
    pointed: ComplexArray


def _measured(
    cube: Cube | str | Path, index: int, options: ExtractOptions, header: dict[str, Any]
) -> _Part:
    with opened(cube, **header) as file:
        bench = make_bench(file, options)
        frames, samples, flux = measure(bench, file, index)
    template = file.template
    if not options.keep_all:
        frames = replace(frames, reason=select(frames, options.clip, LARGEST_SHIFT_PX))
    if not frames.used.any():
        raise DataError(f"no integration can be used: {frames.reason[0]}", source=template.source)
    star = star_image(bench.view)
    centre = frames.shift_px[frames.used].mean(axis=0)
    response = off_axis_response(star, bench.sampling, template.orientation, centre)
    return _Part(
        template,
        bench,
        frames,
        expected_covariance(bench.sampling, flux, samples, bench.variance, bench.skewness),
        response,
        pointing_response(star, bench.sampling, frames.shift_px),
    )


def make_bench(file: Source, options: ExtractOptions) -> Bench:
    """Look at a cube once, and prepare all that its integrations go through."""
    template = file.template
    reference = reference_of(file)
    view = look_at(reference.image, template, options)
    image, good = reference.image[view.part], reference.good[view.part]
    view, basis, even = centre_on(view, image, good, template.source)
    geometry = Geometry()
    if options.geometry == "fitted":
        median = _fit_of_median(view, even, reference)
        view, geometry, basis = fit_geometry(view, image, median, basis)
    if not geometry.stated:
        view, basis, even = centre_on(view, image, good, template.source, basis)
    noise, level, scatter = _noise_and_misfit(view, even, reference)
    fit = fringe_fit(even.model, _fit_variance(basis, image, noise, good) + level, good)
    sampling = (
        fringe_sampling(fit, view)
        if options.method == "fringes"
        else fourier_sampling(view, basis, options)
    )
    variance, third = (np.where(good, a, 0.0).ravel() for a in (noise.variance, noise.skewness))
    return Bench(view, geometry, reference, fit, scatter, sampling, variance, third, options)


def _fit_of_median(view: View, even: FringeFit, reference: Reference) -> FringeFit:
    """Fit of the median image with its own weights, out of one with ``even`` weights."""
    image, good = reference.image[view.part], reference.good[view.part]
    left = image - (even.design @ even.solve(image.reshape(1, -1))[0]).reshape(view.shape)
    noise = cropped(reference.noise, view.part)
    if not reference.has_errors and len(reference.sample) < 3:
        noise = noise_model(image, left**2, good)
    variance = noise.variance * (np.pi / 2.0 / len(reference.sample))  # of a median
    return fringe_fit(even.model, variance + misfit_level(left, variance, good), good)


def _fit_variance(
    basis: FringeBasis, image: FloatArray, noise: NoiseModel, good: BoolArray
) -> FloatArray:
    """Variance that the fit's weights are made of: that of a single star of the same light.

    The image's own fringes have no part in it. Light off the axis is let through in a way
    that hangs on the weights; were those of a binary to follow its fringes, and those of its
    calibrator another pattern, a contrast of 0.4 would come out half a percent too small.
    All but a fiftieth of it is the envelope's: weights that follow the fringes have up to a
    tenth less noise, but let a companion's light through as the fringes of other baselines
    too, by some percent that hang on where in a pixel the star stands.
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
    left = float((residual[good] ** 2).sum()) - expected
    share = np.sqrt(max(left, 0.0) / max(float((image[good] ** 2).sum()), 1e-300))
    if share > MOST_LEFT:
        raise DataError(
            f"the fringes of this mask and filter leave {100.0 * share:.0f} % of the image",
            source=reference.source,
            remedy="check instrument, filter and pixel scale",
        )


def _finished(parts: list[_Part], options: ExtractOptions) -> Extraction:
    """One exposure out of its files: average, covariance, table."""
    view = parts[0].bench.view
    frames, mean, physical = _together(parts, options)
    n_vis2 = view.instrument.mask.n_baselines
    basis = independent_basis(view)
    shrunk = shrunk_covariance(mean.deviation, physical, basis, n_vis2, options.covariance)
    observables = _tabled(parts[0], frames, mean, shrunk)
    benches = tuple(p.bench for p in parts)
    sources = tuple(p.template.source for p in parts)
    return Extraction(observables, frames, mean, shrunk, physical, benches, options, sources)


def _together(parts: list[_Part], options: ExtractOptions) -> tuple[Frames, Average, FloatArray]:
    """Integrations of all files, those that stand off marked, their mean, and their noise."""
    frames = concatenated([p.frames for p in parts])
    pointed = np.concatenate([p.pointed for p in parts])
    count = np.array([p.frames.used.sum() for p in parts], dtype=float)
    physical = np.einsum("k,kij->ij", count / count.sum(), np.stack([p.physical for p in parts]))
    triangles = parts[0].bench.view.instrument.mask.triangle_baselines
    mean = average(frames.select(frames.used), pointed[frames.used], triangles)
    if not options.keep_all:
        off = np.zeros(len(frames), dtype=bool)
        off[frames.used] = standing_off(mean.deviation, np.sqrt(np.diag(physical)), options.clip)
        if off.any():
            reason = np.where(off, "observables stand off the others'", frames.reason)
            frames = replace(frames, reason=reason)
            mean = average(frames.select(frames.used), pointed[frames.used], triangles)
    return frames, mean, np.asarray(physical)


def _tabled(part: _Part, frames: Frames, mean: Average, shrunk: Shrunk) -> Observables:
    n = int(frames.used.sum())
    scatter = None if shrunk.carried is None else csr_array(shrunk.scatter / n)
    return observables_of(
        part.bench.view,
        part.template,
        mean,
        shrunk.matrix / n,
        n_integrations=n if n > 1 else None,
        kind="estimated" if n > 1 else "given",
        freedom=shrunk.carried,
        scatter=scatter,
        response=part.response,
        mjd=_mjd(frames, part.template),
        integration_s=n * (part.template.integration_time_s or 0.0),
        notes=_notes(part.bench.view, frames, shrunk),
    )


def _mjd(frames: Frames, template: Cube) -> float:
    """Mean time of what was used; 0 where nothing tells it."""
    known = frames.mjd[frames.used & np.isfinite(frames.mjd)]
    if len(known):
        return float(known.mean())
    for key in ("EXPMID", "MJD-AVG", "MJD-OBS"):
        value = template.header.get(key)
        if isinstance(value, int | float):
            return float(value)
    return 0.0


def _notes(view: View, frames: Frames, shrunk: Shrunk) -> tuple[str, ...]:
    notes = []
    coarse = int((np.abs(view.frequency_px).max(axis=1) > NYQUIST).sum())
    if coarse:
        notes.append(
            f"the pixels are too large for the fringes of {coarse} of {len(view.frequency_px)} "
            "baselines: what is measured of light off the axis hangs on where in a pixel the star "
            "stands, by some percent of a faint companion's light and more of a bright one's"
        )
    lost = int((~frames.used).sum())
    if lost:
        notes.append(f"{lost} of {len(frames)} integrations not used")
    if shrunk.block > 1:
        notes.append(
            f"integrations are correlated in time ({shrunk.correlation:.2f} from one to the "
            f"next): the covariance rests on means of {shrunk.block}"
        )
    return tuple(notes)

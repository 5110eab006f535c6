"""Numbers of every integration, and which of the integrations are kept."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from amibayes.cube import Cube
from amibayes.extraction.cleaning import MAX_BAD, TO_SIGMA, Reference
from amibayes.extraction.fourier.sampling import OneEach, PixelArray, Sampling
from amibayes.extraction.geometry import Geometry
from amibayes.extraction.image_plane import FringeFit, shift_of
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.source import Source
from amibayes.extraction.view import View
from amibayes.units import BoolArray, ComplexArray, FloatArray, IntArray, SingleArray

CHUNK, CHUNK_PIXELS = 64, 2**23
"""Integrations that are worked on together; fewer where they are large."""


@dataclass(frozen=True, eq=False)
class Frames:
    """What was measured in every integration.

    Parameters
    ----------
    flux : (n,) array
    shift_px : (n, 2) array
        Of the star from the centre of the view.
    power : (n, n_baselines) array
        V² times flux², noise bias taken off.
    square : (n,) array
        Flux², noise bias taken off.
    bispectrum : (n, n_triangles) complex array
    misfit : (n,) array
        Residual of the fringe fit as a share of the image, rms.
    n_bad : (n,) array
        Pixels left out.
    mjd : (n,) array
    file : (n,) int array
        Which of the files it is in.
    number : (n,) int array
        Its number there.
    reason : (n,) array of str
        Why it is not used; empty where it is.
    """

    flux: FloatArray
    shift_px: FloatArray
    power: FloatArray
    square: FloatArray
    bispectrum: ComplexArray
    misfit: FloatArray
    n_bad: IntArray
    mjd: FloatArray
    file: IntArray
    number: IntArray
    reason: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.flux)

    @property
    def used(self) -> BoolArray:
        """Integrations without a reason against them."""
        return np.asarray(self.reason == "")

    def select(self, keep: BoolArray) -> Frames:
        """The integrations ``keep``."""
        return Frames(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})


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
        Of what a fit leaves of good integrations.
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

    def look(
        self, pixels: PixelArray, room: SingleArray | None = None
    ) -> tuple[FloatArray, SingleArray]:
        """Measure images (n, n_pixels), and tell what the model of the fringes leaves of them.

        Both are those of the reference, and those of what an image differs by from it: the
        rounding of single precision is then that of a small number.

        Parameters
        ----------
        pixels : (n, n_pixels) array
        room : (2, n or more, n_pixels) array, optional
            Memory to work in; ``left`` is part of it.

        Returns
        -------
        numbers : (n, m) array
            What the sampling needs first, and perhaps the coefficients of the fit.
        left : (n, n_pixels) array
            Residual less that of the reference.
        """
        room = np.empty((2, *pixels.shape), np.float32) if room is None else room
        left, model = room[:, : len(pixels)]
        single = pixels.dtype == np.float32
        off = np.subtract(pixels, self._usual, out=left if single else None)
        beyond = off @ (self._single if single else self._operator)
        if not single:
            left[...] = off
        coefficients = (beyond @ self._to_model).astype(np.float32)
        left -= np.matmul(coefficients, self.fit.model.single, out=model)
        return beyond + self._known, left

    def standing_off(self, left: SingleArray) -> BoolArray:
        """Pixels (n, n_pixels) of which more is left than of other integrations."""
        return np.asarray(np.abs(left) > np.float32(self.options.outlier) * self.scatter)

    def outliers(self, images: PixelArray, bad: BoolArray) -> BoolArray:
        """Pixels (n, n_pixels) of images of the whole detector that stand off the reference."""
        found = self.reference.outliers(images, bad, self.options.outlier)
        return found[:, self.view.rows, self.view.columns].reshape(len(images), -1)

    def misfit(self, flux: FloatArray, left: SingleArray) -> FloatArray:
        """Residual of images of a flux (n,) in units of the reference at that flux, rms."""
        usual = self._usual_left
        own = (left[:, None] @ left[:, :, None]).ravel()
        power = own + 2.0 * (left @ usual) + usual @ usual
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

    @property
    def _complete(self) -> bool:
        """Whether what is measured determines the whole model."""
        return isinstance(self.sampling, OneEach)

    @cached_property
    def _operator(self) -> FloatArray:
        """(n_pixels, m): images times this are the numbers."""
        linear = self.sampling.linear
        return linear if self._complete else np.concatenate([linear, self.fit.inverse], axis=1)

    @cached_property
    def _to_model(self) -> FloatArray:
        """(m, n_coefficients): numbers times this are coefficients of the model."""
        if self._complete and self.options.method != "fringes":  # which are coefficients
            return np.asarray(np.linalg.inv(self.fit.design.T @ self._operator))
        n = self.fit.n_coefficients
        return np.eye(self._operator.shape[1], n, n - self._operator.shape[1])

    @cached_property
    def _single(self) -> SingleArray:
        if isinstance(self.sampling, OneEach):
            return self.sampling.single
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


def measure(
    bench: ExtractionOperator, file: Source, index: int
) -> tuple[Frames, ComplexArray, float]:
    """Measure every integration of a file, which is number ``index`` of its set.

    Returns
    -------
    frames : Frames
    samples : (n_samples,) complex array
        Mean of the samples, each integration moved back to the centre.
    flux : float
        Mean flux.
    """
    parts, flux, count = [], 0.0, 0
    total = np.zeros(bench.sampling.n_samples, dtype=complex)
    size = _chunk_size(file)
    room = np.empty((2, size, len(bench.scatter)), np.float32)
    for start in range(0, file.n_integrations, size):
        cube = file.read(start, min(start + size, file.n_integrations))
        frames, samples = _measure_chunk(bench, cube, room)
        lit = frames.used
        total += bench.sampling.centred(samples[lit], frames.shift_px[lit])
        flux, count = flux + float(frames.flux[lit].sum()), count + int(lit.sum())
        parts.append(frames)
    joined = concatenated(parts)
    number = np.arange(len(joined))
    return (
        replace(joined, number=number, file=np.full(len(number), index)),
        np.asarray(total / max(count, 1), dtype=complex),
        flux / max(count, 1),
    )


def concatenated(parts: list[Frames]) -> Frames:
    """Lay integrations end to end."""
    return Frames(
        **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Frames)}
    )


def _chunk_size(file: Source) -> int:
    n_y, n_x = file.template.images.shape[1:]
    return min(CHUNK, file.n_integrations, max(int(CHUNK_PIXELS // (n_y * n_x)), 1))


def _measure_chunk(
    bench: ExtractionOperator, cube: Cube, room: SingleArray
) -> tuple[Frames, ComplexArray]:
    pixels, numbers, misfit, n_bad = _cleaned(bench, cube, room)
    flux, samples = bench.sampled(numbers, pixels)
    own, extra = bench.bias
    n = cube.n_integrations
    hopeless = n_bad > MAX_BAD * pixels.shape[1]
    reason = np.where(hopeless, "too many bad pixels", np.where(flux > 0.0, "", "no light"))
    return (
        Frames(
            flux,
            shift_of(bench.view, bench.sampling.fringes(samples), bench.weight),
            bench.sampling.power(samples) - extra,
            flux**2 - own,
            bench.sampling.bispectrum(samples),
            misfit,
            n_bad,
            np.full(n, np.nan) if cube.mjd is None else cube.mjd,
            np.zeros(n, dtype=int),
            np.zeros(n, dtype=int),
            reason.astype("U60"),
        ),
        samples,
    )


def _cleaned(
    bench: ExtractionOperator, cube: Cube, room: SingleArray
) -> tuple[PixelArray, FloatArray, FloatArray, IntArray]:
    """Give pixels that are flagged, or stand off, the values that a fit predicts.

    Only where the fit of an integration leaves something that it does not of others is it
    looked for: what stands off the reference, and then what a fit without that leaves.

    Returns
    -------
    pixels : (n, n_pixels) array
    numbers : (n, m) array
        Those of the bench.
    misfit : (n,) array
        Residual as a share of the image, rms.
    n_bad : (n,) int array
        Pixels left out, of those that are ever used.
    """
    view, n, fit = bench.view, cube.n_integrations, bench.fit
    bad = cube.bad
    images = np.where(bad, 0.0, cube.images) if bad.any() else cube.images
    part = np.s_[:, view.rows, view.columns]
    pixels, missing = images[part].reshape(n, -1), bad[part].reshape(n, -1)
    filled = _filled(fit, pixels, missing)
    numbers, left = bench.look(filled, room)
    hit = np.flatnonzero(bench.standing_off(left).any(axis=1))
    if len(hit):
        wrong = missing[hit] | bench.outliers(images[hit], bad[hit])
        wrong |= bench.standing_off(bench.look(_filled(fit, pixels[hit], wrong))[1])
        filled, missing[hit] = np.array(filled), wrong
        filled[hit] = _filled(fit, pixels[hit], wrong)
        numbers[hit], left[hit] = bench.look(filled[hit])
    n_bad = np.count_nonzero(missing & fit.used, axis=1) if missing.any() else np.zeros(n, int)
    return filled, numbers, bench.misfit(numbers[:, 0], left), n_bad


def _filled(fit: FringeFit, pixels: PixelArray, missing: BoolArray) -> PixelArray:
    """Pixels with the missing ones filled, unless there are too many."""
    gone = missing | ~fit.used
    if gone.any():
        hopeless = np.count_nonzero(missing & fit.used, axis=1) > MAX_BAD * missing.shape[1]
        pixels = fit.fill(pixels, gone & ~hopeless[:, None])
    return pixels


def select(frames: Frames, limit: float, largest_shift_px: float) -> NDArray[np.str_]:
    """Say why integrations are not to be used: flux, pointing, shape.

    Returns
    -------
    (n,) array of str
        Empty where nothing speaks against an integration.
    """
    reason = frames.reason.copy()
    for name, values, floor in _criteria(frames):
        used = reason == ""
        if used.sum() < 3:
            break
        middle = np.median(values[used])
        spread = max(TO_SIGMA * float(np.median(np.abs(values[used] - middle))), floor, 1e-300)
        off = (values - middle) / spread
        hit = used & (np.abs(off) > look_elsewhere(limit, int(used.sum())))
        reason[hit] = [f"{name} stands off by {o:.1f} sigma" for o in off[hit]]
    used = reason == ""
    if used.any():
        away = np.hypot(*(frames.shift_px - np.median(frames.shift_px[used], axis=0)).T)
        hit = used & (away > largest_shift_px)
        reason[hit] = [f"star is {a:.2f} pixels off" for a in away[hit]]
    return np.asarray(reason)


def _criteria(frames: Frames) -> list[tuple[str, FloatArray, float]]:
    """Names, values, and the least scatter that counts."""
    lit = np.maximum(frames.flux, 0.0)
    middle = float(np.median(lit[frames.used])) if frames.used.any() else 0.0
    return [("flux", lit, 1e-3 * middle), ("shape", frames.misfit, 0.02)]


def look_elsewhere(limit: float, n: int) -> float:
    """The limit that one of ``n`` exceeds as rarely as a single one exceeds ``limit``."""
    return float(-ndtri(ndtr(-limit) / max(n, 1)))

"""Numbers of every integration, which of the integrations are kept, and their average."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from amibayes.cube import Cube
from amibayes.cube.source import Source
from amibayes.data.outliers import TO_SIGMA, look_elsewhere
from amibayes.errors import DataError
from amibayes.extraction.cleaning import MAX_BAD
from amibayes.extraction.fourier.sampling import PixelArray
from amibayes.extraction.image_plane import FringeFit, shift_of
from amibayes.extraction.operator import ExtractionOperator
from amibayes.units import BoolArray, ComplexArray, FloatArray, IntArray, SingleArray

CHUNK, CHUNK_PIXELS = 64, 2**23
"""Integrations that are worked on together; fewer where they are large."""

STAR = 5.0
"""A star's flux is more than its error times this in one integration at least; thousands of
images of noise do not come near."""


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


def measure_file(
    operator: ExtractionOperator, file: Source, index: int
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
    total = np.zeros(operator.sampling.n_samples, dtype=complex)
    size = _chunk_size(file)
    workspace = np.empty((2, size, len(operator.scatter)), np.float32)
    for start in range(0, file.n_integrations, size):
        cube = file.read(start, min(start + size, file.n_integrations))
        frames, samples = _measure_chunk(operator, cube, workspace)
        lit = frames.used
        total += operator.sampling.centred(samples[lit], frames.shift_px[lit])
        flux, count = flux + float(frames.flux[lit].sum()), count + int(lit.sum())
        parts.append(frames)
    joined = concatenated(parts)
    number = np.arange(len(joined))
    return (
        replace(joined, number=number, file=np.full(len(number), index)),
        np.asarray(total / max(count, 1), dtype=complex),
        flux / max(count, 1),
    )


def refuse_starless(frames: Frames, source: str) -> None:
    """Refuse images in which no star is seen.

    Raises
    ------
    DataError
    """
    error = np.sqrt(np.maximum(frames.flux**2 - frames.square, 0.0))
    if (frames.flux > STAR * error).any():
        return
    best = int(np.argmax(frames.flux))
    raise DataError(
        f"no star is seen: the flux of the brightest integration is {frames.flux[best]:.3g} ± "
        f"{error[best]:.2g}",
        source=source,
        remedy="check that the images hold the star and that ERR is theirs",
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
    operator: ExtractionOperator, cube: Cube, workspace: SingleArray
) -> tuple[Frames, ComplexArray]:
    pixels, numbers, misfit, n_bad = _cleaned(operator, cube, workspace)
    flux, samples = operator.sampled(numbers, pixels)
    own, extra = operator.bias
    n = cube.n_integrations
    too_many = n_bad > MAX_BAD * pixels.shape[1]
    reason = np.where(too_many, "too many bad pixels", np.where(flux > 0.0, "", "no light"))
    return (
        Frames(
            flux,
            shift_of(operator.view, operator.sampling.fringes(samples), operator.weight),
            operator.sampling.power(samples) - extra,
            flux**2 - own,
            operator.sampling.bispectrum(samples),
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
    operator: ExtractionOperator, cube: Cube, workspace: SingleArray
) -> tuple[PixelArray, FloatArray, FloatArray, IntArray]:
    """Give pixels that are flagged, or outliers, the values that a fit predicts.

    Only where the residual of an integration is not that of the others are they
    looked for: outliers from the reference, then outliers of a fit without those.

    Returns
    -------
    pixels : (n, n_pixels) array
    numbers : (n, m) array
        Those of `ExtractionOperator.measure`.
    misfit : (n,) array
        Residual as a share of the image, rms.
    n_bad : (n,) int array
        Pixels left out, of those that are ever used.
    """
    view, n, fit = operator.view, cube.n_integrations, operator.fit
    bad = cube.bad
    images = np.where(bad, 0.0, cube.images) if bad.any() else cube.images
    part = np.s_[:, view.rows, view.columns]
    pixels, missing = images[part].reshape(n, -1), bad[part].reshape(n, -1)
    filled = _filled(fit, pixels, missing)
    numbers, residual = operator.measure(filled, workspace)
    hit = np.flatnonzero(operator.outlying(residual).any(axis=1))
    if len(hit):
        wrong = missing[hit] | operator.image_outliers(images[hit], bad[hit])
        wrong |= operator.outlying(operator.measure(_filled(fit, pixels[hit], wrong))[1])
        filled, missing[hit] = np.array(filled), wrong
        filled[hit] = _filled(fit, pixels[hit], wrong)
        numbers[hit], residual[hit] = operator.measure(filled[hit])
    n_bad = np.count_nonzero(missing & fit.used, axis=1) if missing.any() else np.zeros(n, int)
    return filled, numbers, operator.misfit(numbers[:, 0], residual), n_bad


def _filled(fit: FringeFit, pixels: PixelArray, missing: BoolArray) -> PixelArray:
    """Pixels with the missing ones filled, unless there are too many."""
    gone = missing | ~fit.used
    if gone.any():
        too_many = np.count_nonzero(missing & fit.used, axis=1) > MAX_BAD * missing.shape[1]
        pixels = fit.fill(pixels, gone & ~too_many[:, None])
    return pixels


def select(frames: Frames, limit: float, largest_shift_px: float) -> NDArray[np.str_]:
    """Say why integrations are not to be used: flux, pointing, shape.

    Returns
    -------
    (n,) array of str
        Empty where an integration is used.
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
        reason[hit] = [f"{name} is an outlier by {o:.1f} sigma" for o in off[hit]]
    used = reason == ""
    if used.any():
        away = np.hypot(*(frames.shift_px - np.median(frames.shift_px[used], axis=0)).T)
        hit = used & (away > largest_shift_px)
        reason[hit] = [f"star is {a:.2f} pixels off" for a in away[hit]]
    return np.asarray(reason)


def _criteria(frames: Frames) -> list[tuple[str, FloatArray, float]]:
    """Names, values, and the smallest scatter that counts."""
    lit = np.maximum(frames.flux, 0.0)
    middle = float(np.median(lit[frames.used])) if frames.used.any() else 0.0
    return [("flux", lit, 1e-3 * middle), ("shape", frames.misfit, 0.02)]


@dataclass(frozen=True, eq=False)
class Average:
    """Mean observables of some integrations.

    Parameters
    ----------
    vis2 : (n_baselines,) array
    closure_phase : (n_triangles,) array
        Phase of the mean bispectrum, radians.
    deviation : (n, n_baselines + n_triangles) array
        What each integration deviates from the mean by, V² and closure phase, to first
        order in its noise; its mean is zero.
    """

    vis2: FloatArray
    closure_phase: FloatArray
    deviation: FloatArray


def average(frames: Frames, pointed: ComplexArray, triangles: IntArray) -> Average:
    """Average power and bispectrum, not their ratios and phases.

    Parameters
    ----------
    frames : Frames
        The integrations to be used.
    pointed : (n, n_baselines) complex array
        What each integration's pointing makes of a visibility of 1.
    triangles : (n_triangles, 3) int array
        Baselines ij, jk, ik of every triangle.
    """
    power = frames.power / np.abs(pointed) ** 2
    turn = pointed / np.abs(pointed)
    ij, jk, ik = (turn[:, index] for index in triangles.T)
    bispectrum = frames.bispectrum * (ij * jk).conj() * ik
    square = frames.square.mean()
    vis2 = power.mean(axis=0) / square
    by_vis2 = (power - frames.square[:, None] * vis2) / square
    total = bispectrum.mean(axis=0)
    by_closure = (bispectrum / total).imag
    return Average(vis2, np.angle(total), np.concatenate([by_vis2, by_closure], axis=1))

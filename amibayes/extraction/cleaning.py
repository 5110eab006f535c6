"""Clean reference of a cube, pixels that are bad, and integrations that are not like the rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter, rank_filter

from amibayes.cube import Cube
from amibayes.cube.source import Source
from amibayes.data.outliers import TO_SIGMA
from amibayes.errors import DataError
from amibayes.extraction.fourier.sampling import PixelArray
from amibayes.extraction.image_plane import FringeFit, fringe_fit
from amibayes.extraction.noise import NoiseModel, noise_model
from amibayes.extraction.view import View
from amibayes.units import BoolArray, FloatArray, read_only

SAMPLE, RUN = 32, 4
"""Integrations that the reference is the median of: short runs, evenly over the cube."""

MAX_BAD = 0.2
"""An integration with a larger fraction of bad pixels is not used."""

ALWAYS_BAD = 0.5
"""A pixel bad in a larger fraction of the integrations is never used."""

OUTLIER = 7.0
"""Pixels of the sample that are outliers by more standard deviations are left out of it."""

NOISE = 7.0
"""Standard deviations of noise by which a hot pixel differs, at least."""

AROUND = np.ones((3, 3), dtype=bool)
AROUND[1, 1] = False
BESIDE, NEIGHBOURS = 5.0, 3
"""How many times as far from the fit as the third of the pixels around it: what a companion far
from the star, a wrong spectrum, jitter or aberrations leave goes on over λ/D, two pixels or more;
two or three hot pixels may be neighbours."""

LIGHT, FAINT = 0.1, 0.01
"""… and by this part of the brightest light that is fitted within two pixels of it, and of the
brightest of all: a companion far from the star leaves as much, between dark fringes too."""

MOST = 0.02
"""Share of the pixels beyond which they are not hot: the model is another one."""

ROUNDS = 8
"""Fits: the brightest pixels hide others."""


@dataclass(frozen=True, eq=False)
class Reference:
    """What an integration of the cube looks like.

    Parameters
    ----------
    image : (n_y, n_x) array
        Median image, bad pixels given a value from their surroundings.
    scatter : (n_y, n_x) array
        Robust standard deviation of a pixel between integrations, pointing and noise.
    good : (n_y, n_x) bool array
        Pixels that can be used at all.
    noise : NoiseModel
    n_bad : int
        Pixels that are never used.
    sample : (k, n_y, n_x) array
        The integrations it was made of, NaN at bad pixels.
    has_errors : bool
        Whether the noise is that of the cube's own errors.
    source : str
    """

    image: FloatArray
    scatter: FloatArray
    good: BoolArray
    noise: NoiseModel
    n_bad: int
    sample: PixelArray
    has_errors: bool
    source: str

    def __post_init__(self) -> None:
        read_only(self, "image", "scatter")

    def outliers(self, images: PixelArray, bad: BoolArray, limit: float) -> BoolArray:
        """Outliers (n, n_y, n_x) from the reference, which is scaled to each image's flux."""
        n, usable = len(images), self.good & ~bad
        image, scatter = (a.astype(images.dtype) for a in (self.image, self.scatter))
        # A single hot pixel must not decide what the flux is.
        most = 2.0 * np.abs(image) + limit * scatter
        work = np.minimum(images, most)
        np.maximum(work, -most, out=work)
        work *= usable
        flux = work.reshape(n, -1) @ image.ravel()
        own = usable.reshape(n, -1) @ image.ravel() ** 2
        scale = flux / np.maximum(own, np.finfo(images.dtype).tiny)
        np.subtract(images, np.multiply(scale[:, None, None], image, out=work), out=work)
        return np.asarray((np.abs(work, out=work) > limit * scatter) & usable)


def reference_of(file: Source) -> Reference:
    """Look at some integrations, and make the reference.

    Raises
    ------
    DataError
        Where no integration holds light.
    """
    cube = _sample(file)
    bad = cube.bad
    share = np.count_nonzero(bad, axis=(1, 2)) / bad[0].size
    keep = share <= max(MAX_BAD, 1.5 * float(np.median(share)))
    images = np.where(bad, np.nan, cube.images)[keep]
    flux = np.nansum(images, axis=(1, 2)) if len(images) else np.zeros(0)
    lit = flux > 0.2 * max(float(np.median(flux[flux > 0.0])) if np.any(flux > 0.0) else 0.0, 0.0)
    if not lit.any():
        raise _no_light(bad, cube.source)
    images, flux = images[lit], flux[lit]
    missing = np.isnan(images)
    good = np.count_nonzero(missing, axis=0) <= ALWAYS_BAD * len(images)
    with np.errstate(invalid="ignore"):
        scaled = images * (np.median(flux) / flux)[:, None, None]
    scaled = np.where(good, scaled, 0.0)
    image, spread = median_and_scatter(scaled)
    good &= ~_hot(image, good)
    image = _filled(image, good)
    measured = _measured_variance(cube, keep, lit, spread, len(images))
    known = good & np.isfinite(measured) & (measured > 0.0)
    if not known.any():  # a single image without errors: the fit will tell its noise
        known, measured = good, np.full(image.shape, float(np.var(image[good])))
    noise = noise_model(image, measured, known)
    scatter = np.sqrt(
        np.maximum(spread**2, noise.variance) + (0.03 * maximum_filter(np.abs(image), 3)) ** 2
    )
    count = int((~good).sum())
    has_errors = cube.error is not None
    found = Reference(image, scatter, good, noise, count, images, has_errors, cube.source)
    images[missing] = 0.0
    missing |= found.outliers(images, missing, OUTLIER)
    images[missing] = np.nan
    return found


def _no_light(bad: BoolArray, source: str) -> DataError:
    """Describe images without light, or without a pixel that may show any."""
    fault = "no integration holds light"
    if bad.all():
        fault += ": every pixel is flagged in DQ, not a number, or has no positive ERR"
    return DataError(fault, source=source, remedy="check SCI, ERR and DQ, or leave the file out")


def median_and_scatter(values: PixelArray) -> tuple[PixelArray, PixelArray]:
    """Median along the first axis, and the standard deviation that the absolute ones tell.

    NaN are left out; where there is nothing else, NaN comes out.
    """
    middle = _median(values)
    return middle, TO_SIGMA * _median(np.abs(values - middle))


def _median(values: PixelArray) -> PixelArray:
    """`numpy.nanmedian` along the first axis, by a sort: many times quicker for few values."""
    in_order = np.sort(values, axis=0)
    if not np.isnan(in_order[-1]).any():  # where NaN go
        n = len(values)
        return np.asarray(0.5 * (in_order[(n - 1) // 2] + in_order[n // 2]))
    count = np.count_nonzero(~np.isnan(in_order), axis=0)
    low, high = (
        np.take_along_axis(in_order, at[None], axis=0)[0] for at in ((count - 1) // 2, count // 2)
    )
    return np.asarray(0.5 * (low + np.where(count == 0, np.nan, high)))


def _sample(file: Source) -> Cube:
    """Integrations spread evenly over the cube."""
    n = file.n_integrations
    if n <= 2 * SAMPLE:
        return file.read()
    starts = np.linspace(0, n - RUN, SAMPLE // RUN).astype(int)
    parts = [file.read(int(i), int(i) + RUN) for i in starts]
    stacked: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("images", "error", "dq")
        if getattr(parts[0], name) is not None
    }
    return replace(parts[0], mjd=None, **stacked)


def _measured_variance(
    cube: Cube, keep: BoolArray, lit: BoolArray, spread: FloatArray, n: int
) -> FloatArray:
    """Variance of each pixel: the errors that came with it, else its scatter."""
    if cube.error is not None:
        error = np.where(cube.bad, np.nan, cube.error)[keep][lit]
        known = np.isfinite(error).any(axis=0)
        out = np.full(spread.shape, np.nan)
        out[known] = np.nanmean(error[:, known] ** 2, axis=0)
        return out
    return spread**2 * (n / (n - 1.0) if n > 1 else 1.0)


def _hot(image: FloatArray, good: BoolArray) -> BoolArray:
    """Pixels that no optics could light: they differ from all that surrounds them.

    A telescope's image is smooth on the scale of a pixel where it is sampled well; a pixel
    is called hot or dead where it differs from what its neighbours predict by more than
    the neighbours differ among themselves, several times over.
    """
    around = np.ones((5, 5), dtype=bool)
    around[2, 2] = False
    high, low = (
        extreme(np.where(good, image, empty), footprint=around, mode="constant", cval=empty)
        for extreme, empty in ((maximum_filter, -np.inf), (minimum_filter, np.inf))
    )
    size = high - low
    found = good & ((image > high + 2.0 * size) | (image < low - 2.0 * size)) & (size > 0.0)
    return np.asarray(found)


def _filled(image: FloatArray, good: BoolArray) -> FloatArray:
    """Gaussian-weighted mean of good neighbours at bad pixels."""
    if good.all():
        return image
    weight = gaussian_filter(good.astype(float), 1.0)
    smooth = gaussian_filter(np.where(good, image, 0.0), 1.0) / np.maximum(weight, 1e-12)
    return np.where(good, image, smooth)


def without_hot(reference: Reference, view: View, even: FringeFit) -> Reference:
    """Leave hot and dead pixels out of a reference, by a fit of even weights to its image.

    A hot pixel that every integration has is no outlier of any, and beside bright fringes or
    another hot pixel it is not out of the range of its neighbours either. The fit of the fringes
    knows what it should be: it is fitted to all others, and asked. The very reference comes back
    where there is none.
    """
    image, good = reference.image[view.part], reference.good[view.part].copy()
    variance = reference.noise.variance[view.part] * (np.pi / 2.0 / len(reference.sample))
    fit, before = even, good.sum()
    for _ in range(ROUNDS):
        found = _misfitting(image, good, variance, fit)
        if not found.any():
            break
        good &= ~found
        if before - good.sum() > MOST * before:
            return reference
        fit = fringe_fit(even.model, np.ones(image.shape), good)
    if good.sum() == before:
        return reference
    everywhere = reference.good.copy()
    everywhere[view.part] = good
    return replace(
        reference,
        image=_filled(reference.image, everywhere),
        good=everywhere,
        n_bad=int((~everywhere).sum()),
    )


def _misfitting(
    image: FloatArray, good: BoolArray, variance: FloatArray, fit: FringeFit
) -> BoolArray:
    """Hot pixels, if any: of all that differ too much, those at least half as far as the worst.

    A bright one pulls the fit of others along.
    """
    pixels = np.where(good, image, 0.0).reshape(1, -1)
    model = (fit.design @ fit.solve(pixels)[0]).reshape(image.shape)
    own = np.einsum("np,np->n", fit.design, fit.inverse).reshape(image.shape)
    # What a fit to all other pixels would leave here.
    left = np.where(good, np.abs(image - model) / np.maximum(1.0 - own, 0.1), 0.0)
    light = np.maximum(LIGHT * maximum_filter(np.abs(model), 5), FAINT * model.max())
    least = np.maximum(
        NOISE * np.sqrt(variance) + light,
        BESIDE * rank_filter(left, -NEIGHBOURS, footprint=AROUND),
    )
    found = good & (left > least)
    return np.asarray(found & (left >= 0.5 * np.max(left, initial=0.0, where=found)))

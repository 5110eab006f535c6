"""Companions put into measured images, and whether the search finds them there.

The star of a measured cube is located, and its flux measured, in every integration, as
extraction does; a companion is the same star's image again, fainter and elsewhere. What follows
(extraction, calibration, search) does not know of it: the losses of the real way are all there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.optimise import fit_single
from amibayes.companion_search.result import SearchResult
from amibayes.cube import Cube
from amibayes.cube.source import InMemoryCube
from amibayes.data.observables import Observables
from amibayes.detection.false_alarm import Significance, significance
from amibayes.detection.statistic import BankStatistic, make_statistic, statistic_of
from amibayes.errors import DataError
from amibayes.extraction.frames import Frames, measure_file
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.preparation import make_operator
from amibayes.extraction.view import View
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.injection import Recovery, classify_recovery, recover
from amibayes.optics import psf
from amibayes.optics.sampling import fine_sampling, fine_size, pixel_operator
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Shown
from amibayes.support.options import ALPHA
from amibayes.units import MAS, FloatArray, read_only


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredStar(Shown):
    """The star of a cube: what is needed to make it a companion.

    Parameters
    ----------
    cube : Cube
        As measured.
    view : View
        Part of the detector that extraction uses, and the mask.
    flux : (n_int,) array
        Of the star in each integration, in the cube's unit.
    place_px : (n_int, 2) array
        Of the star (x, y) from the middle of the view.
    variance_per_signal : float
        Variance that light brings with it, in the cube's unit.
    """

    cube: Cube
    view: View
    flux: FloatArray
    place_px: FloatArray
    variance_per_signal: float

    def __post_init__(self) -> None:
        read_only(self, "flux", "place_px")

    def with_companion(
        self,
        east_mas: float,
        north_mas: float,
        contrast: float,
        rng: np.random.Generator | None = None,
    ) -> Cube:
        """Put a companion into the images.

        Parameters
        ----------
        east_mas, north_mas : float
            Place on the sky, from the star.
        contrast : float
            Flux relative to the star's.
        rng : numpy.random.Generator, optional
            Draws the photon noise of the companion's light; without it there is none.

        Returns
        -------
        Cube
            With the errors that the further light makes.

        Raises
        ------
        DataError
            Where the companion would stand outside the images.
        """
        light = np.zeros(self.cube.images.shape)
        part = np.s_[:, self.view.rows, self.view.columns]
        light[part] = contrast * self.flux[:, None, None] * self._images(east_mas, north_mas)
        variance = np.maximum(self.variance_per_signal * light, 0.0)
        noise = 0.0 if rng is None else rng.standard_normal(light.shape) * np.sqrt(variance)
        error = self.cube.error
        if error is not None:
            error = np.sqrt(error**2 + variance)
        return replace(self.cube, images=self.cube.images + light + noise, error=error)

    def _images(self, east_mas: float, north_mas: float) -> FloatArray:
        """Image of a star of unit flux at that place, in each integration, (n_int, n_y, n_x)."""
        view, pixel = self.view, self.view.instrument.pixel_scale_rad
        offset = self.cube.orientation.to_image(np.array([east_mas, north_mas]) * MAS) / pixel
        at = self.place_px + offset
        half = 0.5 * np.array(view.shape[::-1])
        if (np.abs(at) > half).any():
            raise DataError(
                f"a companion at {east_mas:g} mas east and {north_mas:g} mas north would stand "
                "outside the images",
                source=self.cube.source,
            )
        fine, oversample = self._fine(float(np.abs(at).max()))
        across, up = (
            [pixel_operator(n, len(fine), oversample, float(s)) for s in at[:, axis]]
            for n, axis in zip(view.shape[::-1], (0, 1), strict=True)
        )
        return np.stack([y @ fine @ x.T for x, y in zip(across, up, strict=True)])

    def _fine(self, reach_px: float) -> tuple[FloatArray, int]:
        """Image of the star on a grid fine enough to shift it, and how fine that is."""
        view, instrument = self.view, self.view.instrument
        mask = instrument.mask.rotated(view.rotation_rad)
        shortest = float(view.channels.wavelength_m.min())
        over = fine_sampling(instrument.pixel_scale_rad * mask.extent_m / shortest)
        size = fine_size(max(view.shape), over, reach_px)
        turned = instrument.with_mask(mask)
        return psf(turned, view.channels, size, oversample=over, integrate=False), over


@checks_arguments
def measure_star(cube: Cube, options: ExtractOptions | None = None) -> MeasuredStar:
    """Find the star of a cube, its flux and its place in every integration.

    Parameters
    ----------
    cube : Cube
    options : ExtractOptions, optional
        Those of the extraction.

    Returns
    -------
    MeasuredStar

    Raises
    ------
    DataError
        Where nothing in the cube can be measured.
    """
    held = InMemoryCube(cube)
    operator = make_operator(held, options or ExtractOptions())
    frames, _, _ = measure_file(operator, held, 0)
    flux, shift = _filled(frames, cube.source)
    place = np.array(operator.view.centre_px) + shift
    return MeasuredStar(cube, operator.view, flux, place, operator.reference.noise.per_signal)


def _filled(frames: Frames, source: str) -> tuple[FloatArray, FloatArray]:
    """Flux and shift of every integration; the middle ones where one cannot be measured."""
    good = frames.used
    if not good.any():
        raise DataError(f"no integration can be used: {frames.reason[0]}", source=source)
    flux = np.where(good, frames.flux, np.median(frames.flux[good]))
    middle = np.median(frames.shift_px[good], axis=0)
    return flux, np.where(good[:, None], frames.shift_px, middle)


@dataclass(frozen=True)
class ImageRecovery:
    """What a search makes of a data set into which a companion was put.

    Parameters
    ----------
    detected : bool
        The false-alarm probability is below α, wherever the companion seems to be.
    located : bool
        Detected, and reported at its place.
    statistic : float
    """

    detected: bool
    located: bool
    statistic: float


@dataclass(frozen=True, eq=False, repr=False)
class Criterion(Shown):
    """What a search takes for a companion, to be applied to other data of the same kind.

    Parameters
    ----------
    result : SearchResult
        Its data, field, lattice and model are used.
    test : BankStatistic
        Of that search.
    significance : Significance
        Its null draws set the threshold, at its α: for whitened data it depends on the number
        of data and on the field, and hardly on the errors.
    stated_errors : bool
        The statistic takes the size of the errors for known.
    """

    result: SearchResult
    test: BankStatistic
    significance: Significance
    stated_errors: bool

    def recover(self, companions: FloatArray, rng: np.random.Generator) -> Recovery:
        """Put companions into the model of the search's own data, with fresh noise.

        Parameters
        ----------
        companions : (n, 3) float array
            east_mas, north_mas, contrast.
        rng : numpy.random.Generator
        """
        companions = np.asarray(companions, dtype=float)
        return recover(self.test, companions, self.significance.threshold(), rng)

    def apply(self, data: Observables, east_mas: float, north_mas: float) -> ImageRecovery:
        """Search data that hold a companion at a known place.

        Parameters
        ----------
        data : Observables
            Calibrated; each data set brings its own covariance.
        east_mas, north_mas : float
            Where the companion was put.
        """
        likelihood = Likelihood(data.only(self._kinds()), self.result.likelihood.model)
        single, _ = fit_single(likelihood)
        grid = self.result.grid
        test = make_statistic(likelihood, grid, single, stated_errors=self.stated_errors)
        hits, place = test.hits(test.observed[:, None]), np.array([[east_mas, north_mas]])
        found = classify_recovery(test, place, hits, self.significance.threshold())
        detected, located = bool(found.detected[0]), bool(found.located[0])
        return ImageRecovery(detected, located, float(hits.statistic[0]))

    def _kinds(self) -> tuple[str, ...]:
        """Kinds of observables that the search used."""
        used = self.result.likelihood.observables
        held = {"vis2": used.n_vis2, "cp": used.n_closure_phases}
        return tuple(kind for kind, n in held.items() if n)


@checks_arguments
def make_criterion(
    result: SearchResult,
    rng: np.random.Generator,
    *,
    alpha: float = ALPHA,
    null_draws: int = 20_000,
    stated_errors: bool = False,
) -> Criterion:
    """Draw noise to find the statistic that a search takes for a companion.

    Parameters
    ----------
    result : SearchResult
        Of data like those that it will be applied to.
    rng : numpy.random.Generator
    alpha : float
        False-alarm probability of a detection.
    null_draws : int
    stated_errors : bool
        Take the size of the errors for known; the command does not, by default.
    """
    test = statistic_of(result, stated_errors=stated_errors)
    drawn = significance(test, null_draws, rng, alpha)
    return Criterion(result, test, drawn, stated_errors)

"""Companions put into measured images, and whether the search finds them there.

The star of a measured cube is located and weighed in every integration, as extraction does
it; a companion is the same star's image again, fainter and elsewhere. What follows (extraction,
calibration, search) does not know of it: the losses of the real way are all there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.optimise import fit_single
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import resolution_mas
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.cube import Cube
from amibayes.cube.source import InMemoryCube
from amibayes.data.observables import Observables
from amibayes.detection.false_alarm import Significance, bank_statistic, significance
from amibayes.errors import DataError
from amibayes.extraction.frames import Frames, measure_file
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.preparation import make_operator
from amibayes.extraction.view import View
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.limits.injection import Recovery, judge, recover
from amibayes.optics import psf
from amibayes.optics.sampling import fine_sampling, fine_size, pixel_operator
from amibayes.support.options import ALPHA
from amibayes.units import MAS, FloatArray, read_only


@dataclass(frozen=True, eq=False)
class MeasuredStar:
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
class Verdict:
    """What a search says of a data set into which a companion was put.

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


@dataclass(frozen=True, eq=False)
class Criterion:
    """What a search takes for a companion, to be applied to other data of the same kind.

    Parameters
    ----------
    result : SearchResult
        Its data, field, lattice and model are used.
    significance : Significance
        Its null draws set the threshold, at its α: for whitened data it depends on the number
        of data and on the field, and hardly on the errors.
    """

    result: SearchResult
    significance: Significance

    def recover(self, companions: FloatArray, rng: np.random.Generator) -> Recovery:
        """Put companions into the model of the search's own data, with fresh noise.

        Parameters
        ----------
        companions : (n, 3) float array
            east_mas, north_mas, contrast.
        rng : numpy.random.Generator
        """
        result = self.result
        return recover(
            result.likelihood,
            TemplateBank(result.likelihood, result.grid, result.single_theta),
            result.single_theta,
            np.asarray(companions, dtype=float),
            self.significance.threshold(),
            rng,
            free_scale=self.significance.free_scale,
        )

    def judge(self, data: Observables, east_mas: float, north_mas: float) -> Verdict:
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
        bank = TemplateBank(likelihood, self.result.grid, single)
        verdict = judge(
            bank,
            resolution_mas(likelihood),
            np.array([[east_mas, north_mas]]),
            single_likelihood(likelihood).residuals(single),
            self.significance.threshold(),
            free_scale=self.significance.free_scale,
        )
        found = (verdict[name][0] for name in ("detected", "located", "statistic"))
        detected, located, statistic = found
        return Verdict(bool(detected), bool(located), float(statistic))

    def _kinds(self) -> tuple[str, ...]:
        """Kinds of observables that the search used."""
        used = self.result.likelihood.observables
        held = {"vis2": used.n_vis2, "cp": used.n_closure_phases}
        return tuple(kind for kind, n in held.items() if n)


def make_criterion(
    result: SearchResult,
    rng: np.random.Generator,
    *,
    alpha: float = ALPHA,
    null_draws: int = 20_000,
    free_scale: bool = True,
) -> Criterion:
    """Draw noise to find the statistic that a search takes for a companion.

    Parameters
    ----------
    result : SearchResult
        Of data like those that will be judged.
    rng : numpy.random.Generator
    alpha : float
        False-alarm probability of a detection.
    null_draws : int
    free_scale : bool
        The statistic does not take the size of the errors on trust, as that of the command.
    """
    bank = TemplateBank(result.likelihood, result.grid, result.single_theta)
    residuals = single_likelihood(result.likelihood).residuals(result.single_theta)
    statistic = float(bank_statistic(bank, residuals, free_scale=free_scale)[0])
    weight = significance(bank, statistic, null_draws, rng, alpha, free_scale=free_scale)
    return Criterion(result, weight)

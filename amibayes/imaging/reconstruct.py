"""Image reconstruction: χ² + weight · regulariser, with light that is nowhere negative.

The weight is chosen by cross-validation: images made of a part of the data are compared with
the rest. A star of flux 1 in the middle is no part of the image. What comes out is an image for
looking: which structure the data ask for, and none that is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from amibayes.companion_search.field import refuse_no_length, resolves_stars
from amibayes.data.observables import Observables
from amibayes.errors import DataError, UsageError
from amibayes.imaging.choice import before, cross_validated, largest_that_fits, p_fit
from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.field import choose_grid
from amibayes.imaging.grid import PixelGrid, pixel_response
from amibayes.imaging.problem import FIRST_FLUX, Problem
from amibayes.imaging.regularisers import REGULARISERS
from amibayes.imaging.result import ReconstructedImage
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.uv_points import UVPoints
from amibayes.units import MAS, BoolArray, ComplexArray, FloatArray

FEWEST_DATA = 4
"""Of which an image is made: one point of light already has a place and a flux."""

DARK = 0.25
"""Distance from a star with a disc that V² resolves, in λ/B of the longest baseline, within which
the image stays dark: the data do not tell light there from a wider disc of the star."""

Diameter = float | Literal["free"] | None


def reconstruct_image(
    observables: Observables,
    *,
    regulariser: str = "tv",
    weight: float | None = None,
    field_mas: float | None = None,
    pixel_mas: float | None = None,
    star: bool = True,
    diameter_mas: Diameter = None,
    rng: np.random.Generator | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ReconstructedImage:
    """Reconstruct an image from V², closure phases or kernel phases with their covariance.

    Parameters
    ----------
    observables : Observables
    regulariser : {"tv", "entropy"}
        Total variation keeps edges; maximum entropy is smooth.
    weight : float, optional
        Of the regulariser; by default the largest whose image fits the data, and predicts data
        left out as well as the best does within one standard error.
    field_mas : float, optional
        Side of the image, by default λ/B of the shortest baseline to either side of the star,
        less where the sky repeats itself before (at least λ/B in all).
    pixel_mas : float, optional
        By default a quarter of λ/2B, or what makes 101 pixels of the field.
    star : bool
        A point, or a disc of ``diameter_mas``, of flux 1 stands in the middle beside the image.
    diameter_mas : float or "free", optional
        Fitted with the image where it is free. By default free where V² would notice a disc of
        0.3 mas, else 0.
    rng : numpy.random.Generator, optional
        How the data are split.
    progress : callable, optional
        Called with (done, expected).

    Raises
    ------
    UsageError
        For a regulariser that is not known, sizes that make no image, or a diameter that the
        data cannot tell.
    DataError
        Where the data are too few for any image.
    """
    likelihood = Likelihood(observables)
    data, samples = likelihood.observables, likelihood.samples
    _refuse_few(likelihood)
    diameter = _diameter(likelihood, diameter_mas, star)
    grid = choose_grid(samples, field_mas, pixel_mas)
    problem = _problem(likelihood, grid, regulariser, star, diameter)
    table, term = np.empty((3, 0)), DataTerm.of(data, samples)
    if weight is None:
        rng = rng or np.random.default_rng(1)
        table = cross_validated(problem, data, samples, rng, progress)
        weight, start = largest_that_fits(problem, term, table)
    else:
        start = before(problem, term, weight)
    values = problem.solve(term, weight, start)
    return _result(values, problem, term, likelihood, (regulariser, weight, table, diameter))


def _problem(
    likelihood: Likelihood,
    grid: PixelGrid,
    regulariser: str,
    star: bool,
    diameter: float | Literal["free"],
) -> Problem:
    if regulariser not in REGULARISERS:
        raise UsageError(
            f"{regulariser!r} is no regulariser", remedy=f"one of {', '.join(REGULARISERS)}"
        )
    samples, free = likelihood.samples, diameter == "free"
    size = 0.0 if diameter == "free" else diameter
    response = pixel_response(samples, grid, star=star, diameter_mas=size)
    flux = FIRST_FLUX if star and not likelihood.observables.n_vis2 else None
    penalty = REGULARISERS[regulariser](grid, flux)
    frequency = samples.frequency if free else None
    disc = bool(diameter) and (free or resolves_stars(likelihood))
    dark = DARK / float(samples.frequency.max()) / MAS if disc else -1.0
    return Problem(response, grid, penalty, regulariser == "entropy", frequency, dark)


def _refuse_few(likelihood: Likelihood) -> None:
    """Raise a `DataError` where the data are no more than the numbers that say what a point is."""
    if likelihood.n_independent < FEWEST_DATA:
        raise DataError(
            f"holds {likelihood.n_independent} independent data, of which no image can be made",
            source=likelihood.observables.source,
            remedy=f"give {FEWEST_DATA} or more",
        )
    refuse_no_length(likelihood)


def _diameter(likelihood: Likelihood, asked: Diameter, star: bool) -> float | Literal["free"]:
    """The star's diameter, or that it is fitted."""
    if not star:
        if asked:
            raise UsageError("is that of no star", source="--diameter", remedy="without --no-star")
        return 0.0
    if asked is None:
        return "free" if resolves_stars(likelihood) else 0.0
    if asked == "free" and not likelihood.observables.n_vis2:
        raise UsageError(
            "is not told by phases alone", source="--diameter", remedy="give it in mas"
        )
    return asked


def _result(
    values: FloatArray,
    problem: Problem,
    term: DataTerm,
    likelihood: Likelihood,
    choice: tuple[str, float, FloatArray, float | Literal["free"]],
) -> ReconstructedImage:
    regulariser, weight, table, diameter = choice
    data, samples = likelihood.observables, likelihood.samples
    response, n = problem.at(values)[0], problem.grid.n
    light = values[: n**2]
    value, total = response.visibility(light)
    everything = np.ones(len(data.vis2), bool), np.ones(len(data.closure_phase), bool)
    nothing = np.zeros_like(everything[0]), np.zeros_like(everything[1])
    slope = -0.5 * response.pulled(term.with_pull(value)[1], value, total)
    chi2 = term.chi2(value)
    return ReconstructedImage(
        light.reshape(n, n),
        problem.grid,
        regulariser,
        weight,
        table[0],
        table[1],
        table[2],
        _chi2_of(data, samples, (everything[0], nothing[1]), value),
        _chi2_of(data, samples, (nothing[0], everything[1]), value),
        chi2,
        term.chi2(response.star.astype(complex)) if response.star_flux else float("nan"),
        p_fit(term, chi2),
        data.n_vis2,
        data.n_closure_phases,
        term.noise.n_independent,
        0.5 / float(samples.frequency.max()) / MAS,
        bool(response.star_flux),
        problem.diameter_mas(values) if diameter == "free" else diameter,
        diameter == "free",
        problem.ends(values),
        value,
        samples,
        data,
        (slope / _noise_of_slope(term, problem, value, total)).reshape(n, n),
    )


def _chi2_of(
    data: Observables,
    samples: UVPoints,
    chosen: tuple[BoolArray, BoolArray],
    visibility: ComplexArray,
) -> float:
    """χ² of V² or phases by themselves; NaN where there are none."""
    if not (chosen[0].any() or chosen[1].any()):
        return float("nan")
    return DataTerm.of(data, samples, chosen).chi2(visibility)


def _noise_of_slope(
    term: DataTerm, problem: Problem, value: ComplexArray, total: FloatArray
) -> FloatArray:
    """Standard deviation that noise gives the back projection of every pixel, (n_pixels,).

    √(tᵀC⁻¹t) of the change t of the data by light in a pixel: whitened, row by row of the data.
    """
    response, n = problem.response, term.n_vis2
    variance = np.zeros(problem.grid.n**2)
    whitening = term.noise.covariance.whitening
    by_data = [2.0 * term.squares.multiply(value.conj()[None]).tocsr()]
    if term.legs.shape[0]:
        by_data.append(term.legs.multiply((-1j / value)[None]).tocsr())
    rows = sum(
        whitening[:, part] @ block
        for part, block in zip((slice(0, n), slice(n, None)), by_data, strict=False)
    )
    dense = np.asarray(rows.todense()) if hasattr(rows, "todense") else np.asarray(rows)
    for row in dense:
        variance += response.pulled(row, value, total) ** 2
    return np.sqrt(np.maximum(variance, 1e-300))

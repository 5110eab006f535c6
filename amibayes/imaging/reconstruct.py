"""Image reconstruction: χ² + weight · regulariser, with light that is nowhere negative.

The weight is chosen by cross-validation: images made of a part of the data are compared with
the rest. A star of flux 1 in the middle is no part of the image. What comes out is an image for
looking: which structure the data ask for, and none that is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from amibayes.data.observables import Observables
from amibayes.errors import UsageError
from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.folds import folds_of
from amibayes.imaging.grid import PixelGrid, PixelResponse, pixel_response
from amibayes.imaging.regularisers import REGULARISERS, Regulariser, default_image
from amibayes.models.uv_points import UVPoints, uv_points_of
from amibayes.units import MAS, ComplexArray, FloatArray, freeze

WEIGHTS = tuple(10.0 ** np.arange(3.5, -0.6, -0.5))
"""Weights that are tried, the smoothest image first: each begins at the one before."""

PIXELS_PER_BEAM = 4.0
"""Pixels across λ/2B: finer ones are filled by the regulariser alone."""

MAX_SIDE = 101
"""Pixels along a side: more take minutes and show no more."""

MAX_NUMBERS = 4e7
"""Entries of the transform of all pixels, 16 bytes each."""

FIRST_FLUX = 0.05
"""Light of the image that the first fit begins with, in units of the star's."""

ITERATIONS, FEWER_ITERATIONS = 400, 150
"""Of the image itself, and of those that are compared with data left out: correlations with the
truth of simulated scenes differ by 0.02 at most."""


@dataclass(frozen=True, eq=False)
class ReconstructedImage:
    """An image, how well it fits, and how it was chosen.

    Parameters
    ----------
    light : (n, n) float array
        Flux of each pixel, rows to the north and columns to the east, in units of the star's
        (where there is no star, of all light).
    grid : PixelGrid
    regulariser : str
    weight : float
    weights, scores, score_errors : (m,) float array
        Weights that were tried, and the deviance of data left out per datum with its standard
        error; empty where the weight was given.
    chi2_vis2, chi2_phase, chi2 : float
        Of V² and of phases by themselves, and of both with their covariance; NaN where there are
        none.
    chi2_star : float
        Of the star alone.
    n_vis2, n_phases, n_independent : int
        Numbers that these are of.
    beam_mas : float
        λ/2B of the longest baseline.
    star : bool
    diameter_mas : float
        Of the star.
    visibility : (n_points,) complex array
    samples : UVPoints
    observables : Observables
        Unflagged.
    back_projected : (n, n) float array
        Residuals projected back: the change of χ²/2 by light added to each pixel, with the
        opposite sign, in units of what noise alone makes of it.
    """

    light: FloatArray
    grid: PixelGrid
    regulariser: str
    weight: float
    weights: FloatArray
    scores: FloatArray
    score_errors: FloatArray
    chi2_vis2: float
    chi2_phase: float
    chi2: float
    chi2_star: float
    n_vis2: int
    n_phases: int
    n_independent: int
    beam_mas: float
    star: bool
    diameter_mas: float
    visibility: ComplexArray
    samples: UVPoints
    observables: Observables
    back_projected: FloatArray

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def flux(self) -> float:
        """Light of the image in units of the star's."""
        return float(self.light.sum())

    @property
    def chi2r(self) -> float:
        """χ² of all data over their number."""
        return self.chi2 / max(self.n_independent, 1)

    def convolved(self, fwhm_mas: float | None = None) -> FloatArray:
        """The image seen with a Gaussian beam, by default of λ/2B, (n, n); the flux stays."""
        sigma = (fwhm_mas or self.beam_mas) / np.sqrt(8.0 * np.log(2.0))
        apart = self.grid.offset_mas[:, None] - self.grid.offset_mas
        kernel = np.exp(-0.5 * (apart / sigma) ** 2)
        kernel /= kernel[len(kernel) // 2].sum()
        return np.asarray(kernel @ self.light @ kernel)

    def dirty_beam(self) -> FloatArray:
        """What the sampled points make of a point in the middle, 1 there, (n, n)."""
        return self._synthesised(np.ones(len(self.samples), dtype=complex))

    def dirty_image(self) -> FloatArray:
        """What they make of the image without its star, light per dirty beam, (n, n)."""
        whole = self.flux + float(self.star)
        of_star = float(self.star) * np.ones(len(self.samples))
        return self._synthesised(self.visibility * whole - of_star)

    def _synthesised(self, visibility: ComplexArray) -> FloatArray:
        turn = 2j * np.pi * MAS
        along = np.exp(turn * np.outer(self.samples.u, self.grid.offset_mas))
        up = np.exp(turn * np.outer(self.samples.v, self.grid.offset_mas))
        made = np.einsum("iy,i,ix->yx", up, visibility, along, optimize=True)
        return np.asarray(made.real / len(self.samples))


def reconstruct_image(
    observables: Observables,
    *,
    regulariser: str = "tv",
    weight: float | None = None,
    field_mas: float | None = None,
    pixel_mas: float | None = None,
    star: bool = True,
    diameter_mas: float = 0.0,
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
        Of the regulariser; by default the largest whose image predicts data left out as well as
        the best, within one standard error.
    field_mas : float, optional
        Side of the image, by default twice λ/2 of the shortest baseline.
    pixel_mas : float, optional
        By default a quarter of λ/2B, or what makes 101 pixels of the field.
    star : bool
        A point, or a disc of ``diameter_mas``, of flux 1 stands in the middle beside the image.
    diameter_mas : float
    rng : numpy.random.Generator, optional
        How the data are split.
    progress : callable, optional
        Called with (done, expected).

    Raises
    ------
    UsageError
        For a regulariser that is not known, or sizes that make no image.
    """
    if regulariser not in REGULARISERS:
        raise UsageError(
            f"{regulariser!r} is no regulariser", remedy=f"one of {', '.join(REGULARISERS)}"
        )
    data = observables.unflagged()
    samples = uv_points_of(data)
    grid = choose_grid(samples, field_mas, pixel_mas)
    response = pixel_response(samples, grid, star=star, diameter_mas=diameter_mas)
    fixed = FIRST_FLUX if star and not data.n_vis2 else None
    penalty = REGULARISERS[regulariser](grid, fixed)
    problem = Problem(response, grid, penalty, regulariser == "entropy")
    table = np.empty((3, 0))
    if weight is None:
        rng = rng or np.random.default_rng(1)
        table = _cross_validated(problem, data, samples, rng, progress)
        weight = _chosen(*table)
    term = DataTerm.of(data, samples)
    falling = [w for w in WEIGHTS if w > 1.001 * weight]
    first = problem.path(term, falling, FEWER_ITERATIONS)[-1] if falling else problem.first
    light = problem.solve(term, weight, first)
    return _result(light, problem, term, data, samples, (regulariser, weight, table, diameter_mas))


def choose_grid(
    samples: UVPoints, field_mas: float | None = None, pixel_mas: float | None = None
) -> PixelGrid:
    """Choose pixels that the data can tell apart, over the field that they can see.

    Raises
    ------
    UsageError
        Where there would be too few or too many pixels.
    """
    frequency = samples.frequency[samples.frequency > 0.0]
    beam = 0.5 / float(frequency.max()) / MAS
    field = field_mas or 1.0 / float(frequency.min()) / MAS
    pixel = pixel_mas or max(beam / PIXELS_PER_BEAM, field / MAX_SIDE)
    n = int(np.ceil(field / pixel)) // 2 * 2 + 1
    if n < 5 or float(n) ** 2 * len(samples) > MAX_NUMBERS:
        raise UsageError(
            f"an image of {n} pixels a side for {len(samples)} points of the (u, v) plane",
            remedy="give other --field and --pixel, or average channels with --bin-channels",
        )
    return PixelGrid(n, pixel)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is minimised: pixels, their transform and the regulariser.

    Parameters
    ----------
    response : PixelResponse
    grid : PixelGrid
    regulariser : callable
    positive : bool
        Keep pixels above 0, where the logarithm of the entropy is steep.
    """

    response: PixelResponse
    grid: PixelGrid
    regulariser: Regulariser
    positive: bool

    def objective(
        self, term: DataTerm, weight: float, light: FloatArray
    ) -> tuple[float, FloatArray]:
        """Deviance + 2 · weight · regulariser of light (n_pixels,), and its gradient."""
        value, total = self.response.visibility(light)
        deviance, pull = term.with_pull(value)
        penalty, slope = self.regulariser(light)
        gradient = self.response.pulled(pull, value, total) + 2.0 * weight * slope
        return deviance + 2.0 * weight * penalty, gradient

    def solve(
        self, term: DataTerm, weight: float, start: FloatArray, iterations: int = ITERATIONS
    ) -> FloatArray:
        """Light (n_pixels,) of least objective from a start, by L-BFGS-B."""
        unit = FIRST_FLUX / self.grid.n**2  # so that variables are of order 1
        low = 1e-6 if self.positive else 0.0

        def scaled(x: FloatArray) -> tuple[float, FloatArray]:
            value, gradient = self.objective(term, weight, unit * x)
            return value, unit * gradient

        found = minimize(
            scaled,
            np.maximum(start / unit, low),
            jac=True,
            method="L-BFGS-B",
            bounds=[(low, None)] * len(start),
            options={"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 20},
        )
        return np.asarray(unit * found.x)

    @property
    def first(self) -> FloatArray:
        """Where the first fit begins: a round Gaussian, (n_pixels,)."""
        flux = FIRST_FLUX if self.response.star_flux else 1.0
        return flux * default_image(self.grid)

    def path(
        self, term: DataTerm, weights: Sequence[float], iterations: int = ITERATIONS
    ) -> list[FloatArray]:
        """Images of falling weights, each from the one before."""
        light, found = self.first, []
        for weight in weights:
            light = self.solve(term, weight, light, iterations)
            found.append(light)
        return found


def _cross_validated(
    problem: Problem,
    data: Observables,
    samples: UVPoints,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] | None,
) -> FloatArray:
    """Weights, mean deviance per datum left out, and its standard error, (3, n_weights)."""
    splits = folds_of(data, rng)
    scores = np.empty((len(splits), len(WEIGHTS)))
    for k, (kept, out) in enumerate(splits):
        fitted, rest = (DataTerm.of(data, samples, part) for part in (kept, out))
        for j, light in enumerate(problem.path(fitted, WEIGHTS, FEWER_ITERATIONS)):
            left = rest.deviance(problem.response.visibility(light)[0])
            scores[k, j] = left / rest.noise.n_independent
        if progress is not None:
            progress(k + 1, len(splits))
    error = scores.std(axis=0, ddof=1) / np.sqrt(len(scores)) if len(scores) > 1 else 0.0
    return np.stack([WEIGHTS, scores.mean(axis=0), np.broadcast_to(error, len(WEIGHTS))])


def _chosen(weights: FloatArray, scores: FloatArray, errors: FloatArray) -> float:
    """The largest weight whose score is within one standard error of the best."""
    best = int(np.argmin(scores))
    enough = scores <= scores[best] + errors[best]
    return float(weights[enough].max())


def _result(
    light: FloatArray,
    problem: Problem,
    term: DataTerm,
    data: Observables,
    samples: UVPoints,
    choice: tuple[str, float, FloatArray, float],
) -> ReconstructedImage:
    regulariser, weight, table, diameter = choice
    response, n = problem.response, problem.grid.n
    value, total = response.visibility(light)
    everything = np.ones(len(data.vis2), bool), np.ones(len(data.closure_phase), bool)
    nothing = np.zeros_like(everything[0]), np.zeros_like(everything[1])
    alone = [
        DataTerm.of(data, samples, chosen).chi2(value)
        if chosen[0].any() or chosen[1].any()
        else np.nan
        for chosen in ((everything[0], nothing[1]), (nothing[0], everything[1]))
    ]
    slope = -0.5 * response.pulled(term.with_pull(value)[1], value, total)
    return ReconstructedImage(
        light.reshape(n, n),
        problem.grid,
        regulariser,
        weight,
        table[0],
        table[1],
        table[2],
        alone[0],
        alone[1],
        term.chi2(value),
        term.chi2(response.star.astype(complex)) if response.star_flux else float("nan"),
        data.n_vis2,
        data.n_closure_phases,
        term.noise.n_independent,
        0.5 / float(samples.frequency.max()) / MAS,
        bool(response.star_flux),
        diameter,
        value,
        samples,
        data,
        (slope / _noise_of_slope(term, problem, value, total)).reshape(n, n),
    )


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

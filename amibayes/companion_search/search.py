"""The search: template bank, nonlinear refinement, global cross-check, and its result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import nlopt
import numpy as np

from amibayes.companion_search.field import box_of, default_separation, resolution_mas
from amibayes.companion_search.grid import Grid, make_grid, rates_per_axis
from amibayes.companion_search.modes import (
    NEARLY_EQUAL,
    distinct_modes,
    innermost_first,
    with_exchanged,
)
from amibayes.companion_search.optimise import Fit, fits_single, refine_at
from amibayes.companion_search.result import (
    OPPOSITE_MAS,
    RIVAL,
    Mode,
    SearchResult,
    companions_of,
    is_opposite,
)
from amibayes.companion_search.scan import ScanResult
from amibayes.companion_search.seeds import (
    NOT_FAINT,
    bright_seeds,
    coarse_likelihood,
    linear_seeds,
    may_be_bright,
    peaks,
    refine_all,
    trial_stars,
)
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.parameters import Box
from amibayes.support.arguments import annulus, checks_arguments
from amibayes.units import FloatArray

MIN_STEPS, MAX_STEPS = 5, 8
"""Lattice points per λ/B_max: a peak loses 3 % of its gain on average with 8, 6 % with 5
((2J₁(x)/x)² of its distance, baselines in a disc). Null searches are on the same lattice."""

AFFORDABLE_WORK = 1e8
"""Positions times data of a search, beyond which the lattice is made coarser: ten thousand null
searches of that take half a minute."""

EVALUATIONS_PER_FRINGE, MIN_EVALUATIONS, MAX_EVALUATIONS = 40, 400, 3000
"""Size of the global check: per patch (λ/B_max)² of the field, and its limits."""

MAX_POSITIONS = 2_000_000
"""Positions of a search: more would take hours and all the memory."""

MAX_NUISANCE_ROUNDS = 3
"""How often the exact map is made with the nuisance parameters of the best fit so far."""

ANOTHER_MINIMUM, MAX_OTHER_STARS = 0.1, 3
"""Difference in χ² of fits of light around the star that are not of one minimum, and how many of
them are tried beside the best."""

MISFIT = 10.0
"""Reduced χ² of the best fit from which other sizes of the star are tried."""

BETTER = 0.1
"""Gain in χ² over the search from which on the global check's solution is told of."""

NUISANCE_HOLDS = 0.02
"""Change of the star's visibility with which the exact map need not be made again."""


@checks_arguments
def search(
    likelihood: Likelihood,
    separation_mas: tuple[float, float] | None = None,
    *,
    known: FloatArray | None = None,
    single: FloatArray | None = None,
    check: bool = True,
) -> SearchResult:
    """Find the companion that explains the data best.

    Parameters
    ----------
    likelihood : Likelihood
    separation_mas : (inner, outer), optional
        Annulus that is searched; by default `default_separation`.
    known : (n, n_dim) float array, optional
        Solutions of nearly the same problem, where fits begin in place of bright companions.
    single : (n_nuisance,) float array, optional
        A fit without a companion to begin from too.
    check : bool
        Look over the whole field with the global optimiser too, see `with_global_check`.

    Raises
    ------
    DataError
        Where there are not more independent data than free parameters.
    UsageError
        Where the annulus holds no position.
    """
    annulus("search", "separation_mas", separation_mas)
    _refuse_underdetermined(likelihood)
    inner, outer = separation_mas or default_separation(likelihood)
    box = Box(inner, outer, resolution_mas(likelihood))
    grid = _grid(likelihood, box)
    stars = fits_single(likelihood, single)
    single, deviance_single = stars[0]
    bank = TemplateBank(likelihood, grid, single)
    residuals = single_likelihood(likelihood).residuals(single)[:, 0]
    survey = bank.survey(residuals)
    coarse = coarse_likelihood(likelihood, box)
    found = _fits(likelihood, coarse, grid, survey, stars, box, known)
    # Where no peak is worth a fit, the global optimiser's is the one solution.
    checked = None if found else _checked(likelihood, coarse, grid, box, single, deviance_single)
    every = _all_modes(likelihood, found if checked is None else [checked], box, deviance_single)
    modes, aliases = innermost_first(likelihood, every, single, box.fringe_mas)
    result = SearchResult(
        likelihood=likelihood,
        single_theta=single,
        chi2_single=float(residuals @ residuals),
        ndof=likelihood.n_independent - len(likelihood.parameters),
        grid=grid,
        bank_contrast=survey.contrast,
        bank_sigma=survey.sigma,
        global_check=checked,
        joint_gain=survey.gain if bank.joint else None,
        **_solutions(likelihood, modes, aliases),
    )
    return with_global_check(result) if check else result


def with_global_check(result: SearchResult) -> SearchResult:
    """Look over the whole field with NLopt, beside the search, and take what is better.

    A result that has been checked is given back as it is.
    """
    if result.global_check is not None:
        return result
    likelihood, grid, single = result.likelihood, result.grid, result.single_theta
    box = box_of(grid, likelihood)
    coarse = coarse_likelihood(likelihood, box)
    deviance = float(likelihood.deviance(np.array(result.chi2_single)))
    found = _checked(likelihood, coarse, grid, box, single, deviance)
    best = max(mode.delta_chi2 for mode in result.modes)
    every = _all_modes(likelihood, [*result.modes, found], box, deviance)
    modes, aliases = innermost_first(likelihood, every, single, box.fringe_mas)
    solutions = _solutions(likelihood, modes, aliases)
    if found.delta_chi2 > best + BETTER:
        told = (
            f"the global optimiser found a better solution than the grid "
            f"(Δχ² {found.delta_chi2:.2f} against {best:.2f}); it was adopted"
        )
        solutions["warnings"] = (told, *solutions["warnings"])
    return replace(result, global_check=found, **solutions)


def _all_modes(
    likelihood: Likelihood, found: Sequence[Mode], box: Box, deviance_single: float
) -> tuple[Mode, ...]:
    """Those fits that differ, and what they are with the two stars exchanged."""
    modes = distinct_modes(found, box.fringe_mas)
    every = with_exchanged(likelihood, modes, box, deviance_single)
    return distinct_modes(every, box.fringe_mas)


def _checked(
    likelihood: Likelihood,
    coarse: Likelihood,
    grid: Grid,
    box: Box,
    single: FloatArray,
    deviance_single: float,
) -> Mode:
    """Look for the best position with NLopt's DIRECT-L over the whole field, then refine it.

    It shares neither the lattice nor the choice of peaks with the search. A field of very
    many fringes is more than it can cover; what it finds is a lower bound then. ``coarse`` are
    the same data, or those with their channels averaged.
    """
    if coarse is not likelihood:
        grid = make_grid(box.inner_mas, box.outer_mas, box.fringe_mas)
    # Combining the data for some hundred positions would take longer than it saves.
    bank = TemplateBank(coarse, grid, single)
    best_at = bank.matched_filter(single_likelihood(coarse).residuals(single)[:, 0])

    def inside(position: FloatArray) -> bool:
        return box.inner_mas <= math.hypot(*position) <= box.outer_mas

    def loss(position: FloatArray, _: FloatArray) -> float:
        return -best_at(position)[1] if inside(position) else 0.0

    optimiser = nlopt.opt(nlopt.GN_DIRECT_L, 2)
    optimiser.set_lower_bounds([-box.outer_mas] * 2)
    # The box is a little lopsided so that its first trial is not the star itself.
    optimiser.set_upper_bounds([1.03 * box.outer_mas, 1.07 * box.outer_mas])
    optimiser.set_min_objective(loss)
    patches = (2.0 * box.outer_mas / box.fringe_mas) ** 2
    wanted = int(EVALUATIONS_PER_FRINGE * patches)
    optimiser.set_maxeval(min(max(wanted, MIN_EVALUATIONS), MAX_EVALUATIONS))
    start = np.array([0.0, 0.5 * (box.inner_mas + box.outer_mas)])
    position = np.asarray(optimiser.optimize(start))
    position = position if inside(position) else start
    return refine_at(likelihood, position, best_at(position)[0], single, box, deviance_single)


def _solutions(
    likelihood: Likelihood, modes: tuple[Mode, ...], aliases: tuple[Mode, ...]
) -> dict[str, Any]:
    """What of a result follows from its modes."""
    theta = np.array(modes[0].theta)
    covariance = _errors(likelihood, theta)
    return {
        "companion": companions_of(likelihood.parameters, theta, covariance)[0],
        "theta": theta,
        "theta_covariance": covariance,
        "chi2_binary": float(likelihood.chi2(theta)[0]),
        "modes": modes,
        "aliases": aliases,
        "warnings": _warnings(likelihood, modes, aliases),
    }


def _refuse_underdetermined(likelihood: Likelihood) -> None:
    if likelihood.n_independent <= len(likelihood.parameters):
        raise DataError(
            f"holds {likelihood.n_independent} independent data for "
            f"{len(likelihood.parameters)} parameters",
            source=likelihood.observables.source,
            remedy="free fewer parameters or give more data",
        )


def farthest_searched(likelihood: Likelihood, inner: float, outer: float) -> float:
    """Outer edge, mas, up to ``outer``, of a field that is not refused as too large.

    Each rate of a motion is a position more: a field that channels allow may be too large then.
    """
    while inner < outer < np.inf:
        step = _step(likelihood, Box(inner, outer, resolution_mas(likelihood)))
        if _positions(inner, outer, step / rates_per_axis(likelihood)) <= MAX_POSITIONS:
            break
        outer *= 0.9
    return outer


def _step(likelihood: Likelihood, box: Box) -> float:
    """Distance of positions, mas: as many per fringe as can be afforded."""
    with np.errstate(all="ignore"):  # a damaged baseline may be of any length
        patches = _positions(box.inner_mas, box.outer_mas, box.fringe_mas)
        steps = np.sqrt(AFFORDABLE_WORK / likelihood.n_independent / patches)
    return box.fringe_mas / float(np.clip(np.nan_to_num(steps), MIN_STEPS, MAX_STEPS))


def _positions(inner: float, outer: float, step: float) -> float:
    """Number of positions of a field."""
    with np.errstate(all="ignore"):  # a damaged baseline may be of any length
        return np.pi * float(np.diff((np.array([inner, outer]) / step) ** 2)[0])


def _grid(likelihood: Likelihood, box: Box) -> Grid:
    """Positions of the field."""
    step = _step(likelihood, box)
    finest = step / rates_per_axis(likelihood)
    _refuse_huge(box.inner_mas, box.outer_mas, finest, likelihood.observables.source)
    grid = make_grid(box.inner_mas, box.outer_mas, step)
    if not len(grid):
        raise UsageError(
            f"no position between {box.inner_mas:g} and {box.outer_mas:g} mas on a grid of "
            f"{grid.step_mas:.3g} mas",
            source="--separation",
            remedy="widen the range",
        )
    return grid


def _errors(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Covariance of the parameters; NaN without a companion, whose errors nothing could tell."""
    if not (theta[likelihood.parameters.contrasts] > 0.0).any():
        return np.full((len(theta),) * 2, np.nan)
    return likelihood.errors(theta)


def _refuse_huge(inner: float, outer: float, step: float, source: str) -> None:
    if not np.isfinite([inner, outer, step]).all():
        raise DataError(
            "has baselines of zero or infinite length",
            source=source,
            remedy="check UCOORD and VCOORD",
        )
    positions = _positions(inner, outer, step)
    if not positions <= MAX_POSITIONS:
        raise UsageError(
            f"{positions:.2g} positions between {inner:.4g} and {outer:.4g} mas",
            source="--separation",
            remedy=f"narrow the range: at most {MAX_POSITIONS:.0e} are searched",
        )


def _fits(
    likelihood: Likelihood,
    coarse: Likelihood,
    grid: Grid,
    survey: ScanResult,
    alone: Sequence[Fit],
    box: Box,
    known: FloatArray | None,
) -> list[Mode]:
    """Local fits from the peaks of the linear map, and of the exact one where it may differ.

    The star alone takes a part of a bright companion's light for its own disc: the exact map
    is made again with the star of the best fit, until that stays. Light around a star makes up
    for a companion even more: with it the other fits of ``alone``, without one, are tried too.
    """
    single, deviance_single = alone[0]
    seeds = linear_seeds(likelihood, grid, survey, single, box)
    if known is not None:
        seeds = np.vstack([seeds, known])
    found = refine_all(likelihood, coarse, seeds, box, deviance_single)
    if known is not None:
        return found
    at = peaks(grid, survey.gain, box.fringe_mas)
    if not may_be_bright(survey, at):
        return found
    tried: list[FloatArray] = []
    linear = survey.contrasts[at].max()
    fitted = max(m.companion.contrast for m in found)
    stars = [single]
    if max(linear, fitted) > NOT_FAINT or _misfits(likelihood, found):
        stars = trial_stars(likelihood, single, box)
    others = _other_minima(alone) if likelihood.model.surroundings else []
    for _ in range(MAX_NUISANCE_ROUNDS):
        new = [star for star in stars if _is_new(likelihood, star, tried)] + others
        others = []
        if not new:
            break
        starts = np.vstack([bright_seeds(coarse, star, box) for star in new])
        found += refine_all(likelihood, coarse, starts, box, deviance_single)
        best = max(found, key=lambda m: m.delta_chi2)
        stars = [np.array(best.theta)[likelihood.parameters.nuisance]]
    return found


def _other_minima(fits: Sequence[Fit]) -> list[FloatArray]:
    """Parameters of fits, sorted by their χ², that are of another minimum than the first."""
    values = np.array([value for _, value in fits])
    other = np.flatnonzero(np.diff(values) > ANOTHER_MINIMUM) + 1
    return [fits[k][0] for k in other[:MAX_OTHER_STARS]]


def _misfits(likelihood: Likelihood, found: Sequence[Mode]) -> bool:
    """Whether the best of some fits is far from the data: the star it goes with may be wrong."""
    theta = np.array(max(found, key=lambda m: m.delta_chi2).theta)
    return bool(likelihood.chi2(theta)[0] > MISFIT * likelihood.n_independent)


def _is_new(likelihood: Likelihood, nuisance: FloatArray, tried: list[FloatArray]) -> bool:
    """Whether a star differs from those tried, to which it is added."""
    star = likelihood.model.linear_response(likelihood.samples, nuisance).star
    if any(np.abs(star - other).max() < NUISANCE_HOLDS for other in tried):
        return False
    tried.append(star)
    return True


def _warnings(
    likelihood: Likelihood, modes: Sequence[Mode], aliases: Sequence[Mode]
) -> tuple[str, ...]:
    if modes[0].delta_chi2 <= RIVAL:
        return ()
    warnings, here = [], np.array(modes[0].place)
    # The fit of stars that have changed places is not quite at the opposite place.
    equal = modes[0].contrast > NEARLY_EQUAL
    within = 0.25 * resolution_mas(likelihood) if equal else OPPOSITE_MAS
    opposite = [m for m in modes[1:] if is_opposite(m, here, within)]
    if not likelihood.observables.n_closure_phases:
        if any(m in aliases for m in opposite):
            warnings.append("without closure phases a position cannot be told from its opposite")
    elif equal and any(m.delta_chi2 > modes[0].delta_chi2 - RIVAL for m in opposite):
        warnings.append(
            "fitted as two stars, they are equally bright within the errors: the position may be "
            "the opposite one, 180 deg away, as either may be the companion"
        )
    repeated = [m for m in aliases if m not in opposite]
    if repeated:
        ends = 0.5 * min(np.hypot(*np.subtract(m.place, here)) for m in repeated)
        far = ", ".join(f"{m.companion.separation_mas:.0f}" for m in repeated)
        warnings.append(
            f"beyond {ends:.0f} mas the sky repeats itself for these baselines: {far} mas would "
            "fit as well; of these the innermost is reported"
        )
    return tuple(warnings)

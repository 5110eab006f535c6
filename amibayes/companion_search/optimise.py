"""Nonlinear fits with NLopt: without a companion, and from a seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import nlopt
import numpy as np
from scipy.stats import qmc

from amibayes.companion_search.result import Mode, mode_of
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.parameters import Box, Parameters
from amibayes.units import FloatArray, IntArray

MIN_SPREAD, MAX_SPREAD, SPREAD_WORK = 2048, 8192, 4e6
"""Points of a fit of extended light: fewer where that would be more model values."""

BEST_STARTS, APART = 8, 0.25
"""How many of the best points are fitted to the end, and how far apart these are in one parameter
at least, as a part of its range. Of 2048 points the very best led to another minimum one fit in
five."""

Objective = Callable[[FloatArray, FloatArray], float]

Fit = tuple[FloatArray, float]
"""Parameters, and deviance or χ²."""


ROUNDS, TOLERANCE, EVALUATIONS = 3, 1e-9, 200
"""How often a local fit is taken up again with new scales, the relative change of χ² with which a
round ends, and its evaluations."""

CONVERGED = 1e-3
"""A fit is taken up again, with new scales, until a round gains less than this in χ²."""


CONSTRAINT_SLACK = 1e-7
"""How far, in units of (λ/B)², a separation may stand outside the field."""


EMPTY = np.empty(0)


SHAPE_START, LARGE_DISC = 0.4, 1.3
"""Diameters of a companion, in units of λ/B_max, at which fits of it begin: at 0 χ² has no slope,
and a disc beyond its first null is another minimum."""


STAR_STARTS, STAR_FITS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5), 3
"""Limb darkening and background, as parts of their ranges, at which diameters are tried (with more
of them, the diameters of the minima are others), and how many of the best are fitted to the end."""

SIMPLEX_EVALUATIONS = 400
"""Of a fit without gradients of two or three parameters, which takes some 150."""

STARS_AROUND, SIGMAS_AROUND = 512, 2.0
"""Stars that V² allow, and how many of its errors they scatter by: those whose closure phases are
on the right side of every null may be a hundredth of them."""

FINEST_STEP = 0.0025
"""Scale of a star's parameters in their fit, as a part of their ranges."""


def fit_single(likelihood: Likelihood, known: FloatArray | None = None) -> Fit:
    """Best fit without a companion: its parameters (n_nuisance,) and deviance.

    A ``known`` fit of nearly the same problem, (n_nuisance,), is one of the starting points.
    """
    return fits_single(likelihood, known)[0]


def fits_single(likelihood: Likelihood, known: FloatArray | None = None) -> list[Fit]:
    """All fits without a companion, from several starting points, the best first."""
    without = single_likelihood(likelihood)
    bounds = np.array(without.parameters.bounds(without.parameters.nuisance)).reshape(-1, 2)
    if not len(bounds):
        return [(np.empty(0), float(without.deviance(without.chi2(np.empty((1, 0))))[0]))]
    lower, width = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
    scale = np.maximum(lower + FINEST_STEP * width, 1e-6)
    objective = _objective(without, scale)
    disc = np.array([name == "diameter_mas" for name in without.parameters.names])
    several = bool(disc.any() and not disc.all())
    # A disc has lobes: a fit starts from the best of a ladder of diameters.
    rungs = np.linspace(0.0, 1.0, 201)[:, None] ** 2
    parts = [np.where(disc | ~disc.any(), rungs, rest) for rest in STAR_STARTS]
    ladders = [lower + part * width for part in (parts if several else parts[:1])]
    starts = [_best_of(without, without.chi2, ladder) for ladder in ladders]
    starts = sorted(starts, key=lambda start: start[1])[:STAR_FITS]
    # Angles go round: a fit that passes the end of their range goes on.
    turn = np.where([p.unit == "deg" for p in without.parameters], width, 0.0)
    bounds = bounds + np.outer(turn, [-1.0, 1.0])
    fits = [_minimise(objective, start, scale, bounds) for start, _ in starts]
    if likelihood.model.surroundings:
        n = np.clip(SPREAD_WORK / len(without.samples), MIN_SPREAD, MAX_SPREAD)
        even = qmc.Sobol(len(bounds), rng=np.random.default_rng(0)).random_base2(int(np.log2(n)))
        ladders.append(lower + even ** _powers(without.parameters) * width)
        best = _apart(even, _of_each(without, without.chi2, ladders[-1]))
        fits += [_minimise(objective, ladders[-1][k], scale, bounds) for k in best]
    if several and likelihood.observables.n_vis2:
        fits += _across_walls(without, objective, ladders, fits, scale, bounds)
    if known is not None:
        fits.append(_minimise(objective, known, scale, bounds))
    fits.sort(key=lambda fit: fit[1])
    return [(np.where(turn > 0.0, lower + (x - lower) % width, x), value) for x, value in fits]


Chi2 = Callable[[FloatArray], FloatArray]
"""χ² (n,) of parameter sets (n, n_dim)."""


def _of_each(star: Likelihood, chi2: Chi2, thetas: FloatArray) -> FloatArray:
    """χ² (n,) of many parameter sets, as many at once as memory is good for."""
    return np.concatenate([chi2(part) for part in star.in_parts(thetas)])


def _best_of(star: Likelihood, chi2: Chi2, thetas: FloatArray) -> Fit:
    found = _of_each(star, chi2, thetas)
    return thetas[np.argmin(found)], float(found.min())


def _powers(parameters: Parameters) -> FloatArray:
    """Powers of even numbers that are parts of ranges: most fluxes and sizes are small ones."""
    power = np.ones(len(parameters))
    power[parameters.discs] = 2.0
    power[[p.unit == "" and p.upper > 1.0 for p in parameters]] = 4.0
    return power


def _apart(points: FloatArray, chi2: FloatArray) -> list[int]:
    """Some of the best of points (n, n_dim), none near a better one."""
    left, found = np.ones(len(points), dtype=bool), list[int]()
    while left.any() and len(found) < BEST_STARTS:
        found.append(int(np.argmin(np.where(left, chi2, np.inf))))
        left &= np.abs(points - points[found[-1]]).max(axis=1) > APART
    return found


def _across_walls(
    star: Likelihood,
    objective: Objective,
    ladders: Sequence[FloatArray],
    fits: Sequence[Fit],
    scale: FloatArray,
    bounds: FloatArray,
) -> list[Fit]:
    """Fit a star, past its nulls perhaps, without gradients: from V² alone, and from other fits.

    Where a baseline is at a null its closure phases turn by 180° at once: χ² has walls there,
    at which a fit by gradients ends. That of V² has none, and its best star is next to that of
    all data: the likeliest of those that V² allow is on the right side of the walls.
    """
    n = star.observables.n_vis2
    sigma = np.sqrt(star.noise.covariance.variance[:n, None])

    def chi2_vis2(thetas: FloatArray) -> FloatArray:
        return np.asarray(((star.difference(thetas)[:n] / sigma) ** 2).sum(axis=0))

    def of_vis2(x: FloatArray, _: FloatArray) -> float:
        return float(chi2_vis2((x * scale)[None])[0])

    start, _ = min((_best_of(star, chi2_vis2, ladder) for ladder in ladders), key=lambda f: f[1])
    first, _ = _without_gradients(of_vis2, start, scale, bounds)
    nearest, _ = _best_of(star, star.chi2, _around(first, star.slopes(first)[:n] / sigma, bounds))
    starts = [first, nearest, min(fits, key=lambda fit: fit[1])[0]]
    return [_without_gradients(objective, start, scale, bounds) for start in starts]


def _around(best: FloatArray, slopes: FloatArray, bounds: FloatArray) -> FloatArray:
    """Parameters (n, n_dim) that data of these whitened slopes (n_data, n_dim) allow, in bounds."""
    _, size, turn = np.linalg.svd(slopes, full_matrices=False)
    error = SIGMAS_AROUND / np.maximum(size, 1e-300)
    rng = np.random.default_rng(0)
    draws = qmc.MultivariateNormalQMC(np.zeros(len(size)), rng=rng).random(STARS_AROUND)
    return np.asarray(np.clip(best + (draws * error) @ turn, *bounds.T))


def _without_gradients(
    objective: Objective, start: FloatArray, scale: FloatArray, bounds: FloatArray
) -> Fit:
    optimiser = nlopt.opt(nlopt.LN_SBPLX, len(start))
    optimiser.set_lower_bounds(bounds[:, 0] / scale)
    optimiser.set_upper_bounds(bounds[:, 1] / scale)
    optimiser.set_min_objective(objective)
    optimiser.set_initial_step(np.maximum(0.02 * start / scale, 0.1))
    optimiser.set_ftol_rel(1e-6)
    optimiser.set_maxeval(SIMPLEX_EVALUATIONS)
    found = optimiser.optimize(np.clip(start / scale, *(bounds.T / scale)))
    return found * scale, float(optimiser.last_optimum_value())


def starting_points(
    likelihood: Likelihood,
    places: FloatArray,
    tails: FloatArray,
    nuisance: FloatArray,
    box: Box,
) -> FloatArray:
    """Parameter vectors (n, n_dim) of one companion.

    Parameters
    ----------
    likelihood : Likelihood
    places : (n, 2) float array
        East and north.
    tails : (n, k) float array
        Contrasts and rates.
    nuisance : (n_nuisance,) float array
    box : Box
        Where a disc of a companion is free, it begins at a part of λ/B_max.
    """
    parameters = likelihood.parameters
    theta = np.zeros((len(places), len(parameters)))
    theta[:, parameters.place()] = places
    theta[:, np.concatenate([parameters.contrasts, parameters.rates])] = tails
    theta[:, parameters.nuisance] = nuisance
    for k in np.intersect1d(parameters.columns("shape"), parameters.discs):
        theta[:, k] = min(SHAPE_START * box.fringe_mas, parameters[k].upper)
    return theta


def with_large_discs(likelihood: Likelihood, theta: FloatArray, box: Box) -> FloatArray:
    """Parameter vectors (n, n_dim) again with large discs of companions, where these are free."""
    parameters = likelihood.parameters
    discs = np.intersect1d(parameters.columns("shape"), parameters.discs)
    large = np.array(theta)[: len(theta) if len(discs) else 0]
    large[:, discs] = LARGE_DISC * box.fringe_mas
    return large


def with_disc(
    likelihood: Likelihood, point: FloatArray, box: Box, size: float = SHAPE_START
) -> FloatArray:
    """Parameter vector of a model whose companion has a free disc, from that of a point.

    The disc has a ``size`` in fringes.
    """
    parameters = likelihood.parameters
    theta = np.zeros(len(parameters))
    discs = np.intersect1d(parameters.columns("shape"), parameters.discs)
    theta[np.setdiff1d(np.arange(len(theta)), discs)] = point
    theta[discs] = size * box.fringe_mas
    return theta


def refine(
    likelihood: Likelihood,
    seed: FloatArray,
    box: Box,
    deviance_single: float,
) -> Mode:
    """Fit all free parameters from a seed (n_dim,), staying near it and inside the field."""
    parameters = likelihood.parameters
    bounds = np.array(parameters.bounds(parameters.columns()))
    places = parameters.columns("position")
    bounds[places] = seed[places, None] + box.fringe_mas * np.array([-1.0, 1.0])
    theta, deviance = seed, np.inf
    for _ in range(ROUNDS):
        scale = _natural_scale(likelihood, theta, box)
        each = [parameters.place(k + 1) for k in range(parameters.companions)]
        limits = [x for place in each for x in _field_limits(seed, box, scale, place)]
        before = deviance
        objective = _objective(likelihood, scale)
        theta, deviance = _minimise(objective, theta, scale, bounds, limits)
        if deviance > before - tolerance_of(likelihood, deviance):
            break
    return mode_of(parameters, theta, deviance_single - deviance)


def tolerance_of(likelihood: Likelihood, chi2: Any) -> Any:
    """Gain below which a fit has arrived: `CONVERGED`, in units of χ² per datum where that is more.

    Of a model that is far from the data no such difference is one of noise.
    """
    return CONVERGED * np.maximum(chi2 / likelihood.n_independent, 1.0)


def _natural_scale(likelihood: Likelihood, theta: FloatArray, box: Box) -> FloatArray:
    """Step of each parameter that moves the data by 1σ: makes χ² round, whatever its size."""
    length = np.linalg.norm(likelihood.jacobian(theta), axis=0)
    return np.asarray(1.0 / np.maximum(length, 1.0 / widest_steps(likelihood, box)))


def widest_steps(likelihood: Likelihood, box: Box) -> FloatArray:
    """Steps (n_dim,) of parameters that the data hardly know."""
    parameters = likelihood.parameters
    widest = np.full(len(parameters), 1.0)
    widest[parameters.columns("position")] = 0.3 * box.fringe_mas
    widest[parameters.contrasts] = 0.3
    widest[parameters.rates] = 0.5 * likelihood.model.fastest_mas_yr
    discs = np.intersect1d(parameters.columns("shape"), parameters.discs)
    widest[discs] = 0.3 * box.fringe_mas
    return widest


def refine_at(
    likelihood: Likelihood,
    position: FloatArray,
    tail: FloatArray,
    single: FloatArray,
    box: Box,
    deviance_single: float,
) -> Mode:
    """Fit from a position (2,) with the contrasts and rates that a matched filter gives there."""
    seed = starting_points(likelihood, position[None], tail[None], single, box)[0]
    bright = likelihood.parameters.contrasts
    low, high = np.array(likelihood.parameters.bounds(bright)).T
    seed[bright] = np.clip(seed[bright], low, high)
    return refine(likelihood, seed, box, deviance_single)


def _objective(likelihood: Likelihood, scale: FloatArray) -> Objective:
    """Deviance and its gradient in scaled variables, as NLopt asks for them."""

    def deviance(x: FloatArray, gradient: FloatArray) -> float:
        value, slope = likelihood.log_prob_and_gradient((x * scale)[None])
        if gradient.size:
            gradient[:] = -2.0 * slope[0] * scale
        return float(-2.0 * (value[0] - likelihood.log_norm))

    return deviance


def _field_limits(
    seed: FloatArray, box: Box, scale: FloatArray, place: IntArray
) -> list[Objective]:
    """Constraints ≤ 0 that keep a companion inside the field, if it might leave it.

    ``place`` are the columns of its position.
    """
    rho = float(np.hypot(*seed[place]))
    reach = 1.5 * box.fringe_mas
    limits: list[Objective] = []
    if rho + reach > box.outer_mas:
        limits.append(_separation_limit(box, scale, place, +1.0, box.outer_mas))
    if rho - reach < box.inner_mas:
        limits.append(_separation_limit(box, scale, place, -1.0, box.inner_mas))
    return limits


def _separation_limit(
    box: Box, scale: FloatArray, place: IntArray, sign: float, limit_mas: float
) -> Objective:
    squared = (scale[place] / box.fringe_mas) ** 2

    def excess(x: FloatArray, gradient: FloatArray) -> float:
        if gradient.size:
            gradient[:] = 0.0
            gradient[place] = 2.0 * sign * squared * x[place]
        return float(sign * (squared @ x[place] ** 2 - (limit_mas / box.fringe_mas) ** 2))

    return excess


def _minimise(
    objective: Objective,
    start: FloatArray,
    scale: FloatArray,
    bounds: FloatArray,
    limits: Sequence[Objective] = (),
) -> tuple[FloatArray, float]:
    """Minimise inside bounds (n, 2); what counts is the best allowed point seen.

    SLSQP is the fastest; where it breaks down CCSAQ takes over from its best point.
    """
    low, high = bounds.T / scale
    inside = np.clip(start / scale, low, high)
    best, least = inside, np.inf

    def watched(x: FloatArray, gradient: FloatArray) -> float:
        nonlocal best, least
        value = objective(x, gradient)
        if value < least and all(limit(x, EMPTY) <= CONSTRAINT_SLACK for limit in limits):
            best, least = x.copy(), value
        return value

    for algorithm in (nlopt.LD_SLSQP, nlopt.LD_CCSAQ):
        optimiser = nlopt.opt(algorithm, len(start))
        optimiser.set_lower_bounds(low)
        optimiser.set_upper_bounds(high)
        optimiser.set_min_objective(watched)
        for limit in limits:
            optimiser.add_inequality_constraint(limit, CONSTRAINT_SLACK)
        optimiser.set_ftol_rel(TOLERANCE)
        optimiser.set_maxeval(EVALUATIONS)
        try:
            optimiser.optimize(best)
        except nlopt.RoundoffLimited:
            pass  # it can improve no further: the best point stands
        except nlopt.runtime_error:
            continue  # its quadratic subproblem failed: the slower one, which has none, goes on
        break
    return best * scale, least

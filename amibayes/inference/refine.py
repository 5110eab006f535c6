"""Nonlinear fits with NLopt: without a companion, from a seed, and over the whole field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import nlopt
import numpy as np

from amibayes.inference.bank import TemplateBank
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.results import Mode
from amibayes.units import MAS, FloatArray

Objective = Callable[[FloatArray, FloatArray], float]

MAX_BACKGROUND = 10.0
"""Largest over-resolved flux, in units of the primary's."""

MAX_CONTRAST = 1.0
"""A companion brighter than its primary is the same binary seen from the other star."""

GLOBAL_EVALUATIONS = 3000

CONVERGED = 1e-9
"""Relative change of χ² at which a local fit stops."""


@dataclass(frozen=True)
class Box:
    """The field of a search: separations, λ/B_max, and a typical error of the contrast."""

    inner_mas: float
    outer_mas: float
    fringe_mas: float
    contrast_scale: float


def single_likelihood(likelihood: Likelihood) -> Likelihood:
    """Make the likelihood without a companion, other parameters as they are."""
    return likelihood.with_model(replace(likelihood.model, companions=0))


def nuisance_bounds(likelihood: Likelihood) -> list[tuple[float, float]]:
    """Ranges of the free diameter (to λ/B_min) and background."""
    widest = 1.0 / likelihood.samples.frequency.min() / MAS
    ranges = {"diameter_mas": (0.0, widest), "background": (0.0, MAX_BACKGROUND)}
    return [ranges[name] for name in likelihood.parameters if name in ranges]


def fit_single(likelihood: Likelihood) -> tuple[FloatArray, float]:
    """Best fit without a companion: its parameters (n_nuisance,) and χ²."""
    without = single_likelihood(likelihood)
    bounds = np.array(nuisance_bounds(likelihood)).reshape(-1, 2)
    if not len(bounds):
        return np.empty(0), float(without.chi2(np.empty((1, 0)))[0])
    # A disc has lobes: the fit starts from the best of a ladder of values.
    ladder = bounds[:, 0] + np.outer(np.linspace(0.0, 1.0, 201) ** 2, bounds[:, 1] - bounds[:, 0])
    start = ladder[np.argmin(without.chi2(ladder))]
    scale = np.maximum(ladder[10], 1e-6)
    return _minimise(_objective(without, scale), start, scale, bounds)


def refine(likelihood: Likelihood, seed: FloatArray, box: Box, chi2_single: float) -> Mode:
    """Fit all free parameters from a seed (n_dim,), staying near it and inside the field."""
    scale = np.array([box.fringe_mas, box.fringe_mas, max(box.contrast_scale, 0.3 * seed[2])])
    near = np.array([[x - box.fringe_mas, x + box.fringe_mas] for x in seed[:2]])
    nuisance = np.array(nuisance_bounds(likelihood)).reshape(-1, 2)
    bounds = np.vstack([near, [[0.0, MAX_CONTRAST]], nuisance])
    scale = np.concatenate([scale, 0.1 * np.maximum(seed[3:], 0.1)])
    theta, chi2 = _minimise(
        _objective(likelihood, scale), seed, scale, bounds, _field_limits(seed, box)
    )
    return Mode(tuple(float(x) for x in theta), chi2_single - chi2)


def global_check(
    likelihood: Likelihood, bank: TemplateBank, box: Box, single: FloatArray, chi2_single: float
) -> Mode:
    """Look for the best position with NLopt's DIRECT-L over the whole field, then refine it.

    It shares neither the lattice nor the choice of peaks with the search. A field of very
    many fringes is more than it can cover; what it finds is a lower bound then.
    """
    residuals = single_likelihood(likelihood).residuals(single)[:, 0]
    best_at = bank.matched_filter(residuals)

    def inside(position: FloatArray) -> bool:
        return box.inner_mas <= float(np.hypot(*position)) <= box.outer_mas

    def loss(position: FloatArray, _: FloatArray) -> float:
        return -best_at(position)[1] if inside(position) else 0.0

    optimiser = nlopt.opt(nlopt.GN_DIRECT_L, 2)
    optimiser.set_lower_bounds([-box.outer_mas] * 2)
    # The box is a little lopsided so that its first trial is not the star itself.
    optimiser.set_upper_bounds([1.03 * box.outer_mas, 1.07 * box.outer_mas])
    optimiser.set_min_objective(loss)
    optimiser.set_maxeval(GLOBAL_EVALUATIONS)
    start = np.array([0.0, 0.5 * (box.inner_mas + box.outer_mas)])
    position = np.asarray(optimiser.optimize(start))
    position = position if inside(position) else start
    contrast = np.clip(best_at(position)[0], 0.0, MAX_CONTRAST)
    return refine(likelihood, np.concatenate([position, [contrast], single]), box, chi2_single)


def _objective(likelihood: Likelihood, scale: FloatArray) -> Objective:
    """χ² and its gradient in scaled variables, as NLopt asks for them."""

    def chi2(x: FloatArray, gradient: FloatArray) -> float:
        value, slope = likelihood.log_prob_and_gradient((x * scale)[None])
        if gradient.size:
            gradient[:] = -2.0 * slope[0] * scale
        return float(-2.0 * (value[0] - likelihood.log_norm))

    return chi2


def _field_limits(seed: FloatArray, box: Box) -> list[Objective]:
    """Constraints ≤ 0 that keep the separation inside the field, where it might leave it."""
    rho = float(np.hypot(seed[0], seed[1]))
    reach = 1.5 * box.fringe_mas
    limits: list[Objective] = []
    if rho + reach > box.outer_mas:
        limits.append(_separation_limit(box, +1.0, box.outer_mas))
    if rho - reach < box.inner_mas:
        limits.append(_separation_limit(box, -1.0, box.inner_mas))
    return limits


def _separation_limit(box: Box, sign: float, limit_mas: float) -> Objective:
    def excess(x: FloatArray, gradient: FloatArray) -> float:
        if gradient.size:
            gradient[:] = 0.0
            gradient[:2] = 2.0 * sign * x[:2]
        return float(sign * (x[:2] @ x[:2] - (limit_mas / box.fringe_mas) ** 2))

    return excess


def _minimise(
    objective: Objective,
    start: FloatArray,
    scale: FloatArray,
    bounds: FloatArray,
    limits: list[Objective] | None = None,
) -> tuple[FloatArray, float]:
    """Minimise with SLSQP inside bounds (n, 2); the best point seen is what counts."""
    optimiser = nlopt.opt(nlopt.LD_SLSQP, len(start))
    optimiser.set_lower_bounds(bounds[:, 0] / scale)
    optimiser.set_upper_bounds(bounds[:, 1] / scale)
    optimiser.set_min_objective(objective)
    for limit in limits or []:
        optimiser.add_inequality_constraint(limit, 1e-9)
    optimiser.set_ftol_rel(CONVERGED)
    optimiser.set_maxeval(200)
    inside = np.clip(start / scale, bounds[:, 0] / scale, bounds[:, 1] / scale)
    try:
        best = np.asarray(optimiser.optimize(inside))
    except nlopt.RoundoffLimited:
        # SLSQP stops this way when it can no longer improve: the start was the minimum.
        best = inside
    return best * scale, objective(best, np.empty(0))

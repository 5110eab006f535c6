"""A second companion: the template bank on what the first one leaves, then a joint fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.optimise import refine, starting_points
from amibayes.companion_search.result import Companion, Mode, SearchResult, companions_of, mode_of
from amibayes.companion_search.seeds import MODE_LIMIT, peaks
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.errors import DataError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.parameters import Box, Parameters
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Shown
from amibayes.units import FloatArray

FIRST_MODES = 3
"""Solutions with one companion from which a second one is looked for."""

SEEDS = 8
"""Positions of the second companion that are refined, for each of them."""

MAX_ROUNDS = 4
"""How often each companion is looked for again on what the other one leaves."""


@dataclass(frozen=True, eq=False, repr=False)
class TwoCompanions(Shown):
    """The joint fit of two companions, the brighter one first.

    Parameters
    ----------
    likelihood : Likelihood
        Of the model with two.
    theta : (n_dim,) float array
    theta_covariance : (n_dim, n_dim) float array
    chi2 : float
    modes : tuple of Mode
        Distinct solutions within Δχ² 25 of the best, best first.
    """

    likelihood: Likelihood
    theta: FloatArray
    theta_covariance: FloatArray
    chi2: float
    modes: tuple[Mode, ...]

    @property
    def companions(self) -> tuple[Companion, ...]:
        """Both, with errors from the inverse Hessian of the joint fit."""
        return companions_of(self.likelihood.parameters, self.theta, self.theta_covariance)


@checks_arguments
def search_second(result: SearchResult) -> TwoCompanions:
    """Look for a second companion beside the one that was found, and fit both together.

    Parameters
    ----------
    result : SearchResult
        Its field, lattice, model and modes are those of both companions.

    Raises
    ------
    DataError
        Where there are not more independent data than parameters.
    """
    one = result.likelihood
    two = one.with_model(replace(one.model, companions=2))
    if two.n_independent <= len(two.parameters):
        raise DataError(
            f"holds {two.n_independent} independent data for the {len(two.parameters)} "
            "parameters of two companions",
            source=two.observables.source,
            remedy="ask for fewer companions",
        )
    bank = TemplateBank(one, result.grid, result.single_theta)
    found: list[Mode] = []
    for first in result.modes[:FIRST_MODES]:
        found += _beside(result, bank, two, np.array(first.theta))
    found = _iterated(result, bank, two, found)
    modes = _distinct(found, 0.25 * resolution_mas(one))
    theta = np.array(modes[0].theta)
    return TwoCompanions(two, theta, two.errors(theta), float(two.chi2(theta)[0]), modes)


def _beside(
    result: SearchResult, bank: TemplateBank, two: Likelihood, first: FloatArray
) -> list[Mode]:
    """Joint fits from the first companion (n_dim of one) and peaks of what it leaves."""
    fringe = resolution_mas(two)
    survey = bank.survey(result.likelihood.residuals(first)[:, 0])
    gain, grid, parameters = survey.gain.copy(), result.grid, result.likelihood.parameters
    place = first[parameters.place()]
    # What stands at the first companion's own place is its error, not another one.
    apart = np.hypot(grid.east_mas - place[0], grid.north_mas - place[1])
    gain[apart < 0.25 * fringe] = 0.0
    at = peaks(grid, gain, fringe)[:SEEDS]
    if not len(at):
        # Light of a second companion is of no use anywhere: the fit begins, and ends, with none.
        at = np.array([np.argmax(apart)])
    box = Box(grid.inner_mas, grid.outer_mas, fringe)
    places = np.column_stack([grid.east_mas[at], grid.north_mas[at]])
    points = starting_points(
        result.likelihood, places, survey.bounded(at), first[parameters.nuisance], box
    )
    second = points[:, parameters.companion()]
    single = float(two.deviance(result.chi2_single))
    one, rest = first[parameters.companion()], first[parameters.nuisance]
    seeds = [np.concatenate([one, other, rest]) for other in second]
    return [_bright_first(refine(two, s, box, single), two.parameters) for s in seeds]


def _iterated(
    result: SearchResult, bank: TemplateBank, two: Likelihood, found: list[Mode]
) -> list[Mode]:
    """Look for each companion again on what the other one leaves, until nothing is gained."""
    columns = two.parameters
    for _ in range(MAX_ROUNDS):
        best = max(found, key=lambda m: m.delta_chi2)
        theta = np.array(best.theta)
        again = [
            mode
            for kept in (theta[columns.companion(1)], theta[columns.companion(2)])
            for mode in _beside(result, bank, two, np.concatenate([kept, theta[columns.nuisance]]))
        ]
        found = found + again
        if max(m.delta_chi2 for m in again) < best.delta_chi2 + 1e-2:
            break
    return found


def _bright_first(mode: Mode, parameters: Parameters) -> Mode:
    first, second = mode.companions
    if second.contrast <= first.contrast:
        return mode
    return mode_of(parameters, np.array(mode.theta)[parameters.swapped], mode.delta_chi2)


def _distinct(found: Sequence[Mode], apart_mas: float) -> tuple[Mode, ...]:
    """Solutions of which at least one companion stands elsewhere than in any better one."""
    kept: list[Mode] = []
    for mode in sorted(found, key=lambda m: -m.delta_chi2):
        if kept and mode.delta_chi2 < kept[0].delta_chi2 - MODE_LIMIT:
            break
        if not any(_alike(mode, other, apart_mas) for other in kept):
            kept.append(mode)
    return tuple(kept)


def _alike(mode: Mode, other: Mode, apart_mas: float) -> bool:
    places, others = ([(c.east_mas, c.north_mas) for c in m.companions] for m in (mode, other))
    moved = [np.abs(np.subtract(places, order)).max() for order in (others, others[::-1])]
    return bool(min(moved) < apart_mas)

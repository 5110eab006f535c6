"""A second companion: the template bank on what the first one leaves, then a joint fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.joint_bank import bank_of
from amibayes.companion_search.optimise import refine
from amibayes.companion_search.result import Companion, Mode, SearchResult, companion_of
from amibayes.companion_search.search import MODE_LIMIT, peaks, resolution_mas
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.errors import DataError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.parameters import Box
from amibayes.units import FloatArray

FIRST_MODES = 3
"""Solutions with one companion from which a second one is looked for."""

SEEDS = 8
"""Positions of the second companion that are refined, for each of them."""

MAX_ROUNDS = 4
"""How often each companion is looked for again on what the other one leaves."""


@dataclass(frozen=True, eq=False)
class TwoCompanions:
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
    def companions(self) -> tuple[Companion, Companion]:
        """Both, with errors from the inverse Hessian of the joint fit."""
        second = self.likelihood.model.width + np.arange(3)
        covariance = self.theta_covariance[np.ix_(second, second)]
        return (
            companion_of(self.theta, self.theta_covariance),
            companion_of(self.theta[second], covariance),
        )


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
    bank = bank_of(one, result.grid, result.single_theta)
    found: list[Mode] = []
    for first in result.modes[:FIRST_MODES]:
        found += _beside(result, bank, two, np.array(first.theta))
    found = _settled(result, bank, two, found)
    modes = _distinct(found, 0.25 * resolution_mas(one), one.model.width)
    theta = np.array(modes[0].theta)
    return TwoCompanions(two, theta, two.errors(theta), float(two.chi2(theta)[0]), modes)


def _beside(
    result: SearchResult, bank: TemplateBank, two: Likelihood, first: FloatArray
) -> list[Mode]:
    """Joint fits from the first companion (n_dim of one) and peaks of what it leaves."""
    fringe = resolution_mas(two)
    survey = bank.survey(result.likelihood.residuals(first)[:, 0])
    gain, grid, w = survey.gain.copy(), result.grid, two.model.width
    # What stands at the first companion's own place is its error, not another one.
    gain[np.hypot(grid.east_mas - first[0], grid.north_mas - first[1]) < 0.25 * fringe] = 0.0
    at = peaks(grid, gain, fringe)[:SEEDS]
    second = np.column_stack([grid.east_mas[at], grid.north_mas[at], survey.bounded(at)])
    box = Box(grid.inner_mas, grid.outer_mas, fringe)
    single = float(two.deviance(result.chi2_single))
    seeds = [np.concatenate([first[:w], place, first[w:]]) for place in second]
    return [_bright_first(refine(two, s, box, single), w) for s in seeds]


def _settled(
    result: SearchResult, bank: TemplateBank, two: Likelihood, found: list[Mode]
) -> list[Mode]:
    """Look for each companion again on what the other one leaves, until nothing is gained."""
    w = two.model.width
    for _ in range(MAX_ROUNDS):
        best = max(found, key=lambda m: m.delta_chi2)
        theta = np.array(best.theta)
        again = [
            mode
            for kept in (theta[:w], theta[w : 2 * w])
            for mode in _beside(result, bank, two, np.concatenate([kept, theta[2 * w :]]))
        ]
        found = found + again
        if max(m.delta_chi2 for m in again) < best.delta_chi2 + 1e-2:
            break
    return found


def _bright_first(mode: Mode, width: int) -> Mode:
    theta = mode.theta
    if theta[width + 2] > theta[2]:
        theta = (*theta[width : 2 * width], *theta[:width], *theta[2 * width :])
    return Mode(theta, mode.delta_chi2)


def _distinct(found: Sequence[Mode], apart_mas: float, width: int) -> tuple[Mode, ...]:
    """Solutions of which at least one companion stands elsewhere than in any better one."""
    kept: list[Mode] = []
    for mode in sorted(found, key=lambda m: -m.delta_chi2):
        if kept and mode.delta_chi2 < kept[0].delta_chi2 - MODE_LIMIT:
            break
        if not any(_alike(mode, other, apart_mas, width) for other in kept):
            kept.append(mode)
    return tuple(kept)


def _alike(mode: Mode, other: Mode, apart_mas: float, width: int) -> bool:
    a, b = np.array(mode.theta), np.array(other.theta)
    places = [0, 1, width, width + 1]
    orders = (b[places], b[[*places[2:], *places[:2]]])
    moved = [np.abs(a[places] - place).max() for place in orders]
    return bool(min(moved) < apart_mas)

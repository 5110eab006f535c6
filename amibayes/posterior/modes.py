"""Modes of a search in the posterior: which a chain explores, and how probable each is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.result import Mode, SearchResult
from amibayes.posterior.grid import GridPosterior
from amibayes.posterior.laplace import log_masses
from amibayes.posterior.priors import Prior
from amibayes.units import (
    BoolArray,
    FloatArray,
)

STRONG = 30.0
"""Δχ² above which a mode is an island in the sea of noise."""


def modes_to_sample(result: SearchResult) -> tuple[Mode, ...]:
    """Choose the modes that one chain explores.

    Where there are strong ones it is that of the reported one: a mean over positions apart
    is no position. Weak ones are joined by the sea of noise around them.
    """
    strong = result.modes[0].delta_chi2 > STRONG
    return result.modes[:1] if strong else result.modes


@dataclass(frozen=True, eq=False)
class Region:
    """Where a chain is at home: nearer to the reported mode than to any that it leaves out.

    Parameters
    ----------
    places : (n, 2) float array
        East and north of the modes, mas, the reported one first; it alone where the chain
        explores all of the field.
    """

    places: FloatArray

    @classmethod
    def of(cls, result: SearchResult) -> Region:
        """Region of the chain of a search's result."""
        reported, *others = (mode.place for mode in result.modes)
        if modes_to_sample(result) == result.modes:
            others = []
        least = 0.5 * resolution_mas(result.likelihood)  # nearer ones are of the same position
        apart = [place for place in others if math.dist(place, reported) > least]
        return cls(np.array([reported, *apart]))

    def holds(self, east: FloatArray, north: FloatArray) -> BoolArray:
        """Whether positions (n,) are in it."""
        away = np.hypot(east[:, None] - self.places[:, 0], north[:, None] - self.places[:, 1])
        return np.asarray(away.argmin(axis=1) == 0)


def mode_probabilities(
    result: SearchResult, prior: Prior, grid: GridPosterior | None = None
) -> FloatArray:
    """Probability of each mode among the modes, (n_modes,).

    By the grid posterior within λ/2B of each mode, where there is one; else by Laplace's
    approximation.
    """
    if grid is not None:
        mass = mode_masses(result, grid)
        if mass.sum() > 0.0:
            return np.asarray(mass / mass.sum())
    log_mass = log_masses(result.likelihood, result.modes, prior)
    weight = np.exp(log_mass - log_mass.max())
    return np.asarray(weight / weight.sum())


def mode_masses(result: SearchResult, grid: GridPosterior) -> FloatArray:
    """Posterior probability within λ/2B of each mode; what is missing to 1 is elsewhere."""
    places = np.array([m.place for m in result.modes])
    return grid.mass_near(places, 0.5 * resolution_mas(result.likelihood))


def elsewhere(result: SearchResult, grid: GridPosterior) -> float:
    """Posterior probability farther than λ/2B from every mode."""
    return max(1.0 - float(mode_masses(result, grid).sum()), 0.0)

"""How the walkers of a chain move, for all chains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import emcee
import numpy as np

from amibayes.units import FloatArray

IndependenceMove = Callable[[FloatArray, np.random.RandomState], tuple[FloatArray, FloatArray]]
"""Places (n, n_dim) proposed for walkers (n, n_dim), and ln q(old)/q(new), (n,)."""


class Proposal(Protocol):
    """Places in the sampled coordinates, and their density."""

    def draw(self, rng: np.random.Generator | np.random.RandomState, n: int) -> FloatArray:
        """Draws (n, n_dim)."""
        ...

    def log_density(self, x: FloatArray) -> FloatArray:
        """ln of the density at x (n, n_dim), (n,)."""
        ...


def independence_move(proposal: Proposal) -> IndependenceMove:
    """Proposals that do not start from where a walker is, for `emcee.moves.MHMove`."""

    def move(walkers: FloatArray, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        places = proposal.draw(random, len(walkers))
        return places, proposal.log_density(walkers) - proposal.log_density(places)

    return move


def along_others() -> list[tuple[emcee.moves.Move, float]]:
    """Moves along differences of other walkers, and how often each is made.

    Differential evolution (ter Braak 2006), every fifth time by a whole difference, which
    leads from mode to mode. emcee's snooker move (3.1) is not among them: its step is divided
    by the root of the walkers' distance and its Hastings factor is that of half the
    dimensions, so that narrow posteriors come out up to a tenth too narrow.
    """
    return [(emcee.moves.DEMove(), 0.8), (emcee.moves.DEMove(gamma0=1.0), 0.2)]

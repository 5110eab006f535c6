"""How the walkers of a chain move, for all chains."""

from __future__ import annotations

import emcee


def along_others() -> list[tuple[emcee.moves.Move, float]]:
    """Moves along differences of other walkers, and how often each is made.

    Differential evolution (ter Braak 2006), every fifth time by a whole difference, which
    leads from mode to mode. emcee's snooker move (3.1) is not among them: its step is divided
    by the root of the walkers' distance and its Hastings factor is that of half the
    dimensions, so that narrow posteriors come out up to a tenth too narrow.
    """
    return [(emcee.moves.DEMove(), 0.8), (emcee.moves.DEMove(gamma0=1.0), 0.2)]

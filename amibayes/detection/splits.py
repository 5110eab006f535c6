"""What is said of data that were compared part by part, and how far apart parts go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from amibayes.units import FloatArray

Split = Literal["observables", "files", "epochs", "calibrators"]

SIMULATIONS = 4000
"""Draws: a probability of 0.0013 is then known to 45 %."""

ENOUGH = 100
"""Draws as extreme as the data after which no more are made: p is known to 10 % (Besag & Clifford
1991)."""

SINGULAR = 1e-10
"""Directions that a part measures so much worse than its best one it does not measure."""


@dataclass(frozen=True)
class Consistency:
    """How far the parts of a split go apart.

    Parameters
    ----------
    split : {"observables", "files", "epochs", "calibrators"}
    parts : tuple of str
    delta_chi2 : float
        Gain in χ² of the parts apart over the parts together.
    p : float
        Share of simulated data sets that go as far apart.
    """

    split: Split
    parts: tuple[str, ...]
    delta_chi2: float
    p: float


def gain_of(fisher: FloatArray, slope: FloatArray, scale: FloatArray) -> FloatArray:
    """Gain in χ² of the best change of the parameters, (n,)."""
    inverse = np.linalg.pinv(fisher / np.outer(scale, scale), rcond=SINGULAR, hermitian=True)
    unit = slope / scale[:, None]
    return np.asarray((unit * (inverse @ unit)).sum(axis=0))


def motion_words(*, moves: bool) -> str:
    """What may explain nights that disagree, with a motion in the model or without one."""
    return "--fastest, or another kind of motion" if moves else "a motion (--motion)"


def most_telling(apart: Sequence[Consistency]) -> Consistency | None:
    """Of splits that go apart, the one that is stated; none of V² against closure phases.

    Where each file is a night both splits are the same, and nights tell more.
    """
    others = [s for s in apart if s.split != "observables"]
    nights = [s for s in others if s.split == "epochs" and len(s.parts) == len(others[0].parts)]
    return next(iter(nights or others), None)

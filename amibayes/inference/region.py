"""Where a chain is at home: the whole field, or about the reported one of strong modes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from amibayes.inference.results import Mode, SearchResult
from amibayes.inference.search import resolution_mas
from amibayes.observables import BoolArray
from amibayes.units import FloatArray

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
        reported, *others = (mode.theta[:2] for mode in result.modes)
        if modes_to_sample(result) == result.modes:
            others = []
        least = 0.5 * resolution_mas(result.likelihood)  # nearer ones are of the same position
        apart = [place for place in others if math.dist(place, reported) > least]
        return cls(np.array([reported, *apart]))

    def holds(self, east: FloatArray, north: FloatArray) -> BoolArray:
        """Whether positions (n,) are in it."""
        away = np.hypot(east[:, None] - self.places[:, 0], north[:, None] - self.places[:, 1])
        return np.asarray(away.argmin(axis=1) == 0)

"""What a validation simulates, and how often."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from amibayes.units import FloatArray
from amibayes.validation.images import SimulatedExposure

RANGES: dict[str, tuple[float, float]] = {
    "faint": (1e-5, 1e-3),
    "middling": (1e-3, 1e-2),
    "bright": (1e-2, 0.5),
}
"""Contrasts of the truths: lost in the noise, at the limit, and plain."""


class Condition(Protocol):
    """How stars are observed: it writes the files that a search is given."""

    @property
    def field_mas(self) -> tuple[float, float]:
        """Separations of the truths, and the field that is searched."""

    def write(
        self, truth: FloatArray | None, seed: np.random.SeedSequence, folder: Path
    ) -> tuple[list[Path], list[Path]]:
        """Write files of a star with a companion, or of one alone, and those of calibrators.

        ``truth`` is east and north (mas) and contrast.
        """


@dataclass(frozen=True)
class ValidationPlan:
    """How much is simulated.

    Parameters
    ----------
    name : str
    settings : tuple of Condition
        Taken in turn.
    per_range : int
        Companions drawn from the prior in each of `RANGES`.
    n_alone : int
        Stars without a companion.
    null_draws : int
        Null searches of every data set.
    alpha : float
        False-alarm probability that counts as a detection.
    options : mapping
        Further options of the search (`amibayes.SearchOptions`) of every star.
    """

    name: str
    settings: tuple[Condition, ...]
    per_range: int
    n_alone: int
    null_draws: int
    alpha: float = 0.01
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kinds(self) -> list[str]:
        """Kind of each trial, in order: the kinds take turns, so that all end together."""
        counts = {name: self.per_range for name in RANGES} | {"alone": self.n_alone}
        place = {name: [(k + 0.5) / n for k in range(n)] for name, n in counts.items()}
        turns = sorted((x, name) for name, xs in place.items() for x in xs)
        return [name for _, name in turns]


QUICK = ValidationPlan("quick", (SimulatedExposure("F430M", 7, 30, 2),), 8, 12, 1000)

FULL = ValidationPlan(
    "full",
    (
        SimulatedExposure("F380M", 7, 60, 3),
        SimulatedExposure("F430M", 14, 40, 4),
        SimulatedExposure("F480M", 19, 120, 3),
    ),
    334,
    2000,
    2000,
)
"""Enough stars that a share of 0.01 of those alone is known to 0.002."""

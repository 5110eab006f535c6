"""What a validation simulates, and how often."""

from __future__ import annotations

from dataclasses import dataclass

FIELD_MAS = (50.0, 400.0)
"""Separations of the truths, and the field that is searched."""

RANGES: dict[str, tuple[float, float]] = {
    "faint": (1e-5, 1e-3),
    "middling": (1e-3, 1e-2),
    "bright": (1e-2, 0.5),
}
"""Contrasts of the truths: lost in the noise, at the limit, and plain."""

MAGNITUDE = 6.0


@dataclass(frozen=True)
class SimulatedExposure:
    """An exposure of a star of magnitude 6, and how many calibrators it comes with."""

    filter: str
    n_groups: int
    n_integrations: int
    n_calibrators: int


@dataclass(frozen=True)
class ValidationPlan:
    """How much is simulated.

    Parameters
    ----------
    name : str
    settings : tuple of SimulatedExposure
        Taken in turn.
    per_range : int
        Companions drawn from the prior in each of `RANGES`.
    n_alone : int
        Stars without a companion.
    null_draws : int
        Null searches of every data set.
    alpha : float
        False-alarm probability that counts as a detection.
    """

    name: str
    settings: tuple[SimulatedExposure, ...]
    per_range: int
    n_alone: int
    null_draws: int
    alpha: float = 0.01

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
    60,
    300,
    2000,
)

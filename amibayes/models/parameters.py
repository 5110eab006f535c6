"""Parameters of a source model: what each one is, by name, role and component."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from amibayes.models.bands import band_name
from amibayes.units import MAS, IntArray

Role = Literal["position", "flux", "rate", "shape", "nuisance"]

MAX_BACKGROUND = 10.0
"""Largest over-resolved flux, in units of the primary's."""

MAX_CONTRAST = 1.0
"""A companion brighter than its primary is the same binary seen from the other star."""


UNITS = (("_mas_yr", " (mas/yr)"), ("_mas", " (mas)"), ("_deg", " (°)"))
"""What names of parameters end with, and what a reader is shown."""


@dataclass(frozen=True)
class Parameter:
    """A free parameter.

    Parameters
    ----------
    name : str
    unit : str
        Empty for a pure number.
    role : {"position", "flux", "rate", "shape", "nuisance"}
        What it does: companions have a position, fluxes, rates and shapes; whatever belongs
        to the star or to the background is a nuisance.
    component : int
        0 for the star and the background, k for companion k = 1, 2, …
    lower, upper : float
        Range. Infinite where only the data bound it.
    """

    name: str
    unit: str
    role: Role
    component: int
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True)
class Parameters:
    """The free parameters of a model, in the order of a parameter vector.

    Columns are looked up by name, role and component, never by number.

    Parameters
    ----------
    items : tuple of Parameter
    """

    items: tuple[Parameter, ...] = ()

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.items)

    def __getitem__(self, k: int) -> Parameter:
        return self.items[k]

    @property
    def names(self) -> tuple[str, ...]:
        """Names, in order."""
        return tuple(p.name for p in self.items)

    @property
    def companions(self) -> int:
        """Number of companions."""
        return max((p.component for p in self.items), default=0)

    def columns(self, *roles: Role, component: int | None = None) -> IntArray:
        """Where the parameters of any of some roles stand, of one component or of all.

        Without a role, all parameters.
        """
        found = [
            k
            for k, p in enumerate(self.items)
            if (not roles or p.role in roles) and (component is None or p.component == component)
        ]
        return np.array(found, dtype=np.intp)

    def companion(self, k: int = 1) -> IntArray:
        """Columns of companion ``k``."""
        return self.columns(component=k)

    def place(self, k: int = 1) -> IntArray:
        """Columns of the east and north of companion ``k``, (2,)."""
        return self.columns("position", component=k)

    @property
    def contrasts(self) -> IntArray:
        """Columns of the contrasts of all companions."""
        return self.columns("flux")

    @property
    def rates(self) -> IntArray:
        """Columns of the rates of all companions."""
        return self.columns("rate")

    @property
    def nuisance(self) -> IntArray:
        """Columns of what belongs to no companion: the star and the background."""
        return self.columns(component=0)

    @property
    def discs(self) -> IntArray:
        """Columns of diameters."""
        return np.array([k for k, p in enumerate(self.items) if _is_size(p)], dtype=np.intp)

    @property
    def swapped(self) -> IntArray:
        """Columns with the first two companions exchanged."""
        order = np.arange(len(self))
        first, second = self.companion(1), self.companion(2)
        order[first], order[second] = second, first
        return order

    def index(self, name: str) -> int:
        """Column of a name.

        Raises
        ------
        ValueError
            Where there is none.
        """
        return self.names.index(name)

    def bounds(self, columns: IntArray) -> list[tuple[float, float]]:
        """Ranges of some columns."""
        return [(self.items[k].lower, self.items[k].upper) for k in columns]

    def within(self, lowest_frequency: float) -> Parameters:
        """Bound the diameters to what the data can see: λ/B_min.

        Parameters
        ----------
        lowest_frequency : float
            B_min/λ of the data, cycles per radian.
        """
        largest = 1.0 / lowest_frequency / MAS if lowest_frequency > 0.0 else np.inf

        def bounded(p: Parameter) -> Parameter:
            return replace(p, upper=min(p.upper, largest)) if _is_size(p) else p

        return Parameters(tuple(bounded(p) for p in self.items))


def _is_size(p: Parameter) -> bool:
    """Whether a parameter is a diameter: an angle that is no position."""
    return p.unit == "mas" and p.role != "position"


@dataclass(frozen=True)
class Box:
    """The field of a search: range of separations, and λ/B_max."""

    inner_mas: float
    outer_mas: float
    fringe_mas: float


def parameter_words(name: str) -> str:
    """Name of a parameter for a reader: ``east_mas_2`` is east of companion 2 (mas)."""
    name, _, band = name.partition("[")
    base, _, number = name.rpartition("_")
    name, of = (base, f" of companion {number}") if number.isdigit() else (name, "")
    ending, unit = next((pair for pair in UNITS if name.endswith(pair[0])), ("", ""))
    words = name.removesuffix(ending).replace("_", " ")
    return f"{words}{of}{unit}" + (f", {band_name(band.rstrip(']'))}" if band else "")

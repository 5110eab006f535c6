"""What every component of the sky gives: flux, place, fringes, and their slopes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from amibayes.models.off_axis import Place
from amibayes.models.parameters import Parameter
from amibayes.models.uv_points import UVPoints
from amibayes.units import FloatArray

CENTRED: Place = (np.zeros(1), np.zeros(1))
"""On the star."""


@dataclass(frozen=True, eq=False)
class Slope:
    """How one parameter changes a source: derivatives of its flux, its fringes and its place.

    A derivative of the place does not repeat what ``wave`` has: it is how the response of
    the extraction, which goes with the place, changes. ``share`` is that of `Source.share`.
    ``None`` stands for 0.
    """

    flux: Any = None
    wave: Any = None
    place: tuple[Any, Any] | None = None
    share: Any = None

    def times(self, factor: Any) -> Slope:
        """The slope by a parameter that moves this one's so many times as far."""
        each = (self.flux, self.wave, self.share)
        flux, wave, share = (None if x is None else factor * x for x in each)
        place = self.place and (factor * self.place[0], factor * self.place[1])
        return Slope(flux, wave, place, share)


@dataclass(frozen=True, eq=False)
class Source:
    """A component at some parameter sets.

    Parameters
    ----------
    flux : float or (n,) or (n_samples, n) array
        In units of the primary's.
    wave : (n_samples, n) complex array or 0
        Its visibility with the phase of its place, averaged over the channel; 0 where it is
        over-resolved.
    place : (east, north) in mas, optional
        None where the response off the axis does not apply.
    share : float or (n_samples, n) array
        Of its flux that the extraction lets through, where ``wave`` is as seen through it.
    slopes : sequence of Slope
        By each of its parameters; empty where they were not asked for.
    """

    flux: Any
    wave: Any
    place: Place | None = CENTRED
    slopes: Sequence[Slope] = ()
    share: Any = 1.0


class Component(Protocol):
    """A star, a companion, a background: parameters, and a source made of their values."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Free parameters, in the order of ``values``."""
        ...

    def source(self, samples: UVPoints, values: FloatArray, *, slopes: bool = False) -> Source:
        """Make the source of parameter values (k, n)."""
        ...

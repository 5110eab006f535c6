"""Over-resolved light: flux without fringes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from amibayes.models.parameters import MAX_BACKGROUND, Parameter
from amibayes.models.source import Slope, Source
from amibayes.models.uv_points import UVPoints
from amibayes.units import FloatArray


@dataclass(frozen=True)
class Background:
    """Light that no baseline resolves.

    Parameters
    ----------
    flux : float or "free"
        In units of the primary's.
    """

    flux: float | Literal["free"]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The flux, where it is free."""
        if self.flux != "free":
            return ()
        return (Parameter("background", "", "nuisance", 0, 0.0, MAX_BACKGROUND),)

    def source(self, samples: UVPoints, values: FloatArray, *, slopes: bool = False) -> Source:
        """Make the background; ``values`` are (0 or 1, n)."""
        if self.flux != "free":
            return Source(float(self.flux), 0.0, None)
        return Source(values[0], 0.0, None, (Slope(flux=1.0),) if slopes else ())

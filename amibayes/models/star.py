"""The primary: a disc at the origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from amibayes.models.parameters import Parameter
from amibayes.models.source import Slope, Source
from amibayes.models.uv_points import UVPoints
from amibayes.scene.disc import uniform_disc
from amibayes.units import FloatArray


@dataclass(frozen=True)
class Star:
    """A uniform disc of flux 1.

    Parameters
    ----------
    diameter_mas : float or "free"
    """

    diameter_mas: float | Literal["free"] = 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The diameter, where it is free."""
        if self.diameter_mas != "free":
            return ()
        return (Parameter("diameter_mas", "mas", "nuisance", 0, lower=0.0),)

    def source(self, samples: UVPoints, values: FloatArray, *, slopes: bool = False) -> Source:
        """Make the disc; ``values`` are (0 or 1, n)."""
        n = values.shape[1]
        free = self.diameter_mas == "free"
        diameter = values[0] if free else np.full(n, float(self.diameter_mas))
        if not free and not diameter.any():
            return Source(1.0, np.ones((len(samples), n), dtype=complex))
        value, by_diameter = uniform_disc(samples.frequency[:, None], diameter)
        wave = value.astype(complex)
        return Source(1.0, wave, slopes=(Slope(wave=by_diameter),) if free and slopes else ())

"""The primary: a disc at the origin, uniform or darkened towards its limb."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from amibayes.models.limb_darkening import power_law_disc, power_law_with_slopes
from amibayes.models.parameters import Parameter
from amibayes.models.source import Slope, Source
from amibayes.models.uv_points import UVPoints
from amibayes.scene.disc import disc_visibility, uniform_disc
from amibayes.units import FloatArray

MAX_LIMB_DARKENING = 2.0
"""Largest exponent α that is tried: the Sun in the blue has 0.6, coolest giants some 1."""


@dataclass(frozen=True)
class Star:
    """A disc of flux 1 and brightness μ^α.

    Parameters
    ----------
    diameter_mas : float or "free"
    limb_darkening : float or "free"
        α; 0 for a uniform disc.
    """

    diameter_mas: float | Literal["free"] = 0.0
    limb_darkening: float | Literal["free"] = 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Diameter and α, where they are free."""
        found = []
        if self.diameter_mas == "free":
            found.append(Parameter("diameter_mas", "mas", "nuisance", 0, lower=0.0))
        if self.limb_darkening == "free":
            found.append(Parameter("limb_darkening", "", "nuisance", 0, 0.0, MAX_LIMB_DARKENING))
        return tuple(found)

    def source(self, samples: UVPoints, values: FloatArray, *, slopes: bool = False) -> Source:
        """Make the disc; ``values`` are (n_parameters, n)."""
        rows, n = list(values), values.shape[1]
        diameter, exponent = (
            rows.pop(0) if value == "free" else np.full(n, float(value))
            for value in (self.diameter_mas, self.limb_darkening)
        )
        if self.diameter_mas == 0.0:
            still = (Slope(),) * len(values)
            return Source(1.0, np.broadcast_to(1.0 + 0.0j, (len(samples), n)), slopes=still)
        frequency = samples.frequency[:, None]
        if not slopes and self.limb_darkening == 0.0:
            return Source(1.0, disc_visibility(frequency, diameter).astype(complex))
        if self.limb_darkening == 0.0:
            wave, by_diameter = uniform_disc(frequency, diameter)
            found = [by_diameter]
        elif slopes:
            wave, *found = power_law_with_slopes(frequency, diameter, exponent)
        else:
            wave, found = power_law_disc(frequency, diameter, exponent), []
        free = (self.diameter_mas == "free", self.limb_darkening == "free")
        kept = [Slope(wave=s) for s, wanted in zip(found, free, strict=False) if wanted]
        return Source(1.0, wave.astype(complex), slopes=kept if slopes else ())

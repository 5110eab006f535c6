"""Wavefront errors: what all exposures share, and what drifts between them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from amibayes.errors import UsageError
from amibayes.optics import PupilMap, Wavefront
from amibayes.parallel import child_seeds
from amibayes.units import FloatArray


@dataclass(frozen=True, eq=False)
class WavefrontErrors:
    """How large the errors of the holes are, root mean square.

    Parameters
    ----------
    piston_m : float
        Optical path of each hole, the same in all exposures.
    tilt_rad : float
        Displacement of each hole's image, per axis, the same in all exposures.
    piston_drift_m, tilt_drift_rad : float
        What each exposure adds of its own.
    map : PupilMap, optional
        Optical path over the pupil, the same in all exposures.

    Raises
    ------
    UsageError
        Where a number is negative or not finite.
    """

    piston_m: float = 0.0
    tilt_rad: float = 0.0
    piston_drift_m: float = 0.0
    tilt_drift_rad: float = 0.0
    map: PupilMap | None = None

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name != "map" and not 0.0 <= value < np.inf:
                raise UsageError(f"wavefront.{entry.name} is {value:g}; it must be at least 0")

    def shared(self, n_holes: int, seed: np.random.SeedSequence) -> Wavefront:
        """Draw the part that all exposures share."""
        piston, tilt = _draw(n_holes, self.piston_m, self.tilt_rad, seed)
        return Wavefront(piston, tilt, self.map)

    def drifted(self, shared: Wavefront, n_holes: int, seed: np.random.SeedSequence) -> Wavefront:
        """Add one exposure's own part."""
        piston, tilt = _draw(n_holes, self.piston_drift_m, self.tilt_drift_rad, seed)
        return Wavefront(_sum(shared.piston_m, piston), _sum(shared.tilt_rad, tilt), shared.map)


PAPER_WAVEFRONT = WavefrontErrors()
"""The paper's mask is perfect."""

REALISTIC_WAVEFRONT = WavefrontErrors(piston_m=30e-9, piston_drift_m=5e-9)
"""Segments aligned to some tens of nanometres, of which a few change between pointings."""

WAVEFRONT_PRESETS = {"paper": PAPER_WAVEFRONT, "realistic": REALISTIC_WAVEFRONT}


def _draw(
    n_holes: int, piston_m: float, tilt_rad: float, seed: np.random.SeedSequence
) -> tuple[FloatArray | None, FloatArray | None]:
    """Draw pistons and tilts, each from a stream of its own; None where there are none."""
    of_piston, of_tilt = (np.random.default_rng(child) for child in child_seeds(seed, 2))
    piston = piston_m * of_piston.standard_normal(n_holes) if piston_m > 0.0 else None
    tilt = tilt_rad * of_tilt.standard_normal((n_holes, 2)) if tilt_rad > 0.0 else None
    return piston, tilt


def _sum(one: FloatArray | None, other: FloatArray | None) -> FloatArray | None:
    if one is None or other is None:
        return other if one is None else one
    return np.asarray(one + other)

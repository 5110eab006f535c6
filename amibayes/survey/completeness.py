"""Completeness of a survey: the probability of detection, averaged over its targets.

Each target's probability is a logistic function of contrast at every ring of separations; a
target counts with probability 0 outside of the field that was searched, so that the mean is
the share of companions that the survey finds if each of its stars has one there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from amibayes.limits.logistic import Logistic, fit_logistic
from amibayes.limits.mass_table import MassTable
from amibayes.units import FloatArray, IntArray, delta_mag_to_contrast

MAS_PER_AU_PC = 1000.0
"""One astronomical unit at one parsec is one arcsecond, by the definition of the parsec."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """A logistic function of ln contrast through two probabilities that are known of it."""

    middle: float
    slope: float

    def __call__(self, log_contrast: FloatArray) -> FloatArray:
        """Probability at ln contrast."""
        return np.asarray(special.expit(self.slope * (log_contrast - self.middle)))


@dataclass(frozen=True, eq=False)
class DetectionProbability:
    """Probability that a companion of one target is recovered.

    Parameters
    ----------
    separation_mas : (n,) float array
        Rings, rising.
    rings : tuple of Logistic or Crossings
        Of each ring, functions of ln contrast; None where nothing is ever recovered.
    """

    separation_mas: FloatArray
    rings: tuple[Logistic | Crossings | None, ...]

    def __call__(self, separation_mas: FloatArray, contrast: FloatArray) -> FloatArray:
        """Probability at separations (n,) and contrasts (m,), (n, m); 0 outside of the field."""
        return self.at(
            separation_mas, np.broadcast_to(contrast, (len(separation_mas), len(contrast)))
        )

    def at(self, separation_mas: FloatArray, contrast: FloatArray) -> FloatArray:
        """Probability at separations (n,) and contrasts of their own, (n, m)."""
        separation_mas = np.asarray(separation_mas, dtype=float)
        last = len(self.separation_mas) - 1
        behind = np.clip(np.searchsorted(self.separation_mas, separation_mas, "right") - 1, 0, last)
        beyond = np.minimum(behind + 1, last)
        width = self.separation_mas[beyond] - self.separation_mas[behind]
        part = (separation_mas - self.separation_mas[behind]) / np.where(width > 0, width, 1.0)
        log_contrast = np.log(contrast)
        near, far = (
            np.stack([self._ring(k, x) for k, x in zip(which, log_contrast, strict=True)])
            for which in (behind, beyond)
        )
        inside = (separation_mas >= self.separation_mas[0]) & (
            separation_mas <= self.separation_mas[-1]
        )
        mean = near + part[:, None] * (far - near)
        return np.where(inside[:, None] & np.isfinite(mean), mean, 0.0)

    def _ring(self, k: int, log_contrast: FloatArray) -> FloatArray:
        ring = self.rings[k]
        return np.zeros_like(log_contrast) if ring is None else ring(log_contrast)


def from_counts(
    separation_mas: FloatArray, contrast: FloatArray, trials: IntArray, recovered: IntArray
) -> DetectionProbability:
    """Fit the probability of detection to counts of injected companions.

    Parameters
    ----------
    separation_mas : (n,) float array
    contrast : (n, m) float array
        Injected.
    trials, recovered : (n, m) int array
    """
    rings: list[Logistic | None] = []
    for level, n, found in zip(contrast, trials, recovered, strict=True):
        tried = n > 0
        some = tried.any() and found[tried].any()
        counts = found[tried].astype(float), n[tried].astype(float)
        rings.append(fit_logistic(np.log(level[tried]), *counts) if some else None)
    return DetectionProbability(np.asarray(separation_mas, dtype=float), tuple(rings))


@dataclass(frozen=True, eq=False)
class StackedCompleteness:
    """Mean probability of detection over targets.

    Parameters
    ----------
    separation : (n,) float array
        mas, or au.
    depth : (m,) float array
        Magnitude differences, or masses.
    mean : (n, m) float array
    covering : (n,) int array
        Targets whose field reaches the separation.
    n_targets : int
    """

    separation: FloatArray
    depth: FloatArray
    mean: FloatArray
    covering: IntArray
    n_targets: int


def stack(
    targets: Sequence[DetectionProbability],
    separation: FloatArray,
    depth: FloatArray,
    *,
    distance_pc: Sequence[float] | None = None,
    masses: Sequence[MassTable] | None = None,
) -> StackedCompleteness:
    """Average the probability of detection over targets.

    Parameters
    ----------
    targets : sequence of DetectionProbability
    separation : (n,) float array
        In mas, or in au (projected) where distances are given.
    depth : (m,) float array
        Magnitude differences, or masses in the unit of the tables where these are given.
    distance_pc : sequence of float, optional
        Of each target.
    masses : sequence of MassTable, optional
        Of each target. A mass outside of its table counts with probability 0 below and with
        that of its last mass above: heavier companions are brighter.
    """
    total = np.zeros((len(separation), len(depth)))
    covering = np.zeros(len(separation), dtype=np.intp)
    for k, target in enumerate(targets):
        scale = 1.0 if distance_pc is None else MAS_PER_AU_PC / distance_pc[k]
        rho = np.asarray(separation, dtype=float) * scale
        delta_mag = depth if masses is None else _magnitudes(masses[k], depth)
        known = np.isfinite(delta_mag)
        total[:, known] += target(rho, delta_mag_to_contrast(delta_mag[known]))
        covering += (rho >= target.separation_mas[0]) & (rho <= target.separation_mas[-1])
    mean = total / max(len(targets), 1)
    return StackedCompleteness(separation, depth, mean, covering, len(targets))


def _magnitudes(table: MassTable, mass: FloatArray) -> FloatArray:
    """Magnitude differences of masses; NaN below the table."""
    found = table.delta_mag_at(np.minimum(mass, table.mass.max()))
    return np.where(mass < table.mass.min(), np.nan, found)

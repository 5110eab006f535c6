"""Coefficients of charge migration, fitted to all exposures of a visit together.

The mean change of every pixel's current is a sum of what migration, and imperfect linearity,
make of the exposure's own image, and of what is the exposure's alone: a flux and a pointing
that drift along the ramp, and a change that all pixels share. Weighted least squares; the
covariance is scaled by the scatter of parts of the exposures where that is larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from amibayes.ramps.curvature import Curvature
from amibayes.ramps.migration import Migration
from amibayes.ramps.transfer import FURTHER, KINDS, LINEARITY, SIDES, gains
from amibayes.units import FloatArray

ALWAYS = (*SIDES, LINEARITY)
"""Kinds that are always fitted."""

LINEARITY_PRIOR = 5e-8
"""Standard deviation of what a linearised ramp's current is off by per electron: 0.2 % of the
signal at full well. Without it a flux that drifts within the ramp could make up for any of it, and
further neighbours that are not fitted would be taken for both (seen with GalSim's sensor)."""

ROUNDS = 3
"""Fits, each with the image that the one before left: the coefficients are good to 1e-4 then."""

ASKED_FOR = 1e-3
"""Further kinds are fitted where without them their gain in χ² would be less probable."""

EXPLAINED = 1e-3
"""A model is called not enough where a larger χ² than that of the ramps is less probable."""

EXCESS = 0.01
"""Errors follow the scatter of parts where so large a one is less probable by chance."""


@dataclass(frozen=True, eq=False)
class MigrationFit:
    """Coefficients, and whether they explain the ramps.

    Parameters
    ----------
    migration : Migration
    chi2 : float
        Of the mean changes; its expectation is ``dof``.
    dof : int
    chi2_without : float
        Without migration; linearity and drifts are fitted all the same.
    p_value : float
        Probability of a larger χ².
    bend_p_value : float
        Probability of ramps that bend more beside the linear change.
    error_scale : float
        What the scatter of parts made of the errors; 1 where it agrees with the noise.
    exposures : tuple of Curvature
    """

    migration: Migration
    chi2: float
    dof: int
    chi2_without: float
    p_value: float
    bend_p_value: float
    error_scale: float
    exposures: tuple[Curvature, ...]

    @property
    def explained(self) -> bool:
        """Whether the ramps look as the model has them."""
        return min(self.p_value, self.bend_p_value) > EXPLAINED

    def predicted(self, exposure: Curvature) -> FloatArray:
        """(ny, nx) change of the current that migration makes, electrons per second squared."""
        chosen = _chosen(_refined(exposure, self.migration), self.migration.kinds)
        return np.tensordot(self.migration.value, chosen, axes=1)

    def as_json(self) -> dict[str, Any]:
        """Plain numbers."""
        return {
            **self.migration.as_json(),
            "chi2": self.chi2,
            "dof": self.dof,
            "chi2_without": self.chi2_without,
            "p_value": self.p_value,
            "p_value_bend": self.bend_p_value,
            "error_scale": self.error_scale,
            "explained": self.explained,
            "n_exposures": len(self.exposures),
        }


def fit_migration(exposures: Sequence[Curvature]) -> MigrationFit:
    """Fit the coefficients to all exposures of one detector.

    Parameters
    ----------
    exposures : sequence of Curvature
        At least one.

    Returns
    -------
    MigrationFit
    """
    kinds: tuple[str, ...] = ALWAYS
    found = _solved(exposures, kinds)
    for _ in FURTHER:
        tried = [_solved(exposures, (*kinds, k)) for k in FURTHER if k not in kinds]
        more = min(tried, key=lambda fit: fit.chi2)
        if chi2_distribution.sf(found.chi2 - more.chi2, 1) > ASKED_FOR:
            break
        kinds, found = more.migration.kinds, more
    none = _solved(exposures, (LINEARITY,))
    bend = sum(e.bend_chi2 for e in exposures), sum(e.bend_dof for e in exposures)
    p_bend = float(chi2_distribution.sf(*bend)) if bend[1] else 1.0
    return replace(found, chi2_without=none.chi2, bend_p_value=p_bend)


def _solved(exposures: Sequence[Curvature], kinds: tuple[str, ...]) -> MigrationFit:
    """Fit some kinds, a few times over with the image that is left."""
    start = np.zeros(len(kinds)), np.eye(len(kinds))
    migration = Migration(kinds, *start, "fit")
    systems: list[_System] = []
    for _ in range(ROUNDS):
        systems = [_system(e, _chosen(_refined(e, migration), kinds)) for e in exposures]
        normal, right = sum(s.normal for s in systems), sum(s.right for s in systems)
        normal = normal + np.diag([(k == LINEARITY) / LINEARITY_PRIOR**2 for k in kinds])
        covariance = np.linalg.inv(normal)
        migration = Migration(kinds, np.asarray(covariance @ right), np.asarray(covariance), "fit")
    scale = _excess(systems, migration.covariance)
    total = float(sum(s.chi2 for s in systems) - right @ covariance @ right)
    dof = sum(s.n_data for s in systems) - len(kinds)
    migration = replace(migration, covariance=migration.covariance * scale**2)
    p = float(chi2_distribution.sf(total, dof))
    return MigrationFit(migration, total, dof, total, p, 1.0, scale, tuple(exposures))


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of one exposure, what is its alone taken out.

    Parameters
    ----------
    normal : (k, k) array
    right : (k,) array
    chi2 : float
        With all coefficients 0.
    n_data : int
        Pixels less what was fitted of the exposure alone.
    scores : (b, k) array
        Right-hand sides of its parts.
    """

    normal: FloatArray
    right: FloatArray
    chi2: float
    n_data: int
    scores: FloatArray


def _system(exposure: Curvature, columns: FloatArray) -> _System:
    used = exposure.used
    weight = 1.0 / exposure.sigma[used]
    slope_y, slope_x = np.gradient(exposure.current)
    own = np.stack([exposure.current, slope_x, slope_y, np.ones_like(slope_x)])[:, used] * weight
    basis = np.linalg.qr(own.T)[0]
    rows = columns[:, used] * weight
    rows = rows - (rows @ basis) @ basis.T
    data = exposure.change[used] * weight
    data = data - basis @ (basis.T @ data)
    scores = (exposure.batches[:, used] * weight) @ rows.T
    n_data = int(used.sum()) - basis.shape[1]
    return _System(rows @ rows.T, rows @ data, float(data @ data), n_data, scores)


def _excess(systems: Sequence[_System], covariance: FloatArray) -> float:
    """Factor of the errors by the scatter of the parts, where that is larger by more than chance.

    It holds whatever correlates pixels: stripes, pointing within a ramp.
    """
    trace, dof = 0.0, 0
    for system in systems:
        b, k = system.scores.shape
        if b < 2:
            continue
        off = system.scores - system.scores.mean(axis=0)
        own = np.linalg.inv(system.normal)
        trace += float(np.einsum("bk,kl,bl->", off, own, off)) / b
        dof += (b - 1) * k
    if not dof or chi2_distribution.sf(trace, dof) > EXCESS:
        return 1.0
    return float(np.sqrt(trace / dof))


def _chosen(every: FloatArray, kinds: Sequence[str]) -> FloatArray:
    return every[[KINDS.index(kind) for kind in kinds]]


def _refined(exposure: Curvature, migration: Migration) -> FloatArray:
    """Gains (len(KINDS), ny, nx) of charge as it collects by light as it falls.

    Charge collects at the current that is measured in the middle of the ramp; light falls as
    it would with no charge about.
    """
    if not migration.value.any():
        return exposure.gains
    lost = np.tensordot(migration.value, _chosen(exposure.gains, migration.kinds), axes=1)
    light = exposure.current - exposure.time_s * lost
    middle = exposure.current
    return exposure.gains + gains(KINDS, middle, light) - gains(KINDS, middle, middle)

"""Coefficients of charge migration, fitted to all exposures of a visit together.

The mean change of every pixel's current is a sum of what migration, and imperfect linearity,
make of the exposure's own image, and of what is the exposure's alone: a flux and a pointing
that drift along the ramp, and a change that all pixels share. Errors of the converter, where the
pixels' bias is known, also make ramps bend otherwise. Weighted least squares; the covariance is
scaled by the scatter of parts of the exposures where that is larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import f as f_distribution

from amibayes.ramps.converter import WAVE_PRIOR, WAVES
from amibayes.ramps.curvature import Curvature
from amibayes.ramps.migration import Migration
from amibayes.ramps.own_response import OwnResponse, own_response
from amibayes.ramps.transfer import FURTHER, KINDS, LINEARITY, SIDES, gains
from amibayes.units import FloatArray

ALWAYS = (*SIDES, LINEARITY)
"""Kinds that are always fitted."""

LINEARITY_PRIOR = 5e-8
"""Standard deviation of what a linearised ramp's current is off by per electron: 0.2 % of the
signal at full well. Without it a flux that drifts within the ramp could make up for any of it, and
further neighbours that are not fitted would be taken for both (seen with GalSim's sensor)."""

PRIORS = {LINEARITY: LINEARITY_PRIOR, **dict(zip(WAVES, WAVE_PRIOR, strict=True))}
"""Standard deviations about zero of what ramps do not always tell."""

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
    bend_chi2 : float
        Of what ramps bend beside a linear change.
    bend_p_value : float
        Probability of ramps that bend more.
    error_scale : float
        What the scatter of parts made of the errors; 1 where it agrees with the noise.
    exposures : tuple of Curvature
    own : OwnResponse, optional
        What single pixels do of their own, of exposures that have the same pixels.
    """

    migration: Migration
    chi2: float
    dof: int
    chi2_without: float
    p_value: float
    bend_chi2: float
    bend_p_value: float
    error_scale: float
    exposures: tuple[Curvature, ...]
    own: OwnResponse | None = None

    @property
    def pixels_differ(self) -> bool:
        """Whether single pixels change by more than noise makes them."""
        return self.own is not None and self.own.p_value <= ASKED_FOR

    @property
    def explained(self) -> bool:
        """Whether the ramps look as the model has them."""
        return min(self.p_value, self.bend_p_value) > EXPLAINED

    def predicted(self, exposure: Curvature) -> FloatArray:
        """(ny, nx) change of the current that migration makes, electrons per second squared."""
        return np.tensordot(self.migration.value, _columns(exposure, self.migration), axes=1)

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
            "pixels": None
            if self.own is None
            else {
                "spread_per_e": self.own.spread,
                "spread_error_per_e": self.own.spread_error,
                "p_value": self.own.p_value,
                "corrected": self.pixels_differ,
            },
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
    found = _solved(exposures, ALWAYS)
    of_converter: tuple[str, ...] = ()
    if any(e.waves is not None for e in exposures):
        more = _solved(exposures, (*ALWAYS, *WAVES))
        if _asked_for(found, more):
            of_converter, found = WAVES, more
    for _ in FURTHER:
        kinds = found.migration.kinds
        tried = [_solved(exposures, (*kinds, k)) for k in FURTHER if k not in kinds]
        more = min(tried, key=_misfit)
        if not _asked_for(found, more):
            break
        found = more
    none = _solved(exposures, (LINEARITY, *of_converter))
    return _with_pixels(replace(found, chi2_without=none.chi2))


def _with_pixels(fit: MigrationFit) -> MigrationFit:
    """Tell what single pixels do; the coefficients' errors have their part."""
    exposures, migration = fit.exposures, fit.migration
    if len({e.current.shape for e in exposures}) > 1:
        return fit
    gain = [_refined(e, migration.of_pixels)[KINDS.index(LINEARITY)] for e in exposures]
    systems = [_system(e, _columns(e, migration)) for e in exposures]
    left = [_undrifted(e, e.change - fit.predicted(e)) for e in exposures]
    own = own_response(left, gain, [e.sigma for e in exposures])
    fit = replace(fit, own=own)
    pulled = np.zeros((len(migration.kinds), *exposures[0].current.shape))
    for exposure, system, g in zip(exposures, systems, gain, strict=True):
        used = exposure.used
        pulled[:, used] += system.rows * (g[used] / exposure.sigma[used])
    moved = migration.covariance / fit.error_scale**2 @ pulled.reshape(len(pulled), -1)
    # What is not seen of it is no less than what a correction for linearity leaves.
    spread = np.hypot(own.spread, LINEARITY_PRIOR)
    more = migration.covariance + spread**2 * moved @ moved.T
    return replace(fit, migration=replace(migration, covariance=more))


def _undrifted(exposure: Curvature, change: FloatArray) -> FloatArray:
    """A change (ny, nx) without what is the exposure's alone: flux and pointing that drift."""
    own, used = _drifts(exposure), exposure.used
    weight = 1.0 / exposure.sigma[used]
    found = np.linalg.lstsq((own[:, used] * weight).T, change[used] * weight, rcond=None)[0]
    return np.asarray(change - np.tensordot(found, own, axes=1))


def _drifts(exposure: Curvature) -> FloatArray:
    """Changes (4, ny, nx) by flux, pointing along x and y, and one that all pixels share."""
    slope_y, slope_x = np.gradient(exposure.current)
    return np.stack([exposure.current, slope_x, slope_y, np.ones_like(slope_x)])


def _misfit(fit: MigrationFit) -> float:
    return fit.chi2 + fit.bend_chi2


def _asked_for(less: MigrationFit, more: MigrationFit) -> bool:
    """Whether χ² falls by more than chance makes it, with the kinds that are more."""
    count = len(more.migration.kinds) - len(less.migration.kinds)
    return bool(chi2_distribution.sf(_misfit(less) - _misfit(more), count) <= ASKED_FOR)


def _solved(exposures: Sequence[Curvature], kinds: tuple[str, ...]) -> MigrationFit:
    """Fit some kinds, a few times over with the image that is left."""
    start = np.zeros(len(kinds)), np.eye(len(kinds))
    migration = Migration(kinds, *start, "fit")
    systems: list[_System] = []
    for _ in range(ROUNDS):
        systems = [_system(e, _columns(e, migration)) for e in exposures]
        bends = [_bend_system(e, kinds) for e in exposures]
        normal = sum(s.normal for s in (*systems, *bends))
        normal = normal + np.diag([PRIORS[k] ** -2 if k in PRIORS else 0.0 for k in kinds])
        covariance = np.asarray(np.linalg.inv(normal))
        value = np.asarray(covariance @ sum(s.right for s in (*systems, *bends)))
        migration = Migration(kinds, value, covariance, "fit")
    scale = _excess(systems, kinds)
    chi2, bend = (sum(s.left(value) for s in parts) for parts in (systems, bends))
    dof, bend_dof = sum(s.n_data for s in systems) - len(kinds), sum(e.bend_dof for e in exposures)
    migration = replace(migration, covariance=migration.covariance * scale**2)
    known = sum(e.noise_degrees for e in exposures)
    p, p_bend = survival(chi2, dof, known), survival(bend, bend_dof, known)
    return MigrationFit(migration, chi2, dof, chi2, p, bend, p_bend, scale, tuple(exposures))


def survival(chi2: float, dof: int, noise_degrees: float) -> float:
    """Probability of a larger χ², of noise whose variance is known with degrees of freedom.

    Their ratio per degree has Fisher's F distribution.
    """
    if not dof:
        return 1.0
    if not np.isfinite(noise_degrees):
        return float(chi2_distribution.sf(chi2, dof))
    return float(f_distribution.sf(chi2 / dof, dof, noise_degrees))


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
    rows : (k, n_used) array
        Columns of the used pixels in units of their errors.
    """

    normal: FloatArray
    right: FloatArray
    chi2: float
    n_data: int
    scores: FloatArray
    rows: FloatArray

    def left(self, value: FloatArray) -> float:
        """χ² with coefficients (k,)."""
        return float(self.chi2 - 2.0 * value @ self.right + value @ self.normal @ value)


def _bend_system(exposure: Curvature, kinds: tuple[str, ...]) -> _System:
    """Of what ramps bend beside a linear change: of all kinds only the converter's show there."""
    k, n = len(kinds), exposure.bend_dof
    normal, right = np.zeros((k, k)), np.zeros(k)
    if exposure.waves is not None and WAVES[0] in kinds:
        own = [kinds.index(wave) for wave in WAVES]
        normal[np.ix_(own, own)], right[own] = exposure.waves.normal, exposure.waves.right
    return _System(normal, right, exposure.bend_chi2, n, np.empty((0, k)), np.empty((k, 0)))


def _system(exposure: Curvature, columns: FloatArray) -> _System:
    used = exposure.used
    weight = 1.0 / exposure.sigma[used]
    own = _drifts(exposure)[:, used] * weight
    basis = np.linalg.qr(own.T)[0]
    rows = columns[:, used] * weight
    rows = rows - (rows @ basis) @ basis.T
    data = exposure.change[used] * weight
    data = data - basis @ (basis.T @ data)
    scores = (exposure.batches[:, used] * weight) @ rows.T
    n_data = int(used.sum()) - basis.shape[1]
    return _System(rows @ rows.T, rows @ data, float(data @ data), n_data, scores, rows)


def _excess(systems: Sequence[_System], kinds: tuple[str, ...]) -> float:
    """Factor of the errors by the scatter of the parts, where that is larger by more than chance.

    It holds whatever correlates pixels: stripes, pointing within a ramp.
    """
    trace, dof = 0.0, 0
    own = [k for k, kind in enumerate(kinds) if kind in KINDS]
    for system in systems:
        b, k = len(system.scores), len(own)
        if b < 2:
            continue
        off = (system.scores - system.scores.mean(axis=0))[:, own]
        inverse = np.linalg.inv(system.normal[np.ix_(own, own)])
        trace += float(np.einsum("bk,kl,bl->", off, inverse, off)) / b
        dof += (b - 1) * k
    if not dof or chi2_distribution.sf(trace, dof) > EXCESS:
        return 1.0
    return float(np.sqrt(trace / dof))


def _chosen(every: FloatArray, kinds: Sequence[str]) -> FloatArray:
    return every[[KINDS.index(kind) for kind in kinds]]


def _columns(exposure: Curvature, migration: Migration) -> FloatArray:
    """Changes (k, ny, nx) that coefficients of 1 make, of all kinds of a migration."""
    of_pixels = _chosen(_refined(exposure, migration.of_pixels), migration.of_pixels.kinds)
    if exposure.waves is None:
        of_converter = np.zeros((len(WAVES), *exposure.current.shape))
    else:
        of_converter = exposure.waves.change
    columns = dict(
        zip((*migration.of_pixels.kinds, *WAVES), (*of_pixels, *of_converter), strict=True)
    )
    return np.stack([columns[kind] for kind in migration.kinds])


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

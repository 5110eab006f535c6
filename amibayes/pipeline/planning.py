"""What an exposure will measure: errors of closure phase and V², and the faintest companion.

The image is a sum of envelope and fringes (the linear fringe model), every pixel has the
variance of its slope fit, and weighted least squares gives the covariance of the complex
visibilities, read noise included. What calibrators and errors that photons do not average out
make of it, and what a search then reaches, is in `amibayes.pipeline.plan_floor`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import dense_covariance
from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.optics import fringe_basis
from amibayes.pipeline.migration_plan import MigrationExpectation, expect_migration
from amibayes.pipeline.plan_floor import Floor, FloorExpectation, expect_floor
from amibayes.scene.orientation import Orientation
from amibayes.simulation import PRESETS, Detector
from amibayes.simulation.budget import PAPER, Plan, PlanOptions, make_plan, star_channels
from amibayes.simulation.slopes import electron_variance, slope_weights
from amibayes.support.arguments import checks_arguments
from amibayes.support.options import PLAN_SEPARATION_MAS
from amibayes.units import FloatArray, contrast_to_delta_mag

__all__ = [
    "PAPER",
    "ContrastCurve",
    "Expectation",
    "Floor",
    "FloorExpectation",
    "Plan",
    "PlanOptions",
    "expect",
    "make_plan",
]

DELTA_CHI2 = 9.0
"""3σ of the contrast at a known position."""

MAX_UNCERTAIN_RAD = 1.0
"""Past this a closure phase may have any value, and linear predictions are void."""

STEP_MAS = 10.0
"""Step of the curve, and of the grid under it; λ/8B is 19 mas or more."""


@dataclass(frozen=True, eq=False)
class ContrastCurve:
    """Contrast at which Δχ² reaches 9, over all position angles; arrays (n,).

    Parameters
    ----------
    separation_mas : array
        Middle of each ring.
    delta_mag, delta_mag_worst, delta_mag_best : arrays
        Median, worst and best of the ring.
    """

    separation_mas: FloatArray
    delta_mag: FloatArray
    delta_mag_worst: FloatArray
    delta_mag_best: FloatArray


@dataclass(frozen=True, eq=False)
class Expectation:
    """Errors of an exposure.

    Parameters
    ----------
    closure_phase_rad, vis2 : float
        Median 1σ errors of closure phases and squared visibilities.
    closure_phase_photons_rad : float
        √1.5 · n_holes / √N_photons, the paper's formula for photon noise alone.
    curve : ContrastCurve
        From V² and closure phases with their joint covariance.
    closure_curve : ContrastCurve
        From closure phases alone.
    migration : MigrationExpectation, optional
        Bias by charge that passes between pixels.
    floor : FloorExpectation, optional
        What a calibrated search reaches, with errors that photons do not average out.
    """

    closure_phase_rad: float
    vis2: float
    closure_phase_photons_rad: float
    curve: ContrastCurve
    closure_curve: ContrastCurve
    migration: MigrationExpectation | None = None
    floor: FloorExpectation | None = None


@checks_arguments
def expect(
    plan: Plan,
    separation_mas: tuple[float, float] = PLAN_SEPARATION_MAS,
    detector: Detector | None = None,
    floor: Floor | None = None,
) -> Expectation:
    """Predict the errors and the contrast curve of a plan.

    Parameters
    ----------
    plan : Plan
        From `make_plan`.
    separation_mas : (low, high)
        Range of the curve.
    detector : Detector, optional
        The paper's unless given.
    floor : Floor, optional
        Errors beside photon and read noise; without it the limits of a search are not predicted.

    Returns
    -------
    Expectation

    Raises
    ------
    UsageError
        Where the light is too faint for closure phases.
    """
    detector = detector or PRESETS["paper"]
    observables = expected_observables(plan, detector)
    sigma_vis2, sigma_closure = observables.errors
    if np.median(sigma_closure) > MAX_UNCERTAIN_RAD:
        raise UsageError(
            f"closure phases would be uncertain by {np.degrees(np.median(sigma_closure)):.3g} deg: "
            "read noise drowns the star",
            remedy="a brighter star or more photons",
        )
    photons = np.sqrt(1.5) * plan.instrument.mask.n_holes / np.sqrt(plan.total_photons)
    curve = contrast_curve(observables, separation_mas)
    reached = None
    if floor is not None:
        reached = expect_floor(plan, detector, observables, separation_mas, floor)
    return Expectation(
        float(np.median(sigma_closure)),
        float(np.median(sigma_vis2)),
        float(photons),
        curve,
        contrast_curve(observables.only(("cp",)), separation_mas),
        expect_migration(plan, detector, float(np.median(sigma_vis2))),
        reached,
    )


def visibility_covariance(plan: Plan, detector: Detector) -> FloatArray:
    """Covariance of a point source's fringe fit over the whole exposure.

    Returns
    -------
    (1 + 2 n_baselines, 1 + 2 n_baselines) array
        Of the relative flux, then Re V and Im V of every baseline times that flux.
    """
    basis = fringe_basis(plan.instrument, star_channels(plan.instrument))
    light = plan.count_rate_e_s * basis.image()
    timed = replace(detector, frame_time_s=plan.options.frame_time_s)
    electrons = electron_variance(light, timed)
    n_increments = timed.n_reads(plan.n_groups) - 1
    variance = slope_weights(electrons, n_increments, timed).variance / plan.n_integrations
    columns = np.column_stack([plan.count_rate_e_s * basis.matrix, np.ones(light.size)])
    normal = columns.T @ (columns / variance.reshape(-1, 1))
    scale = 1.0 / np.sqrt(np.diag(normal))  # the pedestal is in other units
    inverse = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(inverse[:-1, :-1])


def expected_observables(plan: Plan, detector: Detector) -> Observables:
    """Give a point source's V² and closure phases with their joint covariance."""
    mask, bandpass = plan.instrument.mask, plan.instrument.bandpass
    closures, _ = closure_matrix(mask.triangles)
    jacobian = _jacobian(closures)
    covariance = jacobian @ visibility_covariance(plan, detector) @ jacobian.T
    basis = block_diag(np.eye(mask.n_baselines), kernel_basis(closures))
    blank = point_source(
        Orientation().baselines_to_sky(mask.holes_m),
        star_channels(plan.instrument).mean_m,
        bandpass.effective_width_m,
        vis2_error=1.0,
        closure_error_rad=1.0,
    )
    known = dense_covariance(covariance, basis)
    return replace(blank, covariance=known, covariance_kind="given")


def _jacobian(closures: FloatArray) -> FloatArray:
    """d(V², closure phase) / d(flux, flux·Re V, flux·Im V) of a point source of flux 1."""
    n_triangles, n = closures.shape
    flux = np.concatenate([np.full(n, -2.0), np.zeros(n_triangles)])[:, None]
    return np.hstack([flux, block_diag(2.0 * np.eye(n), closures)])


def contrast_curve(observables: Observables, separation_mas: tuple[float, float]) -> ContrastCurve:
    """Contrast of Δχ² = 9 around rings of the given range of separations."""
    low, high = separation_mas
    half = STEP_MAS / 2.0
    grid = make_grid(max(low - half, 1.0), high + half, STEP_MAS / 2.0)
    likelihood = Likelihood(observables, BinaryModel())
    bank = TemplateBank(likelihood, grid, np.empty(0))
    _, sigma = bank.scan(np.zeros(bank.n_data))
    faintest = contrast_to_delta_mag(np.sqrt(DELTA_CHI2) * sigma)
    radius = np.hypot(grid.east_mas, grid.north_mas)
    rings = np.arange(low, high + half, STEP_MAS)
    inside = [faintest[np.abs(radius - ring) <= half] for ring in rings]
    spread = np.array([np.percentile(ring, [50.0, 0.0, 100.0]) for ring in inside])
    return ContrastCurve(rings, *spread.T)

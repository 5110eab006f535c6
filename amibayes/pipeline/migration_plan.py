"""What migration and the converter will do to an exposure: bias, and the groups that cost least.

The bias that matters is what calibrators do not share: that of migration is stated for calibrators
of half the target's brightness, read with the same groups. Errors of the analogue-to-digital
converter look drawn by chance: the pixels' counts go through dozens of periods of its waves, each
from its own bias, and what a pixel is off by is the same in all integrations but changes with
the flux and with the place of the star. Calibrators share little of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.cube.ramps import GAIN_E_DN
from amibayes.data.closure import closure_matrix
from amibayes.extraction.preparation import SMOOTH_FLOOR
from amibayes.instrument import ChargeMigration
from amibayes.optics import FringeBasis, fringe_basis
from amibayes.ramps.converter import HARMONICS, PERIOD_DN, waves
from amibayes.ramps.curvature import expected_curvature
from amibayes.ramps.fit import fit_migration
from amibayes.ramps.transfer import SIDES, gains
from amibayes.simulation import Detector
from amibayes.simulation.budget import Plan, star_channels
from amibayes.simulation.ramps import ADC_WAVES
from amibayes.simulation.slopes import electron_variance, slope_weights
from amibayes.units import FloatArray

CALIBRATOR = 0.5
"""Brightness of the calibrators that the bias is stated for, in units of the target's."""

MAX_TRIED = 12
"""Numbers of groups that are compared."""


AMPLITUDES = np.array([wave[1:] for wave in ADC_WAVES]).ravel()
"""Of `amibayes.ramps.converter.WAVES`, of JWST's readout."""


MAX_READS = 128
"""Of longer ramps every so many reads: a pixel at the usual 30 000 electrons has gone through 18
periods."""


@dataclass(frozen=True)
class MigrationExpectation:
    """Rms over the baselines of the bias of V², calibrators of half the brightness.

    Parameters
    ----------
    left_in : float
        With migration left in.
    slopes : float
        Taken out of slopes with the instrument's value: what its error leaves, 1σ.
    ramps : float, optional
        Fitted to the ramps of this exposure alone; None with too few groups.
    error_per_e : float, optional
        Of the coefficient that these ramps would give.
    best_groups : int
        Groups with the smallest sum of squares of noise and of ``slopes``, in the same time
        on the clock.
    """

    left_in: float
    slopes: float
    ramps: float | None
    error_per_e: float | None
    best_groups: int


def expect_migration(
    plan: Plan, detector: Detector, vis2_error: float
) -> MigrationExpectation | None:
    """Predict the bias; None where the instrument's file knows nothing of migration.

    Parameters
    ----------
    plan : Plan
    detector : Detector
    vis2_error : float
        Of the whole exposure, by photon and read noise.
    """
    known = plan.instrument.charge_migration
    if known is None:
        return None
    per_e = float(np.sqrt((vis2_change(plan, detector) ** 2).mean())) * (1.0 - CALIBRATOR)
    error = coefficient_error(plan, detector)
    return MigrationExpectation(
        known.per_e * per_e,
        known.error * per_e,
        None if error is None else error * per_e,
        error,
        best_groups(plan, known, per_e, vis2_error),
    )


def light_of(plan: Plan) -> FloatArray:
    """Electrons per second (ny, nx) of the star in every pixel."""
    basis = fringe_basis(plan.instrument, star_channels(plan.instrument))
    image = np.asarray(basis.image())
    side = round(float(np.sqrt(image.size)))
    return np.asarray(plan.count_rate_e_s * image.reshape(side, side))


def vis2_change(plan: Plan, detector: Detector) -> FloatArray:
    """Change of V² (n_baselines,) that a coefficient of 1 per electron makes of a point source."""
    return migration_change(plan, detector)[: plan.instrument.mask.n_baselines]


def migration_change(
    plan: Plan, detector: Detector, centre_px: tuple[float, float] = (0.0, 0.0)
) -> FloatArray:
    """Change of V² and closure phases (rad) by a coefficient of 1 per electron, (n_data,).

    Of a point source at ``centre_px`` of the middle of the image; closure phases change where
    the pixels do not lie evenly about it.
    """
    basis = fringe_basis(plan.instrument, star_channels(plan.instrument), centre_px=centre_px)
    image = np.asarray(basis.image())
    side = round(float(np.sqrt(image.size)))
    light = plan.count_rate_e_s * image.reshape(side, side)
    reads = detector.n_reads(plan.n_groups)
    middle = 0.5 * plan.options.frame_time_s * (reads + 1 - 2 * detector.zero_read)
    moved = gains(SIDES, middle * light, light).sum(axis=0).ravel()
    found = envelope_fit(basis) @ moved / plan.count_rate_e_s
    n = (len(found) - 1) // 2
    closures = closure_matrix(plan.instrument.mask.triangles)[0]
    return np.concatenate([2.0 * (found[1 : 1 + n] - found[0]), closures @ found[1 + n :]])


def envelope_fit(basis: FringeBasis) -> FloatArray:
    """From an image (n_pixels,) to flux and fringes, (1 + 2 n_baselines, n_pixels).

    As in the extraction's own fit, the envelope has the weights, not its fringes: these would
    halve the bias by migration, which is strongest where fringes are bright. A pedestal is free.
    """
    columns = np.column_stack([basis.matrix, np.ones(len(basis.matrix))])
    envelope = np.asarray(basis.matrix[:, 0])
    weight = 1.0 / (envelope + SMOOTH_FLOOR * envelope.max())
    scale = np.sqrt((columns**2 * weight[:, None]).sum(axis=0))
    normal = (columns / scale).T @ (columns / scale * weight[:, None])
    fit = np.linalg.solve(normal, (columns / scale).T * weight) / scale[:, None]
    return np.asarray(fit[:-1])


def coefficient_error(plan: Plan, detector: Detector) -> float | None:
    """Error per electron that the ramps of this exposure leave; None with too few groups."""
    timed = replace(detector, frame_time_s=plan.options.frame_time_s)
    reads = timed.n_reads(plan.n_groups)
    expected = expected_curvature(
        light_of(plan),
        timed.single_read_noise_e**2,
        timed.frame_time_s,
        reads,
        plan.n_integrations,
        first_s=0.0 if timed.zero_read else timed.frame_time_s,
    )
    return None if expected is None else fit_migration([expected]).migration.mean[1]


def best_groups(plan: Plan, known: ChargeMigration, per_e: float, noise: float) -> int:
    """Groups with the smallest sum of squares of noise and of what an unknown value leaves.

    Noise goes with the photons that the same time on the clock collects, of which a reset takes
    a frame from each ramp; the bias with the charge, hence with the groups.
    """
    n = plan.n_groups
    tried = np.unique(np.geomspace(2, n, MAX_TRIED).round().astype(int)) if n > 2 else np.array([n])
    share = (tried / (tried + 1.0)) / (n / (n + 1.0))
    cost = noise**2 / share + (known.error * per_e * tried / n) ** 2
    return int(tried[cost.argmin()])


def converter_change(
    plan: Plan,
    detector: Detector,
    bias_dn: FloatArray,
    centre_px: tuple[float, float] = (0.0, 0.0),
    brightness: float = 1.0,
) -> FloatArray:
    """Change of V² and closure phases (rad), (k, n_data), that the converter makes of a point.

    Parameters
    ----------
    plan : Plan
    detector : Detector
    bias_dn : (k, n, n) array
        Counts of every pixel after the reset, of k detectors.
    centre_px : (x, y)
        Place of the star from the middle of the image.
    brightness : float
        Of the star, in units of the target's; read with the same groups.
    """
    n = bias_dn.shape[-1]
    basis = fringe_basis(plan.instrument, star_channels(plan.instrument), n, centre_px=centre_px)
    rate = brightness * plan.count_rate_e_s
    light = rate * np.asarray(basis.image()).reshape(n, n)
    off = np.stack([_slope_error(plan, detector, light, bias).ravel() for bias in bias_dn])
    found = off @ envelope_fit(basis).T / rate
    m = plan.instrument.mask.n_baselines
    closures = closure_matrix(plan.instrument.mask.triangles)[0]
    vis2 = 2.0 * (found[:, 1 : 1 + m] - found[:, :1])
    return np.concatenate([vis2, found[:, 1 + m :] @ closures.T], axis=1)


def _slope_error(
    plan: Plan, detector: Detector, light: FloatArray, bias_dn: FloatArray
) -> FloatArray:
    """Electrons per second (ny, nx) too many, the mean of many integrations."""
    together = -(-plan.n_groups // MAX_READS)
    frame = together * plan.options.frame_time_s
    timed = replace(detector, frame_time_s=frame)
    reads = max(timed.n_reads(plan.n_groups // together), 2)
    weight = slope_weights(electron_variance(light, timed), reads - 1, timed).reads
    turn = 2.0 * np.pi / PERIOD_DN * np.repeat(HARMONICS, 2)[:, None, None]
    total = np.zeros_like(light)
    # One read after the other: bright stars of many groups would fill the memory otherwise.
    for number in range(reads):
        charge = (number + 1 - detector.zero_read) * frame * light
        noise = (charge + detector.single_read_noise_e**2) / GAIN_E_DN**2
        # Photons and read noise move the counts by a part of the period: that blurs the waves.
        blurred = np.exp(-0.5 * turn**2 * noise) * waves(bias_dn + charge / GAIN_E_DN)
        total += weight[number] * np.tensordot(AMPLITUDES, blurred, axes=1)
    return np.asarray(GAIN_E_DN * total)

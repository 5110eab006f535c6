"""What errors of the analogue-to-digital converter do to a planned exposure.

The pixels' counts go through dozens of periods of the waves, each from its own bias: what a pixel
is off by looks drawn by chance, is the same in all integrations, and changes with the flux and
with the place of the star. Calibrators share little of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.cube.ramps import GAIN_E_DN
from amibayes.data.closure import closure_matrix
from amibayes.optics import fringe_basis
from amibayes.pipeline.migration_plan import envelope_fit
from amibayes.ramps.converter import HARMONICS, PERIOD_DN, waves
from amibayes.simulation import Detector
from amibayes.simulation.budget import Plan, star_channels
from amibayes.simulation.ramps import ADC_WAVES
from amibayes.simulation.slopes import electron_variance, slope_weights
from amibayes.units import FloatArray

AMPLITUDES = np.array([wave[1:] for wave in ADC_WAVES]).ravel()
"""Of `amibayes.ramps.converter.WAVES`, of JWST's readout."""


MAX_READS = 128
"""Of longer ramps every so many reads: a pixel at the usual 30 000 electrons has gone through 18
periods."""


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

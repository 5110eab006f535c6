"""Critical contrasts for all components of the noise along the companion's own template.

Noise along the template of a companion acts as contrast: c/σ = u − s·z, where z is that component
in its standard deviations and u is what the rest of the noise makes of it, which hardly depends on
z. So a trial with one z tells the critical contrast for all of them, and the mean over z is a sum
and no matter of chance (conditional Monte Carlo: Asmussen & Glynn 2007, Stochastic Simulation,
V.4). Limits of AX Cir are then known three times as well by as many trials.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from amibayes.limits.critical import CriticalContrasts
from amibayes.support.evenly import evenly
from amibayes.units import BoolArray, FloatArray

NODES = 16
"""Values of z for each trial; those of other trials lie between them."""

CURVED = 2
"""Degree of the polynomial in z: signals of bright companions are not quite linear."""


def over_components(critical: CriticalContrasts) -> FloatArray:
    """Critical contrasts in units of a place's error, for several components of the noise.

    Of rings on which some companion is not recovered however bright, each trial's own contrast
    is repeated: what u is there is not known. The same where noise is not linear in z: with a
    covariance of 60 integrations, limits would come out 1.5 % too large.

    Parameters
    ----------
    critical : CriticalContrasts

    Returns
    -------
    (n_rings, n_angles, NODES, n_noise) float array
    """
    in_errors = critical.located / critical.sigma[:, :, None]
    out = np.repeat(in_errors[:, :, None], NODES, axis=2)
    found = (np.isfinite(in_errors) & (critical.width > 0.0)).all(axis=(1, 2))
    # Never 0, of which the normal quantile is infinite.
    offset = np.maximum(evenly(in_errors[0].size), 1e-6).reshape(in_errors.shape[1:])
    nodes = ndtri((np.arange(NODES)[:, None] + offset[:, None]) / NODES)
    for kind in np.unique(critical.by_detection):
        rings = found & (critical.by_detection == kind)
        if rings.any():
            out[rings] += _changes(critical, in_errors, nodes, rings)
    return out


def _changes(
    critical: CriticalContrasts, in_errors: FloatArray, nodes: FloatArray, rings: BoolArray
) -> FloatArray:
    """What other components would change, (n_rings, n_angles, NODES, n_noise)."""
    own = critical.width[rings] * critical.component[rings]
    line = np.polyfit(own.ravel(), in_errors[rings].ravel(), CURVED)
    other = critical.width[rings][:, :, None] * nodes
    return np.polyval(line, other) - np.polyval(line, own)[:, :, None]

"""Extra noise of known size, of single channels, beside floors of calibration errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amibayes.data.assumed_covariance import covariance_of_errors
from amibayes.data.observables import Observables
from amibayes.data.systematics import Systematics
from amibayes.likelihood.extra_noise import NoisePrior
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise_fit import fit_noise
from amibayes.models.binary import BinaryModel
from amibayes.units import MAS
from tests.interferometer import four_telescopes, observed

EAST, NORTH, CONTRAST = 6.0, -4.0, 0.1
CHANNELS = 8


def unequal_errors(vis2: float, closure_deg: float) -> Observables:
    """Four exposures whose stated errors differ tenfold between channels, in no order."""
    sheet = four_telescopes(4, CHANNELS, vis2_error=vis2, closure_error_deg=closure_deg)
    size = 10.0 ** np.linspace(-0.5, 0.5, CHANNELS)
    size = size[np.random.default_rng(5).permutation(CHANNELS)]
    own = [m.channel for m in (sheet.vis2, sheet.closure_phase)]
    errors = vis2 * size[own[0]], np.radians(closure_deg) * size[own[1]]
    return replace(
        sheet, covariance=covariance_of_errors(errors[0], sheet.closure_phase, errors[1], "assumed")
    )


def companion(u: np.ndarray, v: np.ndarray, _wavelength: np.ndarray) -> np.ndarray:
    """Visibility of a point and a fainter one."""
    other = CONTRAST * np.exp(-2j * np.pi * MAS * (u * EAST + v * NORTH))
    return (1.0 + other) / (1.0 + CONTRAST)


@pytest.mark.parametrize("floor", [0.0, 0.01, 0.03, 0.05])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_extra_noise_of_channels_is_found_beside_a_floor(floor, seed):
    """192 V² tell it to 5 %, 96 combinations of closure phases to 7 %.

    A floor that grew with the noise took up half of it, and the true companion was refused.
    """
    vis2, closure = 0.04, np.radians(3.0)
    sheet, rng = unequal_errors(0.005, 0.6), np.random.default_rng(seed)
    sizes = np.full(len(sheet.vis2), vis2), np.full(len(sheet.closure_phase), closure)
    flat = covariance_of_errors(sizes[0], sheet.closure_phase, sizes[1], "assumed")
    data = observed(sheet, companion, rng)
    value = np.concatenate([data.vis2.value, data.closure_phase.value]) + flat.draw(rng, 1)[:, 0]
    theta = np.array([EAST, NORTH, CONTRAST])
    likelihood = Likelihood(sheet.with_data(value), BinaryModel(smearing=False)).expecting(theta)
    floors = (Systematics(sheet.source, floor, np.radians(0.5)),) if floor else ()
    noise = fit_noise(likelihood, theta, prior=NoisePrior(floors=floors))
    assert noise.vis2 == pytest.approx(vis2, rel=0.25)
    assert noise.closure_phase_rad == pytest.approx(closure, rel=0.3)

"""Errors of the components beyond a point: companion's disc, its colour, the star's limb darkening.

The data come from formulas of their own (Hestroffer 1997 for discs; no smearing on either side).
"""

from __future__ import annotations

import interferometer
import numpy as np
import pytest
from brute_force import coverage
from interferometer import darkened_disc

from amibayes.companion_search.optimise import refine
from amibayes.data.observables import Observables
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box
from amibayes.units import MAS

TRUTH = {
    "diameter_mas": 2.6,
    "limb_darkening": 0.25,
    "companion_diameter_mas": 0.7,
    "contrast_slope": -1.5,
}
PLACE, CONTRAST, REFERENCE_M = (5.2, -3.7), 0.24, 1.62e-6


def observed(sheet: Observables) -> Observables:
    """The data of a limb-darkened star and a companion that is a disc with a colour, no noise."""

    def visibility(u: np.ndarray, v: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
        ratio = CONTRAST * (wavelength / REFERENCE_M) ** TRUTH["contrast_slope"]
        east, north = (MAS * x for x in PLACE)
        star = darkened_disc(TRUTH["diameter_mas"], TRUTH["limb_darkening"], u, v)
        other = darkened_disc(TRUTH["companion_diameter_mas"], 0.0, u, v)
        return (star + ratio * other * np.exp(-2j * np.pi * (u * east + v * north))) / (1 + ratio)

    return interferometer.observed(sheet, visibility)


@pytest.mark.parametrize("n", [60, pytest.param(600, marks=pytest.mark.slow)])
def test_pulls_of_discs_colour_and_limb_darkening(n: int) -> None:
    """Means, widths and shares within 1σ of all parameters, to 4.5 standard errors."""
    model = BinaryModel(
        diameter_mas="free",
        smearing=False,
        limb_darkening="free",
        companion_diameter_mas="free",
        contrast_slope="free",
        reference_wavelength_m=REFERENCE_M,
    )
    sheet = observed(coverage("mirc4t", 0.004, 0.01))
    free = Likelihood(sheet, model)
    names = free.parameters.names
    known = {"east_mas": PLACE[0], "north_mas": PLACE[1], "contrast": CONTRAST} | TRUTH
    truth = np.array([known[name] for name in names])
    assert free.chi2(truth)[0] < 1e-6
    noise = sheet.covariance.draw(np.random.default_rng(8), n)
    pulls = np.empty((n, len(names)))
    for k in range(n):
        data = sheet.with_data(
            np.concatenate([sheet.vis2.value, sheet.closure_phase.value]) + noise[:, k]
        )
        likelihood = Likelihood(data, model)
        fit = np.array(refine(likelihood, truth, Box(0.5, 20.0, 1.0), 0.0).theta)
        pulls[k] = (fit - truth) / np.sqrt(np.diag(likelihood.errors(fit)))
    assert np.abs(pulls.mean(axis=0)).max() < 4.5 / np.sqrt(n)
    assert np.abs(pulls.std(axis=0) - 1.0).max() < 4.5 / np.sqrt(2 * n)
    covered = (np.abs(pulls) < 1.0).mean(axis=0)
    assert np.abs(covered - 0.683).max() < 4.5 * np.sqrt(0.683 * 0.317 / n)

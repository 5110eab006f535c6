"""Fits from many seeds at once end where SciPy's least squares end, inside what is allowed."""

from __future__ import annotations

import numpy as np
import pytest
from epochs import epoch, noisy
from helpers import niriss, simulated
from scipy import optimize

from amibayes.companion_search.descent import descend
from amibayes.companion_search.field import resolution_mas
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.companion import fringes_into, fringes_of_one
from amibayes.models.parameters import Box


@pytest.mark.parametrize("contrast", [0.004, 0.3])
def test_seeds_arrive_at_the_minimum_that_least_squares_finds(rng, contrast: float) -> None:
    model = BinaryModel(1, "free", "free")
    truth = np.array([140.0, -60.0, contrast, 20.0, 0.02])
    likelihood = Likelihood(simulated(niriss(), truth, rng, model), model)
    box = Box(50.0, 400.0, resolution_mas(likelihood))
    seeds = truth + rng.uniform(-1, 1, (6, 5)) * [20.0, 20.0, 0.3 * contrast, 10.0, 0.01]
    found, chi2 = descend(likelihood, seeds, box)
    bounds = np.array(likelihood.parameters.bounds(np.arange(5))).T
    peer = optimize.least_squares(
        lambda theta: likelihood.residuals(theta)[:, 0], truth, bounds=bounds, x_scale="jac"
    )
    np.testing.assert_allclose(chi2, 2.0 * peer.cost, atol=0.01)
    np.testing.assert_allclose(chi2, likelihood.chi2(found), rtol=1e-9)
    # Δχ² of 0.01 is a tenth of the errors.
    error = np.sqrt(np.diag(likelihood.errors(peer.x)))
    assert (np.abs(found - peer.x) < 0.15 * error + 1e-9).all()


@pytest.mark.parametrize(("field", "edge"), [((50.0, 120.0), 120.0), ((190.0, 400.0), 190.0)])
def test_at_the_edge_of_the_field_fits_go_along_it(field, edge: float) -> None:
    """The best place on a circle is found by trying all of it."""
    truth = [120.0, -100.0, 0.01]  # at 156 mas
    likelihood = Likelihood(simulated(niriss(), truth, None))
    seed = np.array([[1.05 * edge * np.sin(2.0), 1.05 * edge * np.cos(2.0), 0.005]])
    found, chi2 = descend(likelihood, seed, Box(*field, resolution_mas(likelihood)))
    assert np.hypot(*found[0, :2]) == pytest.approx(edge, rel=1e-9)
    angle, contrast = np.meshgrid(np.linspace(1.6, 2.8, 241), np.linspace(0.0, 0.02, 201))
    circle = edge * np.sin(angle), edge * np.cos(angle), contrast
    best = likelihood.chi2(np.column_stack([x.ravel() for x in circle])).min()
    assert chi2[0] <= best + 0.01


def test_parameters_stay_in_their_ranges(rng) -> None:
    likelihood = Likelihood(simulated(niriss(), [140.0, -60.0, 0.0], rng))
    box = Box(50.0, 400.0, resolution_mas(likelihood))
    seeds = np.column_stack([*rng.uniform(-250, 250, (2, 20)), np.full(20, 0.001)])
    seeds = seeds[np.hypot(*seeds[:, :2].T) > 60.0]
    found, chi2 = descend(likelihood, seeds, box)
    assert (found[:, 2] >= 0.0).all()
    assert (chi2 <= likelihood.chi2(seeds)).all()
    assert (np.abs(found[:, :2] - seeds[:, :2]) <= box.fringe_mas + 1e-9).all()


def test_residuals_and_slopes_of_many_sets_are_those_of_each(rng) -> None:
    model = BinaryModel(1, "free")
    likelihood = Likelihood(niriss(), model)
    sets = np.column_stack([*rng.uniform(80, 200, (2, 4)), rng.uniform(0, 0.5, 4), np.full(4, 30)])
    both = likelihood.residuals_and_slopes(sets)
    np.testing.assert_allclose(both[:, 0], likelihood.residuals(sets), atol=1e-12)
    for k, theta in enumerate(sets):
        np.testing.assert_allclose(both[:, 1:, k], likelihood.jacobian(theta), atol=1e-12)


@pytest.mark.parametrize("smearing", [True, False])
def test_fringes_of_one_place_are_those_of_many(smearing: bool) -> None:
    samples = Likelihood(niriss()).samples
    out = np.empty(2 * len(samples))
    fringes_of_one(samples, smearing)(out, np.array([130.0, -420.0]))
    cosine, sine = np.empty((2, len(samples), 1))
    fringes_into(cosine, sine, samples, np.array([130.0]), np.array([-420.0]), smearing)
    np.testing.assert_allclose(out, np.concatenate([cosine, sine])[:, 0], atol=1e-14)


def test_data_of_one_night_that_know_no_rate_have_a_fit() -> None:
    """Any rate fits them with a place to match, and steps along it are damped, not infinite."""
    model = BinaryModel(1, fastest_mas_yr=100.0, reference_mjd=60000.0)
    at_rest = Likelihood(epoch(mjd=59000.0))
    rng = np.random.default_rng(2)
    night = noisy(at_rest.observables, (150.0, -80.0, 0.02), rng)
    box = Box(50.0, 400.0, resolution_mas(at_rest))
    seeds = np.tile([150.0, -80.0, 0.02, 0.0, 0.0], (24, 1))
    seeds += rng.uniform(-1, 1, seeds.shape) * [20.0, 20.0, 0.005, 60.0, 60.0]
    moving, resting = Likelihood(night, model), Likelihood(night)
    _, chi2 = descend(moving, seeds, box)
    least = descend(resting, np.array([[150.0, -80.0, 0.02]]), box)[1]
    assert chi2.min() == pytest.approx(least[0], abs=0.01)
    assert (chi2 <= moving.chi2(seeds)).all()

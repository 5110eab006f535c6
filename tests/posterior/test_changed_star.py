"""A resolved star whose disc depends on what its companion is: integral, draws and chain.

Three holes see little more than the disc: a faint companion widens what V² say of it by 2.4
times, and one of 0.2 fits as well with a disc that is 10 mas (35 errors of the disc alone) larger.
"""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import simulated
from scipy.special import logsumexp
from scipy.stats import t

from amibayes.companion_search.search import search
from amibayes.data.point_source import point_source
from amibayes.errors import DataError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.posterior.ensemble import sample
from amibayes.posterior.evidence import log_evidence_importance
from amibayes.posterior.grid import affordable, grid_posterior
from amibayes.posterior.independence import Unnoticed
from amibayes.posterior.nuisance import given_rest, nuisance_nodes, star_alone
from amibayes.posterior.priors import Prior, default_prior

HOLES = np.array([[0.0, -2.64], [-2.28631, 0.0], [2.28631, 1.32]])

FIELD = (60.0, 250.0)

N_DRAWS, DISCS = 3000, np.linspace(65.0, 140.0, 301)


@cache
def problem(seed: int) -> tuple[Likelihood, Prior]:
    wavelength = 4.8e-6 + 0.15e-6 * np.array([-1.0, 0.0, 1.0])
    errors = {"vis2_error": 0.005, "closure_error_rad": np.radians(0.5)}
    sheet = point_source(HOLES, wavelength, 0.05e-6, **errors)
    star = BinaryModel(companions=0, diameter_mas="free")
    data = simulated(sheet, [90.0], np.random.default_rng(seed), star)
    likelihood = Likelihood(data, BinaryModel(diameter_mas="free"))
    return likelihood, default_prior(likelihood, *FIELD)


@cache
def brute_force(seed: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Draws of a companion from the prior, their weights; ln Z and its error.

    For each the disc is summed over steps of 0.25 mas, as large as its error.
    """
    likelihood, prior = problem(seed)
    companions = prior.draw(np.random.default_rng(9), N_DRAWS)[:, :3]
    mass = prior.ranges[0].log_density(DISCS) + np.log(DISCS[1] - DISCS[0])
    sets = np.column_stack([np.repeat(companions, len(DISCS), 0), np.tile(DISCS, N_DRAWS)])
    log = logsumexp(likelihood.log_prob(sets).reshape(N_DRAWS, -1) + mass, axis=1)
    log_z = float(logsumexp(log) - np.log(N_DRAWS))
    weight = np.exp(log - log_z)
    return companions, weight, log_z, float(weight.std() / np.sqrt(N_DRAWS))


@pytest.mark.parametrize("slope", [0.0, 3.0, -5.0])
def test_nodes_are_as_close_as_the_star_is_known_at_a_companion(slope: float) -> None:
    """Two parameters that follow a companion s: the integral over them is 1 at every s."""
    own = np.array([[0.04, 0.015], [0.015, 0.01]])
    response = slope * np.array([0.2, -0.1])
    full = np.eye(3)
    full[1:, 1:] = own + np.outer(response, response)
    full[0, 1:] = full[1:, 0] = response
    np.testing.assert_allclose(given_rest(full, np.array([1, 2])), own, atol=1e-12)
    prior = Prior(1.0, 2.0, nuisance=((-20.0, 20.0), (-20.0, 20.0)))
    nodes = nuisance_nodes(prior, np.zeros((1, 2)), full[1:, 1:], at_companion=own)
    assert nodes.close
    inverse, norm_of = np.linalg.inv(own), 2.0 * np.pi * np.sqrt(np.linalg.det(own))
    for s in np.linspace(-2.0, 2.0, 9):
        away = nodes.value - s * response
        density = np.exp(-0.5 * np.einsum("ni,ij,nj->n", away, inverse, away)) / norm_of
        total = (np.exp(nodes.log_weight) * density).sum() * 40.0**2
        assert total == pytest.approx(1.0, abs=5e-3)


def test_nodes_fill_the_prior_where_errors_are_not_known() -> None:
    prior = Prior(1.0, 2.0, nuisance=((-20.0, 20.0),))
    nodes = nuisance_nodes(prior, np.zeros((1, 1)), np.full((1, 1), np.nan))
    assert np.isfinite(nodes.value).all()
    assert np.exp(nodes.log_weight).sum() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("error", [0.0, 50.0])
def test_nodes_cover_a_range_in_which_the_data_tell_nothing(error: float) -> None:
    """Moments of a uniform prior, whatever the fit; beside it one that the data tell."""
    prior = Prior(1.0, 2.0, nuisance=((2.0, 5.0), (-20.0, 20.0)))
    errors = np.array([[error**2, 0.5 * error], [0.5 * error, 1.0]])
    nodes = nuisance_nodes(prior, np.array([[4.0, 0.0]]), errors)
    mass, x = np.exp(nodes.log_weight), nodes.value[:, 0]
    second = np.exp(-0.5 * nodes.value[:, 1] ** 2) / np.sqrt(2.0 * np.pi) * 40.0
    for power in (0, 1, 2, 5):
        expected = (5.0 ** (power + 1) - 2.0 ** (power + 1)) / (3.0 * (power + 1))
        assert (mass * second) @ x**power == pytest.approx(expected, rel=1e-3)


def test_integral_and_draws_have_the_evidence_of_brute_force() -> None:
    """4.5 errors of the sum; nodes by the disc's error beside a companion were 0.17 off."""
    likelihood, prior = problem(0)
    *_, expected, error = brute_force(0)
    assert error < 0.025
    grid = grid_posterior(likelihood, prior)
    assert abs(grid.log_z - expected) < 0.005 + 4.5 * error
    modes = search(likelihood, FIELD).modes
    log_z, own = log_evidence_importance(likelihood, modes, modes, prior, np.random.default_rng(1))
    assert own < 0.005
    assert abs(log_z - grid.log_z) < 0.005 + 4.5 * own


def test_disc_of_any_size_is_not_integrated_but_drawn() -> None:
    likelihood, prior = problem(1)
    *_, expected, error = brute_force(1)
    assert not affordable(likelihood, prior)
    with pytest.raises(DataError, match="depend too much on the companion"):
        grid_posterior(likelihood, prior)
    modes = search(likelihood, FIELD).modes
    log_z, own = log_evidence_importance(likelihood, modes, modes, prior, np.random.default_rng(1))
    assert own < 0.01
    assert abs(log_z - expected) < 4.5 * np.hypot(error, own)


@pytest.mark.slow
def test_chain_without_an_integral_has_the_posterior_of_brute_force() -> None:
    """Means of contrast and separation within 5 errors; converged in a tenth of the steps."""
    likelihood, prior = problem(1)
    companions, weight, *_ = brute_force(1)
    weight = weight / weight.sum()
    posterior = sample(search(likelihood, FIELD), prior, np.random.default_rng(2))
    assert posterior.converged
    assert posterior.n_steps < 5000
    truth = {
        "separation_mas": np.hypot(*companions[:, :2].T),
        "contrast": np.log(companions[:, 2]),
    }
    for name, values in truth.items():
        found = posterior.column(name) if name != "contrast" else np.log(posterior.column(name))
        mean = float(weight @ values)
        error = np.sqrt(weight**2 @ (values - mean) ** 2 + found.var() / posterior.n_effective)
        assert abs(found.mean() - mean) < 5.0 * error, name


@pytest.mark.parametrize("width", [1e-3, 1e-4])
def test_posterior_far_narrower_than_the_errors(
    width: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One node of the first layout has all the weight: closure phases that turn at nulls do so."""
    error, away = 0.02, 0.015305  # of the node above the middle of 20

    def log_prob(theta: np.ndarray) -> np.ndarray:
        return -0.5 * ((theta[:, 0] - 5.0 - away - 0.3 * width) / width) ** 2

    likelihood = SimpleNamespace(errors=lambda _: np.array([[error**2]]), log_prob=log_prob)
    flat = SimpleNamespace(low=0.0, high=10.0, log_density=lambda x: np.full_like(x, -np.log(10)))
    monkeypatch.setattr("amibayes.posterior.nuisance.single_likelihood", lambda _: likelihood)
    prior: Any = SimpleNamespace(ranges=[flat])
    unused: Any = None
    found = star_alone(unused, prior, np.array([5.0]))
    assert found.log_z == pytest.approx(np.log(width * np.sqrt(2.0 * np.pi) / 10.0), abs=0.01)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(width, rel=0.1)


@pytest.mark.parametrize("some", [6, 400])
def test_density_of_a_companion_that_is_not_noticed_adds_up_to_1(
    some: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over the disc, at any companion; and draws are spread as it says (4.5 errors).

    Half of the 12 data tell less well what a companion does, which changes the density alike.
    """
    monkeypatch.setattr("amibayes.posterior.independence.SOME_DATA", some)
    likelihood, prior = problem(0)
    alone = star_alone(likelihood, prior)
    proposal, n = Unnoticed(likelihood, prior, alone), 20_000
    x = proposal.draw(np.random.default_rng(3), n)
    centre = alone.mean[0] + proposal.moved(x)[:, 0]
    inside = np.abs(x[:, 3] - centre) < np.sqrt(alone.covariance[0, 0])
    assert inside.mean() == pytest.approx(2.0 * t(5).cdf(1.0) - 1.0, abs=4.5 * np.sqrt(0.24 / n))
    for k in range(20):
        disc = centre[k] + np.linspace(-10.0, 10.0, 2001)
        sets = np.column_stack([np.repeat(x[k : k + 1, :3], len(disc), 0), disc])
        density = np.exp(proposal.log_density(sets) - Prior(*FIELD).log_density(sets[:, :3]))
        assert density.sum() * 0.01 == pytest.approx(1.0, abs=1e-3)

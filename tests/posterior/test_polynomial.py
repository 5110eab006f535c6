"""A chain on the polynomial of ln L has the posterior of the integral, and knows its place."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.companion_search.search import search
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.posterior import ensemble
from amibayes.posterior.grid import grid_posterior
from amibayes.posterior.laplace import gaussian_of, physical
from amibayes.posterior.polynomial import GOOD, polynomial_log_prob
from amibayes.posterior.priors import default_prior
from amibayes.posterior.sampler import ModelPrior

FIELD = (120.0, 220.0)


@pytest.fixture(scope="module")
def likelihood() -> Likelihood:
    """A companion of some 15 σ; the disc of the star is not resolved (ln L by its 4th power)."""
    model = BinaryModel(diameter_mas="free")
    rng = np.random.default_rng(5)
    return Likelihood(simulated(niriss(), [150.0, -80.0, 0.01, 8.0], rng, model), model)


def test_chain_on_it_has_the_posterior_of_the_integral(likelihood, monkeypatch) -> None:
    monkeypatch.setattr(ensemble, "MANY_SAMPLES", 1)
    made = []

    def kept(*arguments):
        made.append(polynomial_log_prob(*arguments))
        return made[-1]

    monkeypatch.setattr(ensemble, "polynomial_log_prob", kept)
    result = search(likelihood, FIELD)
    prior = default_prior(likelihood, *FIELD)
    posterior = ensemble.sample(result, prior, np.random.default_rng(4))
    assert posterior.converged
    assert made[0] is not None
    assert 0.0 < made[0].error < GOOD
    grid = grid_posterior(likelihood, prior)
    near = np.hypot(*(np.array(grid.cells.position).T - result.modes[0].place).T) < 40.0
    grid = grid.within(near)
    for k, name in enumerate(("east_mas", "north_mas", "ln_contrast")):
        column = posterior.samples[:, k]
        values = np.sort(np.log(column) if name == "ln_contrast" else column)
        ranks = (np.arange(len(values)) + 0.5) / len(values)
        n = posterior.convergence()[posterior.names[k]]["n_effective"]
        distance = np.abs(grid.marginal(name).cdf(values) - ranks).max()
        assert distance < 0.02 + 2.7 / np.sqrt(n), name


def test_it_is_that_of_draws_it_has_not_seen_and_exact_far_away(likelihood) -> None:
    prior = ModelPrior(default_prior(likelihood, *FIELD), likelihood.parameters)
    mode = search(likelihood, FIELD).modes[0]
    fit = gaussian_of(likelihood, np.array(mode.theta), prior.prior)
    found = polynomial_log_prob(likelihood.log_prob, prior, *fit, np.random.default_rng(1))
    assert found is not None
    scatter = np.linalg.inv(found.unit)
    rng = np.random.default_rng(2)
    x = found.centre + rng.standard_normal((2000, 4)) @ scatter.T
    theta = physical(x[np.isfinite(prior.prior.log_density(x))], prior.parameters)
    truth = likelihood.log_prob(theta)
    weight = np.exp(truth - truth.max())
    assert np.sqrt(weight @ (found(theta) - truth) ** 2 / weight.sum()) < GOOD
    away = physical(found.centre + 8.0 * scatter.T, prior.parameters)
    away[:, 3] = abs(away[:, 3])
    np.testing.assert_array_equal(found(away), likelihood.log_prob(away))


def test_what_is_no_polynomial_is_left_alone(likelihood) -> None:
    """Two narrow peaks: no polynomial of low degree has them."""
    prior = ModelPrior(default_prior(likelihood, *FIELD), likelihood.parameters)
    mode = search(likelihood, FIELD).modes[0]
    centre, scatter = gaussian_of(likelihood, np.array(mode.theta), prior.prior)

    def log_prob(theta: np.ndarray) -> np.ndarray:
        x = theta.copy()
        x[:, 2] = np.log(x[:, 2])
        z = np.linalg.solve(scatter, (x - centre).T).T
        parts = [-0.5 * ((z - s * np.array([3.0, 0.0, 0.0, 0.0])) ** 2).sum(1) for s in (1, -1)]
        return np.logaddexp(*parts)

    assert polynomial_log_prob(log_prob, prior, centre, scatter, np.random.default_rng(3)) is None

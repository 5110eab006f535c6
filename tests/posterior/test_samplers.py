"""Every sampler gives the posterior that draws of the prior, weighted by the likelihood, give."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy.special import logsumexp

from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.posterior.chain import EnsembleSampler
from amibayes.posterior.grid import grid_posterior
from amibayes.posterior.independence import GridSampler
from amibayes.posterior.laplace import physical, sampled
from amibayes.posterior.nested import NestedSampler
from amibayes.posterior.priors import Prior
from amibayes.posterior.sampler import Draws, ModelPrior, Sampler, draw_posterior

PRIOR = Prior(60.0, 160.0, 1e-3, 1e-1)


@pytest.fixture(scope="module")
def likelihood() -> Likelihood:
    """A companion of some 5 σ."""
    sheet = niriss(vis2_error=0.01, closure_error_deg=1.0)
    return Likelihood(simulated(sheet, [90.0, -60.0, 0.02], np.random.default_rng(4)))


@pytest.fixture(scope="module")
def expected(likelihood: Likelihood) -> Draws:
    prior = ModelPrior(PRIOR, likelihood.parameters)
    samples = prior.draw(200_000, np.random.default_rng(5))
    value = np.concatenate([likelihood.log_prob(part) for part in np.split(samples, 20)])
    log_z = float(logsumexp(value) - np.log(len(value)))
    weights = np.exp(value - logsumexp(value))
    return Draws(samples, value, weights, {"log_z": log_z, "log_z_error": spread(weights)})


def spread(weights: np.ndarray) -> float:
    return float(np.sqrt((weights**2).sum()))


def moments(draws: Draws) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of east, north and ln contrast."""
    x = np.column_stack([draws.samples[:, :2], np.log(draws.samples[:, 2])])
    mean = draws.weights @ x
    return mean, draws.weights @ (x - mean) ** 2


SAMPLERS = ["ensemble", "grid", pytest.param("nested", marks=pytest.mark.slow)]


def made(name: str, likelihood: Likelihood) -> Sampler:
    if name == "nested":
        pytest.importorskip("dynesty")
        return NestedSampler(live_points=400)
    if name == "ensemble":
        return EnsembleSampler()
    return GridSampler(grid_posterior(likelihood, PRIOR))


@pytest.mark.parametrize("name", SAMPLERS)
def test_draws_are_those_of_the_posterior(name, likelihood, expected) -> None:
    """Mean and variance of three parameters within 4.5 of their errors, and the evidence."""
    found = draw_posterior(likelihood, PRIOR, np.random.default_rng(6), made(name, likelihood))
    assert found.weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(found.log_prob, likelihood.log_prob(found.samples), rtol=1e-9)
    # A chain's own samples are half an autocorrelation time apart: a quarter of their number.
    n = found.n_effective * (0.25 if name == "ensemble" else 1.0)
    (mean, variance), (true_mean, true_variance) = moments(found), moments(expected)
    error = np.sqrt(true_variance * (1.0 / n + 1.0 / expected.n_effective))
    assert np.all(np.abs(mean - true_mean) < 4.5 * error)
    # Of a Gaussian's variance: √(2/n); tails make it twice that at most.
    share = 2.0 * np.sqrt(2.0 / n + 2.0 / expected.n_effective)
    assert np.all(np.abs(variance / true_variance - 1.0) < 4.5 * share)
    if "log_z" in found.diagnostics:
        errors = [d.diagnostics["log_z_error"] for d in (found, expected)]
        off = found.diagnostics["log_z"] - expected.diagnostics["log_z"]
        assert abs(off) < 4.5 * np.hypot(*errors)
    else:
        assert found.diagnostics["converged"] == 1.0


def test_same_seed_same_draws(likelihood) -> None:
    for name in ("ensemble", "grid"):
        both = [
            draw_posterior(likelihood, PRIOR, np.random.default_rng(7), made(name, likelihood))
            for _ in range(2)
        ]
        np.testing.assert_array_equal(both[0].samples, both[1].samples)


def test_walkers_that_cannot_move_give_a_chain_that_is_said_not_to_have_converged(
    likelihood,
) -> None:
    """No place but their own is possible: autocorrelation times are those of a constant."""
    prior, rng = ModelPrior(PRIOR, likelihood.parameters), np.random.default_rng(8)
    start = sampled(prior.draw(64, rng), prior.parameters)
    possible, told = physical(start, prior.parameters)[:, 0], []
    sampler = EnsembleSampler(
        start=start, max_steps=1000, progress=lambda *steps: told.append(steps)
    )
    found = sampler.sample(
        lambda theta: np.where(np.isin(theta[:, 0], possible), 0.0, -np.inf), prior, rng
    )
    assert found.diagnostics["converged"] == 0.0
    assert found.diagnostics["autocorrelation_time"] == np.inf
    assert found.diagnostics["split_rhat"] > 1e6
    assert np.isin(found.samples[:, 0], possible).all()
    assert told == [(500, 1000), (1000, 1000)]


def test_of_two_companions_the_brighter_one_comes_first(rng: np.random.Generator) -> None:
    """Whatever else the pair has, it is the same pair."""
    likelihood = Likelihood(niriss(), BinaryModel(companions=2))
    prior = ModelPrior(Prior(50.0, 400.0, 1e-4, 1.0), likelihood.parameters)
    cube = rng.random((50, prior.n_dim))
    plain, found = prior.prior.from_cube(cube), prior.from_cube(cube)
    pairs = (a.reshape(50, 2, 3) for a in (plain, found))
    for before, after in zip(*pairs, strict=True):
        assert after[0, 2] >= after[1, 2]
        order = np.argsort(-before[:, 2])
        np.testing.assert_array_equal(after, before[order])

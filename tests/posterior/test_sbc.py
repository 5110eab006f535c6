"""Simulation-based calibration (Talts et al. 2018): truths from the prior have uniform ranks.

Every bound is one of 24; each fails by chance with less than 4e-6, all with less than 1e-4.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import stats

from amibayes.companion_search.search import search
from amibayes.likelihood.likelihood import Likelihood
from amibayes.posterior.ensemble import sample
from amibayes.posterior.grid import grid_posterior
from amibayes.posterior.modes import Region
from amibayes.posterior.priors import Prior

FIELD = (50.0, 400.0)
RANGES = {"faint": (1e-5, 1e-3), "middling": (1e-3, 1e-2), "bright": (1e-2, 0.5)}
NAMES = ("east_mas", "north_mas", "ln_contrast")
CHANCE = 4e-6


def truths(name: str, n: int, seed: int):
    """Prior, and n pairs of truth (east, north, ln contrast) and likelihood."""
    prior = Prior(*FIELD, *RANGES[name])
    rng = np.random.default_rng([seed, list(RANGES).index(name)])
    sheet = niriss()
    for theta in prior.draw(rng, n):
        likelihood = Likelihood(simulated(sheet, theta, rng))
        yield prior, np.array([*theta[:2], np.log(theta[2])]), likelihood


def check(ranks: np.ndarray) -> None:
    """Uniform ranks (Kolmogorov–Smirnov) and coverage of 68 and 95 % intervals (binomial)."""
    report = []
    for name, column in zip(NAMES, ranks.T, strict=True):
        p = stats.kstest(column, "uniform").pvalue
        report.append(f"{name} KS p {p:.3f}")
        assert p > CHANCE, report
        for level in (0.68, 0.95):
            inside = int((np.abs(column - 0.5) < 0.5 * level).sum())
            error = np.sqrt(level * (1 - level) / len(column))
            report.append(f"{level:.0%}: {inside / len(column):.3f} +/- {error:.3f}")
            assert stats.binomtest(inside, len(column), level).pvalue > CHANCE, report
    logging.getLogger("sbc").info("%s", ", ".join(report))


def sizes(slow: int, release: int) -> pytest.MarkDecorator:
    """Numbers of truths in each range of contrast."""
    marks = (pytest.mark.slow, pytest.mark.release)
    numbers = zip((slow, release), marks, strict=True)
    return pytest.mark.parametrize("n", [pytest.param(n, marks=mark) for n, mark in numbers])


@sizes(70, 170)
@pytest.mark.parametrize("name", list(RANGES))
def test_ranks_of_the_grid_posterior_are_uniform(name, n) -> None:
    """A third of a second each on one core."""
    ranks = []
    for prior, truth, likelihood in truths(name, n, seed=11):
        grid = grid_posterior(likelihood, prior)
        ranks.append([grid.cdf(n, x) for n, x in zip(NAMES, truth, strict=True)])
    check(np.array(ranks))


@sizes(15, 30)
@pytest.mark.parametrize("name", list(RANGES))
def test_ranks_of_the_chain_are_uniform(name, n) -> None:
    """Two seconds each on one core."""
    ranks = []
    for k, (prior, truth, likelihood) in enumerate(truths(name, n, seed=12)):
        result = search(likelihood, FIELD)
        grid = grid_posterior(likelihood, prior)
        posterior = sample(result, prior, np.random.default_rng([13, k]), grid=grid)
        sampled = posterior.samples.copy()
        sampled[:, 2] = np.log(sampled[:, 2])
        ranks.append((sampled < truth).mean(axis=0))
    check(np.array(ranks))


@pytest.mark.parametrize(
    "contrast", [0.006, *(pytest.param(c, marks=pytest.mark.slow) for c in (0.0, 0.003))]
)
def test_chain_and_grid_are_one_posterior(contrast) -> None:
    """Kolmogorov–Smirnov distance of the samples, below 2.7/√n (p = 1e-6 for n independent)."""
    likelihood = Likelihood(simulated(niriss(), [150.0, -80.0, contrast], np.random.default_rng(3)))
    result, prior = search(likelihood, FIELD), Prior(*FIELD)
    grid = grid_posterior(likelihood, prior)
    posterior = sample(result, prior, np.random.default_rng(4), grid=grid)
    assert posterior.converged
    inside = Region.of(result).holds(*grid.cells.position)
    # In noise the chain is that of the field; that of a strong mode leaves the others out.
    assert inside.all() == (contrast == 0.0 or len(result.modes) == 1)
    assert (grid.probability[inside].sum() > 0.999) == (contrast != 0.003)
    grid = grid.within(inside)
    for k, name in enumerate(NAMES):
        values = np.sort(np.log(posterior.samples[:, k]) if k == 2 else posterior.samples[:, k])
        share = (np.arange(len(values)) + 0.5) / len(values)
        distance = np.abs(grid.marginal(name).cdf(values) - share).max()
        n = posterior.convergence()[posterior.names[k]]["n_effective"]
        assert distance < 0.01 + 2.7 / np.sqrt(n), name
    assert posterior.mode_method == "grid"
    assert posterior.mode_probability.sum() == pytest.approx(1.0)
    assert (posterior.elsewhere < 1e-3) == (contrast > 0)


@pytest.mark.parametrize(
    "contrast_form", ["log-uniform", pytest.param("uniform", marks=pytest.mark.slow)]
)
def test_chain_takes_the_prior_it_is_given(contrast_form) -> None:
    """On data that say nothing, the chain is the prior (distance as above)."""
    likelihood = Likelihood(niriss(vis2_error=1e3, closure_error_deg=1e4))
    prior = replace(Prior(*FIELD, 1e-3, 0.5), contrast_form=contrast_form)
    posterior = sample(search(likelihood, FIELD), prior, np.random.default_rng(4))
    n = posterior.convergence()["contrast"]["n_effective"]
    ranks = np.sort(prior.contrast_cdf(posterior.column("contrast")))
    assert np.abs(ranks - np.linspace(0, 1, len(ranks))).max() < 0.01 + 2.7 / np.sqrt(n)
    rings = np.sort(prior.ring_cdf(posterior.column("separation_mas")))
    assert np.abs(rings - np.linspace(0, 1, len(rings))).max() < 0.01 + 2.7 / np.sqrt(n)

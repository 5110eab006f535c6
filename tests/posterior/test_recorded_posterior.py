"""Numbers of posteriors and evidences as they were recorded: a change of any of them is seen.

Chains are recorded after no step, or by densities: many steps would magnify rounding.

`pytest tests/posterior/test_recorded_posterior.py --force-regen` records them anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import niriss, simulated
from recorded_numbers import numbers_of
from test_bootstrap import exposures

from amibayes.companion_search.result import Mode, SearchResult
from amibayes.companion_search.search import search
from amibayes.companion_search.second_companion import search_second
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.posterior import evidence
from amibayes.posterior.bootstrap import bootstrap, exposures_of
from amibayes.posterior.chain import burn_in, longest, split_rhat, thinning, times
from amibayes.posterior.contrast_profile import profile
from amibayes.posterior.derived import interval
from amibayes.posterior.ensemble import START_WIDTH, Posterior, _start
from amibayes.posterior.evidence import _Pairs, compare_models
from amibayes.posterior.grid import affordable, grid_posterior
from amibayes.posterior.independence import (
    GridSampler,
    IndependenceProposal,
    Mixture,
    Unnoticed,
    independence_move_within,
    mode_mixture,
)
from amibayes.posterior.laplace import HeavyTailed, gaussian_of, log_evidence_laplace, log_masses
from amibayes.posterior.modes import Region, elsewhere, mode_masses, mode_probabilities
from amibayes.posterior.nuisance import star_alone
from amibayes.posterior.polynomial import Around, polynomial_log_prob
from amibayes.posterior.priors import Prior, default_prior, edit_prior, parse_setting
from amibayes.posterior.sampler import Draws, ModelPrior, draw_posterior, log_mean, tempered

FIELD = (150.0, 190.0)
TOLERANCE = {"rtol": 0.0, "atol": 1e-4}
STAR = BinaryModel(diameter_mas="free")


@pytest.fixture(scope="module")
def result() -> SearchResult:
    """A companion of some 10 σ."""
    data = simulated(niriss(), [150.0, -80.0, 0.006], np.random.default_rng(1))
    return search(Likelihood(data), FIELD, check=False)


@pytest.fixture(scope="module")
def resolved() -> SearchResult:
    data = simulated(niriss(), [150.0, -80.0, 0.02, 40.0], np.random.default_rng(1), STAR)
    return search(Likelihood(data, STAR), (150.0, 190.0), check=False)


def test_grids(result: SearchResult, resolved: SearchResult, num_regression) -> None:
    numbers: dict[str, Any] = {}
    for name, found, forms in (
        ("point", result, ()),
        ("uniform", result, ("contrast=uniform", "position=separation")),
        ("star", resolved, ()),
    ):
        prior = default_prior(found.likelihood, 164.0, 176.0)
        names = [p.name for p in found.likelihood.parameters][3:]
        prior = edit_prior(prior, map(parse_setting, forms), names)
        grid = grid_posterior(found.likelihood, prior, step=4.0)
        wanted = ("east_mas", "separation_mas", "position_angle_deg", "contrast", "delta_mag")
        proposal = IndependenceProposal(grid)
        places, density = proposal.draw(40, np.random.RandomState(3))
        region = Region.of(found)
        inside = independence_move_within(grid, region)
        assert inside is not None
        numbers |= numbers_of(
            **{
                name: {
                    "log_z": grid.log_z - found.likelihood.log_norm,
                    "none": grid.log_z_none - found.likelihood.log_norm,
                    "intervals": [grid.interval(n) for n in (*wanted, *grid.nuisance_names)],
                    "cdf": [grid.cdf("north_mas", x) for x in (-90.0, -80.0, -70.0)],
                    "limits": [grid.upper_limit(), grid.upper_limit(uniform=True)],
                    "near": grid.mass_near(np.array([[150.0, -80.0], [100.0, 100.0]]), 5.0),
                    "masses": mode_masses(found, grid)[:2],
                    # Near nothing in both, which rounding decides.
                    "elsewhere": np.round(elsewhere(found, grid), 9),
                    "drawn": (places, density),
                    "density": proposal.log_density(places),
                    "inside": inside.grid.probability.max(),
                    "affordable": affordable(found.likelihood, prior),
                }
            }
        )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_evidences(
    result: SearchResult, resolved: SearchResult, monkeypatch: pytest.MonkeyPatch, num_regression
) -> None:
    def mixture_of(likelihood: Likelihood, modes: Sequence[Mode], *_: object) -> Mixture:
        """A law around the first mode whose axes rounding does not turn."""
        theta = np.round(modes[0].theta, 4)
        bright = likelihood.parameters.contrasts
        theta[bright] = np.log(theta[bright])
        widths = np.resize([6.0, 4.0, 0.2], len(theta))
        return Mixture((HeavyTailed(theta, np.diag(widths)),), np.ones(1))

    monkeypatch.setattr(evidence, "mode_mixture", mixture_of)
    monkeypatch.setattr(evidence, "MAX_DRAWS", 4000)
    numbers: dict[str, Any] = {}
    for name, found in (("point", result), ("star", resolved)):
        likelihood = found.likelihood
        prior = default_prior(likelihood, found.grid.inner_mas, found.grid.outer_mas)
        rng = np.random.default_rng(4)
        compared = compare_models(found, prior, rng, model_prior=(1.0, 2.0))
        mixture = mode_mixture(likelihood, found.modes, prior, np.random.default_rng(5))
        pairs = _Pairs(mixture_of(likelihood, found.modes), prior, 1)
        drawn = pairs.draw(np.random.default_rng(6), 30)
        theta = np.array(found.modes[0].theta)
        own = gaussian_of(likelihood, theta, prior)
        numbers |= numbers_of(
            **{
                name: {
                    "compared": compared,
                    "odds": compared.log_odds(1, 0),
                    "probability": compared.probability,
                    "laplace": log_evidence_laplace(likelihood, found.modes, prior),
                    "masses": log_masses(likelihood, found.modes[:2], prior),
                    "probabilities": mode_probabilities(found, prior)[:2],
                    "pairs": (drawn, pairs.log_density(drawn)),
                    "mixture": mixture.share,
                    "centre": own[0],
                    "scatter": own[1] @ own[1].T,
                }
            }
        )
    two = search_second(result)
    prior = default_prior(result.likelihood, *FIELD)
    rng = np.random.default_rng(4)
    pair = compare_models(result, prior, rng, companions=(0, 1, 2), two=two)
    alone = star_alone(result.likelihood, prior)
    unnoticed = Unnoticed(result.likelihood, prior, alone)
    unseen = unnoticed.draw(np.random.default_rng(7), 20)
    star = Prior(*FIELD, nuisance=((0.0, 90.0),), half_cauchy=(1.0,))
    numbers |= numbers_of(
        passed_over=("companions",),  # zeros but for rounding
        pair=pair,
        two=log_evidence_laplace(two.likelihood, two.modes[:1], prior),
        alone=alone,
        unseen=(unseen, unnoticed.log_density(unseen)),
        star_alone=star_alone(resolved.likelihood, star).log_z,
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_draws_and_polynomials(resolved: SearchResult, num_regression) -> None:
    likelihood = resolved.likelihood
    prior = default_prior(likelihood, resolved.grid.inner_mas, resolved.grid.outer_mas)
    everything = ModelPrior(prior, likelihood.parameters)
    theta = np.array(resolved.modes[0].theta)
    centre, scatter = gaussian_of(likelihood, theta, prior, START_WIDTH)
    made = polynomial_log_prob(
        likelihood.log_prob, everything, centre, scatter, np.random.default_rng(8)
    )
    assert made is not None
    near = theta * (1.0 + 0.002 * np.cos(np.arange(20.0).reshape(5, 4)))
    tailed = Around(likelihood.log_prob, everything, np.random.default_rng(9)).heavy_tailed(
        centre, scatter
    )
    assert tailed is not None
    grid = grid_posterior(likelihood, prior)
    by_grid = draw_posterior(likelihood, prior, np.random.default_rng(2), GridSampler(grid, 500))
    log_weight = np.sin(np.arange(60.0)) * 8.0
    start = _start(resolved, prior, Region.of(resolved), np.random.default_rng(3))
    numbers = numbers_of(
        error=made.error,
        radius=made.radius,
        fitted=made(near) - likelihood.log_prob(theta),
        around=made.around.log_density(centre[None] + 0.001),
        tailed=(tailed.centre, tailed.scatter @ tailed.scatter.T),
        heavy=HeavyTailed(centre, np.diag([1.0, 2.0, 0.1, 3.0])).log_density(centre[None] + 0.3),
        by_grid=by_grid,
        effective=by_grid.n_effective,
        again=by_grid.resampled(20, np.random.default_rng(1)),
        mean=log_mean(log_weight, 80),
        tempered=tempered(log_weight, 20.0),
        start=start.mean(axis=0),
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_priors(num_regression) -> None:
    rng, numbers = np.random.default_rng(5), {}
    for name, prior in (
        ("plain", Prior(50.0, 400.0)),
        (
            "all",
            Prior(
                50.0,
                400.0,
                contrast_form="uniform",
                position_form="separation",
                nuisance=((0.0, 90.0), (0.0, 2.0), (3.0, 40.0)),
                half_cauchy=(1.0, 0.0, 0.0),
                log_uniform=(2,),
                n_contrasts=2,
                fastest_mas_yr=30.0,
                shapes=((0.0, 50.0),),
            ),
        ),
    ):
        for companions in (1, 2):
            theta = prior.draw(np.random.default_rng(3), 12, companions)
            bright = prior.parameters(companions).contrasts
            x = theta.copy()
            x[:, bright] = np.log(x[:, bright])
            outside = x + 300.0 * rng.standard_normal(x.shape)
            numbers |= numbers_of(
                **{
                    f"{name} {companions}": {
                        "theta": theta,
                        "cube": prior.to_cube(theta),
                        "density": prior.log_density(x),
                        "outside": prior.log_density(outside),
                    }
                }
            )
        rho = np.array([10.0, 60.0, 300.0, 500.0])
        numbers |= numbers_of(
            **{
                f"{name} laws": {
                    "ring": prior.ring_cdf(rho),
                    "contrast": prior.contrast_cdf(np.array([1e-6, 1e-3, 0.5, 2.0])),
                    "ranges": [r.quantile(np.array([0.1, 0.6])) for r in prior.ranges],
                }
            }
        )
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-6})


def test_chains_as_they_are_summarised(num_regression) -> None:
    """An autoregressive process, four numbers of eight walkers, in the place of a sampler."""
    rng = np.random.default_rng(6)
    chain = np.empty((900, 8, 3))
    chain[0] = rng.standard_normal((8, 3))
    for k in range(1, len(chain)):
        kept = np.array([0.5, 0.8, 0.9])
        chain[k] = kept * chain[k - 1] + np.sqrt(1 - kept**2) * rng.standard_normal((8, 3))
    sampler: Any = SimpleNamespace(iteration=len(chain), get_chain=lambda: chain)
    samples = np.array([150.0, -80.0, 0.02]) + chain[300:].reshape(-1, 3) * [5.0, 4.0, 0.002]
    found = Posterior(
        **{"names": ("east_mas", "north_mas", "contrast"), "samples": samples},
        **{"log_prob": samples[:, 0], "chain": chain, "chain_log_prob": chain[..., 0]},
        **{"autocorrelation_time": 20.0, "n_steps": 900, "n_burn": 300, "n_walkers": 8},
        **{"split_rhat": 1.0, "acceptance": 0.3, "converged": True, "prior": Prior(50.0, 400.0)},
        **{"mode_probability": np.ones(1), "mode_method": "grid", "elsewhere": 0.0},
        **{"times": np.array([3.0, 9.0, 19.0]), "rhats": np.array([1.0, 1.01, 1.02])},
    )
    numbers = numbers_of(
        burn=burn_in(sampler),
        thin=thinning(sampler),
        times=times(sampler),
        longest=longest(times(sampler)),
        rhat=split_rhat(sampler),
        effective=found.n_effective,
        intervals=[found.interval(n) for n in ("separation_mas", "delta_mag", "contrast")],
        angle=interval("position_angle_deg", samples[:, 0] * 0.1 - 12.0, 0.9),
        convergence=found.convergence(),
        table=found.to_table()["position_angle_deg"].value.mean(),
        facts=found.to_xarray().attrs["autocorrelation_time"],
        draws=found.to_xarray()["separation_mas"].values,
        weights=Draws(samples, samples[:, 0], np.abs(samples[:, 2])).n_effective,
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_exposures_drawn_anew_and_profiles(num_regression) -> None:
    data = simulated(exposures(8), [120.0, -60.0, 0.05], np.random.default_rng(6))
    result = search(Likelihood(data), (100.0, 160.0), check=False)
    found = bootstrap(result, ExtraNoise(), 6, np.random.default_rng(7))
    low, high = np.array([0.0, 0.001]), np.array([0.02, 0.1])
    boxes = np.linspace(low, high, 30, axis=1)

    def at(rows: np.ndarray, contrast: np.ndarray) -> np.ndarray:
        middle, width = 0.004 + 0.01 * (rows[:, None] // 2), 0.002 + 0.001 * (rows[:, None] % 2)
        return np.asarray(-0.5 * ((contrast - middle) / width) ** 2 - 30.0 * contrast)

    numbers = numbers_of(
        samples=found.samples,
        intervals=[found.interval(n) for n in ("separation_mas", "position_angle_deg", "contrast")],
        exposures=exposures_of(data),
        profile=np.maximum(profile(at, low, high, boxes, 2), -60.0),
    )
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-4})

"""Evidences: methods that share nothing agree, and the models win that should."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy.stats import chi2, norm

from amibayes.companion_search.search import search
from amibayes.companion_search.second_companion import search_second
from amibayes.data.point_source import point_source
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.posterior import evidence
from amibayes.posterior.evidence import compare_models, log_evidence_importance
from amibayes.posterior.grid import grid_posterior
from amibayes.posterior.laplace import log_evidence_laplace, log_masses
from amibayes.posterior.priors import Prior, default_prior
from amibayes.posterior.sampler import draw_posterior

FIELD = (50.0, 400.0)

TWO = BinaryModel(companions=2)

STRONG_PAIR = [150.0, -80.0, 0.05, -200.0, 100.0, 0.01]


def problem(theta, model: BinaryModel | None = None, seed: int | np.random.Generator = 1):
    data = simulated(niriss(), theta, np.random.default_rng(seed), model)
    result = search(Likelihood(data), FIELD)
    return result, default_prior(result.likelihood, *FIELD)


def agree(a: tuple[float, float], b: tuple[float, float], slack: float = 0.005) -> bool:
    """Within 4.5 standard errors (7e-6) and a stated systematic error."""
    return abs(a[0] - b[0]) < slack + 4.5 * np.hypot(a[1], b[1])


@pytest.mark.parametrize(
    "contrast",
    [0.0, *(pytest.param(c, marks=pytest.mark.slow) for c in (0.001, 0.002, 0.004, 0.02, 0.3))],
)
def test_one_companion_importance_agrees_with_the_grid_everywhere(contrast) -> None:
    result, prior = problem([150.0, -80.0, contrast])
    grid = grid_posterior(result.likelihood, prior)
    rng = np.random.default_rng(2)
    by_draws = log_evidence_importance(result.likelihood, result.modes, result.modes, prior, rng)
    assert by_draws[1] < 0.03
    assert agree(by_draws, (grid.log_z, 0.0), slack=0.01)


@pytest.mark.parametrize(
    "contrast", [0.01, *(pytest.param(c, marks=pytest.mark.slow) for c in (0.03, 0.3))]
)
def test_laplace_agrees_on_strong_companions(contrast) -> None:
    """Corrections to Laplace are of the order of (σ/c)², below 2 % here."""
    result, prior = problem([150.0, -80.0, contrast])
    grid = grid_posterior(result.likelihood, prior)
    assert log_evidence_laplace(result.likelihood, result.modes, prior) == pytest.approx(
        grid.log_z, abs=0.08
    )


def test_two_strong_companions_laplace_and_importance_agree() -> None:
    result, prior = problem(STRONG_PAIR, TWO)
    two = search_second(result)
    rng = np.random.default_rng(2)
    by_draws = log_evidence_importance(two.likelihood, two.modes, result.modes, prior, rng)
    assert by_draws[1] < 0.03
    assert agree((log_evidence_laplace(two.likelihood, two.modes, prior), 0.0), by_draws, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [0.0, 0.0015])
def test_two_faint_companions_are_weighed_like_the_prior_mean(contrast) -> None:
    """Against 400 000 plain draws of both companions from the prior."""
    result, prior = problem([150.0, -80.0, contrast], seed=5)
    two = search_second(result)
    rng = np.random.default_rng(4)
    log_z, error = log_evidence_importance(two.likelihood, two.modes, result.modes, prior, rng)
    relative = np.exp(
        np.concatenate(
            [two.likelihood.log_prob(prior.draw(rng, 40_000, companions=2)) for _ in range(10)]
        )
        - log_z
    )
    plain = relative.std() / np.sqrt(len(relative))
    assert plain < 0.1
    assert abs(relative.mean() - 1.0) < 4.5 * np.hypot(plain, error)


@pytest.mark.parametrize(
    "truth",
    [
        STRONG_PAIR,
        [-90.0, 60.0, 0.02, 220.0, 130.0, 0.015],
        [100.0, 0.0, 0.3, 0.0, 300.0, 0.02],
    ],
)
def test_noiseless_pairs_come_back(truth) -> None:
    result = search(Likelihood(simulated(niriss(), truth, None, TWO)), FIELD)
    two = search_second(result)
    assert two.chi2 < 1e-2
    np.testing.assert_allclose(two.theta, truth, rtol=5e-3, atol=0.05)
    first, second = two.companions
    assert first.contrast >= second.contrast
    assert second.separation_error_mas > 0.0


@pytest.mark.slow
def test_errors_of_a_pair_mean_what_they_say() -> None:
    """40 noisy pairs: pulls of six parameters, mean 0 ± 1/√40 and width 1, to 5 sigma."""
    truth = np.array([150.0, -80.0, 0.03, -200.0, 100.0, 0.02])
    rng, pulls = np.random.default_rng(42), []
    for _ in range(40):
        two = search_second(problem(truth, TWO, seed=rng)[0])
        pulls.append((two.theta - truth) / np.sqrt(np.diag(two.theta_covariance)))
    assert np.abs(np.mean(pulls, axis=0)).max() < 5.0 / np.sqrt(40)
    assert np.abs(np.std(pulls, axis=0, ddof=1) - 1.0).max() < 5.0 / np.sqrt(80)


@pytest.mark.parametrize(
    ("theta", "number"),
    [
        ([0.0] * 6, 0),
        pytest.param([150.0, -80.0, 0.02, 0.0, 60.0, 0.0], 1, marks=pytest.mark.slow),
        (STRONG_PAIR, 2),
    ],
)
def test_the_right_number_of_companions_wins(theta, number) -> None:
    result, prior = problem(theta, TWO)
    grid = grid_posterior(result.likelihood, prior)
    evidence = compare_models(
        result,
        prior,
        np.random.default_rng(0),
        companions=(0, 1, 2),
        grid=grid,
        two=search_second(result),
    )
    assert int(np.argmax(evidence.probability)) == number
    assert evidence.probability.sum() == pytest.approx(1.0)
    assert evidence.method == ("quadrature", "grid", "importance")
    assert evidence.log_odds(1, 0) == pytest.approx(grid.log_z - grid.log_z_none)
    assert (evidence.halo_log_z < evidence.log_z[0]) == (number == 0)


def test_prior_odds_shift_posterior_odds() -> None:
    result, prior = problem([0.0, 0.0, 0.0])
    grid = grid_posterior(result.likelihood, prior)
    even, odd = (
        compare_models(result, prior, np.random.default_rng(0), grid=grid, model_prior=p)
        for p in (None, (9.0, 1.0))
    )
    assert odd.log_odds(1, 0) == pytest.approx(even.log_odds(1, 0) - np.log(9.0))
    assert odd.model_prior == (0.9, 0.1)


def test_over_resolved_light_is_not_taken_for_a_companion() -> None:
    model = BinaryModel(companions=0, background=0.02)
    data = simulated(niriss(), [], np.random.default_rng(3), model)
    result = search(Likelihood(data), FIELD)
    prior = default_prior(result.likelihood, *FIELD)
    evidence = compare_models(result, prior, np.random.default_rng(0))
    assert evidence.halo_log_z > max(evidence.log_z) + 3.0
    free = Likelihood(data, BinaryModel(background="free"))
    found = search(free, FIELD)
    prior = default_prior(free, *FIELD)
    assert np.isnan(compare_models(found, prior, np.random.default_rng(0)).halo_log_z)


def test_impossible_requests_say_so(monkeypatch) -> None:
    result, prior = problem([150.0, -80.0, 0.02])
    rng = np.random.default_rng(0)
    with pytest.raises(UsageError, match="two with their joint fit"):
        compare_models(result, prior, rng, companions=(0, 2))
    with pytest.raises(UsageError, match="positive prior probability"):
        compare_models(result, prior, rng, model_prior=(1.0, 0.0))
    monkeypatch.setitem(sys.modules, "dynesty", None)
    with pytest.raises(UsageError, match=r"pip install 'amibayes\[evidence\]'"):
        draw_posterior(result.likelihood, prior, rng, "nested")
    three = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
    sheet = point_source(three, [4.8e-6], 1e-8, vis2_error=0.1, closure_error_rad=0.1)
    few = search(Likelihood(sheet), (100.0, 300.0))
    with pytest.raises(DataError, match="6 parameters of two companions"):
        search_second(few)


@pytest.mark.parametrize(
    "contrast",
    [
        pytest.param(0.005, marks=pytest.mark.slow),
        *(pytest.param(c, marks=pytest.mark.release) for c in (0.0, 0.05)),
    ],
)
def test_nested_sampling_agrees_with_the_grid_everywhere(contrast) -> None:
    pytest.importorskip("dynesty")
    result, prior = problem([150.0, -80.0, contrast])
    grid = grid_posterior(result.likelihood, prior)
    found = draw_posterior(result.likelihood, prior, np.random.default_rng(6), "nested").diagnostics
    nested = found["log_z"], found["log_z_error"]
    assert agree(nested, (grid.log_z, 0.0))


@pytest.mark.release
@pytest.mark.parametrize("theta", [STRONG_PAIR, [150.0, -80.0, 0.01, 0.0, 60.0, 0.0]])
def test_nested_sampling_agrees_on_two_companions(theta) -> None:
    pytest.importorskip("dynesty")
    result, prior = problem(theta, TWO)
    two = search_second(result)
    rng = np.random.default_rng(2)
    by_draws = log_evidence_importance(two.likelihood, two.modes, result.modes, prior, rng)
    found = draw_posterior(two.likelihood, prior, np.random.default_rng(6), "nested").diagnostics
    nested = found["log_z"], found["log_z_error"]
    assert agree(nested, by_draws)


@pytest.mark.slow
def test_nested_sampling_integrates_nuisance_parameters() -> None:
    pytest.importorskip("dynesty")
    model = BinaryModel(background="free")
    truth = [150.0, -80.0, 0.02, 0.05]
    data = simulated(niriss(), truth, np.random.default_rng(1), model)
    result = search(Likelihood(data, model), FIELD)
    prior = default_prior(result.likelihood, *FIELD)
    prior = replace(prior, nuisance=((0.0, 0.5),))
    grid = grid_posterior(result.likelihood, prior)
    nested = compare_models(result, prior, np.random.default_rng(6), method="nested")
    assert nested.method == ("nested", "nested")
    assert agree((nested.log_z[1], nested.log_z_error[1]), (grid.log_z, 0.0))
    assert agree((nested.log_z[0], nested.log_z_error[0]), (grid.log_z_none, 0.0))


def test_few_draws_of_importance_scatter_as_stated_about_the_grid(monkeypatch) -> None:
    """An unresolved disc (ln L by its 4th power) with a prior of heavy tails: no Gaussian."""
    model = BinaryModel(diameter_mas="free")
    truth = [150.0, -80.0, 0.01, 8.0]
    field = (120.0, 220.0)
    data = simulated(niriss(), truth, np.random.default_rng(5), model)
    result = search(Likelihood(data, model), field)
    prior = default_prior(result.likelihood, *field)
    expected = grid_posterior(result.likelihood, prior).log_z
    monkeypatch.setattr(evidence, "MODEL_VALUES", 0.0)
    found = np.array([
        log_evidence_importance(
            result.likelihood, result.modes, result.modes, prior, np.random.default_rng(seed)
        )
        for seed in range(10)
    ])  # fmt: skip
    assert found[:, 1].max() < 0.06
    mean_error = np.sqrt((found[:, 1] ** 2).mean() / len(found))
    assert abs(found[:, 0].mean() - expected) < 0.005 + 4.5 * mean_error
    pulls = (found[:, 0] - found[:, 0].mean()) / found[:, 1]
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], len(found) - 1)
    assert low < pulls @ pulls < high


def test_laplace_cuts_gaussians_off_at_both_ends_of_a_range() -> None:
    """A nuisance parameter that is known, by its range, to a part of its own error."""
    model = BinaryModel(diameter_mas="free")
    data = simulated(niriss(), [150.0, -80.0, 0.05, 40.0], None, model)
    likelihood = Likelihood(data, model)
    mode = SimpleNamespace(theta=(150.0, -80.0, 0.05, 40.0))
    sigma = float(np.sqrt(likelihood.errors(np.array(mode.theta))[3, 3]))
    assert 6.0 * sigma < 40.0

    def mass(low: float, high: float) -> float:
        prior = Prior(50.0, 400.0, 1e-4, 1.0, nuisance=((40.0 + low * sigma, 40.0 + high * sigma),))
        # Of the density over the range, the Gaussian's share times its width.
        return float(log_masses(likelihood, [mode], prior)[0] + np.log(high - low))  # type: ignore[list-item]

    whole = mass(-6.0, 6.0)
    for low, high in ((-0.5, 1.0), (-1.5, 0.2), (-6.0, 0.0)):
        share = np.log(norm.cdf(high) - norm.cdf(low))
        assert mass(low, high) - whole == pytest.approx(share, abs=1e-5)

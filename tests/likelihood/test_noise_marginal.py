"""The likelihood averaged over its extra noise: exact, calibrated, and sane where χ² is large."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from interferometer import four_telescopes
from scipy import stats
from scipy.special import logsumexp
from weighted_draws import ranks_of

from amibayes.companion_search.optimise import refine
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.assumed_covariance import covariance_of_errors
from amibayes.data.covariance import dense_covariance
from amibayes.data.systematics import Systematics
from amibayes.likelihood.averaged_noise import averaged_noise
from amibayes.likelihood.channel_noise import ChannelShare, Correlation
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior, add_noise, with_noise
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise_fit import fit_noise
from amibayes.likelihood.noise_terms import MAX_INFLATION, PRIOR_STATED_ERRORS_CORRECT
from amibayes.likelihood.student import averaged_student_noise
from amibayes.models.parameters import Box
from amibayes.posterior.ensemble import sample
from amibayes.posterior.grid import grid_posterior
from amibayes.posterior.priors import Prior

FIELD = (50.0, 400.0)
TRUTH = [150.0, -80.0, 0.02]


def understated(theta, factor, rng):
    """Data whose noise is ``factor`` times the stated errors."""
    noisy = simulated(niriss(0.005 * factor, 0.3 * factor), theta, rng)
    return replace(noisy, covariance=niriss().covariance)


FLAT = NoisePrior(np.inf, np.inf)


def averaged(data, prior=None):
    result, _ = search_with_noise(Likelihood(data), FIELD)
    alone = single_likelihood(result.likelihood)
    fits = [(result.likelihood, result.theta), (alone, result.single_theta)]
    noise = averaged_noise(result.likelihood.noise, data, fits, prior=prior)
    return result, result.likelihood.with_noise(noise)


@pytest.mark.parametrize("kind", ["assumed", "diagonal"])
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_average_is_the_integral_over_the_noise(kind, factor, rng) -> None:
    """Against scipy's quadrature of likelihoods whose covariances are made one by one."""
    data = simulated(niriss(0.005 * factor, 0.3 * factor), TRUTH, rng)
    data = replace(data, covariance=niriss(covariance=kind).covariance)
    result, marginal = averaged(data, FLAT)
    theta = np.array([result.theta, result.theta + np.array([1.0, 2.0, 5e-4])])
    x, w = np.polynomial.legendre.leggauss(80)
    inflation = np.log(MAX_INFLATION) * 0.5 * (1.0 + x)
    expected = np.zeros(2)
    for kind_of, typical in (({"vis2"}, 0.005), ({"cp"}, np.radians(0.3))):
        part = data.only(list(kind_of))
        name = "vis2" if "vis2" in kind_of else "closure_phase_rad"
        amounts = [0.0, *(typical * np.sqrt(np.expm1(2.0 * inflation)))]
        log = np.array(
            [Likelihood(add_noise(part, ExtraNoise(**{name: a}))).log_prob(theta) for a in amounts]
        )
        mass = np.concatenate(
            [[PRIOR_STATED_ERRORS_CORRECT], (1.0 - PRIOR_STATED_ERRORS_CORRECT) * 0.5 * w]
        )
        expected += logsumexp(log, axis=0, b=mass[:, None])
    np.testing.assert_allclose(marginal.log_prob(theta), expected, atol=2e-3)


def test_correlated_kinds_share_the_relative_noise(rng) -> None:
    """The covariance of one block grows by one factor of both kinds' noise."""
    data = simulated(niriss(covariance="diagonal"), TRUTH, rng)
    matrix = np.diag(data.covariance.variance)
    matrix[0, 30] = matrix[30, 0] = 0.3 * np.sqrt(matrix[0, 0] * matrix[30, 30])
    data = replace(data, covariance=dense_covariance(matrix))
    _, marginal = averaged(data)
    (term,) = marginal.noise.terms
    extra = ExtraNoise(0.005 * np.sqrt(3.0), np.radians(0.3) * np.sqrt(3.0))
    noisy = Likelihood(add_noise(data, extra))
    residual = data.data - noisy.predict([TRUTH])[:, 0]
    found = term.log_likelihoods(residual[:, None], np.array([np.log(2.0)]))[0, 0]
    assert found == pytest.approx(noisy.log_prob([TRUTH])[0], abs=1e-6)


@pytest.mark.parametrize("kind", ["known", "averaged", "student"])
def test_sums_of_residuals_have_the_likelihood_of_their_sums(kind, rng) -> None:
    data = understated(TRUTH, 2.0, rng)
    result, marginal = averaged(data)
    fits = [(result.likelihood, result.theta)]
    noise = {
        "known": result.likelihood.noise,
        "averaged": marginal.noise,
        "student": averaged_student_noise(result.likelihood.noise, data, fits),
    }[kind]
    a, b = noise.draw(5, rng), noise.draw(3, rng)
    pairs = rng.random((5, 3)) < 0.6
    expected = np.full((5, 3), -np.inf)
    for i, k in np.argwhere(pairs):
        expected[i, k] = noise.log_prob((a[:, i] + b[:, k])[:, None])[0]
    np.testing.assert_allclose(noise.log_prob_of_sums(a, b, pairs), expected, rtol=1e-10)


def test_a_scale_that_is_known_has_no_extra_noise_in_its_posterior(rng) -> None:
    """Residuals of a t distribution whose scale is the stated one, however large they are."""
    data = understated(TRUTH, 2.0, rng)
    result, _ = averaged(data)
    fits = [(result.likelihood, result.theta)]
    noise = averaged_student_noise(result.likelihood.noise, data, fits, free_scale=False)
    for found in noise.posterior(result.likelihood.difference(result.theta)).values():
        assert found.probability_none == 1.0
        assert found.interval() == (0.0, 0.0, 0.0)
        assert len(found.amount.low) == len(found.amount.high) == len(found.amount.weight) == 1


@pytest.mark.slow
def test_noise_of_the_posterior_is_the_noise_of_the_data() -> None:
    """Right errors: probably right. Understated by 3: certainly not, and the amount is told."""
    rng = np.random.default_rng(5)
    right, amounts = [], []
    for factor in (1.0, 3.0):
        for _ in range(12):
            result, marginal = averaged(understated(TRUTH, factor, rng))
            scatter = rng.multivariate_normal(result.theta, result.theta_covariance, 50)
            found = marginal.noise.posterior(marginal.difference(scatter))
            right.append(found["vis2"].probability_none)
            if factor == 3.0:
                amounts.append([found[k].interval(0.95) for k in ("vis2", "closure_phase_rad")])
    assert np.median(right[:12]) > 0.7
    assert max(right[12:]) < 1e-2
    truth = np.sqrt(8.0) * np.array([0.005, np.radians(0.3)])
    inside = (np.array(amounts)[:, :, 1] < truth) & (truth < np.array(amounts)[:, :, 2])
    # 24 intervals of 95 %: more than 6 missed is a 1e-4 accident.
    assert (~inside).sum() <= 6


@pytest.mark.parametrize(
    "n", [pytest.param(80, marks=pytest.mark.slow), pytest.param(300, marks=pytest.mark.release)]
)
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_intervals_cover_whatever_the_errors_say(factor, n) -> None:
    """Companions of 20σ; 68 and 95 % intervals of east, north and contrast.

    Right errors must not be over-covered by more than 5 % (the price of asking), understated
    ones not under-covered; binomial chance of each bound 1e-4.
    """
    rng = np.random.default_rng(77)
    ranks = []
    box = Box(*FIELD, 188.0)
    for _ in range(n):
        truth = np.array(
            [150.0 + rng.uniform(-20, 20), -80.0 + rng.uniform(-20, 20), 0.01 * factor]
        )
        data = understated(truth, factor, rng)
        theta = np.array(refine(Likelihood(data), truth, box, 0.0).theta)
        profile = Likelihood(add_noise(data, fit_noise(Likelihood(data), theta)))
        theta = np.array(refine(profile, theta, box, 0.0).theta)
        marginal = profile.with_noise(averaged_noise(profile.noise, data, [(profile, theta)]))
        ranks.append(ranks_of(marginal, theta, truth, rng))
    off = np.abs(np.array(ranks) - 0.5)
    report = []
    for level in (0.68, 0.95):
        for inside in (off < 0.5 * level).sum(axis=0):
            report.append(f"{level:.0%}: {inside / n:.3f}")
            assert stats.binomtest(int(inside), n, level, alternative="less").pvalue > 1e-4, report
            most = min(level + 0.05, 0.99)
            assert stats.binomtest(int(inside), n, most, alternative="greater").pvalue > 1e-4, (
                report
            )
    logging.getLogger("coverage").info("factor %s: %s", factor, ", ".join(report))


@pytest.mark.slow
def test_chain_samples_the_average() -> None:
    """Against the grid posterior of the same average."""
    result, marginal = averaged(understated(TRUTH, 3.0, np.random.default_rng(8)))
    prior = Prior(*FIELD)
    posterior = sample(replace(result, likelihood=marginal), prior, np.random.default_rng(1))
    grid = grid_posterior(marginal, prior)
    assert posterior.converged
    for name in ("east_mas", "north_mas", "contrast"):
        assert posterior.interval(name)[0] == pytest.approx(
            grid.interval(name)[0], abs=0.15 * (grid.interval(name)[2] - grid.interval(name)[1])
        )
        wide = [p.interval(name)[2] - p.interval(name)[1] for p in (posterior, grid)]
        assert wide[0] == pytest.approx(wide[1], rel=0.15)


@pytest.mark.parametrize("lasting", [0.0, 0.4])
def test_at_the_fitted_noise_the_average_is_of_the_likelihood_of_the_fit(lasting, rng) -> None:
    """Unequal channels that share noise, floors beside them: exact there, and near it close.

    About the stated errors posteriors of real data were 2.4σ from the best fit.
    """
    sheet = four_telescopes(4, channels=8)
    vis2, closure = (
        error * np.geomspace(0.3, 3.0, 8)[table.channel]
        for error, table in zip(sheet.errors, (sheet.vis2, sheet.closure_phase), strict=True)
    )
    covariance = covariance_of_errors(vis2, sheet.closure_phase, closure, "assumed")
    data = replace(sheet, covariance=covariance)
    data = data.with_data(simulated(sheet, [4.0, 5.0, 0.1], rng).data)
    floors = (Systematics(data.setups[0].source, 0.02, np.radians(0.5), 0.002),)
    shared = Correlation(0.2, 0.1, 0.3, 0.1, lasting=(0.0, 0.0, 0.0, lasting, 0.0, 0.0))
    channels = (ChannelShare(shared, shared),)
    noise = ExtraNoise(0.02, np.radians(1.2), channels=channels, floors=floors)
    stated, prior = Likelihood(data).expecting([4.0, 5.0, 0.1]), NoisePrior(floors=floors)
    theta = np.array([4.0, 5.0, 0.1]) + rng.normal(size=(40, 3)) * [0.05, 0.05, 0.01]
    for times, within in ((1.0, 1e-8), (0.97, 0.02), (1.03, 0.02)):
        amount = replace(noise, vis2=times * noise.vis2, closure_phase_rad=times * np.radians(1.2))
        exact = with_noise(stated, amount)
        fits = [(exact, theta[0])]
        terms = averaged_noise(
            exact.noise, stated.observables, fits, noise=noise, prior=prior
        ).terms
        found = np.zeros(len(theta))
        for term in terms:
            of = getattr(amount, term.kind)
            node = np.array([0.5 * np.log1p((of / term.typical[term.kind]) ** 2)])
            found += term.log_likelihoods(stated.difference(theta), node)[0]
        right = exact.log_prob(theta)
        assert found - found.mean() == pytest.approx(
            right - right.mean(), abs=within * np.ptp(right)
        )
        assert found.mean() == pytest.approx(right.mean(), abs=1e-6 if times == 1.0 else 1.0)

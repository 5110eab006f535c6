"""Student-t residuals: exact where nothing is wrong, unmoved by what is, honest about chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import integrate, stats
from weighted_draws import ranks_of

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.optimise import refine
from amibayes.companion_search.robust import RobustFits, search_robust
from amibayes.companion_search.search import search
from amibayes.data.covariance import dense_covariance
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.detection.statistic import make_statistic
from amibayes.detection.treatments import KnownErrors
from amibayes.errors import UsageError
from amibayes.likelihood.averaged_noise import AveragedNoise, averaged_noise
from amibayes.likelihood.extra_noise import add_noise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise import noise_of
from amibayes.likelihood.noise_fit import fit_noise
from amibayes.likelihood.noise_terms import with_nodes
from amibayes.likelihood.student import (
    DEGREES,
    normal_moments,
    scales,
    scores,
    student_terms,
    symmetric_whitening,
)
from amibayes.models.parameters import Box

FIELD = (50.0, 400.0)
TRUTH = np.array([150.0, -80.0, 0.02])
SHARE, SIZE = 0.05, 10.0
"""Share of the data that are outliers, and how many errors they stand off."""


def spoiled(theta, rng, share=SHARE):
    """Data with some V² and closure phases pushed 10 errors up or down, and which they are."""
    data = simulated(niriss(), theta, rng)
    sigma = np.sqrt(data.covariance.variance)
    hit = rng.random(len(sigma)) < share
    push = np.where(hit, SIZE * sigma * rng.choice([-1.0, 1.0], len(sigma)), 0.0)
    vis2, closure = np.split(push, [len(data.vis2)])
    return replace(
        data,
        vis2=replace(data.vis2, value=data.vis2.value + vis2),
        closure_phase=replace(data.closure_phase, value=data.closure_phase.value + closure),
    ), hit


@pytest.mark.parametrize("kind", ["assumed", "diagonal", "dense"])
def test_frame_keeps_chi2_and_the_names_of_the_data(kind, rng) -> None:
    data = niriss(covariance="diagonal" if kind == "dense" else kind)
    if kind == "dense":
        shape = rng.standard_normal((56, 200))
        data = replace(data, covariance=dense_covariance(shape @ shape.T * 1e-7))
    frame = symmetric_whitening(data)
    white = data.covariance.whiten(data.covariance.draw(rng, 4000))
    z = frame.residuals(white)
    np.testing.assert_allclose(frame.share @ z**2, (white**2).sum(axis=0), rtol=1e-9)
    np.testing.assert_allclose(frame.gather(z), white, atol=1e-9)
    assert np.abs(z.std(axis=1) - 1.0).max() < 5 / np.sqrt(2 * 4000)
    assert frame.share.sum() == pytest.approx(data.covariance.rank)
    # A push of one datum shows in that datum most.
    pushed = frame.residuals(data.covariance.whiten(np.diag(np.sqrt(data.covariance.variance))))
    np.testing.assert_array_equal(np.abs(pushed).argmax(axis=0), np.arange(56))


def test_moments_are_integrals_over_the_normal_distribution() -> None:
    def psi(z):
        return (DEGREES + 1) * z / (DEGREES + z * z)

    def mean(f):
        return integrate.quad(lambda z: f(z) * stats.norm.pdf(z), -12, 12)[0]

    found = normal_moments()
    scatter = mean(lambda z: psi(z) ** 2)
    assert found.curvature == pytest.approx(mean(lambda z: z * psi(z)), rel=1e-5)
    assert found.power == pytest.approx(found.curvature / scatter, rel=1e-5)
    assert found.efficiency == pytest.approx(0.926, abs=1e-3)
    assert found.score_variance == pytest.approx(mean(lambda z: (0.8 * psi(z)) ** 2), rel=1e-5)


def test_t_likelihood_of_independent_data_is_scipys(rng) -> None:
    """Up to the power, and the normalisation of the t distribution."""
    data = simulated(niriss(covariance="diagonal"), TRUTH, rng)
    difference = data.data[:, None] - Likelihood(data).predict(
        [TRUTH, TRUTH + np.array([5.0, 0, 0])]
    )
    power = normal_moments().power
    total = sum(t.log_likelihoods(difference, np.zeros(1))[0] for t in student_terms(data))
    z = difference / np.sqrt(data.covariance.variance)[:, None]
    expected = power * stats.t.logpdf(z, DEGREES).sum(axis=0)
    assert total[1] - total[0] == pytest.approx(expected[1] - expected[0], rel=1e-9)


def test_scale_is_that_of_the_normal_bulk(rng) -> None:
    frame = symmetric_whitening(niriss(covariance="diagonal", channels=20))
    noise = 3.0 * rng.standard_normal((frame.rows.shape[0], 200))
    assert scales(frame, noise).mean() == pytest.approx(3.0, rel=0.01)
    noise[rng.random(noise.shape) < SHARE] = 30.0
    # Gaussian scatter grows by a factor of 2.4.
    assert 1.0 < scales(frame, noise).mean() / 3.0 < 1.3


def test_outliers_are_named_and_do_not_move_the_companion(rng) -> None:
    data, _ = spoiled(TRUTH, rng, 0.0)
    vis2, closure = data.vis2.value.copy(), data.closure_phase.value.copy()
    vis2[3] += 10 * 0.005
    closure[20] -= 15 * np.radians(0.3)
    data = replace(
        data,
        vis2=replace(data.vis2, value=vis2),
        closure_phase=replace(data.closure_phase, value=closure),
    )
    result, _ = search_robust(Likelihood(data), FIELD)
    outliers = result.robustness.outliers
    assert {(o.kind, len(o.stations)) for o in outliers[:2]} == {("vis2", 2), ("closure_phase", 3)}
    setup = data.setups[0]
    named = {o.stations for o in outliers[:2]}
    assert tuple(setup.stations[s] for s in data.vis2.stations[3]) in named
    assert tuple(setup.stations[s] for s in data.closure_phase.stations[20]) in named
    pull = (result.theta - TRUTH) / np.sqrt(np.diag(result.theta_covariance))
    assert np.abs(pull).max() < 4.0


def test_estimated_errors_are_refused(rng) -> None:
    data = replace(simulated(niriss(), TRUTH, rng), freedom=Freedom(60.0, 40.0))
    with pytest.raises(UsageError, match="stated, not estimated"):
        search_robust(Likelihood(data), FIELD)
    data = replace(data, freedom=None, covariance_kind="estimated")
    with pytest.raises(UsageError, match="stated, not estimated"):
        search_robust(Likelihood(data), FIELD)


def test_statistic_does_not_depend_on_the_scale_and_bounds_one_datum(rng) -> None:
    data = niriss()
    frame, grid = symmetric_whitening(data), make_grid(50.0, 400.0, 30.0)
    test = make_statistic(Likelihood(data), grid, np.empty(0), whitening=frame)
    bank = test.bank
    white = rng.standard_normal((bank.n_data, 5))
    first = test.evaluate(white)
    again = test.evaluate(7.0 * white)
    np.testing.assert_allclose(again, first, rtol=1e-4)
    bounded, _ = scores(frame, np.where(np.arange(bank.n_data)[:, None] == 2, 1e3, white))
    assert np.abs(bounded).max() < 3.0


def test_residuals_below_a_floor_of_the_errors_count_by_the_floor(rng) -> None:
    """They are as small by chance: what they hold is not measured in their own scatter."""
    data = niriss()
    grid, frame = make_grid(50.0, 400.0, 30.0), symmetric_whitening(data)
    floored = Likelihood(data, noise=replace(noise_of(data), floor=True))
    free, held = (
        make_statistic(likelihood, grid, np.empty(0), whitening=frame)
        for likelihood in (Likelihood(data), floored)
    )
    white = rng.standard_normal((free.bank.n_data, 400))
    np.testing.assert_allclose(free.evaluate(0.1 * white), free.evaluate(white), rtol=1e-3)
    # Small scores are the residuals themselves: n ln(1 − gain/χ²), its gain a thousandth.
    small = held.evaluate(0.03 * white)
    gain = KnownErrors().search(held.bank, held.bank.project(0.03 * white)).gain
    n = held.bank.n_data - held.bank.n_nuisance
    share = gain / (n * normal_moments().score_variance)
    expected = -n * np.log1p(-share)
    np.testing.assert_allclose(small, expected, rtol=0.01, atol=0.01 * expected.max())
    # Larger ones than the floor count by their own scatter.
    np.testing.assert_allclose(held.evaluate(5.0 * white), free.evaluate(white), rtol=1e-3)


def efficiency_and_coverage(share, n, seed):
    """Errors/σ and ranks of ``n`` data sets, Gaussian with extra noise and robust.

    Fits start from the truth: what is measured are the residuals, not the search.
    """
    rng, box = np.random.default_rng(seed), Box(*FIELD, 188.0)
    errors, ranks = {"gaussian": [], "robust": []}, {"gaussian": [], "robust": []}
    for _ in range(n):
        truth = TRUTH + np.array([*rng.uniform(-20, 20, 2), 0.0])
        data, _ = spoiled(truth, rng, share)
        stated = Likelihood(data)
        sigma = np.sqrt(np.diag(stated.errors(truth)))
        theta = np.array(refine(stated, truth, box, 0.0).theta)
        profile = Likelihood(add_noise(data, fit_noise(stated, theta)))
        plain = np.array(refine(profile, theta, box, 0.0).theta)
        averaged = profile.with_noise(averaged_noise(profile.noise, data, [(profile, plain)]))
        errors["gaussian"].append((plain - truth) / sigma)
        ranks["gaussian"].append(ranks_of(averaged, plain, truth, rng))
        robust, averaged = weighted_fit(stated, theta, box)
        errors["robust"].append((robust - truth) / sigma)
        ranks["robust"].append(ranks_of(averaged, robust, truth, rng))
    return {k: np.array(v) for k, v in errors.items()}, {k: np.array(v) for k, v in ranks.items()}


def weighted_fit(stated, theta, box):
    """The robust fit near one place, and its averaged likelihood."""
    work = RobustFits(stated, FIELD, free_scale=True)
    stretch, found = work.steps(theta, box)
    profile = work.stretched(stretch)
    left = stated.difference(found)[:, 0]
    terms = tuple(with_nodes(t, [left]) for t in student_terms(stated.observables))
    return found, profile.with_noise(AveragedNoise(profile.noise, terms))


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, SHARE])
def test_coverage_and_efficiency(share) -> None:
    """60 data sets: coverage of 68 and 95 % intervals, and scatter against Gaussian residuals.

    Binomial chance 1e-4 of each lower bound. With 5 % outliers of 10σ the robust scatter is
    the smaller one; without, it costs less than 15 %.
    """
    n = 60
    errors, ranks = efficiency_and_coverage(share, n, 3)
    off = np.abs(ranks["robust"] - 0.5)
    for level in (0.68, 0.95):
        for inside in (off < 0.5 * level).sum(axis=0):
            assert stats.binomtest(int(inside), n, level, alternative="less").pvalue > 1e-4
    scatter = {k: np.sqrt((v**2).mean()) for k, v in errors.items()}
    limit = 1.15 if share == 0.0 else 0.8
    assert scatter["robust"] < limit * scatter["gaussian"]
    assert np.abs(errors["robust"].mean(axis=0)).max() < 5 * scatter["robust"] / np.sqrt(n)


@pytest.mark.parametrize("share", [pytest.param(0.0, marks=pytest.mark.slow), SHARE])
def test_false_alarm_probability_stays_uniform(share) -> None:
    """400 null data sets with and without outliers, each against one robust null.

    Kolmogorov-Smirnov p > 1e-4 without; P(p < 0.05) and P(p < 0.01) at most their binomial
    1e-4 bounds with outliers (which make the test a little conservative).
    """
    rng = np.random.default_rng(12)
    data = niriss()
    likelihood = Likelihood(data)
    frame, grid = symmetric_whitening(data), make_grid(*FIELD, 23.5)
    test = make_statistic(likelihood, grid, np.empty(0), whitening=frame)
    null = np.sort(test.draw_null(5_000, rng))
    n = 400
    sets = [spoiled(np.zeros(3), rng, share)[0] for _ in range(n)]
    blank = likelihood.predict([np.zeros(3)])[:, 0]
    white = data.covariance.whiten(np.array([s.data - blank for s in sets]).T)
    statistic = test.evaluate(white)
    p = (1 + len(null) - np.searchsorted(null, statistic)) / (1 + len(null))
    if share == 0.0:
        assert stats.kstest(p, "uniform").pvalue > 1e-4
    for level in (0.05, 0.01):
        hits = int((p < level).sum())
        assert stats.binomtest(hits, n, level, alternative="greater").pvalue > 1e-4


def test_a_companion_is_found_as_surely_as_by_gaussian_residuals(rng) -> None:
    """Both statistics put a companion of 10σ far beyond their nulls."""
    data, _ = spoiled([150.0, -80.0, 0.006], rng, 0.0)
    result = search(Likelihood(data), FIELD)
    made = result.likelihood, result.grid, result.single_theta
    for whitening in (None, symmetric_whitening(data)):
        test = make_statistic(*made, whitening=whitening)
        assert test.value > 1.2 * test.draw_null(4000, rng).max()


def test_errors_of_normal_residuals_are_those_of_the_efficiency() -> None:
    """E[ψ′]²/E[ψ²] of ψ(x) = (ν + 1)x/(ν + x²), integrated: the mean weight of 720 residuals."""
    likelihood = Likelihood(niriss(channels=20))
    white = np.random.default_rng(12).standard_normal(likelihood.n_independent)
    stretch = RobustFits(likelihood, FIELD, free_scale=False)._stretch(white)[0]
    nu, pdf = DEGREES, stats.norm.pdf

    def mean(of) -> float:
        return float(integrate.quad(lambda x: of(x) * pdf(x), -12.0, 12.0)[0])

    slope = mean(lambda x: (nu + 1.0) * (nu - x * x) / (nu + x * x) ** 2)
    efficiency = slope**2 / mean(lambda x: ((nu + 1.0) * x / (nu + x * x)) ** 2)
    # Weights scatter by 0.3: 5 sigma of the mean is 6 %.
    assert np.mean(stretch**-2.0) == pytest.approx(efficiency, rel=0.06)


def test_t_likelihood_is_normal_at_its_peak_and_shifts_with_its_scale(rng) -> None:
    """Residuals in proportion to the scale differ by its part of the norm alone."""
    data = niriss(covariance="diagonal")
    (term, _) = student_terms(data)
    white = rng.standard_normal((term.n_independent, 3))
    at_peak = term.log_likelihoods_of_white(0.0 * white, np.zeros(1))[0]
    sigma = np.sqrt(data.covariance.variance[: data.n_vis2])
    np.testing.assert_allclose(at_peak, stats.norm.logpdf(0.0, scale=sigma).sum(), rtol=1e-9)
    nodes = np.array([0.0, 0.4, 1.5])
    scaled = [term.log_likelihoods_of_white(np.exp(u) * white, np.array([u]))[0] for u in nodes]
    shift = normal_moments().efficiency * term.n_independent * nodes
    np.testing.assert_allclose(scaled + shift[:, None], scaled[0] + np.zeros((3, 1)), rtol=1e-9)


def test_power_of_the_t_likelihood_obeys_bartletts_identity() -> None:
    """Of normal residuals the score's variance is the mean curvature: weights are fair."""
    z = np.linspace(-12.0, 12.0, 200_001)
    mass = stats.norm.pdf(z) * (z[1] - z[0])
    score = np.gradient(normal_moments().power * stats.t.logpdf(z, DEGREES), z)
    assert mass @ score**2 == pytest.approx(-(mass @ np.gradient(score, z)), rel=1e-4)


@pytest.mark.parametrize(
    "start", [(140.0, -90.0, 0.01), (150.0, -80.0, 0.3), (120.0, -60.0, 0.1), (200.0, -30.0, 0.05)]
)
def test_weights_and_fit_go_on_until_every_weight_holds(
    start: tuple[float, float, float], rng
) -> None:
    """Those that a fit ends with are those that its residuals have, to half a percent."""
    data, _ = spoiled([150.0, -80.0, 0.02], rng)
    work = RobustFits(Likelihood(data), FIELD, True, per_file=False)
    box = Box(*FIELD, resolution_mas(work.likelihood))
    stretch, theta = work.steps(np.array(start), box)
    again = work._stretch(work.likelihood.residuals(theta)[:, 0])[0]
    assert np.abs(np.log(again / stretch)).max() < 0.005

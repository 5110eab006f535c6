"""Closed limits against the exact model, numerical integrals and simulated closure phases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import integrate, optimize, stats

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import search
from amibayes.likelihood.chi2 import candid_n_sigma
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.limits.analytic import LINEAR, AnalyticLimit, analytic_limit
from amibayes.models.binary import BinaryModel

RINGS = (70.0, 150.0, 330.0)
FEW = [(0, 3), (1, 40), (2, 77)]
"""Ring and angle of the positions that are looked at one by one."""


def searched(noise: float, kinds: tuple[str, ...] = ("vis2", "cp"), seed: int = 4) -> SearchResult:
    """A search of a point source whose errors are ``noise`` times NIRISS's."""
    sheet = niriss(0.005 * noise, 0.3 * noise)
    data = simulated(sheet, [0.0, 0.0, 0.0], np.random.default_rng(seed)).only(kinds)
    return search(Likelihood(data), (50.0, 400.0))


@pytest.fixture(scope="module")
def results() -> dict[float, SearchResult]:
    return {noise: searched(noise) for noise in (0.1, 1.0, 10.0)}


def residuals(result: SearchResult) -> np.ndarray:
    return single_likelihood(result.likelihood).residuals(result.single_theta)[:, 0]


def positions(limit: AnalyticLimit):
    for k, a in FEW:
        yield limit.rings.east_mas[k, a], limit.rings.north_mas[k, a], limit.contrast_at[k, a]


def tolerance(contrast: float) -> float:
    """The linear signal is wrong by about its contrast (relative); the solver by nothing."""
    return 3.0 * contrast if contrast <= LINEAR else 1e-6


@pytest.mark.parametrize("noise", [0.1, 1.0, 10.0])
def test_absil_is_three_sigma_of_candid_with_the_exact_model(results, noise: float) -> None:
    result = results[noise]
    limit = analytic_limit(result, "absil", separation_mas=RINGS)
    dof = result.likelihood.n_independent
    for east, north, contrast in positions(limit):
        worse = result.likelihood.chi2([east, north, contrast])[0]
        n_sigma = candid_n_sigma(worse, result.chi2_single, dof)
        assert n_sigma == pytest.approx(3.0, rel=2.0 * tolerance(contrast))


@pytest.mark.parametrize("noise", [0.1, 1.0, 10.0])
def test_candid_finds_what_was_put_into_the_data_at_three_sigma(results, noise: float) -> None:
    """Data are made with the companion; the contrast by bisection on nσ of the exact model."""
    result = results[noise]
    likelihood = result.likelihood
    limit = analytic_limit(result, "candid", separation_mas=RINGS)
    alone = single_likelihood(likelihood).predict(np.empty((1, 0)))
    for east, north, contrast in positions(limit):

        def n_sigma(c: float, place=(east, north)) -> float:
            change = likelihood.predict([[*place, c]]) - alone
            change[21:] = np.angle(np.exp(1j * change[21:]))
            white = residuals(result) + likelihood.observables.covariance.whiten(change)[:, 0]
            return float(
                candid_n_sigma(white @ white, result.chi2_single, likelihood.n_independent) - 3.0
            )

        low, high = 0.3 * contrast, min(3.0 * contrast, 1.0)
        exact = optimize.brentq(n_sigma, low, high)
        assert contrast == pytest.approx(exact, rel=tolerance(contrast))


@pytest.mark.parametrize("noise", [0.1, 1.0, 10.0])
def test_posterior_is_the_quantile_of_an_integral(results, noise: float) -> None:
    result = results[noise]
    limit = analytic_limit(result, "posterior", separation_mas=RINGS)
    for east, north, contrast in positions(limit):

        def likeness(c: float, place=(east, north)) -> float:
            lowered = result.likelihood.chi2([*place, c])[0] - result.chi2_single
            return float(np.exp(-0.5 * lowered))

        breaks = [0.3 * contrast, contrast, min(3.0 * contrast, 1.0)]
        pieces = [
            integrate.quad(likeness, a, b)[0]
            for a, b in zip([0.0, *breaks], [*breaks, 1.0], strict=True)
        ]
        below = sum(pieces[:2]) / sum(pieces)
        # The tail falls by about 3.3 per sigma here: a relative error e of the limit at
        # three sigma moves it by a factor of about exp(10 e).
        log_ratio = np.log((1.0 - below) / stats.norm.sf(3.0))
        assert abs(log_ratio) < 12.0 * tolerance(contrast) + 0.02


@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_closure_phases_with_the_companion_are_fitted_better_by_it(noise: float) -> None:
    """Simulated closure phases: noise of the data's covariance, χ² with and without."""
    result = searched(noise, ("cp",))
    likelihood = result.likelihood
    limit = analytic_limit(result, "closure-phase", separation_mas=RINGS)
    assert "(delta chi2 36)" in replace(limit, sigmas=3.0).criterion
    covariance, n = likelihood.observables.covariance, 200_000
    for east, north, contrast in positions(limit):
        companion = likelihood.predict([[east, north, contrast]])
        noisy = companion + covariance.draw(np.random.default_rng(7), n)
        single = (covariance.whiten(noisy) ** 2).sum(axis=0)
        binary = (covariance.whiten(noisy - companion) ** 2).sum(axis=0)
        better = int((binary < single).sum())
        expected = stats.norm.cdf(3.0)
        spread = np.sqrt(n * expected * (1.0 - expected))
        # The linear signal is too strong by up to LINEAR, which is 0.03 sigma of 3.
        slack = n * 0.03 * stats.norm.pdf(3.0) if contrast <= LINEAR else 0.0
        assert abs(better - n * expected) < 4.5 * spread + slack


def test_closure_phase_limit_does_not_know_the_noise_of_the_data_at_hand() -> None:
    first, other = (
        analytic_limit(searched(1.0, ("cp",), seed), "closure-phase", separation_mas=RINGS)
        for seed in (1, 2)
    )
    np.testing.assert_allclose(first.contrast_at, other.contrast_at)


def test_nothing_is_excluded_by_data_that_see_nothing() -> None:
    result = searched(4000.0)
    for method in ("absil", "candid", "closure-phase"):
        limit = analytic_limit(result, method, separation_mas=RINGS)
        assert np.isnan(limit.delta_mag).all(), method
    # A flat prior from 0 to 1 always has its quantile.
    limit = analytic_limit(result, "posterior", separation_mas=RINGS)
    assert (limit.contrast > 0.99).all()


def test_a_detected_companion_is_taken_out_first() -> None:
    truth = [110.0, -75.0, 0.02]
    clean, loud = (
        simulated(niriss(), theta, np.random.default_rng(5)) for theta in ([0.0, 0.0, 0.0], truth)
    )
    expected = analytic_limit(search(Likelihood(clean), (50.0, 400.0)), "candid")
    found = search(Likelihood(loud), (50.0, 400.0))
    removed = analytic_limit(found, "candid", remove=True)
    left_in = analytic_limit(found, "candid")
    # Three fitted parameters take some noise along with the companion.
    assert np.abs(removed.delta_mag - expected.delta_mag).max() < 0.35
    assert (left_in.delta_mag < expected.delta_mag - 0.5).mean() > 0.5


def test_a_free_diameter_is_fitted_again_beside_the_companion() -> None:
    """NLopt fits the diameter to data that hold the companion: nσ of CANDID is still 3."""
    data = simulated(
        niriss(0.0005, 0.03),
        [0.0, 0.0, 0.0, 40.0],
        np.random.default_rng(6),
        BinaryModel(1, "free"),
    )
    likelihood = Likelihood(data, BinaryModel(1, "free"))
    result = search(likelihood, (50.0, 400.0))
    limit = analytic_limit(result, "absil", separation_mas=RINGS)
    for east, north, contrast in positions(limit):
        fit = optimize.minimize_scalar(
            lambda d, c=(east, north, contrast): likelihood.chi2([*c, d])[0],
            bounds=(30.0, 50.0),
            method="bounded",
            options={"xatol": 1e-5},
        )
        n_sigma = candid_n_sigma(fit.fun, result.chi2_single, likelihood.n_independent - 1)
        assert n_sigma == pytest.approx(3.0, rel=0.03)


def test_spread_holds_two_thirds_of_the_angles(results) -> None:
    limit = analytic_limit(results[1.0], "candid", separation_mas=RINGS)
    low, middle, high = limit.spread.T
    inside = (limit.contrast_at >= low[:, None]) & (limit.contrast_at <= high[:, None])
    assert ((inside.mean(axis=1) > 0.64) & (inside.mean(axis=1) < 0.72)).all()
    np.testing.assert_allclose(middle, np.median(limit.contrast_at, axis=1), rtol=0.05)
    assert "3 sigma" in limit.criterion
    # Δχ² of noise is Gaussian about the signal's own, s, with the error 2√s: s = 3 · 2√s is 36.
    assert "(delta chi2 36)" in replace(limit, method="closure-phase").criterion

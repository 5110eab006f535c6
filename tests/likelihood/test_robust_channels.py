"""Robust residuals of data whose channels share some of their noise."""

from __future__ import annotations

import numpy as np
import pytest
from channel_sets import pionier, share, with_draw
from helpers import niriss, simulated
from scipy import stats
from scipy.optimize import minimize

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.robust import RobustFits, search_robust, shared_noise, with_shared
from amibayes.data.blocks import BlockCovariance
from amibayes.data.observables import Observables
from amibayes.detection.statistic import make_statistic
from amibayes.likelihood.channel_noise import ChannelCovariance, noise_with_channels
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.student import symmetric_whitening
from amibayes.models.parameters import Box

FIELD = (3.0, 8.0)
COMMON = share(0.5, 0.5)


def drawn(sheet: Observables, rng: np.random.Generator, pushed: int = 0) -> tuple:
    """Half of the variance common to channels, some data pushed by 12 errors, and which."""
    draw = noise_with_channels(sheet, [COMMON]).draw(1, rng)[:, 0]
    at = rng.choice(len(draw), pushed, replace=False)
    draw[at] += 12.0 * np.sqrt(sheet.covariance.variance[at]) * rng.choice([-1.0, 1.0], pushed)
    return with_draw(sheet, draw), at


TRUTH = np.array([5.0, -3.0, 0.3])


def binary(rng: np.random.Generator) -> tuple:
    """A binary, four of its data pushed by 12 errors, and which."""
    return drawn(simulated(pionier(6), TRUTH, None), rng, 4)


def errors_hold_the_truth(theta: np.ndarray, covariance: np.ndarray) -> bool:
    return bool((np.abs(theta - TRUTH) < 4.0 * np.sqrt(np.diag(covariance))).all())


def test_share_is_fitted_beside_outliers_and_grows_errors(rng) -> None:
    """Share of 0.5 within five errors; an offset of all channels makes the place uncertain."""
    stated, box = Likelihood(binary(rng)[0]), Box(*FIELD, 4.0)
    stretch, theta = RobustFits(stated, FIELD, free_scale=True).steps(TRUTH, box)
    weighted = RobustFits(stated, FIELD, free_scale=True).stretched(stretch)
    shared = shared_noise(weighted, theta, NoisePrior())
    (found,) = shared.channels
    for kind in (found.vis2, found.closure_phase):
        assert abs(kind.value - 0.5) < 5 * kind.error < 1.0
    assert not shared_noise(weighted, theta, NoisePrior(channels=False)).channels
    correlated = with_shared(stated, shared)
    stretch, again = RobustFits(correlated, FIELD, free_scale=True).steps(theta, box)
    larger = RobustFits(correlated, FIELD, free_scale=True).stretched(stretch).errors(again)
    assert errors_hold_the_truth(again, larger)
    assert larger[2, 2] > 1.4 * weighted.errors(theta)[2, 2]


@pytest.mark.slow
def test_search_names_outliers_and_has_the_share(rng) -> None:
    data, at = binary(rng)
    result, noise = search_robust(Likelihood(data), FIELD)
    assert abs(noise.channels[0].vis2.value - 0.5) < 5 * noise.channels[0].vis2.error
    assert set(np.argsort(result.robustness.weights)[:4]) == set(at)
    assert errors_hold_the_truth(result.theta, result.theta_covariance)


def test_one_channel_and_no_share_leave_the_data_as_they_are() -> None:
    for data, noise in ((niriss(), ExtraNoise(channels=(COMMON,))), (pionier(2), ExtraNoise())):
        likelihood = Likelihood(data)
        assert with_shared(likelihood, noise).noise.rows is None


def test_covariance_is_that_of_gaussian_residuals() -> None:
    data = pionier(2)
    found = with_shared(Likelihood(data), ExtraNoise(channels=(COMMON,)))
    expected = noise_with_channels(data, [COMMON]).covariance.dense()
    np.testing.assert_allclose(found.noise.covariance.dense(), expected, atol=1e-12)


@pytest.mark.slow
def test_false_alarms_of_null_sets() -> None:
    """40 null sets without outliers: bounds are those with binomial 1e-4.

    Weights and share are fitted at the strongest place, as a search does it. With outliers a third
    of the sets is below 0.05 (half of them where channels count as independent): a warning says so.
    """
    rng, grid, n = np.random.default_rng(5), make_grid(*FIELD, 0.7), 40
    sheet, p = pionier(8), []
    for _ in range(n):
        plain = Likelihood(drawn(sheet, rng)[0]).expecting(np.array([5.0, 3.0, 0.0]))
        (best,) = make_statistic(plain, grid, np.empty(0)).strongest
        work = RobustFits(plain, FIELD, free_scale=True)
        stretch, theta = work.steps(best, Box(*FIELD, 4.0))
        shared = shared_noise(work.stretched(stretch), theta, NoisePrior())
        fitted = with_shared(plain.expecting(theta), shared)
        symmetric = symmetric_whitening(fitted.observables, fitted.noise.covariance)
        test = make_statistic(fitted, grid, np.empty(0), whitening=symmetric)
        null = test.draw_null(150, rng)
        p.append((1 + (null >= test.value).sum()) / 151.0)
    for level in (0.2, 0.1, 0.05):
        hits = int((np.array(p) < level).sum())
        assert stats.binomtest(hits, n, level, alternative="greater").pvalue > 1e-4


def test_part_that_shares_nothing_keeps_its_rows_and_its_covariance() -> None:
    """Closure phases, and V² of half of the exposures, against rows of the dense matrix."""
    data = pionier(6)
    whole = noise_with_channels(data, [COMMON]).covariance
    dense = whole.dense()
    row = np.concatenate([data.vis2.row, data.closure_phase.row])
    vis2 = np.arange(whole.size) < data.n_vis2
    for which in (~vis2, vis2 & (row % 2 == 0), ~vis2 | (row % 3 == 0)):
        at = np.flatnonzero(which)
        part = whole.select(at)
        assert isinstance(part, ChannelCovariance)
        np.testing.assert_allclose(part.dense(), dense[np.ix_(at, at)], atol=1e-15)
        assert part.logdet() == pytest.approx(dense_of(whole).select(at).logdet())
    # One channel of each exposure shares noise with what is left out, and so does another order.
    for at in (np.arange(0, whole.size, 3), np.arange(whole.size)[::-1]):
        part = whole.select(at)
        assert isinstance(part, BlockCovariance)
        np.testing.assert_allclose(part.dense(), dense[np.ix_(at, at)], atol=1e-15)


def dense_of(covariance: ChannelCovariance) -> BlockCovariance:
    """The same as blocks of numbers, as a permutation there and back makes it."""
    back = np.arange(covariance.size)[::-1]
    return covariance.select(back).select(back)


def test_symmetric_whitening_of_channels_keeps_chi2_and_names_the_data(rng) -> None:
    data = pionier(6)
    covariance = noise_with_channels(data, [COMMON]).covariance
    frame = symmetric_whitening(data, covariance)
    white = covariance.whiten(covariance.draw(rng, 3000))
    z = frame.residuals(white)
    np.testing.assert_allclose(frame.share @ z**2, (white**2).sum(axis=0), rtol=1e-9)
    assert np.abs(z.std(axis=1) - 1.0).max() < 5 / np.sqrt(2 * 3000)
    pushed = frame.residuals(covariance.whiten(np.diag(np.sqrt(covariance.variance))))
    np.testing.assert_array_equal(np.abs(pushed).argmax(axis=0), np.arange(covariance.size))


def test_the_solution_that_stands_is_the_most_likely_with_weights_of_its_own() -> None:
    """Six of 120 data are pushed by 8 errors: weights of another place hide the better one.

    What other places lose is that of the t likelihood, maximised there by a simplex.
    """
    rng, sheet = np.random.default_rng(24), simulated(pionier(2), [5.0, -3.0, 0.008], None)
    noise = sheet.covariance.draw(rng, 1)[:, 0]
    at = rng.choice(len(noise), 6, replace=False)
    noise[at] += 8.0 * np.sqrt(sheet.covariance.variance[at]) * rng.choice([-1.0, 1.0], 6)
    likelihood = Likelihood(with_draw(sheet, noise))
    work = RobustFits(likelihood, (3.0, 20.0), free_scale=True)
    first = work.converge(likelihood.residuals([5.0, -3.0, 0.0])[:, 0])
    found = work.settled(first)[0]
    best = work.log_prob(found.theta)
    assert best > work.log_prob(first[0].theta) + 0.5
    for mode in found.modes[1:4]:
        fit = minimize(lambda t: -work.log_prob(t), mode.theta, method="Nelder-Mead")
        loss = found.modes[0].delta_chi2 - mode.delta_chi2
        assert loss == pytest.approx(2.0 * (best + fit.fun), abs=0.1)
        assert loss > 0.0

"""Noise that channels of an exposure share: algebra, its fit, and honest false alarms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from channel_sets import STATIONS, pionier, probabilities, share, with_draw
from helpers import niriss, simulated
from scipy import stats

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.optimise import fit_single
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.data.systematics import Systematics
from amibayes.detection.statistic import make_statistic
from amibayes.likelihood.channel_noise import (
    ChannelShare,
    Correlation,
    correlation_of,
    noise_with_channels,
)
from amibayes.likelihood.channel_rows import CURVE, OFFSET, SLOPE, channel_layout
from amibayes.likelihood.extra_noise import NoisePrior, with_noise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise_fit import _Kind, fit_noise
from amibayes.likelihood.smooth_basis import smooth_basis
from amibayes.models.binary import BinaryModel


def noisy(data: Observables, shares: ChannelShare, rng) -> Observables:
    """A point source with noise that channels share."""
    return with_draw(data, noise_with_channels(data, [shares]).draw(1, rng)[:, 0])


@pytest.mark.parametrize("n", [2, 3, 7, 64])
def test_offset_and_slope_are_in_two_rows_alone(n, rng) -> None:
    weight = rng.uniform(0.5, 2.0, n)
    basis = smooth_basis(weight)
    turn = np.zeros((n, n))
    turn[basis.row, basis.column] = basis.value
    np.testing.assert_allclose(turn @ turn.T, np.eye(n), atol=1e-12)
    np.testing.assert_allclose(turn[0], weight / np.linalg.norm(weight))
    slope = turn @ (weight * np.linspace(-1.0, 1.0, n))
    assert slope[1] > 0.0
    np.testing.assert_allclose(slope[2:], 0.0, atol=1e-12)
    assert len(basis.value) <= n * (2 + 2 * np.log2(n))


@pytest.mark.parametrize("covariance", ["assumed", "diagonal"])
def test_covariance_is_the_stated_matrix(covariance, rng) -> None:
    """Against the matrix written out: channels of a baseline, or of triangles, correlated.

    V² are 1 and errors equal, so that the common error has the same size in every channel.
    """
    data = pionier(2, covariance)
    found = noise_with_channels(data, [share(0.5, 0.3)]).covariance
    base, n2, expected = data.covariance.dense(), data.n_vis2, np.zeros((data.covariance.size,) * 2)
    vis2, closure = data.vis2, data.closure_phase
    same = (vis2.setup[:, None] == vis2.setup) & (vis2.row[:, None] == vis2.row)
    apart = vis2.channel[:, None] - vis2.channel
    expected[:n2, :n2] = np.where(same, np.where(apart == 0, 1.0, 0.5) * 0.02**2, 0.0)
    # Triangles: as within one channel, times the correlation between channels of an exposure.
    one = {}
    for a, b in np.argwhere(closure.channel[:, None] == closure.channel):
        one[closure.setup[a], closure.setup[b], closure.row[a], closure.row[b]] = base[
            n2 + a, n2 + b
        ]
    for a, b in np.ndindex(len(closure), len(closure)):
        key = closure.setup[a], closure.setup[b], closure.row[a], closure.row[b]
        apart = closure.channel[a] - closure.channel[b]
        expected[n2 + a, n2 + b] = one[key] * (1.0 if apart == 0 else 0.3)
    np.testing.assert_allclose(found.dense(), expected, atol=1e-12)
    np.testing.assert_allclose(found.variance, np.diag(expected), rtol=1e-9)
    white = found.whitening.toarray()
    np.testing.assert_allclose(white @ expected @ white.T, np.eye(found.rank), atol=1e-9)
    # Triangles of a channel are mixed first, and then the channels: a third of the numbers.
    assert len(found.factors) == (2 if covariance == "assumed" else 1)
    np.testing.assert_allclose(found.whiten(np.eye(found.size)), white, atol=1e-9)
    np.testing.assert_allclose(
        found.solve(np.eye(found.size)), white.T @ white, rtol=1e-9, atol=1e-6
    )
    draws = found.draw(rng, 4000)
    assert np.abs((found.whiten(draws) ** 2).mean(axis=1) - 1.0).max() < 5 * np.sqrt(2 / 4000)
    values = np.linalg.eigvalsh(expected)
    assert found.logdet() == pytest.approx(np.log(values[values > 1e-10]).sum(), abs=1e-6)
    at = np.array([0, 3, n2 + 1])
    np.testing.assert_allclose(found.select(at).dense(), expected[np.ix_(at, at)], atol=1e-12)


@pytest.mark.parametrize("common", [1e-9, 0.4])
def test_amount_of_noise_is_by_the_likelihood_of_the_matrix(common: float, rng) -> None:
    """−2 ln L of the covariance written out; with next to no common noise, of channels alone."""
    data = pionier(2, "diagonal").only(["vis2"])
    residual, share_left = rng.normal(0.0, 0.05, len(data.data)), 0.9
    one = _Kind(data, residual, np.empty((len(residual), 0)), share_left, "vis2", ())
    shared = Correlation(common=common)
    found = []
    for amount in (0.01, 0.03, 0.08):
        matrix = one.covariance(amount, shared).dense()
        chi2 = residual @ np.linalg.solve(matrix, residual)
        expected = chi2 + share_left * np.linalg.slogdet(matrix)[1]
        found.append(
            [f(amount) - expected for f in (one._misfit(shared), one._misfit_of_independent)]
        )
    shared_off, alone_off = np.array(found).T
    np.testing.assert_allclose(shared_off, shared_off[0], atol=1e-6)
    if common < 0.1:
        np.testing.assert_allclose(alone_off, alone_off[0], atol=1e-4)


@pytest.mark.parametrize("phi", [0.3, 0.8])
def test_neighbours_raise_the_variance_of_sums_and_of_no_difference_lower_it(phi) -> None:
    """The mean of an exposure has the variance of the matrix; no direction has less than 1."""
    data = pionier(1, "diagonal").only(["vis2"])
    found = noise_with_channels(data, [share(0.0, 0.0, phi)]).covariance.dense() / 0.02**2
    apart = np.subtract.outer(np.arange(6), np.arange(6))
    exact = phi ** np.abs(apart)
    rows = [np.flatnonzero(data.vis2.row == r) for r in np.unique(data.vis2.row)]
    mean = np.full(6, 1.0 / 6.0)
    for at in rows:
        assert mean @ found[np.ix_(at, at)] @ mean == pytest.approx(mean @ exact @ mean, rel=1e-9)
    assert np.linalg.eigvalsh(found).min() > 1.0 - 1e-9


def test_one_channel_and_stated_correlations_stay_as_they_are() -> None:
    data = niriss()
    assert not channel_layout(data).any
    assert noise_with_channels(data, [share(0.5, 0.5)]).covariance is data.covariance


def correlated(layout, rho: float, phi: float, n: int, rng) -> np.ndarray:
    """Whitened noise (rank, n) of the very model, channel by channel."""
    out, before = np.empty((len(layout.order), n)), np.zeros(n)
    for k, first in enumerate(layout.starts):
        if first:
            gain, before = rng.standard_normal(n), rng.standard_normal(n)
        else:
            before = phi * before + np.sqrt(1.0 - phi**2) * rng.standard_normal(n)
        out[layout.order[k]] = np.sqrt(1.0 - rho) * before + np.sqrt(rho) * gain
    return out


@pytest.mark.parametrize(("rho", "phi"), [(0.0, 0.0), (0.5, 0.0), (0.8, 0.0), (0.3, 0.5)])
def test_correlation_is_recovered_with_its_error(rho, phi) -> None:
    """40 data sets of 8 exposures: pulls scatter by 1, whatever the scale of the errors."""
    rng = np.random.default_rng(4)
    data = pionier(8).only(["vis2"])
    layout = channel_layout(data)
    jacobian = rng.standard_normal((len(layout.order), 3))
    draws = 3.0 * correlated(layout, rho, phi, 40, rng)
    found = [correlation_of(layout, left, jacobian) for left in draws.T]
    truth = rho + (1.0 - rho) * phi
    pulls = np.array([(f.value - truth) / f.error for f in found])
    if truth == 0.0:
        assert 0.0 < np.median(pulls) < 2.0  # correlations are not negative here
        return
    # 40 pulls: mean to 0.16, scatter to 0.11; half of a pull is the price of a flat prior.
    assert abs(pulls.mean()) < 5 * 0.16
    assert abs(pulls.std() - 1.0) < 5 * 0.11


def test_noise_is_not_fitted_to_data_that_a_fit_passes_through(rng) -> None:
    """As many parameters as closure phases, one triangle's three channels: no division by 0."""
    data = pionier(1).only(["cp"])
    layout = channel_layout(data)
    n = len(layout.order)
    found = correlation_of(layout, rng.standard_normal(n), np.eye(n))
    assert 0.0 < found.value < 1.0
    assert 0.0 < found.error < 1.0


def test_gains_that_change_across_the_band_are_no_companion() -> None:
    """V² of sixty channels whose gains have a slope in every exposure, four times the floor's:
    12 null sets, and 5 below 0.05 are a 2e-4 accident.

    (Were the slope in differences of halves, quarters and so on, independent: 10 of 12.)
    """
    rng = np.random.default_rng(11)
    wavelengths = np.linspace(2.0e-6, 2.4e-6, 60)
    sheet = join([
        point_source(
            STATIONS @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]), wavelengths,
            7e-9, vis2_error=0.01, closure_error_rad=0.01, mjd=60000.0 + a,
        )
        for a in (0.0, 0.2, 0.4, 0.6)
    ]).only(("vis2",))  # fmt: skip
    floors = (Systematics("", 0.01, 0.0, 0.0),)
    grid, out = make_grid(2.0, 8.0, 0.7), []
    across = np.linspace(-1.0, 1.0, 60) * np.sqrt(3.0 / 2.0)
    rows = np.unique(np.stack([sheet.vis2.setup, sheet.vis2.row]), axis=1, return_inverse=True)[1]
    for _ in range(12):
        gain = 0.04 * rng.standard_normal(rows.max() + 1)[rows.ravel()]
        draw = gain * across[sheet.vis2.channel] + 0.01 * rng.standard_normal(len(rows.ravel()))
        likelihood = Likelihood(with_draw(sheet, draw))
        noise = noise_with_channels(likelihood.observables, (), floors)
        assert set(np.unique(noise.rows.level)) == {0, OFFSET, SLOPE, CURVE}
        statistic = make_statistic(likelihood.with_noise(noise), grid, np.empty(0))
        null = statistic.draw_null(100, rng)
        out.append((1 + (null >= statistic.value).sum()) / 101.0)
    assert (np.array(out) < 0.05).sum() < 5


def test_fit_of_noise_finds_share_and_amount(rng) -> None:
    data = noisy(pionier(16), share(0.5, 0.7), rng)
    found = fit_noise(Likelihood(data), np.array([10.0, 5.0, 0.0]))
    (told,) = found.channels
    assert abs(told.vis2.value - 0.5) < 5 * told.vis2.error < 0.5
    assert abs(told.closure_phase.value - 0.7) < 5 * told.closure_phase.error < 0.5
    assert not found.any
    assert not fit_noise(
        Likelihood(data), np.array([10.0, 5.0, 0.0]), prior=NoisePrior(channels=False)
    ).channels


@pytest.mark.parametrize(
    "sizes", [(0.0, 0.0, 0.0), (0.04, 0.0, 0.0), (0.04, 0.04, 0.0), (0.04, 0.04, 0.03)]
)
def test_smooth_errors_of_exposures_are_told_apart(sizes, rng) -> None:
    """V² with offsets, slopes and curves beside errors of 2 %: variances that were put in.

    Of 72 exposures and baselines a variance is known to 0.17 of itself. With nothing but ρ and φ
    that of a slope was a fourth of what it is.
    """
    sheet = pionier(12, "diagonal").only(["vis2"])
    rows = np.unique(np.stack([sheet.vis2.setup, sheet.vis2.row]), axis=1, return_inverse=True)[1]
    # Curves are a tent, and a step with neither offset nor slope.
    x = np.linspace(-1.0, 1.0, 6)
    shapes = np.array([np.ones(6), x, np.abs(x) - 0.6, np.sign(x) - 9.0 / 7.0 * x])
    shapes /= np.sqrt((shapes**2).mean(axis=1, keepdims=True))
    curve = sizes[2] / np.sqrt(2.0)
    theta, draw = np.array([10.0, 5.0, 0.0]), 0.02 * rng.standard_normal(len(rows.ravel()))
    for shape, size in zip(shapes, (*sizes[:2], curve, curve), strict=True):
        own = size * rng.standard_normal(rows.max() + 1)[rows.ravel()]
        draw += own * shape[sheet.vis2.channel]
    likelihood = Likelihood(with_draw(sheet, draw))
    noise = fit_noise(likelihood, theta)
    told = noise.channels[0].vis2.smooth
    assert noise.vis2 < 0.015
    found = with_noise(likelihood, noise).noise.covariance.dense()[:6, :6]
    assert all(one > 0.0 or size == 0.0 for one, size in zip(told, sizes, strict=True))
    for shape, size in zip(shapes, (*sizes[:2], curve, curve), strict=True):
        expected = 0.02**2 + 6.0 * size**2
        assert shape @ found @ shape / 6.0 == pytest.approx(expected, rel=5.0 * 0.17)


def test_gains_larger_than_the_floor_are_fitted_and_smaller_ones_are_not(rng) -> None:
    """Gains of 6 % where the floor has 2 % common to all channels, from 24 of them (to 15 %)."""
    sheet = pionier(4)
    floors = (Systematics("", 0.02 * np.sqrt(2.0), 0.0, 0.0),)
    theta = np.array([10.0, 5.0, 0.0])
    rows = np.unique(np.stack([sheet.vis2.setup, sheet.vis2.row]), axis=1, return_inverse=True)[1]
    for size, least, most in ((0.06, 0.5, 2.0), (0.01, 0.0, 0.12)):
        draw = sheet.covariance.draw(rng, 1)[:, 0]
        draw[: sheet.n_vis2] += size * rng.standard_normal(rows.max() + 1)[rows.ravel()]
        noise = fit_noise(
            Likelihood(with_draw(sheet, draw)), theta, prior=NoisePrior(floors=floors)
        )
        (told,) = noise.channels
        assert least < 0.02**2 * told.vis2.offset / 0.06**2 < most
        assert told.vis2.slope == told.closure_phase.offset == 1.0
        assert noise.vis2 < 0.01


def test_extra_noise_is_bounded_by_its_prior(rng) -> None:
    """A binary that a single star is fitted to looks like noise of tens of degrees."""
    likelihood = Likelihood(simulated(pionier(4), [12.0, 6.0, 0.5], rng))
    theta = np.array([10.0, 5.0, 0.0])
    bounds = {"narrow": (0.15, np.radians(9.0)), "wide": (3.0, np.radians(180.0))}
    found = {
        "narrow": fit_noise(likelihood, theta),
        "wide": fit_noise(likelihood, theta, prior=NoisePrior(1.0, np.radians(60.0))),
    }
    for name, noise in found.items():
        each = zip((noise.vis2, noise.closure_phase_rad), noise.smooth, bounds[name], strict=True)
        for (amount, smooth, bound), error in zip(each, (0.02, np.radians(1.0)), strict=True):
            assert amount <= bound
            # Offset, slope and curve each.
            assert smooth * np.hypot(error, amount) <= np.sqrt(3.0) * 1.1 * bound
    wide = found["wide"]
    size = wide.smooth[1] * np.hypot(np.radians(1.0), wide.closure_phase_rad)
    assert np.hypot(size, wide.closure_phase_rad) > np.radians(12.0)


def test_false_alarms_are_uniform_with_half_of_the_noise_common() -> None:
    """24 null sets: KS p > 1e-4; 9 below 0.1 are a 1e-4 accident."""
    p = probabilities(24, 100, 1)
    assert stats.kstest(p, "uniform").pvalue > 1e-4
    assert (p < 0.1).sum() < 9


@pytest.mark.parametrize(
    ("n", "draws"),
    [
        pytest.param(120, 400, marks=pytest.mark.slow),
        pytest.param(1000, 1000, marks=pytest.mark.release),
    ],
)
def test_false_alarms_of_many_null_sets(n: int, draws: int) -> None:
    """``docs/channel_nulls.py`` measures the same with more sets.

    (With gains in proportion to the measured V² 11 and 3 %: the direction of a gain then goes
    along with the errors, Peelle's puzzle.) Bounds are those with binomial 1e-4.
    """
    p = probabilities(n, draws, 2)
    for level in (0.05, 0.01):
        hits = int((p < level).sum())
        assert stats.binomtest(hits, len(p), level, alternative="greater").pvalue > 1e-4


def test_gains_that_channels_share_do_not_shrink_the_visibility(rng) -> None:
    """Peelle's puzzle: a common gain in proportion to *measured* V² draws a fit towards zero.

    A star of known diameter, forty channels with errors of 5 % and gains of 5 %: the mean of 16
    fits is the truth with what the fit expects as the pattern, and is not with the data.
    """
    sheet = join([
        point_source(
            STATIONS + 5.0 * k, np.linspace(1.5e-6, 1.8e-6, 40), 7e-9,
            vis2_error=0.03, closure_error_rad=0.01, mjd=60000.0 + k,
        )
        for k in range(2)
    ]).only(("vis2",))  # fmt: skip
    model, true = BinaryModel(0, "free"), np.array([3.0])
    vis2 = Likelihood(sheet, model).predict(true[None])[:, 0]
    floors = (Systematics("", 0.05, 0.0, 0.0),)
    gain = np.unique(np.stack([sheet.vis2.setup, sheet.vis2.row]), axis=1, return_inverse=True)[1]
    errors = {"expected": [], "measured": []}
    for _ in range(16):
        gains = 1.0 + 0.05 * np.sqrt(0.5) * rng.standard_normal(gain.max() + 1)[gain.ravel()]
        value = vis2 * gains + 0.03 * rng.standard_normal(len(vis2))
        data = replace(sheet, vis2=replace(sheet.vis2, value=value))
        stated = Likelihood(data, model)
        first, _ = fit_single(stated)
        for name, known in (("expected", stated.expecting(first)), ("measured", stated)):
            noise = noise_with_channels(known.observables, (), floors)
            fit, _ = fit_single(stated.with_noise(noise))
            errors[name].append(fit[0] - true[0])
    bias = {k: np.mean(e) / (np.std(e) / np.sqrt(16)) for k, e in errors.items()}
    assert abs(bias["expected"]) < 4.5, bias
    assert bias["measured"] > 7.0, bias


def test_a_coherent_error_changes_v2_and_closure_phase_as_the_slopes_say(rng) -> None:
    """Against draws: small independent errors added to every complex visibility."""
    likelihood = Likelihood(pionier(1, "diagonal"), BinaryModel(0, "free")).expecting(
        np.array([3.0])
    )
    data, points, size = likelihood.observables, likelihood.samples, 1e-5
    visibility = likelihood.model.visibility(points, np.array([[3.0]]))
    error = size * rng.standard_normal((2, len(points), 4000))
    change = likelihood.observe(visibility + error[0] + 1j * error[1]) - likelihood.observe(
        visibility
    )
    slope = np.concatenate([data.vis2.coherent_slope, data.closure_phase.coherent_slope])
    spread = likelihood.wrapped(change).std(axis=1) / size
    np.testing.assert_allclose(spread / slope, 1.0, atol=4.5 / np.sqrt(2 * 4000))


def test_amplitudes_are_what_a_coherent_error_does() -> None:
    """V² of 0.64 moves by 2|V| = 1.6 with the visibility; a closure phase not at all."""
    data = niriss(0.01, 0.1, channels=4)
    data = replace(data, vis2=replace(data.vis2, value=np.full(data.n_vis2, 0.64)))
    layout = channel_layout(data)
    np.testing.assert_allclose(layout.amplitude[layout.vis2], 1.6 / 0.01)
    assert not layout.amplitude[~layout.vis2].any()


def test_growth_of_a_floor_is_that_of_the_squares() -> None:
    """Rows alike: their variance is the mean of their squares, where the prior is wide."""
    data = pionier(2)
    one = _Kind(data, data.data, np.empty((len(data.data), 0)), 1.0, "vis2", ())
    alike = np.ones(40)
    found = one._growth(10.0 * alike, 3.0 * alike, 2.0 * alike, 1e-3)
    assert found == pytest.approx(1.0 + (10.0 - 3.0) / 2.0, rel=1e-2)
    assert one._growth(2.0 * alike, 3.0 * alike, 2.0 * alike, 1e-3) == 1.0


def test_larger_gains_are_told_from_the_errors_beside_them(rng) -> None:
    """Gains whose mean square is that of the floor, all of it common to the channels."""
    sheet = pionier(10).only(["vis2"])
    key = np.stack([sheet.vis2.setup, sheet.vis2.row], axis=1)
    row = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    gain = rng.standard_normal(row.max() + 1)
    gain *= 0.1 / np.sqrt((gain**2).mean())
    data = with_draw(sheet, gain[row] + sheet.covariance.draw(rng, 1)[:, 0])
    prior = NoisePrior(vis2=0.3, floors=(Systematics("", 0.1, 0.0),))
    point = np.array([10.0, 5.0, 0.0])
    found = fit_noise(Likelihood(data).expecting(point), point, prior=prior)
    # Half of a floor's variance is common to the channels, the rest changes across them.
    assert found.channels[0].vis2.offset == pytest.approx(2.0, rel=0.1)

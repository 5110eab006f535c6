"""Randomised residuals: uniform where the model of the noise is wrong, and they see companions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from interferometer import common_errors, four_telescopes
from scipy import stats

from amibayes.companion_search.grid import make_grid
from amibayes.data.observables import Observables
from amibayes.detection.false_alarm import Significance, draws_needed, reachable
from amibayes.detection.randomised import Randomised, randomisation_of, randomised
from amibayes.detection.statistic import BankStatistic, make_statistic
from amibayes.detection.tails import clopper_pearson
from amibayes.likelihood.likelihood import Likelihood

GRID = make_grid(3.0, 12.0, 1.0)


def statistic(data: Observables) -> BankStatistic:
    return make_statistic(Likelihood(data), GRID, np.empty(0))


def moved(sheet: Observables, noise: np.ndarray) -> Observables:
    vis2, closure = np.split(noise, [sheet.n_vis2])
    return replace(
        sheet,
        vis2=replace(sheet.vis2, value=sheet.vis2.value + vis2),
        closure_phase=replace(sheet.closure_phase, value=sheet.closure_phase.value + closure),
    )


def test_signs_and_places_are_all_that_changes(rng) -> None:
    sheet = four_telescopes(12)
    shuffle = randomisation_of(sheet)
    assert shuffle.n_exposures == 12
    residual = rng.standard_normal(len(sheet.data))
    drawn = shuffle.draw(residual, 50, rng)
    n = sheet.n_vis2
    sign = drawn[n:] / residual[n:, None]
    np.testing.assert_allclose(np.abs(sign), 1.0)
    for k in range(12):
        mine = sign[shuffle.exposure == k]
        assert (mine == mine[0]).all()
    assert abs(sign.mean()) < 0.2
    # Every V² of a baseline and channel goes to another exposure of the same, all in one order.
    for entries in shuffle.exchangeable:
        assert entries.shape == (12, 18)
        apart = np.abs(drawn[entries][..., None] - residual[entries].T[None, :, None, :])
        source = apart.argmin(axis=3)
        assert apart.min(axis=3).max() < 1e-12
        assert (source == source[:, :1]).all()
        assert sorted(source[:, 0, 0].tolist()) == list(range(12))


def test_residuals_are_exchanged_in_units_of_their_errors(rng) -> None:
    sheet = four_telescopes(10)
    shuffle = randomisation_of(sheet)
    uneven = replace(shuffle, sigma=shuffle.sigma * np.exp(rng.normal(0, 1, sheet.n_vis2)))
    residual = np.concatenate([uneven.sigma, np.zeros(sheet.n_closure_phases)])
    np.testing.assert_allclose(uneven.draw(residual, 3, rng), np.repeat(residual[:, None], 3, 1))


def reported(n_sets: int, seed: int) -> np.ndarray:
    """Probabilities (n_sets, 2), by null draws and randomised, with errors common to channels."""
    rng, sheet = np.random.default_rng(seed), four_telescopes(12)
    null = np.sort(statistic(sheet).draw_null(4000, rng))
    out = np.empty((n_sets, 2))
    for k in range(n_sets):
        noise = sheet.covariance.draw(rng, 1)[:, 0]
        test = statistic(moved(sheet, noise + common_errors(sheet, 0.04, 0.04, rng)))
        parametric = (1 + (null >= test.value).sum()) / 4001
        out[k] = parametric, randomised(test, 199, rng).probability
    return out


def test_probability_is_uniform_where_channels_err_together() -> None:
    """60 null sets, twice the stated error common to channels: KS p > 1e-4.

    By null draws of independent errors about a third are called unlikely at 0.05.
    """
    parametric, signs = reported(60, 3).T
    assert (parametric < 0.05).mean() > 0.15
    assert stats.kstest(signs, "uniform").pvalue > 1e-4
    assert stats.binomtest(int((signs < 0.05).sum()), 60, 0.05).pvalue > 1e-4


@pytest.mark.parametrize(
    "n",
    [pytest.param(150, marks=pytest.mark.slow), pytest.param(1000, marks=pytest.mark.release)],
)
def test_probability_is_uniform_over_many_sets_that_err_together(n: int) -> None:
    """KS p > 1e-3; shares below 0.01 and 0.05 within binomial chance 1e-3."""
    signs = reported(n, 4)[:, 1]
    assert stats.kstest(signs, "uniform").pvalue > 1e-3
    for level in (0.01, 0.05):
        assert stats.binomtest(int((signs < level).sum()), n, level).pvalue > 1e-3


@pytest.mark.parametrize(("kinds", "n"), [(("vis2", "cp"), 10), (("cp",), 20)])
def test_a_companion_is_seen_by_randomised_residuals_too(kinds, n, rng) -> None:
    """Signs that give the data back, or their mirror image, do not count."""
    sheet = four_telescopes(n).only(kinds)
    found = randomised(statistic(simulated(sheet, [5.0, -4.0, 0.02], rng)), 3000, rng)
    assert found.n_exposures == n
    assert found.probability is not None
    assert found.probability < 0.001
    assert found.interval == clopper_pearson(round(3001 * found.probability) - 1, 3000)


def test_few_exposures_tell_nothing_and_say_so(rng) -> None:
    for sheet, n in (
        (niriss(), 1),
        (four_telescopes(9), 9),
        (four_telescopes(12).only(("cp",)), 12),
    ):
        found = randomised(make_statistic(Likelihood(sheet), GRID, np.empty(0)), 100, rng)
        assert (found.n_exposures, found.n_draws, found.probability) == (n, 0, None)
        assert "too few" in found.note


def test_without_closure_phases_exposures_exchange_v2(rng) -> None:
    sheet = four_telescopes(14).only(("vis2",))
    assert randomisation_of(sheet).n_exposures == 14
    found = randomised(statistic(simulated(sheet, [5.0, -4.0, 0.1], rng)), 500, rng)
    assert found.probability == pytest.approx(1 / 501)


def test_the_larger_probability_is_stated_and_decides() -> None:
    null = np.sort(np.random.default_rng(1).exponential(2.0, 5000))
    alone = Significance(100.0, null, 1 / 5001, clopper_pearson(0, 5000), None, 0.0013)
    assert alone.detected
    refuted = alone.beside(Randomised(12, 3000, 0.03, (0.02, 0.04)))
    assert (refuted.probability, refuted.interval) == (0.03, (0.02, 0.04))
    assert refuted.parametric == alone.probability
    assert refuted.detected is False
    for check in (Randomised(12, 9000, 1 / 9001, (0.0, 4e-4)), Randomised(4)):
        assert alone.beside(check).detected
        assert alone.beside(check).probability == alone.probability


def test_detection_asks_for_the_upper_bound_and_for_enough_draws() -> None:
    """95 % bounds by Clopper and Pearson: none of n is below 1 - 0.025^(1/n)."""
    n = draws_needed(0.0013)
    assert reachable(0.0013, n)
    assert not reachable(0.0013, n - 1)
    assert n == int(np.ceil(np.log(0.025) / np.log(1.0 - 0.0013)))
    null = np.sort(np.random.default_rng(2).exponential(2.0, 10_000))
    above = [Significance(x, null, 0.0, (0, 1), None, 0.0013) for x in (null[-8], null[-3])]
    found = [
        replace(w, probability=w.parametric, interval=clopper_pearson(w.n_above, 10_000))
        for w in above
    ]
    # 8 of 10 000 are 8e-4, but may well be 1.6e-3; 3 of them are 9e-4 at most.
    assert [w.detected for w in found] == [False, True]
    assert all(w.probability < 0.0013 for w in found)
    assert replace(found[0], null=null[:1000]).detected is None

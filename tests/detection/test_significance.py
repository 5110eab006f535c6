"""The false-alarm probability against independent null searches and published quantiles."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import stats

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.optimise import refine
from amibayes.companion_search.search import search
from amibayes.detection.false_alarm import Significance, significance
from amibayes.detection.statistic import BankStatistic, make_statistic, statistic_of
from amibayes.detection.tails import clopper_pearson, extreme_value_survival, pareto_survival
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box


def kernel_test(step_mas: float) -> BankStatistic:
    likelihood = Likelihood(niriss().only(("cp",)))
    grid = make_grid(50.0, 400.0, step_mas)
    return make_statistic(likelihood, grid, np.empty(0), stated_errors=True)


def test_null_quantiles_for_15_kernel_phases() -> None:
    """50/90/99/99.9 % of the largest Δχ² (F480M, 50–400 mas): 6.4/10.9/16.0/20.5 elsewhere.

    40 000 draws: the quantiles scatter by sqrt(p(1-p)/n)/density, 0.02/0.04/0.12/0.4; the
    lattice of λ/16B is 0.05-0.1 below the continuum.
    """
    null = kernel_test(11.75).draw_null(40_000, np.random.default_rng(2))
    found = np.quantile(null, [0.5, 0.9, 0.99, 0.999])
    assert (np.abs(found - [6.4, 10.9, 16.0, 20.5]) < [0.2, 0.35, 0.7, 2.0]).all()


def test_reported_probability_is_uniform_under_noise_of_another_maker() -> None:
    """400 null sets drawn as triangles of independent baseline phases, not by the covariance.

    Kolmogorov-Smirnov p > 1e-4, and the number below 0.1 within 4 sigma of binomial.
    """
    rng = np.random.default_rng(11)
    sheet = niriss()
    cp = sheet.closure_phase
    likelihood = Likelihood(sheet.only(("cp",)))
    test = make_statistic(likelihood, make_grid(50.0, 400.0, 23.5), np.empty(0), stated_errors=True)
    null = np.sort(test.draw_null(20_000, rng))
    pairs = {(i, j): k for k, (i, j) in enumerate(sheet.vis2.stations.tolist())}
    n = 400
    phase = rng.normal(0.0, np.radians(0.3) / np.sqrt(3.0), (21, n))
    closure = np.array(
        [
            phase[pairs[a, b]] + phase[pairs[b, c]] - phase[pairs[a, c]]
            for a, b, c in cp.stations.tolist()
        ]
    )
    white = likelihood.observables.covariance.whiten(closure)
    statistic = test.evaluate(white)
    p = (1 + len(null) - np.searchsorted(null, statistic)) / (1 + len(null))
    assert stats.kstest(p, "uniform").pvalue > 1e-4
    assert abs((p < 0.1).sum() - 40) < 4 * np.sqrt(36)


def test_statistic_of_the_data_and_of_the_null_are_the_same(rng) -> None:
    """A free background is projected out of both; its value does not move the null."""
    model = BinaryModel(background="free")
    result = search(Likelihood(simulated(niriss(), [0, 0, 0, 0.1], rng, model), model), (50, 400))
    test = statistic_of(result, stated_errors=True)
    assert test.value == pytest.approx(result.bank_delta_chi2.max(), rel=1e-5)
    found = significance(test, 2000, rng)
    assert 1e-3 < found.probability <= 1.0
    low, high = found.interval
    assert low <= found.probability <= high
    assert not found.detected
    assert found.tail is None
    assert found.null[0] > 0


def test_same_seed_same_null_whatever_came_before() -> None:
    test = kernel_test(47.0)
    first = test.draw_null(5000, np.random.default_rng(5))
    np.testing.assert_array_equal(first, test.draw_null(5000, np.random.default_rng(5)))
    np.testing.assert_array_equal(first[:2048], test.draw_null(2048, np.random.default_rng(5)))


def test_strong_companion_is_bounded_by_the_draws_and_the_tail_says_it_is_extrapolated() -> None:
    found = significance(kernel_test(23.5), 10_000, np.random.default_rng(4), observed=30.0)
    assert found.probability == pytest.approx(1 / 10_001)
    assert found.detected
    assert found.tail is not None
    # 1e6 draws put P(max > 26) at 6.6e-5: a factor of 10 per 4.6 in Δχ² makes 9e-6 at 30.
    assert found.tail.generalised_pareto < 1e-4
    assert found.tail.log10_error > 0.1


@pytest.mark.parametrize(("k", "n"), [(0, 100), (3, 50), (50, 50)])
def test_clopper_pearson_is_scipys_exact_interval(k: int, n: int) -> None:
    expected = stats.binomtest(k, n).proportion_ci(0.95, method="exact")
    np.testing.assert_allclose(clopper_pearson(k, n), [expected.low, expected.high], atol=1e-12)


def test_survival_is_the_share_of_the_draws_and_then_a_law_without_a_step() -> None:
    null = np.sort(np.random.default_rng(8).exponential(2.0, 10_000))
    weight = Significance(5.0, null, 0.1, (0.0, 1.0), None, 0.0013)
    inside = np.array([0.0, 1.0, 8.0])
    counted = [(1 + (null >= x).sum()) / 10_001 for x in inside]
    np.testing.assert_allclose(weight.survival(inside), counted)
    x = np.linspace(0.0, 40.0, 2000)
    p = weight.survival(x)
    assert (np.diff(p) <= 0).all()
    just = weight.survival(weight.reach + np.array([-1e-9, 1e-9]))
    assert just[0] == pytest.approx(just[1], rel=0.11)  # one draw of ten
    # The law of an exponential is exp(-x/2): to a factor of two at 1e-6.
    assert abs(np.log(weight.survival(np.array(27.6)) / 1e-6)) < np.log(3.0)


@pytest.mark.parametrize(
    ("law", "far"),
    [(stats.expon(scale=2.0), 1e-6), (stats.gumbel_r(6, 2), 1e-6), (stats.genpareto(0.1), 1e-5)],
)
def test_both_tails_find_laws_they_did_not_make(law, far) -> None:
    """Median over 40 samples of 10 000 within a factor of 2 (an error of 0.3 dex / √40)."""
    x = np.array(law.isf(far))
    for survival in (pareto_survival, extreme_value_survival):
        draws = [
            np.sort(law.rvs(10_000, random_state=np.random.default_rng([9, k]))) for k in range(40)
        ]
        found = np.median([float(survival(null, x)) for null in draws])
        assert 0.5 < found / far < 2.0, survival.__name__


@pytest.mark.parametrize("stated_errors", [True, False])
def test_local_probability_is_uniform_at_a_fixed_position(stated_errors) -> None:
    """1500 null data sets; half of them gain nothing there. Binomial chance 1e-5 per level."""
    model = BinaryModel(background="free")
    likelihood, grid = Likelihood(niriss(), model), make_grid(100.0, 110.0, 47.0)
    test = make_statistic(likelihood, grid, np.array([0.0]), stated_errors=stated_errors)
    white = np.random.default_rng(10).standard_normal((test.bank.n_data, 1500))
    p = test.local_survival(np.array([test.field(w)[3] for w in white.T]))
    for level in (0.3, 0.1, 0.02):
        assert stats.binomtest(int((p < level).sum()), 1500, level).pvalue > 1e-5


def test_field_peaks_at_the_statistic_of_the_search(rng) -> None:
    data = simulated(niriss(), [150.0, -80.0, 0.005], rng)
    result = search(Likelihood(data), (50, 400))
    white = result.likelihood.observables.covariance.whiten(result.likelihood.observables.data)
    white = white - result.likelihood.observables.covariance.whiten(
        Likelihood(niriss()).observables.data
    )
    for stated in (True, False):
        test = statistic_of(result, stated_errors=stated)
        at_most = test.field(white).max()
        assert at_most == pytest.approx(test.evaluate(white[:, None])[0], rel=1e-5)


@pytest.mark.parametrize("n", [80, pytest.param(300, marks=pytest.mark.slow)])
def test_probability_of_a_second_companion_beside_the_first_is_uniform(n: int) -> None:
    """Data sets of one companion of 2 %: the probability of a second one is uniform.

    Kolmogorov-Smirnov p > 1e-4, rates below 0.1 and 0.02 within binomial chance 1e-4.
    """
    rng, truth = np.random.default_rng(14), np.array([150.0, -80.0, 0.02])
    sheet = niriss()
    grid, box = make_grid(50.0, 400.0, 23.5), Box(50.0, 400.0, 188.0)
    test = make_statistic(Likelihood(sheet), grid, np.empty(0), beside=truth)
    null = np.sort(test.draw_null(10_000, rng))
    statistic = []
    for _ in range(n):
        likelihood = Likelihood(simulated(sheet, truth, rng))
        theta = np.array(refine(likelihood, truth, box, 0.0).theta)
        statistic.append(make_statistic(likelihood, grid, np.empty(0), beside=theta).value)
    p = (1 + len(null) - np.searchsorted(null, statistic)) / (1 + len(null))
    assert stats.kstest(p, "uniform").pvalue > 1e-4
    for level in (0.1, 0.02):
        assert stats.binomtest(int((p < level).sum()), n, level).pvalue > 1e-4

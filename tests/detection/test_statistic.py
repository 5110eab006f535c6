"""One statistic: simulated data have the noise of the data, injected ones as null draws do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from noise_maker import Recipe
from scipy import stats

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.search import search
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables
from amibayes.detection.ratio import Ratio
from amibayes.detection.statistic import BankStatistic, make_statistic, statistic_of
from amibayes.detection.treatments import FreeScale, drawn_scale
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.student import symmetric_whitening
from amibayes.limits.injection import recover
from amibayes.units import offset

FIELD = (50.0, 400.0)


def moved(sheet: Observables, noise: np.ndarray) -> Observables:
    """The sheet's data moved by noise."""
    vis2, closure = np.split(noise, [sheet.n_vis2])
    return replace(
        sheet,
        vis2=replace(sheet.vis2, value=sheet.vis2.value + vis2),
        closure_phase=replace(sheet.closure_phase, value=sheet.closure_phase.value + closure),
    )


def found_share(test: BankStatistic, contrast: float, threshold: float, seed: int) -> float:
    """Share of companions at 200 mas that the statistic sees."""
    rng = np.random.default_rng(seed)
    east, north = offset(200.0, rng.uniform(0.0, 360.0, 2000))
    companions = np.column_stack([east, north, np.full(2000, contrast)])
    return float(recover(test, companions, threshold, rng).detected.mean())


def test_injections_have_the_scatter_of_the_data_not_that_of_the_stated_errors() -> None:
    """Errors stated a third as large as they are, against the same data with errors as they are.

    The scatter of 36 data is known to 12 %, which at half completeness moves the share by 0.1.
    With noise of the stated size nearly every companion would be found.
    """
    rng = np.random.default_rng(3)
    noise = 3.0 * Recipe().draw(rng, 1)[:, 0]
    right = moved(niriss(0.015, 0.9), noise)
    small = moved(niriss(), noise)
    grid = make_grid(*FIELD, 31.0)
    tests = [make_statistic(Likelihood(data), grid, np.empty(0)) for data in (right, small)]
    threshold = float(np.quantile(tests[0].draw_null(4000, rng), 0.99))
    assert tests[0].value == pytest.approx(tests[1].value, rel=1e-4)
    shares = [found_share(test, 0.007, threshold, 4) for test in tests]
    assert 0.3 < shares[0] < 0.9
    assert shares[1] == pytest.approx(shares[0], abs=0.01)


def test_each_kind_of_data_scatters_by_itself_in_injections(rng) -> None:
    """Closure phases 4 times as good as stated, V² as stated: levels and noise know both."""
    noise = Recipe().draw(rng, 1)[:, 0]
    noise[21:] *= 0.25
    grid = make_grid(*FIELD, 31.0)
    test = make_statistic(Likelihood(moved(niriss(), noise)), grid, np.empty(0))
    good = make_statistic(Likelihood(moved(niriss(0.005, 0.075), noise)), grid, np.empty(0))
    threshold = float(np.quantile(test.draw_null(4000, rng), 0.99))
    shares = [found_share(t, 0.0012, threshold, 5) for t in (test, good)]
    assert shares[1] == pytest.approx(shares[0], abs=0.01)
    places = np.column_stack(offset(150.0, np.arange(0.0, 360.0, 30.0)))
    np.testing.assert_allclose(test.contrast_error(places), good.contrast_error(places), rtol=1e-6)


KINDS = {
    "stated": (Freedom(60.0, 30.0), True, False),
    "estimated": (Freedom(60.0, 30.0), False, False),
    "known": (None, True, False),
    "free": (None, False, False),
    "robust": (None, False, True),
}


@pytest.mark.parametrize("kind", KINDS)
def test_data_nulls_and_injections_of_nothing_have_one_distribution(kind: str) -> None:
    """Two samples of 1500 by Kolmogorov and Smirnov, p > 1e-4; and the data set's own value."""
    freedom, stated, robust = KINDS[kind]
    rng = np.random.default_rng(7)
    data = replace(simulated(niriss(), [0.0, 0.0, 0.0], rng), freedom=freedom)
    whitening = symmetric_whitening(data) if robust else None
    grid, single = make_grid(*FIELD, 47.0), np.empty(0)
    test = make_statistic(Likelihood(data), grid, single, stated_errors=stated, whitening=whitening)
    null = test.draw_null(1500, rng)
    nothing = test.signal_of(np.tile([100.0, 50.0, 0.0], (1500, 1)))
    blank = test.simulated(1500, rng, nothing).statistic
    assert stats.ks_2samp(null, blank).pvalue > 1e-4
    assert test.field(test.observed).max() == pytest.approx(test.value, rel=1e-4)
    faint = test.signal_of(np.tile([100.0, 50.0, 0.02], (200, 1)))
    assert test.simulated(200, rng, faint).statistic.min() > np.quantile(null, 0.9)


def test_noise_is_measured_without_the_companion_where_one_was_found(rng) -> None:
    data = simulated(niriss(), [150.0, -80.0, 0.05], rng)
    result = search(Likelihood(data), FIELD)
    test = statistic_of(result)
    without = test.with_noise_of(result.likelihood.residuals(result.theta)[:, 0])
    assert isinstance(test.treatment, FreeScale)
    assert isinstance(without.treatment, FreeScale)
    assert test.treatment.scale.mean() > 5.0
    assert without.treatment.scale.mean() == pytest.approx(1.0, abs=0.35)
    assert without.value == test.value


def test_local_probability_of_an_estimated_covariance_counts_free_data() -> None:
    """Three data left of six, four degrees of freedom: a t distribution drawn directly, 4.5 σ."""
    rng, n, nu = np.random.default_rng(8), 400_000, 4.0
    scale = np.sqrt((nu - 2.0) / rng.chisquare(nu, n))
    data = rng.standard_normal((3, n)) * scale
    ratio = Ratio.student(3, 6, nu)
    found = ratio(np.maximum(data[0], 0.0) ** 2, (data**2).sum(axis=0))
    for at in (0.5, 2.0, 6.0):
        expected = float(ratio.local_survival(np.array(at)))
        error = np.sqrt(expected * (1.0 - expected) / n)
        assert abs((found > at).mean() - expected) < 4.5 * error


def test_gain_at_a_threshold_is_the_inverse_of_the_ratio() -> None:
    for ratio in (Ratio.known(30), Ratio.scale_free(30), Ratio.student(30, 32, 50.0)):
        gain = ratio.gain_at(12.0)
        # χ² without the companion: what the companion explains, and the expectation of the rest.
        assert float(ratio(np.array([gain]), gain + 30.0)[0]) == pytest.approx(12.0)


@pytest.mark.parametrize("kinds", [("vis2", "cp"), ("cp",)])
def test_data_that_are_all_as_the_model_have_no_gain(kinds: tuple[str, ...]) -> None:
    """Phases that were set to 0: a scatter of 0 is not divided by, nor a gain of 0 out of 0."""
    test = make_statistic(Likelihood(niriss().only(kinds)), make_grid(*FIELD, 31.0), np.empty(0))
    assert isinstance(test.treatment, FreeScale)
    nothing = np.zeros_like(test.observed)
    assert test.hits(nothing[:, None]).statistic[0] == 0.0
    assert not test.field(nothing).any()


def test_scatter_of_few_data_is_as_stated_unless_they_say_otherwise() -> None:
    """Against Bayes' rule on a fine grid of ln v, half of the prior at 1."""
    rng, n = np.random.default_rng(4), 4000
    for measured in (0.85, 1.0, 1.2, 2.0):
        drawn = drawn_scale(measured, 20.0, n, rng, stated_probable=True)
        log_v = np.linspace(-2.0, 2.0, 8001) * np.log(100.0)
        log_like = -10.0 * (log_v + measured**2 * np.exp(-log_v))
        free = np.exp(log_like + 10.0 * measured**2)
        mass = free.sum() * np.diff(log_v)[0] / (4.0 * np.log(100.0))
        # Drawn one from each n-th of the distribution: to one draw.
        assert (drawn == 1.0).mean() == pytest.approx(1.0 / (1.0 + mass), abs=2.0 / n)
        others = drawn[drawn != 1.0]
        if len(others) > 500:
            expected = (free * np.exp(0.5 * log_v)).sum() / free.sum()
            assert others.mean() == pytest.approx(expected, rel=0.01)
    free = drawn_scale(0.85, 20.0, n, rng, stated_probable=False)
    assert np.sqrt(1.0 / np.mean(free**-2.0)) == pytest.approx(0.85, rel=1e-3)

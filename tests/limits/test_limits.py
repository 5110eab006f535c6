"""Limits by injection and recovery: their rate of success is the one they state."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated
from interferometer import four_telescopes, observed
from scipy import stats

from amibayes.companion_search.search import search
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables
from amibayes.detection.false_alarm import significance
from amibayes.detection.statistic import statistic_of
from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.analytic import analytic_limit
from amibayes.limits.completeness import detection_limit
from amibayes.limits.injection import recover
from amibayes.limits.limit import SHARES, DetectionLimit
from amibayes.oifits import write_oifits
from amibayes.pipeline.false_alarm import false_alarm
from amibayes.pipeline.field import search_field
from amibayes.pipeline.limits import LimitsOptions, measure_limits
from amibayes.pipeline.options import SearchOptions
from amibayes.units import MAS, offset


@pytest.fixture(scope="module")
def setting():
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1))
    result = search(Likelihood(data), (50.0, 400.0))
    test = statistic_of(result, stated_errors=True)
    rng = np.random.default_rng(2)
    weight = significance(test, 20_000, rng, alpha=0.01, observed=0.0)
    limit = detection_limit(result, weight, rng, n_separations=6)
    return result, test, weight, limit


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def found_by_a_full_search(theta: list[float], rng, threshold: float) -> bool:
    """Fresh data, a new search of them, its best statistic and the position it reports."""
    again = search(Likelihood(simulated(niriss(), theta, rng)), (50.0, 400.0))
    away = np.hypot(again.companion.east_mas - theta[0], again.companion.north_mas - theta[1])
    return bool(again.bank_delta_chi2.max() > threshold and away < 94.0)


@pytest.mark.parametrize("n", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_completeness_at_the_limit_is_the_stated_one(n: int, setting) -> None:
    """Fresh companions at c50 and at c95, each found by an independent full search.

    The bounds add the binomial error of the count to what the fit's own error of c50 moves
    (its slope is near 6 per unit of ln c); 4.5 sigma.
    """
    _, _, weight, limit = setting
    rng = np.random.default_rng(3)
    k = 3
    for contrast, expected in ((limit.contrast_50[k], 0.5), (limit.contrast[k], 0.95)):
        places = zip(*offset(limit.separation_mas[k], rng.uniform(0, 360, n)), strict=True)
        found = sum(
            found_by_a_full_search([float(e), float(m), contrast], rng, weight.threshold())
            for e, m in places
        )
        spread = np.sqrt(n * expected * (1 - expected)) + 6 * 0.25 * limit.log_error_50[k] * n
        assert abs(found - n * expected) < 4.5 * spread


def test_probability_of_any_companion_is_that_of_injections(setting) -> None:
    """Fresh injections at faint and bright contrasts: 4.5 sigma of their count and of the limit."""
    _, test, _, limit = setting
    rho, k = limit.separation_mas, 3
    for contrast, expected in ((limit.contrast_50[k], 0.5), (limit.contrast[k], 0.95)):
        assert limit.probability(rho[k], contrast) == pytest.approx(expected, abs=5e-3)
    rng, n = np.random.default_rng(31), 2000
    for factor in (0.8, 1.0, 1.25):
        contrast = factor * limit.contrast_50[k]
        east, north = offset(rho[k], rng.uniform(0.0, 360.0, n))
        theta = np.column_stack([east, north, np.full(n, contrast)])
        found = recover(test, theta, limit.threshold, rng).located.mean()
        p = limit.probability(rho[k], contrast)
        error = np.hypot(np.sqrt(p * (1.0 - p) / n), 2.0 * limit.log_error_50[k])
        assert abs(found - p) < 4.5 * error
    middle = limit.probability(0.5 * (rho[1] + rho[2]), 1e-3)
    ends = sorted(limit.probability(r, 1e-3) for r in rho[1:3])
    assert ends[0] <= middle <= ends[1]
    assert limit.probability(rho[k], 1e-9) < 1e-3
    assert limit.probability(rho[k], 1.0) > 0.9999
    assert np.isnan([limit.probability(r, 1e-3) for r in (0.9 * rho[0], 1.1 * rho[-1])]).all()
    assert np.isfinite([limit.probability(r, 1e-3) for r in rho]).all()
    for ring in (0, len(rho) - 1):
        half = limit.probability(rho[ring], limit.contrast_50[ring])
        assert half == pytest.approx(0.5, abs=5e-3)


@pytest.mark.parametrize(
    "n",
    [pytest.param(100, marks=pytest.mark.slow), pytest.param(1000, marks=pytest.mark.release)],
)
def test_completeness_of_fresh_simulations_through_the_job(n: int, tmp_path) -> None:
    """c50 and c95 of `measure_limits` against the search job's own verdict on new data sets.

    Each is simulated in the space of the data, read by nothing of the limits, searched as
    `search_companion` does (extra noise and all), weighed by the statistic without scale, and
    located by the position that it reports. 4.5 sigma of count and fit together. A limit is that
    of data which scatter as those that it was measured in: these do so as the errors say.
    """
    sheet = simulated(niriss(), [0.0] * 3, np.random.default_rng(15))
    scatter = Likelihood(sheet).residuals([0.0] * 3)[:, 0]
    assert rms(scatter[:21]) == pytest.approx(1.0, abs=0.02)
    assert rms(scatter[21:]) == pytest.approx(1.0, abs=0.02)
    write_oifits(tmp_path / "t.oifits", sheet)
    asked = SearchOptions(separation_mas=(50.0, 400.0), null_draws=100_000)
    options = LimitsOptions(asked, observables=("vis2", "cp"), n_separations=8)
    limit = measure_limits([tmp_path / "t.oifits"], options=options).main.limit
    rng, k = np.random.default_rng(21), 4
    for contrast, expected, error in (
        (limit.contrast_50[k], 0.5, limit.log_error_50[k]),
        (limit.contrast[k], 0.95, limit.log_error[k]),
    ):
        found = 0
        for angle in rng.uniform(0, 360, n):
            east, north = (float(x) for x in offset(limit.separation_mas[k], angle))
            data = simulated(niriss(), [east, north, contrast], rng)
            result = search_field(data, asked).result
            seen = statistic_of(result).value > limit.threshold
            c = result.companion
            found += bool(seen and np.hypot(c.east_mas - east, c.north_mas - north) < 94.0)
        slope = 7.0 * expected * (1.0 - expected)
        spread = np.hypot(np.sqrt(n * expected * (1 - expected)), n * slope * np.hypot(error, 0.02))
        assert abs(found - n * expected) < 4.5 * spread


def test_false_positive_rate_is_alpha(setting) -> None:
    """Noise in the space of the data, templates by finite differences, generalised χ²: no bank.

    Both the threshold (20 000 draws) and the count (20 000) scatter; 4.5 sigma.
    """
    result, test, weight, limit = setting
    bank = test.bank
    likelihood = result.likelihood
    covariance, n = likelihood.observables.covariance, 20_000
    step = 1e-6
    places = np.column_stack([bank.grid.east_mas, bank.grid.north_mas, np.full(len(bank), step)])
    alone = likelihood.predict([[100.0, 0.0, 0.0]])
    templates = (likelihood.predict(places) - alone) / step
    weighted = covariance.solve(templates)
    norm = (templates * weighted).sum(axis=0)
    noise = covariance.draw(np.random.default_rng(9), n)
    gain = np.maximum(weighted.T @ noise, 0.0) ** 2 / norm[:, None]
    rate = (gain.max(axis=0) > weight.threshold()).mean()
    sigma = np.sqrt(0.01 * 0.99 * (1 / n + 1 / 20_000))
    assert abs(rate - limit.false_positive_rate) < 4.5 * sigma
    exceeding, drawn = limit.false_positives
    assert abs(exceeding / drawn - rate) < 4.5 * sigma
    low, high = limit.false_positive_interval
    assert low < exceeding / drawn < high


def test_limits_do_not_depend_on_the_seed(setting) -> None:
    """Six seeds scatter by less than 0.03 mag, and as the stated error says.

    The mean variance of 6 rings, of one threshold, has 30 degrees of freedom or fewer, as rings
    of a kind share errors: within a factor 0.3 to 2.5 of its expectation.
    """
    result, _, weight, _ = setting
    found = [
        detection_limit(result, weight, np.random.default_rng(k), n_separations=6)
        for k in range(100, 106)
    ]
    scatter = np.array([limit.delta_mag for limit in found]).std(axis=0, ddof=1)
    stated = np.mean([limit.columns()["delta_mag_error"] for limit in found])
    assert rms(scatter) < 0.03
    assert stated < 0.03
    assert 0.3 < (rms(scatter) / stated) ** 2 < 2.5


def test_spread_over_angles_is_what_injections_at_single_angles_find(setting) -> None:
    """Limits at single position angles, by many injections at each: their median and 68 %."""
    _, test, _, limit = setting
    k, rng = 2, np.random.default_rng(12)
    each = []
    for angle in np.arange(0.0, 360.0, 15.0) + 3.0:
        east, north = offset(limit.separation_mas[k], angle)
        level = np.repeat(limit.contrast_50[k] * np.geomspace(0.6, 2.2, 8), 250)
        theta = np.column_stack([np.full(2000, east), np.full(2000, north), level])
        found = recover(test, theta, limit.threshold, rng)
        share = np.maximum.accumulate(found.located.reshape(8, 250).mean(axis=1))
        deviate = stats.norm.ppf(np.clip(share, 0.002, 0.998)) + 1e-9 * np.arange(8)
        each.append(np.exp(np.interp(stats.norm.ppf(0.95), deviate, np.log(level[::250]))))
    low, middle, high = np.log(np.quantile(each, (0.16, 0.5, 0.84)))
    stated = np.log(limit.spread[k])
    # 24 angles sample the quantiles to 0.03, each limit has an error of 0.03.
    np.testing.assert_allclose(stated, [low, middle, high], atol=0.12)


def test_completeness_rises_with_contrast(setting) -> None:
    *_, limit = setting
    share = limit.recovered / limit.trials
    assert (share[:, -1] > 0.95).all()
    assert (share[:, 0] < 0.2).all()
    assert (limit.contrast > limit.contrast_50).all()
    low, high = limit.jeffreys()
    assert ((low <= share + 1e-12) | (share == 0)).all()
    assert ((high >= share - 1e-12) | (share == 1)).all()
    found, tried = limit.recovered[0, 4], limit.trials[0, 4]
    expected = stats.beta.ppf([0.16, 0.84], found + 0.5, tried + 0.5 - found)
    np.testing.assert_allclose([low[0, 4], high[0, 4]], expected)


def test_bright_companions_are_recovered_and_absent_ones_are_not(setting) -> None:
    _, test, weight, _ = setting
    rng = np.random.default_rng(6)
    east, north = offset(200.0, rng.uniform(0, 360, 500))
    for contrast, low, high in ((0.05, 500, 500), (0.0, 0, 15)):
        theta = np.column_stack([east, north, np.full(500, contrast)])
        found = recover(test, theta, weight.threshold(), rng)
        assert low <= found.located.sum() <= high


def test_same_seed_same_limit(setting) -> None:
    result, _, weight, _ = setting
    first = detection_limit(result, weight, np.random.default_rng(5), trials=100)
    again = detection_limit(result, weight, np.random.default_rng(5), trials=100)
    np.testing.assert_array_equal(first.contrast, again.contrast)


def test_large_data_get_as_many_companions_as_a_limit_takes(
    setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From 80 on a ring, up to what was asked for; the limit is that of many companions."""
    result, _, weight, whole = setting
    monkeypatch.setattr("amibayes.limits.completeness.AFFORDABLE", 0.0)
    monkeypatch.setattr("amibayes.limits.completeness.WANTED", 0.006)
    counts, errors = [], []
    for trials in (80, 450, 2000):
        rng = np.random.default_rng(5)
        limit = detection_limit(result, weight, rng, n_separations=6, trials=trials)
        counts.append(int(limit.trials[0, 0]))
        errors.append(float(limit.log_error[0]))
        both = np.hypot(limit.log_error, whole.log_error)
        assert (np.abs(np.log(limit.contrast / whole.contrast)) < 4.5 * both).all()
    assert counts[0] == 80
    assert 400 < counts[1] <= 450 < counts[2] <= 2000
    assert sorted(errors, reverse=True) == errors
    monkeypatch.setattr("amibayes.limits.completeness.WANTED", 0.1)  # 80 tell it as well
    rng = np.random.default_rng(5)
    assert detection_limit(result, weight, rng, n_separations=6).trials[0, 0] == 80


@pytest.mark.slow
def test_robust_search_has_limits_of_its_own_statistic() -> None:
    """One closure phase is 30 sigma off: threshold, rate and limit are those of robust searches.

    Injections of nothing are found at the rate α, and the limit is that of clean data but for the
    scale, which the outlier stretches a little.
    """
    clean = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1))
    phases = clean.closure_phase.value.copy()
    phases[3] += np.radians(9.0)
    spoilt = replace(clean, closure_phase=replace(clean.closure_phase, value=phases))
    asked = SearchOptions(separation_mas=(50.0, 400.0), null_draws=20_000, alpha=0.01, robust=True)
    found = []
    for data in (clean, spoilt):
        result = search_field(data, asked).result
        weight = false_alarm(result, asked, np.random.default_rng(2), None, None)
        rng = np.random.default_rng(3)
        limit = detection_limit(result, weight, rng, separation_mas=[200.0], trials=300)
        assert result.robustness is not None
        nothing = np.column_stack([np.full(10_000, 200.0), np.zeros((10_000, 2))])
        blank = recover(statistic_of(result), nothing, limit.threshold, rng)
        sigma = np.sqrt(0.01 * 0.99 * (1 / 10_000 + 1 / 20_000))
        assert abs(blank.detected.mean() - 0.01) < 4.5 * sigma
        found.append(limit.delta_mag[0])
    assert abs(found[0] - found[1]) < 0.4


def test_limits_of_an_estimated_covariance_do_not_feel_the_companion_that_is_there() -> None:
    """Rotations of the integrations would hold it as noise: 3 mag, in these data."""
    limits = {}
    for contrast in (0.0, 0.05):
        sheet = replace(niriss(), freedom=Freedom(3000.0, 78.0), covariance_kind="estimated")
        sheet = replace(sheet, scatter=sheet.covariance.sparse)
        data = simulated(sheet, [150.0, 90.0, contrast], np.random.default_rng(6))
        result = search(Likelihood(data), (50.0, 400.0))
        weight = false_alarm(
            result, SearchOptions(null_draws=2000, alpha=0.01), np.random.default_rng(1), None, None
        )
        assert weight.detected == (contrast > 0.0)
        limits[contrast] = detection_limit(
            result, weight, np.random.default_rng(2), separation_mas=[150.0, 300.0]
        )
        if contrast:
            assert weight.threshold() > 1.5 * limits[contrast].threshold
    without, beside = limits[0.0], limits[0.05]
    # 1 % quantiles of 2000 draws: each about 4 % off; their residuals are not the same either.
    assert beside.threshold == pytest.approx(without.threshold, rel=0.25)
    error = np.hypot(without.log_error, beside.log_error)
    assert (np.abs(np.log(beside.contrast / without.contrast)) < 0.15 + 4.0 * error).all()


def binary(east_mas: float, north_mas: float, contrast: float):
    """Visibility of a companion beside a point, of spatial frequencies in 1/rad."""

    def visibility(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        turn = np.exp(-2j * np.pi * MAS * (east_mas * u + north_mas * v))
        return (1.0 + contrast * turn) / (1.0 + contrast)

    return visibility


def limit_of_exposures(data: Observables, *, detected: bool) -> DetectionLimit:
    """Limit of a search between 2 and 10 mas at three separations."""
    result = search(Likelihood(data), (2.0, 10.0))
    options = SearchOptions(null_draws=2000, alpha=0.01)
    tested = false_alarm(result, options, np.random.default_rng(1))
    assert tested.detected == detected
    rng = np.random.default_rng(2)
    return detection_limit(result, tested, rng, separation_mas=[2.5, 4.0, 8.0])


def test_limits_of_exposures_do_not_take_the_companion_that_is_there_for_drift() -> None:
    """It is what all exposures share: limits were 0.2 to 0.4 mag brighter."""
    without, beside = (
        limit_of_exposures(
            observed(four_telescopes(5, 1), binary(3.5, 2.0, c), np.random.default_rng(8)),
            detected=c > 0.0,
        )
        for c in (0.0, 0.05)
    )
    error = np.hypot(without.log_error, beside.log_error)
    off = np.abs(np.log(beside.contrast / without.contrast))
    assert (off < 0.1 + 4.0 * error).all()


def test_limits_hold_where_the_search_takes_a_part_of_a_companion_for_drift() -> None:
    """Of the companions at c50 of the innermost ring one in seven was found."""
    rng, sheet = np.random.default_rng(5), four_telescopes(5, 1)
    limit = limit_of_exposures(observed(sheet, binary(0.0, 0.0, 0.0), rng), detected=False)
    found = 0
    for angle in rng.uniform(0.0, 360.0, 60).tolist():
        east, north = (float(x) for x in offset(2.5, angle))
        data = observed(sheet, binary(east, north, limit.contrast_50[0]), rng)
        result = search(Likelihood(data), (2.0, 10.0))
        c, seen = result.companion, statistic_of(result).value > limit.threshold
        found += bool(seen and np.hypot(c.east_mas - east, c.north_mas - north) < 1.55)
    assert found == pytest.approx(30, abs=12)


def test_a_kind_of_observable_that_cannot_carry_a_fit_is_left_out_and_named(tmp_path) -> None:
    """Two squared visibilities say nothing by themselves of a companion's three numbers."""
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1))
    few = data.select(np.arange(data.n_vis2) < 2, np.ones(data.n_closure_phases, dtype=bool))
    path = tmp_path / "few.oifits"
    write_oifits(path, few)
    search = SearchOptions(separation_mas=(60.0, 200.0), null_draws=500)
    report = measure_limits([path], [], LimitsOptions(search, criterion="candid", n_separations=3))
    assert [limit.observables for limit in report.limits] == [("vis2", "cp"), ("cp",)]
    assert any("no limit from vis2 alone" in said for said in report.warnings)


def test_limits_at_no_separation_are_refused(setting) -> None:
    result, _, tested, _ = setting
    with pytest.raises(UsageError, match="separation_mas is empty"):
        detection_limit(result, tested, np.random.default_rng(1), separation_mas=[])
    with pytest.raises(UsageError, match="separation_mas is empty"):
        analytic_limit(result, "absil", separation_mas=[])


def test_shares_between_rings_and_levels_are_interpolated() -> None:
    """Of a curve by which the share is linear in ln contrast, and one that stays incomplete."""
    rising = np.exp(np.interp(SHARES, [0.0, 1.0], np.log([1e-3, 1e-2])))
    critical = np.stack([rising, np.where(SHARES < 0.6, rising, np.nan), np.full(400, np.nan)])
    limit = SimpleNamespace(
        critical=critical,
        separation_mas=np.array([100.0, 200.0, 300.0]),
        by_detection=np.array([True, False, False]),
    )
    limit._share = lambda ring, contrast: DetectionLimit._share(limit, ring, contrast)  # type: ignore[arg-type]

    def probability(separation: float, contrast: float) -> float:
        return DetectionLimit.probability(limit, separation, contrast)  # type: ignore[arg-type]

    middle = 10.0**-2.5
    for contrast, shares in ((1e-4, (0.0, 0.0)), (middle, (0.5, 0.5)), (0.1, (1.0, 0.6))):
        assert probability(100.0, contrast) == pytest.approx(shares[0], abs=0.003)
        assert probability(200.0, contrast) == pytest.approx(shares[1], abs=0.003)
        mean = 0.75 * shares[0] + 0.25 * shares[1]
        assert probability(125.0, contrast) == pytest.approx(mean, abs=0.003)
        assert probability(300.0, contrast) == 0.0
        assert np.isnan([probability(99.0, contrast), probability(301.0, contrast)]).all()
    anywhere = [DetectionLimit.counts_anywhere(limit, s) for s in (90.0, 149.0, 151.0, 400.0)]  # type: ignore[arg-type]
    assert anywhere == [True, True, False, False]

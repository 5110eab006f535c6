"""Errors that last from exposure to exposure: found in residuals, and in null sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss
from interferometer import four_telescopes, observed
from scipy import stats

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.reduction import Roots
from amibayes.companion_search.search import search
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.observables import Observables
from amibayes.data.systematics import Systematics
from amibayes.detection.exposure_noise import exposure_noise, exposures_of
from amibayes.detection.false_alarm import significance
from amibayes.detection.statistic import make_statistic, statistic_of
from amibayes.likelihood.channel_noise import noise_with_channels
from amibayes.likelihood.channel_rows import OFFSET, SLOPE, ChannelRows, channel_layout
from amibayes.likelihood.exposure_rows import HOURS, SHARES, Series, SeriesAxes, drift_of, series_of
from amibayes.likelihood.extra_noise import NoisePrior
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.binary import BinaryModel
from amibayes.units import MAS

GRID = make_grid(3.0, 12.0, 1.0)


def drifting(hours: np.ndarray, tau: float, rng: np.random.Generator, n: int) -> np.ndarray:
    """Ornstein and Uhlenbeck's process of unit variance at rising times, (n_times, n)."""
    out = [rng.standard_normal(n)]
    for step in np.diff(hours):
        kept = np.exp(-step / tau)
        out.append(kept * out[-1] + np.sqrt(1.0 - kept**2) * rng.standard_normal(n))
    return np.array(out)


def of_drifting_gains(
    sheet: Observables, vis2: float, phase_rad: float, tau: float, rng: np.random.Generator
) -> Observables:
    """A point source whose V² has gains, and whose fringes have phases, that drift."""
    table, closure = sheet.vis2, sheet.closure_phase
    times, exposure = np.unique(table.mjd, return_inverse=True)
    _, baseline = np.unique(table.stations, axis=0, return_inverse=True)
    gain = drifting(24.0 * times, tau, rng, baseline.max() + 1)[exposure, baseline.ravel()]
    phases = np.zeros((len(times), 4, 4))
    upper = np.triu_indices(4, 1)
    phases[:, upper[0], upper[1]] = drifting(24.0 * times, tau, rng, 6)
    phases -= phases.transpose(0, 2, 1)
    at, (i, j, k) = np.searchsorted(times, closure.mjd), closure.stations.T
    turned = phases[at, i, j] + phases[at, j, k] + phases[at, k, i]
    noise = sheet.covariance.draw(rng, 1)[:, 0]
    return sheet.with_data(np.concatenate([1.0 + vis2 * gain, phase_rad * turned]) + noise)


def covariance_of(roots: Roots, n: int) -> np.ndarray:
    """Covariance (n, n) of rows of which some are correlated."""
    out = np.eye(n)
    for rows, root in roots:
        out[np.ix_(rows, rows)] = root @ root.T
    return out


def test_series_are_baselines_and_combinations_of_a_night() -> None:
    sheet = four_telescopes(5, channels=3)
    layout = channel_layout(sheet)
    found = series_of(sheet, layout)
    vis2, closure = ([one for one in found if one.vis2 == kind] for kind in (True, False))
    assert [len(s.rows) for s in vis2] == [5] * 6
    assert [len(s.rows) for s in closure] == [5] * 3  # of four triangles three are independent
    for one in (*vis2, *closure):
        np.testing.assert_allclose(np.diff(one.hours), 1.0 / 6.0)
    rows = np.concatenate([s.rows for s in (*vis2, *closure)])
    assert len(set(rows.tolist())) == 5 * 9
    # A night later it is another series.
    later = replace(
        sheet.vis2, mjd=np.where(sheet.vis2.row > sheet.vis2.row.min(), 60001.0, 60000.0)
    )
    apart = series_of(replace(sheet, vis2=later), layout)
    assert all(np.ptp(s.hours) == 0.0 for s in apart if s.vis2)


def test_series_do_not_depend_on_the_order_of_triangles_nor_on_their_sense() -> None:
    """Combinations of triangles do not: exposures with another order of rows belong to them."""
    sheet = four_telescopes(5, channels=3)
    closure = sheet.closure_phase
    stations = closure.stations.copy()
    for k, entries in enumerate(closure.sets):
        stations[entries] = np.roll(stations[entries], k // 3, axis=0)
        if k % 2:
            stations[entries] = stations[entries][:, ::-1]
    turned = replace(sheet, closure_phase=replace(closure, stations=stations))
    found = [one for one in series_of(turned, channel_layout(turned)) if not one.vis2]
    assert [len(s.rows) for s in found] == [5] * 3
    # A triangle that stands alone changes its sign: it is another series then.
    alone = replace(turned, covariance_kind="diagonal")
    assert max(len(s.rows) for s in series_of(alone, channel_layout(alone)) if not s.vis2) < 5


def test_share_and_time_are_found(rng) -> None:
    # The posterior covers the truth: of 60 draws of known κ and τ, quantiles are uniform.
    hours = np.arange(12) / 3.0
    series = [Series(np.arange(12) + 12 * k, hours, "", vis2=True) for k in range(12)]
    level = []
    for _ in range(60):
        share, tau = rng.choice(SHARES[1:]), rng.choice(HOURS)
        common = drifting(hours, tau, rng, 12).T.ravel()
        white = np.sqrt(share) * common + np.sqrt(1.0 - share) * rng.standard_normal(144)
        slopes = rng.standard_normal((144, 2))
        data = white + slopes @ (10.0 * rng.standard_normal(2))
        found = drift_of(SeriesAxes.of(series), np.column_stack([data, slopes]))
        mass = found.mass.sum(axis=0)
        mass[0] = 0.0  # the truth is drawn from the rest of the prior
        mass /= mass.sum()
        k = np.searchsorted(SHARES, share)
        level.append(mass[:k].sum() + rng.uniform() * mass[k])
    assert stats.kstest(level, "uniform").pvalue > 1e-4


def test_independent_exposures_are_told(rng) -> None:
    hours = np.arange(20) / 3.0
    series = [Series(np.arange(20) + 20 * k, hours, "", vis2=True) for k in range(6)]
    shares = [
        drift_of(SeriesAxes.of(series), rng.standard_normal((120, 3))).share[0] for _ in range(30)
    ]
    assert np.mean(shares) < 0.08


def test_roots_make_the_covariance_of_the_mean(rng) -> None:
    data = of_drifting_gains(four_telescopes(8), 0.05, 0.05, 1.0, rng)
    found = exposure_noise(Likelihood(data), np.empty(0))
    assert found is None  # channels are independent there: no row is common to them
    single = four_telescopes(8, channels=1)
    data = of_drifting_gains(single, 0.05, 0.05, 1.0, rng)
    found = exposure_noise(Likelihood(data), np.empty(0))
    n = single.covariance.rank
    mean = np.mean([covariance_of(roots, n) for roots in found.roots], axis=0)
    np.testing.assert_allclose(mean, np.eye(n), atol=1e-9)
    # Variances stay as they were, and baselines do not mix.
    covariance = found.noise.covariance.dense()
    np.testing.assert_allclose(np.diag(covariance), single.covariance.variance, rtol=1e-9)
    v = single.vis2
    same = (v.stations[:, None] == v.stations).all(axis=2)
    assert np.abs(covariance[: len(v), : len(v)][~same]).max() < 1e-12
    assert found.vis2.share[0] > 0.3
    drawn = found.shared(rng.standard_normal((n, 40_000)), rng)
    np.testing.assert_allclose(np.cov(drawn), np.eye(n), atol=6.0 / np.sqrt(40_000))


def test_rows_of_a_reduced_bank_have_the_same_covariance(rng) -> None:
    data = of_drifting_gains(four_telescopes(30, channels=1, turn_deg=10.0), 0.05, 0.05, 1.0, rng)
    test = statistic_of(search(Likelihood(data), (3.0, 5.0)))
    bank, whole = test.bank, exposure_noise(Likelihood(data), test.single)
    assert bank.reduction is not None
    label = bank.reduction.label
    held = np.arange(len(label)) < len(label) - len(bank.reduction.bases)
    for small, root in zip(test.exposures.roots[::8], whole.roots[::8], strict=True):
        full, mine = covariance_of(root, bank.n_data), covariance_of(small, bank.n_rows)
        for k, (rows, basis) in enumerate(
            zip(bank.reduction.rows, bank.reduction.bases, strict=True)
        ):
            here = np.flatnonzero(held & (label == k))
            found = mine[np.ix_(here, here)]
            wanted = basis.T @ full[np.ix_(rows, rows)] @ basis
            np.testing.assert_allclose(found, wanted, atol=1e-6)


def probabilities(
    n: int, rng: np.random.Generator, draws: int = 400
) -> tuple[np.ndarray, np.ndarray]:
    """False-alarm probabilities of single stars with drifting gains: as stated, and without."""
    sheet = four_telescopes(8, channels=1, turn_deg=50.0)
    stated, without = [], []
    for _ in range(n):
        data = of_drifting_gains(sheet, 0.06, 0.03, 1.5, rng)
        test = statistic_of(search(Likelihood(data), (3.0, 12.0)))
        alone = make_statistic(Likelihood(data), test.bank.grid, test.single)
        for found, one in ((stated, test), (without, alone)):
            found.append(significance(one, draws, rng).probability)
    return np.array(stated), np.array(without)


def test_drifting_gains_give_no_companion(rng) -> None:
    # 1e-4 of a binomial of 40 with 0.05 lies above 9; without, many stars are below it.
    # (1 + k)/(1 + n) is below 0.05 as rarely with 159 draws as with more.
    stated, without = probabilities(40, rng, draws=159)
    assert (stated <= 0.05).sum() <= 9
    assert (without <= 0.05).sum() > 12


@pytest.mark.slow
def test_false_alarms_of_drifting_gains_are_those_stated(rng) -> None:
    stated, _ = probabilities(400, rng)
    for level in (0.02, 0.05, 0.2):
        bound = stats.binom.isf(1e-4, 400, level)
        assert (stated <= level).sum() <= bound


def test_a_companion_is_found_under_drifting_gains(rng) -> None:
    sheet = four_telescopes(8, channels=1, turn_deg=50.0)

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        wave = np.exp(-2j * np.pi * (5.0 * u + 4.0 * v) * MAS)
        return (1.0 + 0.2 * wave) / 1.2

    clean = observed(sheet, binary)
    noise = of_drifting_gains(sheet, 0.06, 0.03, 1.5, rng)
    both = np.concatenate([noise.vis2.value - 1.0, noise.closure_phase.value])
    data = sheet.with_data(clean.data + both)
    tested = significance(statistic_of(search(Likelihood(data), (3.0, 12.0))), 1000, rng, 0.01)
    assert tested.exposures is not None
    assert tested.detected


def test_where_nothing_is_shared() -> None:
    # One exposure, errors that are right as stated, and images: no exposures to compare.
    assert exposure_noise(Likelihood(four_telescopes(1, channels=1)), np.empty(0)) is None
    assert exposure_noise(Likelihood(niriss()), np.empty(0)) is None
    found = search(Likelihood(four_telescopes(6, channels=1)), (3.0, 12.0))
    assert statistic_of(found, stated_errors=True).exposures is None
    assert statistic_of(found).exposures is not None


def pulls(n: int, rng: np.random.Generator, *, channels: bool) -> np.ndarray:
    """Errors of a companion's place and contrast in units of those stated, (n, 3)."""
    sheet = four_telescopes(24, channels=1, turn_deg=60.0)
    truth = np.array([5.0, 4.0, 0.2])

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        wave = np.exp(-2j * np.pi * (truth[0] * u + truth[1] * v) * MAS)
        return (1.0 + truth[2] * wave) / (1.0 + truth[2])

    clean, model, out = observed(sheet, binary), BinaryModel(smearing=False), []
    for _ in range(n):
        noise = of_drifting_gains(sheet, 0.03, 0.015, 0.5, rng)
        both = np.concatenate([noise.vis2.value - 1.0, noise.closure_phase.value])
        data = sheet.with_data(clean.data + both)
        prior = NoisePrior(channels=channels)
        c = search_with_noise(Likelihood(data, model), (4.0, 9.0), prior=prior)[0].companion
        off = np.array([c.east_mas, c.north_mas, c.contrast]) - truth
        out.append(off / [c.east_error_mas, c.north_error_mas, c.contrast_error])
    return np.array(out)


@pytest.mark.slow
def test_errors_of_a_companion_allow_for_drifts(rng) -> None:
    # Mean squares of 240 pulls, known to 0.15: 1.3, the share being known to a third, and 2.7.
    assert (pulls(80, rng, channels=True) ** 2).mean() < 1.8
    assert (pulls(80, rng, channels=False) ** 2).mean() > 1.8


def test_times_of_a_series_are_hours() -> None:
    """Exposures of ten minutes."""
    sheet = four_telescopes(4, channels=3)
    for one in series_of(sheet, channel_layout(sheet)):
        np.testing.assert_allclose(np.diff(one.hours), 1.0 / 6.0, rtol=1e-4)


def of_nights(rows: ChannelRows, spread: float, rng: np.random.Generator, n: int) -> np.ndarray:
    """Noise (rank, n) in rows of one exposure; gains and slopes have sizes of their nights."""
    normals = rng.standard_normal((len(rows.sigma), n))
    size = np.exp(spread * rng.standard_normal((2, n)))
    variance = np.repeat(rows.sigma[:, None] ** 2, n, axis=1)
    for level, own in zip((OFFSET, SLOPE), size, strict=True):
        here = rows.level == level
        variance[here] += rows.floor[here, None] * (own**2 - 1.0)
    return normals * np.sqrt(variance)


@pytest.mark.parametrize("known", [False, True])
def test_a_night_that_is_worse_than_the_table_gives_no_companions(
    monkeypatch: pytest.MonkeyPatch, known: bool
) -> None:
    """One exposure of six baselines: its gains do not tell how large they are that night."""
    rng = np.random.default_rng(3)
    sheet = four_telescopes(1, channels=8)
    floor = Systematics(sheet.setups[0].source, 0.05, 0.0)
    noise = noise_with_channels(sheet, (), (floor,))
    if known:
        monkeypatch.setattr("amibayes.detection.exposure_noise.FLOOR_SPREAD", 1e-6)
    test = statistic_of(search(Likelihood(sheet, noise=noise), (2.0, 12.0)))
    null = np.sort(test.draw_null(20_000, rng))
    nights = of_nights(noise.rows, 0.5, rng, 10_000)
    values = test.evaluate(nights / test.likelihood.noise.rows.sigma[:, None])
    often = np.mean(values > np.quantile(null, [[0.997], [0.99], [0.9]]), axis=1)
    wanted = np.array([0.003, 0.01, 0.1])
    if known:
        assert (often[:2] > 1.5 * wanted[:2]).all()
    else:
        error = np.sqrt(wanted * (1.0 / 10_000 + 1.0 / 20_000))
        assert (np.abs(often - wanted) < 4.5 * error).all(), often


@pytest.mark.parametrize("floor", [False, True])
def test_data_are_whitened_by_the_mean_over_the_posterior(floor, rng) -> None:
    """The covariance added up node by node, and of sizes of floors one by one."""
    sheet = four_telescopes(5, channels=3)
    data = of_drifting_gains(sheet, 0.05, 0.02, 2.0, rng)
    floors = (Systematics(data.setups[0].source, 0.03, np.radians(0.5)),) if floor else ()
    prior = NoisePrior(floors=floors)
    result, _ = search_with_noise(Likelihood(data), (3.0, 12.0), prior=prior)
    exposures, single = exposures_of(result.likelihood), single_likelihood(result.likelihood)
    drifts = exposures.drifts(single, result.single_theta)
    relative = exposures.sizes / exposures.rows.sigma
    covariance = np.diag((relative**2).mean(axis=0))
    for one in exposures.series:
        drift, own = drifts[0 if one.vis2 else 1], relative[:, one.rows]
        mean = sum(
            mass * one.correlation(np.array(share), np.array(tau))
            for row, tau in zip(drift.mass, HOURS, strict=True)
            for mass, share in zip(row, SHARES, strict=True)
        )
        covariance[np.ix_(one.rows, one.rows)] = mean * (own.T @ own) / len(own)
    white = rng.normal(size=(len(covariance), 4))
    found = exposures.whitened(drifts, white)
    assert found.T @ found == pytest.approx(white.T @ np.linalg.solve(covariance, white))
    # Means over the nodes that null sets are drawn with are nearly the same.
    turned = exposures.noise_of(exposures.turned(*drifts)[0])
    apart = exposures.noise_of(exposures.rows)
    data_of_rows = apart.covariance.dense() @ apart.covariance.whitening.T @ white
    by_nodes = turned.whiten(data_of_rows)
    assert (by_nodes**2).sum(axis=0) == pytest.approx((found**2).sum(axis=0), rel=0.05)

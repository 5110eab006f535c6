"""Calibration against dense algebra, simulated instruments and known shares of outliers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated
from oi_builders import random_observables
from scipy.sparse import csr_array
from scipy.special import j1
from scipy.stats import kstest

from amibayes.calibration import Calibration, calibrate
from amibayes.calibration.calibrate import _covariate
from amibayes.calibration.diameters import _band_of
from amibayes.calibration.hierarchical import predictive
from amibayes.calibration.matching import keys_of, match
from amibayes.calibration.scatter_likelihood import population_of
from amibayes.calibration.scatter_posterior import ScatterGrid, sample_tau
from amibayes.calibration.transfer import Transfer, transfer_of, uniform_disc, wrapped
from amibayes.calibration.weighted import clipped, weighted_response
from amibayes.data.closure import canonical, closure_matrix, kernel_basis
from amibayes.data.covariance import Block, BlockCovariance
from amibayes.data.observables import Observables, join
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.data.point_source import point_source
from amibayes.errors import DataError
from amibayes.oifits import read_oifits, write_oifits
from amibayes.pipeline.warnings import calibration_warnings, unused_calibrators
from amibayes.units import MAS

HOLES = np.array(
    [
        (0.0, -2.64),
        (-2.28631, 0.0),
        (2.28631, -1.32),
        (-2.28631, 1.32),
        (-1.14315, 1.98),
        (2.28631, 1.32),
        (1.14315, 1.98),
    ]
)


class Instrument:
    """A mask with a response of its own and stars that scatter about it by ``tau``."""

    def __init__(
        self, rng: np.random.Generator, *, n: int = 7, sigma: float = 0.01, tau: float = 0.0
    ) -> None:
        self.rng, self.sigma, self.tau = rng, sigma, tau
        self.sheet = point_source(
            HOLES[:n], [4.8e-6], [3e-7], vis2_error=sigma, closure_error_rad=sigma
        )
        self.matrix = closure_matrix(self.sheet.closure_phase.stations)[0]
        n_baselines = self.matrix.shape[1]
        self.vis2 = rng.uniform(0.6, 0.9, n_baselines)
        self.closure = self.matrix @ rng.normal(size=n_baselines) * 0.05

    def star(self, source: str = "", mjd: float = 60000.0) -> Observables:
        """Observe a point source: response, its own deviation, noise."""
        noise = self.sheet.covariance.draw(self.rng, 1)[:, 0]
        n = len(self.vis2)
        own = self.tau * self.sigma
        vis2 = self.vis2 + noise[:n] + own * self.rng.normal(size=n)
        closure = self.closure + noise[n:]
        closure = closure + own * self.matrix @ self.rng.normal(size=n) / np.sqrt(3)
        return with_values(self.sheet, vis2, closure, source, mjd)


def with_values(
    sheet: Observables, vis2: np.ndarray, closure: np.ndarray, source: str = "", mjd: float = 6e4
) -> Observables:
    return replace(
        sheet,
        vis2=replace(sheet.vis2, value=vis2, mjd=np.full(len(vis2), mjd)),
        closure_phase=replace(sheet.closure_phase, value=closure, mjd=np.full(len(closure), mjd)),
        setups=(replace(sheet.setups[0], source=source),),
    )


@pytest.fixture
def instrument(rng: np.random.Generator) -> Instrument:
    return Instrument(rng)


def transfers(values: np.ndarray, errors: np.ndarray) -> list[Transfer]:
    return [
        Transfer(v, csr_array(np.diag(e**2)), np.ones(len(v), dtype=bool))
        for v, e in zip(values, errors, strict=True)
    ]


def vis2_keys(n: int) -> Observables:
    """Observables of which only V² of a mask of n holes is used."""
    return point_source(HOLES[:n], [4e-6], [1e-7], vis2_error=0.1, closure_error_rad=0.1).only(
        ["vis2"]
    )


def test_inverse_variance_and_not_inverse_error_squared_the_wrong_way() -> None:
    """0 ± 0.1 and 10 ± 10 average to 0.001; weights equal to σ would say 9.9."""
    keys = keys_of(vis2_keys(3))
    values, errors = np.array([[0.0] * 3, [10.0] * 3]), np.array([[0.1] * 3, [10.0] * 3])
    response = weighted_response(transfers(values, errors), keys)
    np.testing.assert_allclose(response.value, 10 * 0.01 / (100 + 0.01), rtol=1e-12)
    np.testing.assert_allclose(response.value, 0.001, rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(response.covariance.diagonal()), 0.1, rtol=1e-4)


def test_scatter_where_it_is_larger() -> None:
    keys = keys_of(vis2_keys(3))
    values = np.array([[0.8, 0.8, 0.8], [0.9, 0.8, 0.8], [1.0, 0.8, 0.8]])
    errors = np.full((3, 3), 0.01)
    response = weighted_response(transfers(values, errors), keys)
    np.testing.assert_allclose(response.value, [0.9, 0.8, 0.8])
    sigma = np.sqrt(response.covariance.diagonal())
    np.testing.assert_allclose(sigma, [0.1 / np.sqrt(3), *[0.01 / np.sqrt(3)] * 2])


def test_one_calibrator_is_plain_error_propagation(instrument: Instrument) -> None:
    target, calibrator = instrument.star(), instrument.star()
    found = calibrate(target, [calibrator])
    assert found.method == "weighted"
    vis2, ratio = found.observables.vis2.value, target.vis2.value / calibrator.vis2.value
    np.testing.assert_allclose(vis2, ratio, rtol=1e-14)
    kernel = kernel_basis(instrument.matrix)
    difference = target.closure_phase.value - kernel @ kernel.T @ calibrator.closure_phase.value
    np.testing.assert_allclose(found.observables.closure_phase.value, difference, atol=1e-15)
    n = len(vis2)
    by_target = np.diag(np.r_[1 / calibrator.vis2.value, np.ones(35)])
    by_calibrator = np.diag(np.r_[ratio / calibrator.vis2.value, np.ones(35)])
    expected = by_target @ target.covariance.dense() @ by_target
    expected += by_calibrator @ calibrator.covariance.dense() @ by_calibrator
    dense = found.observables.covariance.dense()
    np.testing.assert_allclose(dense[n:, n:], expected[n:, n:], atol=1e-17)
    # Of V² at expected values, not measured ones: the same but for some times the errors.
    np.testing.assert_allclose(dense[:n, :n], expected[:n, :n], rtol=0.2, atol=1e-17)
    assert found.observables.covariance.rank == n + 15
    assert found.observables.covariance_kind == "assumed"
    assert found.calibrators[0].kept


def test_correlations_between_vis2_and_closure_phase_are_carried(rng: np.random.Generator) -> None:
    target = random_observables(rng, kind="given")
    draws = target.covariance.draw(rng, 2)
    calibrators = []
    for draw in draws.T:
        vis2 = replace(target.vis2, value=0.8 + draw[:21])
        closure = replace(target.closure_phase, value=draw[21:])
        calibrators.append(replace(target, vis2=vis2, closure_phase=closure))
    for method in ("weighted", "hierarchical"):
        found = calibrate(target, calibrators[:2], method=method).observables
        assert found.covariance_kind == "given"
        assert np.abs(found.covariance.dense()[:21, 21:]).max() > 0
        assert found.covariance.rank == 36
    single = calibrate(target, calibrators[:1]).observables.covariance.dense()
    c = target.covariance.dense()
    a = np.diag(np.r_[1 / calibrators[0].vis2.value, np.ones(35)])
    b = np.diag(np.r_[target.vis2.value / calibrators[0].vis2.value ** 2, np.ones(35)])
    expected, scale = a @ c @ a + b @ c @ b, np.sqrt(np.diag(a @ c @ a + b @ c @ b))
    np.testing.assert_allclose(single / scale / scale[:, None], expected / scale / scale[:, None],
                               atol=0.5)  # fmt: skip
    np.testing.assert_allclose(single[21:, 21:], expected[21:, 21:], atol=1e-16)


def shuffled(star: Observables, rng: np.random.Generator) -> Observables:
    """The same star from another program: rows, stations and orientations in another order."""
    new = rng.permutation(len(star.setups[0].stations))  # new[old] is the new place
    names = np.empty(len(new), dtype=object)
    names[new] = star.setups[0].stations
    xyz = np.empty((len(new), 3))
    xyz[new] = star.setups[0].station_xyz_m
    v, c = star.vis2, star.closure_phase
    turn = rng.random(len(v)) < 0.5
    pairs = new[v.stations]
    pairs[turn] = pairs[turn, ::-1]
    side = np.where(turn, -1.0, 1.0)[:, None]
    vis2 = replace(v, stations=pairs, u_m=v.u_m * side, v_m=v.v_m * side)
    corners, sign = [], []
    for triangle in c.stations:
        order = rng.permutation(3)
        corners.append(triangle[order])
        sign.append(np.round(np.linalg.det(np.eye(3)[:, order])))
    corners_ = np.array(corners)
    where = HOLES[corners_]
    legs = where[:, 1:] - where[:, :-1]
    closure = replace(
        c,
        stations=new[corners_],
        value=c.value * np.array(sign),
        u_m=legs[..., 0],
        v_m=legs[..., 1],
    )
    rows_v, rows_c = rng.permutation(len(v)), rng.permutation(len(c))
    signs = np.r_[np.ones(len(v)), sign]
    blocks = [
        Block(
            b.index,
            b.matrix * np.outer(signs[b.index], signs[b.index]),
            None if b.basis is None else b.basis * signs[b.index, None],
        )
        for b in star.covariance.blocks
    ]
    covariance = BlockCovariance(len(signs), blocks)
    return replace(
        star,
        vis2=renumbered(vis2.select(rows_v)),
        closure_phase=renumbered(closure.select(rows_c)),
        covariance=covariance.select(np.r_[rows_v, len(v) + rows_c]),
        setups=(replace(star.setups[0], stations=tuple(names), station_xyz_m=xyz),),
    )


def renumbered(m):  # type: ignore[no-untyped-def]
    return replace(m, row=np.arange(len(m)))


def test_sign_of_a_permutation() -> None:
    triangles = np.array([(1, 4, 6), (4, 6, 1), (6, 1, 4), (4, 1, 6), (1, 6, 4), (6, 4, 1)])
    ordered, sign = canonical(triangles)
    assert (ordered == [1, 4, 6]).all()
    np.testing.assert_array_equal(sign, [1, 1, 1, -1, -1, -1])


@pytest.mark.parametrize("known_by", ["name", "position", "uv"])
def test_order_of_rows_and_stations_does_not_matter(
    instrument: Instrument, rng: np.random.Generator, known_by: str
) -> None:
    target, calibrators = instrument.star(), [instrument.star() for _ in range(2)]
    plain = calibrate(target, calibrators).observables
    other = []
    for calibrator in calibrators:
        changed = shuffled(calibrator, rng)
        if known_by != "name":
            setup = replace(changed.setups[0], stations=tuple("abcdefg"))
            if known_by == "uv":
                setup = replace(setup, station_xyz_m=None)
            changed = replace(changed, setups=(setup,))
        other.append(changed)
    found = calibrate(target, other).observables
    np.testing.assert_allclose(found.data, plain.data, atol=1e-13)
    np.testing.assert_allclose(found.covariance.dense(), plain.covariance.dense(), atol=1e-15)


def test_disc_against_the_bessel_function_and_finite_differences() -> None:
    frequency = np.array([0.0, 1e6, 3e7, 1e8])
    z = np.pi * 2.0 * MAS * frequency[1:]
    amplitude, slope = uniform_disc(frequency, 2.0)
    np.testing.assert_allclose(amplitude[1:], 2 * j1(z) / z)
    np.testing.assert_allclose(amplitude[0], 1.0)
    step = 1e-5
    numeric = (uniform_disc(frequency, 2 + step)[0] - uniform_disc(frequency, 2 - step)[0]) / (
        2 * step
    )
    np.testing.assert_allclose(slope, numeric, atol=1e-8)
    np.testing.assert_allclose(uniform_disc(frequency, 0.0), [np.ones(4), np.zeros(4)], atol=1e-4)


def test_diameter_of_a_calibrator_and_its_error(instrument: Instrument) -> None:
    target = with_values(instrument.sheet, instrument.vis2, instrument.closure)
    diameter, error = 30.0, 1.0
    m = target.vis2
    frequency = np.hypot(m.u_m[:, 0], m.v_m[:, 0]) / m.wavelength_m
    disc, slope = uniform_disc(frequency, diameter)
    calibrator = with_values(instrument.sheet, instrument.vis2 * disc**2, instrument.closure)
    exact = calibrate(target, [calibrator], diameters_mas=[diameter]).observables
    np.testing.assert_allclose(exact.vis2.value, 1.0, rtol=1e-12)
    ignored = calibrate(target, [calibrator]).observables
    np.testing.assert_allclose(ignored.vis2.value, 1 / disc**2, rtol=1e-12)
    unsure = calibrate(target, [calibrator], diameters_mas=[(diameter, error)]).observables
    extra = (unsure.covariance.dense() - exact.covariance.dense())[:21, :21]
    gradient = 2 * slope / disc * error
    np.testing.assert_allclose(extra, np.outer(gradient, gradient), atol=1e-12)


def test_exposures_of_a_calibrator_are_averaged(instrument: Instrument) -> None:
    target = instrument.star()
    one, two = instrument.star(mjd=60000.0), instrument.star(mjd=60000.2)
    both = join([one, two])
    found = calibrate(target, [both]).observables
    mean = (one.vis2.value + two.vis2.value) / 2
    np.testing.assert_allclose(found.vis2.value, target.vis2.value / mean)
    keys = keys_of(target)
    transfer = transfer_of(both, keys, (0.0, 0.0))
    np.testing.assert_allclose(
        transfer.covariance.toarray(), one.covariance.dense() / 2, atol=1e-18
    )


def test_time_window(instrument: Instrument) -> None:
    target = join([instrument.star(mjd=60000.0), instrument.star(mjd=60010.0)])
    near, far = instrument.star(mjd=60000.1), instrument.star(mjd=60010.1)
    far = with_values(far, far.vis2.value / 2, far.closure_phase.value, mjd=60010.1)
    found = calibrate(target, [near, far], window_days=1.0).observables
    first = found.vis2.mjd < 60005
    ratio = target.vis2.value[:21]
    np.testing.assert_allclose(found.vis2.value[first], ratio / near.vis2.value)
    np.testing.assert_allclose(found.vis2.value[~first], target.vis2.value[21:] / far.vis2.value)
    only = calibrate(target, [near], window_days=1.0).observables
    np.testing.assert_array_equal(only.vis2.flag, ~first)
    assert any("without calibrator" in note for note in only.notes)


def test_targets_that_share_calibrators_are_correlated(instrument: Instrument) -> None:
    targets = [instrument.star(), instrument.star()]
    calibrator = instrument.star()
    found = calibrate(targets, [calibrator])
    dense, n = found.observables.covariance.dense(), 21
    jacobian = [np.diag(t.vis2.value / calibrator.vis2.value**2) for t in targets]
    expected = jacobian[0] @ calibrator.covariance.dense()[:n, :n] @ jacobian[1]
    np.testing.assert_allclose(dense[:n, n : 2 * n], expected, rtol=0.2, atol=1e-17)
    assert [t.n_vis2 for t in found.targets] == [21, 21]
    np.testing.assert_array_equal(found.targets[1].vis2.value, found.observables.vis2.value[21:])
    alone = calibrate(targets[1], [calibrator]).observables
    np.testing.assert_allclose(
        found.targets[1].covariance.dense(), alone.covariance.dense(), rtol=0.1, atol=1e-17
    )


def test_errors_do_not_follow_the_noise() -> None:
    """A weighted mean of calibrated V² of a point is its plain mean, not below it.

    With errors taken at the measured values it lies 0.9 of its standard errors below, since
    values that come out low get small errors (d'Agostini 1994).
    """
    off = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        stars = [
            replace(s := point_source(HOLES, [4.8e-6], [1e-7], vis2_error=0.07,
                                      closure_error_rad=0.1),
                    vis2=replace(s.vis2, value=1 + 0.07 * rng.normal(size=21),
                                 mjd=s.vis2.mjd + 0.1 * i))
            for i in range(7)
        ]  # fmt: skip
        found = calibrate(stars[:4], stars[4:], method="weighted", clip=None).observables
        found = found.only(["vis2"]).unflagged()
        weight = found.covariance.solve(np.ones(len(found.data)))
        best = weight @ found.data / weight.sum()
        off.append((best - found.data.mean()) * np.sqrt(weight.sum()))
    assert abs(np.mean(off)) < 0.1 + 4 * np.std(off) / np.sqrt(len(off))
    assert np.std(off) < 0.3


def test_mean_of_closures_closes(rng: np.random.Generator) -> None:
    """Calibrators with uneven errors: the mean stays what baselines can make."""
    instrument = Instrument(rng)
    cals = []
    for _ in range(4):
        star = instrument.star()
        keep = rng.random(35) < 0.8
        cals.append(star.select(np.ones(21, dtype=bool), keep))
    target = instrument.star()
    kernel = kernel_basis(instrument.matrix)
    null = np.eye(35) - kernel @ kernel.T
    for method in ("weighted", "hierarchical"):
        found = calibrate(target, cals, method=method).observables
        moved = found.closure_phase.value - target.closure_phase.value
        np.testing.assert_allclose(null @ moved, 0.0, atol=1e-12)
        np.testing.assert_allclose(null @ found.covariance.dense()[21:, 21:], 0.0, atol=1e-12)
        assert found.covariance.rank == 36


def test_phases_are_averaged_across_the_branch_cut(instrument: Instrument) -> None:
    # All closure phases of a mask turned by nearly half a turn cannot close; one triangle can.
    sheet = point_source(HOLES[:3], [4e-6], [1e-7], vis2_error=0.01, closure_error_rad=0.01)
    stars = [with_values(sheet, np.ones(3), np.array([x])) for x in (3.1, -3.13, 3.12)]
    found = calibrate(stars[0], stars[1:]).observables
    mean = (2 * np.pi - 3.13 + 3.12) / 2
    np.testing.assert_allclose(found.closure_phase.value, 3.1 - mean)
    turned = wrapped(np.array([3.5, -3.5, 1.0]))
    np.testing.assert_allclose(turned, [3.5 - 2 * np.pi, 2 * np.pi - 3.5, 1.0])


def test_outlier_is_clipped(instrument: Instrument) -> None:
    target, cals = instrument.star(), [instrument.star(f"c{i}") for i in range(4)]
    vis2 = cals[2].vis2.value.copy()
    vis2[5] += 0.2
    cals[2] = with_values(cals[2], vis2, cals[2].closure_phase.value, "c2")
    found = calibrate(target, cals, method="weighted", clip=5.0)
    assert [u.n_clipped for u in found.calibrators] == [0, 0, 1, 0]
    assert found.calibrators[2].reason == "1 of 56 values is an outlier among the calibrators"
    assert found.calibrators[2].kept
    kept = np.mean([c.vis2.value[5] for i, c in enumerate(cals) if i != 2])
    np.testing.assert_allclose(found.observables.vis2.value[5], target.vis2.value[5] / kept)
    every = calibrate(target, cals, method="weighted", clip=None)
    mean = np.mean([c.vis2.value[5] for c in cals])
    np.testing.assert_allclose(every.observables.vis2.value[5], target.vis2.value[5] / mean)


def test_two_that_disagree_are_both_kept(instrument: Instrument) -> None:
    one, two = instrument.star(), instrument.star()
    two = with_values(two, two.vis2.value + 0.3, two.closure_phase.value)
    found = calibrate(instrument.star(), [one, two])
    assert all(u.n_clipped == 0 for u in found.calibrators)


@pytest.mark.parametrize("tau", [0.0, 5.0])
def test_share_of_good_values_that_clipping_loses(tau: float, rng: np.random.Generator) -> None:
    """3σ loses about 0.27 % of good values, also where stars scatter more than their errors."""
    n, j = 21, 5
    keys = keys_of(vis2_keys(7))
    lost = []
    for _ in range(200):
        values = 0.8 + 0.01 * np.hypot(1, tau) * rng.normal(size=(j, n))
        kept = clipped(transfers(values, np.full((j, n), 0.01)), keys, 3.0)
        lost.append(np.mean([~t.seen for t in kept]))
    # 21 000 values: 0.27 % has a binomial error of 0.04 %; the pooled scatter adds to it.
    assert np.mean(lost) < 0.008


def grid_moments(population, grid):  # type: ignore[no-untyped-def]
    """The predictive moments by a sum over a grid in τ: no sampler."""
    tau = np.stack([grid, np.zeros_like(grid)], axis=1)
    log_p = population.log_prob(tau)
    weight = np.exp(log_p - log_p.max()) * np.gradient(grid)
    weight /= weight.sum()
    return weight, tau


@pytest.mark.parametrize("tau", [0.0, 2.0, 100.0])
def test_sampled_scatter_against_a_grid(tau: float, rng: np.random.Generator) -> None:
    keys = keys_of(vis2_keys(7))
    values = 0.8 + 0.01 * np.hypot(1, tau) * rng.normal(size=(4, 21))
    stars = transfers(values, np.full((4, 21), 0.01))
    population = population_of(stars, keys, np.ones(21, dtype=bool))
    proposals = ScatterGrid.of(population)
    draws = sample_tau(proposals, np.random.default_rng(1))
    weight, grid = grid_moments(population, np.linspace(1e-6, 0.03 * max(tau, 2.0), 20_000))
    for power in (1, 2):
        expected = weight @ grid[:, 0] ** power
        # 20 walkers x 100 steps / 2: 1000 independent draws, of relative width < 1.
        np.testing.assert_allclose((draws[:, 0] ** power).mean(), expected, rtol=0.15)
    assert np.isnan(draws[:, 1]).all()
    value, covariance = predictive(population, *proposals.posterior, 21)
    mean, inverse = population.groups[0].response(grid)
    np.testing.assert_allclose(value, weight @ mean[..., 0], rtol=1e-4)
    spread = weight @ (mean[..., 0] - value) ** 2
    np.testing.assert_allclose(
        covariance.diagonal(),
        weight @ (inverse[..., 0, 0] + grid[:, :1] ** 2) + spread,
        rtol=0.01,  # sixteen nodes, down to a twentieth of an error
    )


def test_proposals_of_scatter_have_the_density_that_is_stated(rng: np.random.Generator) -> None:
    """Or the chain would follow the grid instead of the posterior."""
    values = 0.8 + 0.02 * rng.normal(size=(4, 21))
    stars = transfers(values, np.full((4, 21), 0.01))
    population = population_of(stars, keys_of(vis2_keys(7)), np.ones(21, dtype=bool))
    proposals = ScatterGrid.of(population)
    drawn = proposals.draw(np.random.RandomState(3), 20_000)[:, 0]
    fine = np.linspace(0.0, 6.0, 60_001)
    density = np.exp(proposals.log_density(fine[:, None]))
    share = np.cumsum(density) * (fine[1] - fine[0])
    assert share[-1] == pytest.approx(1.0, abs=1e-3)
    assert kstest(drawn, lambda x: np.interp(x, fine, share)).pvalue > 1e-4


def test_marginal_likelihood_against_dense_algebra(rng: np.random.Generator) -> None:
    """ln p(z | τ) up to a constant, with the response under a very wide prior, done densely."""
    instrument = Instrument(rng, n=4, tau=1.0)
    target, cals = instrument.star(), [instrument.star() for _ in range(3)]
    cals[1] = cals[1].select(np.arange(6) != 2, np.arange(4) != 1)
    keys = keys_of(target)
    stars = [transfer_of(c, keys, (0.0, 0.0)) for c in cals]
    population = population_of(stars, keys, np.ones(10, dtype=bool))
    taus = np.array([[0.003, 0.01], [0.02, 0.001], [0.01, 0.03]])
    kernel = kernel_basis(instrument.matrix)
    basis = np.zeros((10, 9))
    basis[:6, :6], basis[6:, 6:] = np.eye(6), kernel
    wide = 1e3
    expected = []
    for tau_v, tau_c in taus:
        between = np.zeros((10, 10))
        between[:6, :6] = tau_v**2 * np.eye(6)
        between[6:, 6:] = tau_c**2 * instrument.matrix @ instrument.matrix.T / 3
        rows, data, blocks = [], [], []
        for star in stars:
            seen = np.flatnonzero(star.seen)
            own = kernel_basis(instrument.matrix[seen[seen >= 6] - 6])
            v = np.zeros((10, (seen < 6).sum() + own.shape[1]))
            v[seen[seen < 6], np.arange((seen < 6).sum())] = 1
            v[np.ix_(seen[seen >= 6], np.arange((seen < 6).sum(), v.shape[1]))] = own
            rows.append(v.T @ basis)
            data.append(v.T @ star.value)
            blocks.append(v.T @ (star.covariance.toarray() + between) @ v)
        design, z = np.vstack(rows), np.concatenate(data)
        total = wide**2 * design @ design.T
        start = 0
        for block in blocks:
            total[start : start + len(block), start : start + len(block)] += block
            start += len(block)
        expected.append(-0.5 * (np.linalg.slogdet(total)[1] + z @ np.linalg.solve(total, z)))
    scale = population.prior_scale
    prior = -0.5 * ((taus / scale) ** 2).sum(axis=1)
    found = population.log_prob(taus) - prior
    np.testing.assert_allclose(np.diff(found), np.diff(expected), atol=1e-4)


def test_scatter_is_found_and_the_target_has_it_too(rng: np.random.Generator) -> None:
    instrument = Instrument(rng, tau=3.0)
    target, cals = instrument.star(), [instrument.star() for _ in range(6)]
    found = calibrate(target, cals)
    assert found.method == "hierarchical"
    # 5 x 21 and 5 x 15 degrees of freedom: 7 and 8 % each; 5 standard errors.
    assert found.tau_vis2 == pytest.approx(0.03, rel=0.4)
    assert found.tau_closure_phase_rad == pytest.approx(0.03, rel=0.4)
    white = found.observables.covariance.whiten(
        found.observables.data - np.r_[np.ones(21), np.zeros(35)]
    )
    # chi-squared with 36 degrees of freedom beyond [10, 80] happens in 1e-5 of cases.
    assert 10 < (white**2).sum() < 80
    weighted = calibrate(target, cals, method="weighted")
    assert weighted.tau_vis2 is None
    assert weighted.observables.errors[0].mean() < found.observables.errors[0].mean()


@pytest.mark.parametrize("tau", [3.0, pytest.param(0.0, marks=pytest.mark.slow)])
def test_two_calibrators_that_scatter_give_the_target_their_scatter(tau: float) -> None:
    """χ² per datum of stars that are points, whose true errors the instrument here draws.

    That of one star has a standard deviation of 0.24 by its noise and of 0.4 by what 21 and 15
    differences of two calibrators tell of the scatter: the mean of 15 is known to 0.12. Of the
    means of two calibrators alone, without the target's own scatter, it is 5.
    """
    ratio = []
    for seed in range(15):
        instrument = Instrument(np.random.default_rng([seed, 2]), tau=tau)
        found = calibrate(instrument.star(), [instrument.star() for _ in range(2)])
        assert found.method == "hierarchical"
        data = found.observables
        white = data.covariance.whiten(data.data - np.r_[np.ones(21), np.zeros(35)])
        ratio.append((white**2).sum() / 36.0)
    # Without scatter its prior still allows some: errors are then up to a tenth too large.
    assert (0.7 if tau else 0.6) < np.mean(ratio) < 1.4


@pytest.mark.slow
def test_dependence_on_charge_level(rng: np.random.Generator) -> None:
    """A response that grows with charge, and a target beyond the calibrators."""
    instrument = Instrument(rng, sigma=1e-3)
    slope = rng.uniform(0.02, 0.05, 21)
    levels = np.array([3.0, 0.0, 1.0, 2.0, 2.5, 1.5])
    stars = []
    for level in levels:
        star = instrument.star()
        stars.append(with_values(star, star.vis2.value + slope * level, star.closure_phase.value))
    with_slope = calibrate(stars[0], stars[1:], charge_levels=levels, clip=None).observables
    pulls = (with_slope.vis2.value - 1) / with_slope.errors[0]
    # 21 pulls: their mean square is 1 ± 0.31; 5 standard errors.
    assert (pulls**2).mean() < 2.6
    without = calibrate(stars[0], stars[1:], clip=None).observables
    assert np.mean(without.vis2.value - 1) > 0.04


@pytest.mark.parametrize(
    ("levels", "fault"),
    [
        ([1.0, 2.0, 3.0], "charge level"),
        ([1.0, 2.0, np.inf, 3.0], "charge level"),
        ([1.0, 2.0, 2.0, 2.0], "levels"),
    ],
)
def test_charge_levels_that_say_nothing(levels, fault: str, instrument: Instrument) -> None:
    stars = [instrument.star() for _ in range(4)]
    with pytest.raises(DataError, match=fault) as caught:
        calibrate(stars[0], stars[1:], charge_levels=levels)
    assert caught.value.remedy


def test_a_response_that_grows_with_charge_is_followed(rng: np.random.Generator) -> None:
    """One draw of `test_dependence_on_charge_level`; without the levels V² is 7 % too high."""
    instrument = Instrument(rng, sigma=1e-3)
    levels = np.array([3.0, 0.0, 1.0, 2.0])
    stars = []
    for level in levels:
        star = instrument.star()
        stars.append(with_values(star, star.vis2.value + 0.03 * level, star.closure_phase.value))
    found = calibrate(stars[0], stars[1:], charge_levels=levels, clip=None).observables
    # Extrapolated from 0…2 to 3 by three stars of error 1e-3: 1.6e-3 each, 21 of them; 6σ.
    assert abs(np.mean(found.vis2.value - 1.0)) < 6.0 * 1.6e-3
    without = calibrate(stars[0], stars[1:], clip=None).observables
    assert np.mean(without.vis2.value - 1.0) > 0.04


def test_same_seed_same_result(instrument: Instrument) -> None:
    target, cals = instrument.star(), [instrument.star() for _ in range(3)]
    results = [calibrate(target, cals, rng=np.random.default_rng(s)) for s in (4, 4, 5)]
    np.testing.assert_array_equal(
        results[0].observables.covariance.dense(), results[1].observables.covariance.dense()
    )
    assert results[0].tau_vis2 != results[2].tau_vis2


def test_calibrated_data_round_trip(instrument: Instrument, tmp_path: Path) -> None:
    targets = [instrument.star(mjd=60000.0), instrument.star(mjd=60001.0)]
    for method in ("weighted", "hierarchical"):
        found = calibrate(targets, [instrument.star() for _ in range(3)], method=method)
        write_oifits(tmp_path / "a.fits", found.observables, overwrite=True)
        back = read_oifits(tmp_path / "a.fits")
        np.testing.assert_array_equal(back.data, found.observables.data)
        np.testing.assert_array_equal(
            back.covariance.dense(), np.asarray(found.observables.covariance.dense())
        )
        assert back.covariance.rank == found.observables.covariance.rank


def test_independent_errors_stay_independent(instrument: Instrument) -> None:
    from oi_builders import diagonal

    stars = [diagonal(instrument.star()) for _ in range(4)]
    for method in ("weighted", "hierarchical"):
        found = calibrate(stars[0], stars[1:], method=method, clip=None).observables
        dense = found.covariance.dense()
        np.testing.assert_allclose(dense, np.diag(np.diag(dense)), atol=1e-18)
        assert found.covariance.rank == 56
        assert found.covariance_kind == "diagonal"


def test_channels_are_matched_by_wavelength(rng: np.random.Generator) -> None:
    def star(waves: list[float], vis2: list[float]) -> Observables:
        sheet = point_source(
            HOLES[:4], waves, [1e-8] * len(waves), vis2_error=0.01, closure_error_rad=0.01
        )
        m = sheet.vis2
        return replace(sheet, vis2=replace(m, value=np.array(vis2)[m.channel]))

    target = star([1.6e-6, 1.7e-6, 1.8e-6], [0.8, 0.8, 0.8])
    calibrator = star([1.7e-6, 1.60001e-6], [0.5, 0.4])
    found = calibrate(target, [calibrator]).observables
    np.testing.assert_allclose(found.vis2.value[:2], [2.0, 1.6])
    np.testing.assert_array_equal(found.vis2.flag[:3], [False, False, True])
    np.testing.assert_array_equal(found.closure_phase.flag[:3], [False, False, True])


def test_polarisations_are_not_mixed(instrument: Instrument) -> None:
    def polarisation(star: Observables, name: str) -> Observables:
        return replace(star, setups=(replace(star.setups[0], insname=name),))

    target = join([polarisation(instrument.star(), p) for p in ("P1", "P2")])
    stars = [instrument.star(), instrument.star()]
    stars[1] = with_values(stars[1], stars[1].vis2.value / 2, stars[1].closure_phase.value)
    both = join([polarisation(s, p) for s, p in zip(stars, ("P1", "P2"), strict=True)])
    found = calibrate(target, [both]).observables
    np.testing.assert_allclose(
        found.vis2.value, target.vis2.value / np.concatenate([s.vis2.value for s in stars])
    )


def test_faint_calibrator_baselines_are_flagged(instrument: Instrument) -> None:
    target, calibrator = instrument.star(), instrument.star()
    vis2 = calibrator.vis2.value.copy()
    vis2[[3, 4]] = [0.01, -0.2]
    faint = with_values(calibrator, vis2, calibrator.closure_phase.value)
    found = calibrate(target, [faint]).observables
    np.testing.assert_array_equal(np.flatnonzero(found.vis2.flag), [3, 4])
    assert np.isfinite(found.data).all()


def bad(  # noqa: C901
    case: str, instrument: Instrument
) -> tuple[Observables, list[Observables], dict]:  # type: ignore[type-arg]
    target, cal = instrument.star("t.fits"), instrument.star("c.fits")
    setup = cal.setups[0]
    if case == "none":
        return target, [], {}
    if case == "one":
        return target, [cal], {"method": "hierarchical"}
    if case == "self":
        return target, [replace(target, setups=cal.setups)], {}
    if case == "twice":
        return target, [cal, replace(cal, notes=("again",))], {}
    if case == "wavelength":
        m, c = cal.vis2, cal.closure_phase
        m, c = (replace(x, wavelength_m=x.wavelength_m * 0.9) for x in (m, c))
        other = replace(setup, wavelength_m=setup.wavelength_m * 0.9)
        return target, [replace(cal, vis2=m, closure_phase=c, setups=(other,))], {}
    if case == "stations":
        far = point_source(HOLES[:4] * 7.3, [4.8e-6], [3e-7], vis2_error=1, closure_error_rad=1)
        names = tuple("wxyz")
        return target, [replace(far, setups=(replace(far.setups[0], stations=names),))], {}
    if case == "diameters":
        return target, [cal], {"diameters_mas": [1.0, 2.0]}
    if case == "diameter":
        return target, [cal], {"diameters_mas": [np.inf]}
    if case == "time":
        late = instrument.star("c.fits", mjd=60100.0)
        return target, [late], {"window_days": 1.0}
    if case == "faint":
        dark = with_values(cal, np.full(21, -0.1), cal.closure_phase.value).only(["vis2"])
        return target, [dark], {}
    return target, [cal], {"charge_levels": [1.0, 2.0]}


@pytest.mark.parametrize(
    ("case", "fault"),
    [
        ("none", "t.fits: no calibrator given"),
        ("one", "t.fits: one calibrator cannot tell the scatter"),
        ("self", "c.fits: holds the data of the target t.fits"),
        ("twice", "c.fits: holds the data of another calibrator c.fits"),
        ("wavelength", "t.fits: has no baseline at the same wavelength in common with c.fits"),
        ("stations", "t.fits: has no baseline at the same wavelength in common"),
        ("time", "t.fits: has no baseline at the same wavelength within 1 d in common"),
        ("diameters", "2 diameters for 1 calibrators"),
        ("diameter", "a diameter that is negative or not finite"),
        ("faint", "t.fits: nothing is left"),
        ("charge", "charge levels are for the hierarchical method"),
    ],
)
def test_bad_input(case: str, fault: str, instrument: Instrument) -> None:
    target, calibrators, options = bad(case, instrument)
    with pytest.raises(DataError, match=fault) as caught:
        calibrate(target, calibrators, **options)
    assert caught.value.remedy


def test_no_target() -> None:
    with pytest.raises(DataError, match="no target"):
        calibrate([], [])


def test_a_calibrator_without_anything_in_common_is_named(instrument: Instrument) -> None:
    target, cals = instrument.star(), [instrument.star(f"c{i}") for i in range(3)]
    setup = replace(cals[1].setups[0], wavelength_m=cals[1].setups[0].wavelength_m * 2)
    cals[1] = replace(cals[1], setups=(setup,))
    found = calibrate(target, cals)
    assert [u.kept for u in found.calibrators] == [True, False, True]
    assert "no baseline" in found.calibrators[1].reason
    assert isinstance(found, Calibration)


def test_match_of_a_calibrator_with_itself(instrument: Instrument) -> None:
    star = instrument.star()
    found = match(star, keys_of(star))
    assert len(found.entry) == 56
    np.testing.assert_array_equal(np.sort(found.entry), np.arange(56))


@pytest.mark.parametrize(
    ("n_calibrators", "tau"),
    [
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((3, 2.0), (5, 0.0))),
        *(pytest.param(*pair, marks=pytest.mark.release) for pair in ((3, 0.0), (5, 2.0))),
    ],
)
def test_coverage_of_the_whole_calibration(
    n_calibrators: int, tau: float, rng: np.random.Generator
) -> None:
    """68 and 95 % intervals of V² and kernel phases of calibrated point sources."""
    off = {"vis2": [], "kernel": []}
    kernel = None
    for _ in range(60):
        instrument = Instrument(rng, tau=tau)
        kernel = kernel_basis(instrument.matrix) if kernel is None else kernel
        stars = [instrument.star() for _ in range(1 + n_calibrators)]
        found = calibrate(stars[0], stars[1:], rng=rng).observables
        off["vis2"].append((found.vis2.value - 1) / found.errors[0])
        sigma = np.sqrt(np.diag(kernel.T @ found.covariance.dense()[21:, 21:] @ kernel))
        off["kernel"].append(kernel.T @ found.closure_phase.value / sigma)
    for pulls in off.values():
        x = np.abs(np.concatenate(pulls))
        # 1260 and 900 intervals, those of one set tied by its τ: about 1.7 %; 4 standard
        # errors below nominal, and the allowed over-coverage of 6 % (and 4 errors) above.
        for limit, nominal in ((1.0, 0.6827), (2.0, 0.9545)):
            assert nominal - 0.03 - 0.04 < (x < limit).mean() < nominal + 0.06 + 0.06


def test_reader_is_told_what_one_calibrator_cannot_tell() -> None:
    rng = np.random.default_rng(5)
    target, *stars = (simulated(niriss(), [100.0, 0.0, 0.0], rng) for _ in range(3))
    said = [calibration_warnings(calibrate(target, stars[:n])) for n in (1, 2)]
    assert len(said[0]) == 1
    assert "one calibrator calibrates" in said[0][0]
    assert said[1] == calibration_warnings(None) == []


def test_reader_is_told_of_a_calibrator_that_calibrates_nothing() -> None:
    rng = np.random.default_rng(5)
    target, good, other = (simulated(niriss(), [100.0, 0.0, 0.0], rng) for _ in range(3))
    setup = replace(other.setups[0], source="F430M", wavelength_m=np.array([4.3e-6]))
    other = replace(other, setups=(setup,))
    found = calibrate(target, [good, other])
    (said,) = unused_calibrators(found, ["F430M"])
    assert said.startswith("calibrator F430M is not used: no baseline at the same wavelength")
    assert unused_calibrators(found, []) == unused_calibrators(None, ["F430M"]) == []


def test_filters_of_one_instrument_are_told_apart() -> None:
    """Two exposures with the same stations and name, in bands that differ by a tenth."""
    first = niriss()
    wavelength = 1.1 * first.setups[0].wavelength_m
    other = replace(
        first,
        vis2=replace(first.vis2, wavelength_m=1.1 * first.vis2.wavelength_m),
        closure_phase=replace(
            first.closure_phase, wavelength_m=1.1 * first.closure_phase.wavelength_m
        ),
        setups=(replace(first.setups[0], wavelength_m=wavelength, source="other"),),
    )
    keys = keys_of(join([first, other]))
    assert len(keys) == 2 * len(first.data)
    assert match(other, keys).key.min() >= 0
    np.testing.assert_array_equal(
        np.sort(match(join([first, other]), keys).key), np.arange(len(keys))
    )


def test_stations_are_matched_by_place_where_some_are_missing() -> None:
    """Other names, another order, and two holes less: their places have another mean."""
    target = niriss()
    order = np.random.default_rng(4).permutation(7)
    new = np.argsort(order)
    setup = replace(
        target.setups[0],
        stations=tuple("ABCDEFG"),
        station_xyz_m=None,
        station_diameter_m=None,
    )
    moved = replace(
        target,
        vis2=replace(target.vis2, stations=new[target.vis2.stations]),
        closure_phase=replace(target.closure_phase, stations=new[target.closure_phase.stations]),
        setups=(setup,),
    )
    keep = [~np.isin(m.stations, (1, 4)).any(axis=1) for m in (moved.vis2, moved.closure_phase)]
    part = moved.select(*keep)
    keys = keys_of(target)
    found = match(part, keys)
    np.testing.assert_array_equal(found.key, np.flatnonzero(np.concatenate(keep)))


def test_methods_of_extraction_are_named_in_order() -> None:
    """Names come from a set, whose own order changes from run to run."""
    names = ("unique", "square", "gauss", "fft", "matched", "fringes", "other", "another")
    lattice = np.zeros((7, 7, 11, 11), dtype=np.complex64)

    def extracted(method: str, k: int) -> Observables:
        response = OffAxisResponse(lattice, np.eye(2), np.zeros(2), True, method)
        sheet = simulated(niriss(), [100.0, 50.0, 0.01], np.random.default_rng(k))
        return replace(sheet, setups=(replace(sheet.setups[0], response=response, source=f"{k}"),))

    calibrator = join([extracted(name, k) for k, name in enumerate(names)])
    with pytest.raises(DataError, match=f"extracted by {', '.join(sorted(names))}, the target"):
        calibrate(extracted("fringes", 99), [calibrator])


def test_charge_levels_are_taken_from_the_target_in_units_of_the_largest() -> None:
    levels, three = (10.0, 10.0, 14.0, 7.0), [None] * 3
    found = _covariate(levels, three, [0, 1, 2], "hierarchical")  # type: ignore[arg-type]
    np.testing.assert_allclose(found, [0.0, 1.0, -0.75])
    found = _covariate((*levels, 99.0), [None] * 4, [2, 1, 0], "hierarchical")  # type: ignore[arg-type]
    np.testing.assert_allclose(found, [-0.75, 1.0, 0.0])
    for wrong, method, fault in (
        (levels[:3], "hierarchical", "3 charge levels for a target and 3 calibrators"),
        ((1.0, 2.0, 3.0, np.nan), "hierarchical", "charge levels"),
        ((1.0, 2.0, 2.0, 2.0), "hierarchical", "3 calibrators of different levels"),
        (levels, "weighted", "for the hierarchical method"),
    ):
        with pytest.raises(DataError, match=fault):
            _covariate(wrong, three, [0, 1, 2], method)  # type: ignore[arg-type]
    assert _covariate(None, three, [0, 1, 2], "weighted") is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("micron", "band"),
    [(0.48, "uddb"), (1.4, "uddj"), (1.46, "uddh"), (2.7, "uddk"), (2.8, "uddl"), (4.8, "uddm")],
)
def test_diameters_are_those_of_the_nearest_band(micron: float, band: str) -> None:
    """By the ratio of wavelengths, of the columns that the catalogue has."""
    setups = [SimpleNamespace(wavelength_m=1e-6 * micron * np.array([0.99, 1.0, 1.01]))]
    names = ("uddb", "uddj", "uddh", "uddk", "uddl", "uddm", "diameter_mas")
    sizes = {name: [1.0] for name in names}
    assert _band_of(SimpleNamespace(setups=setups), sizes) == band  # type: ignore[arg-type]
    assert _band_of(SimpleNamespace(setups=setups), {"uddv": [1.0]}) == "uddv"  # type: ignore[arg-type]

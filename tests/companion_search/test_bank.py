"""The template bank against finite differences and brute force; CANDID's nσ against scipy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from epochs import F430M, F480M, epoch
from helpers import niriss, simulated
from scipy import stats

from amibayes.companion_search.exact_map import LADDER, ExactMap, exact_map
from amibayes.companion_search.grid import Grid, make_grid
from amibayes.companion_search.optimise import fit_single
from amibayes.companion_search.scan import GroupWeights, ScaleGroups
from amibayes.companion_search.seeds import bright_seeds
from amibayes.companion_search.template_bank import MANY_ROWS, TemplateBank
from amibayes.data.covariance import dense_covariance
from amibayes.data.observables import join
from amibayes.likelihood.chi2 import candid_n_sigma, log_chi2_survival
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.bands import bands_of
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box

MODELS = [
    BinaryModel(),
    BinaryModel(smearing=False),
    BinaryModel(diameter_mas="free", background="free"),
    BinaryModel(diameter_mas=40.0, background=0.1),
]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kinds", [("vis2", "cp"), ("cp",), ("vis2",)])
def test_templates_are_the_derivative_of_the_model(model, kinds, rng) -> None:
    if kinds == ("cp",):
        model = BinaryModel(smearing=model.smearing)
    likelihood = Likelihood(simulated(niriss(channels=2), [0.0, 0.0, 0.0], rng).only(kinds), model)
    nuisance = np.array([30.0, 0.1])[: len(model.parameters.nuisance)]
    bank = TemplateBank(likelihood, make_grid(40.0, 400.0, 35.0), nuisance)
    step, free = 1e-6, np.linalg.qr(likelihood.jacobian([100.0, 0.0, 0.0, *nuisance])[:, 3:])[0]
    seen = np.zeros(len(bank), dtype=int)
    for index, (templates,) in bank.by_band():
        seen[index] += 1
        east, north = bank.grid.east_mas[index], bank.grid.north_mas[index]
        theta = np.column_stack([east, north, np.zeros(len(index))])
        theta = np.hstack([theta, np.broadcast_to(nuisance, (len(index), len(nuisance)))])
        brighter = theta + step * np.eye(theta.shape[1])[2]
        numerical = (likelihood.residuals(theta) - likelihood.residuals(brighter)) / step
        numerical -= free @ (free.T @ numerical)
        numerical /= np.linalg.norm(numerical, axis=0)
        np.testing.assert_allclose(templates, numerical, atol=2e-4)
    assert (seen == 1).all()


def test_scan_is_the_least_squares_contrast_of_every_position(rng) -> None:
    data = simulated(niriss(), [120.0, -90.0, 0.01], rng)
    likelihood = Likelihood(data, BinaryModel(background="free"))
    single, _ = fit_single(likelihood)
    bank = TemplateBank(likelihood, make_grid(50.0, 300.0, 40.0), single)
    residuals = single_likelihood(likelihood).residuals(single)[:, 0]
    contrast, sigma = bank.scan(residuals)
    for k in range(0, len(bank), 7):
        theta = [bank.grid.east_mas[k], bank.grid.north_mas[k], 0.0, *single]
        design = likelihood.jacobian(theta)[:, 2:]
        best = np.linalg.lstsq(design, residuals, rcond=None)[0]
        error = np.sqrt(np.linalg.inv(design.T @ design)[0, 0])
        np.testing.assert_allclose([contrast[k], sigma[k]], [best[0], error], rtol=1e-5)
        (found,), off_lattice = bank.matched_filter(residuals)(np.array(theta[:2]))
        gain = max(best[0], 0.0) ** 2 / error**2
        np.testing.assert_allclose([found, off_lattice], [best[0], gain], rtol=1e-5, atol=1e-9)


def test_largest_gain_of_many_data_sets_is_the_scan_of_each(rng) -> None:
    likelihood = Likelihood(niriss(), BinaryModel(background="free"))
    bank = TemplateBank(likelihood, make_grid(50.0, 400.0, 25.0), np.array([0.05]))
    noise = bank.project(rng.standard_normal((bank.n_data, 20)))
    gain, position = bank.largest_gain(noise.astype(np.float32))
    for one, largest, where in zip(noise.T, gain, position, strict=True):
        contrast, sigma = bank.scan(one)
        each = np.maximum(contrast / sigma, 0.0) ** 2
        np.testing.assert_allclose([largest, each[where]], each.max(), rtol=1e-5)


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_largest_gain_is_that_of_templates_laid_out(mixed: bool, weighted: bool, rng) -> None:
    # Errors that V² and closure phases share make templates of mirror images unequally long.
    data = simulated(niriss(), [0.0, 0.0, 0.0], rng)
    if mixed:
        root = rng.standard_normal((56, 56)) * 2e-3
        data = replace(data, covariance=dense_covariance(root @ root.T + 1e-5 * np.eye(56)))
    bank = TemplateBank(Likelihood(data), make_grid(50.0, 300.0, 30.0), np.empty(0))
    sets = rng.standard_normal((bank.n_data, 90))
    groups = ScaleGroups(np.arange(bank.n_data) % 2, 1.0)
    amount = rng.uniform(0.3, 3.0, (2, 90)) if weighted else np.ones((2, 90))
    weight = amount[groups.label]
    rows = (weight * sets).astype(np.float32)
    gain, position = bank.largest_gain(rows, GroupWeights(groups, amount) if weighted else None)
    every = np.zeros((90, len(bank)))
    for index, units in bank.by_band():
        match = np.maximum((weight * sets).T @ units[0], 0.0)
        every[:, index] = match**2 / (weight.T @ units[0] ** 2)
    np.testing.assert_allclose(gain, every.max(axis=1), rtol=1e-4)
    np.testing.assert_allclose(every[np.arange(90), position], gain, rtol=1e-4)


@pytest.mark.parametrize("weighted", [False, True])
def test_every_second_position_leads_to_the_largest_gain(weighted: bool, rng) -> None:
    """Of many data; where it leads elsewhere the gain is smaller, and what is large is found."""
    likelihood = Likelihood(niriss(channels=5))
    bank = TemplateBank(likelihood, make_grid(60.0, 600.0, 23.0), np.empty(0))
    assert bank.n_data >= MANY_ROWS
    groups = ScaleGroups(np.arange(bank.n_data) % 2, 1.0)
    amount = rng.uniform(0.5, 2.0, (2, 500)) if weighted else np.ones((2, 500))
    weight = amount[groups.label]
    rows = weight * rng.standard_normal((bank.n_data, 500))
    weights = GroupWeights(groups, amount) if weighted else None
    gain, position = bank.largest_gain(rows.astype(np.float32), weights)
    every = np.zeros((500, len(bank)))
    for index, units in bank.by_band():
        every[:, index] = np.maximum(rows.T @ units[0], 0.0) ** 2 / (weight.T @ units[0] ** 2)
    np.testing.assert_allclose(every[np.arange(500), position], gain, rtol=1e-3)
    largest = every.max(axis=1)
    missed = gain < 0.999 * largest
    # One of a hundred is to be expected: 21 of 500 with a probability below 1e-6.
    assert 0 < missed.sum() <= 20
    assert not missed[np.argsort(largest)[-50:]].any()


def test_tiles_have_a_coarse_position_beside_every_position() -> None:
    grid = make_grid(40.0, 300.0, 9.0)
    tiles = grid.half_plane(900, tiles=True)
    assert sorted(np.concatenate(tiles)) == list(range(len(grid) // 2))
    for tile in tiles:
        coarse = tile[grid.coarse(tile)]
        far = [np.abs(x[tile][:, None] - x[coarse]) for x in (grid.rows, grid.columns)]
        assert (np.maximum(*far).min(axis=1) <= 1).all()


def test_grid_fills_the_annulus_and_mirrors_itself() -> None:
    grid = make_grid(50.0, 400.0, 9.7)
    rho = np.hypot(grid.east_mas, grid.north_mas)
    assert rho.min() >= 50.0
    assert rho.max() <= 400.0
    area = np.pi * (400.0**2 - 50.0**2) / 9.7**2
    assert abs(len(grid) - area) < 3 * np.sqrt(2 * np.pi * 450 / 9.7)
    half = len(grid) // 2
    np.testing.assert_array_equal(grid.columns[:half], -grid.columns[half:])
    assert len(np.unique(np.stack([grid.columns, grid.rows]), axis=1).T) == len(grid)
    image = grid.image(grid.north_mas)
    assert image[grid.half_width + 10, grid.half_width] == pytest.approx(97.0)
    assert np.isnan(image[grid.half_width, grid.half_width])


@pytest.mark.parametrize(("dof", "delta"), [(32, 26.7), (34, 27.4)])
def test_three_candid_sigma(dof: int, delta: float) -> None:
    assert candid_n_sigma(dof + delta, dof, dof) == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize("dof", [3, 30, 1346])
def test_survival_of_chi2_joins_smoothly_past_underflow(dof: int) -> None:
    x = stats.chi2.isf(1e-250, dof)
    assert log_chi2_survival(x, dof) == pytest.approx(stats.chi2.logsf(x, dof), rel=1e-10)
    assert log_chi2_survival(10 * x, dof) < -2000


def test_candid_n_sigma_is_plain_where_it_can_be_and_finite_elsewhere() -> None:
    p = stats.chi2.sf(100.0, 33)
    assert candid_n_sigma(100.0, 33.0, 33) == pytest.approx(stats.norm.isf(p / 2))
    assert candid_n_sigma(10.0, 10.0, 33) < 1.0
    assert 1e3 < candid_n_sigma(1e9, 1e3, 1e3) < 1e5


def test_a_template_that_the_star_makes_whole_gains_nothing(rng) -> None:
    """Rounding leaves squares of either sign of it: neither NaN nor a gain without bounds."""
    likelihood = Likelihood(simulated(niriss(), [0.0, 0.0, 0.0], rng))
    bank = TemplateBank(likelihood, make_grid(50.0, 400.0, 20.0), np.empty(0))
    bank.nuisance_basis = np.linalg.qr(rng.standard_normal((bank.n_data, bank.n_data)))[0]
    gain, _ = bank.largest_gain(rng.standard_normal((bank.n_data, 5)).astype(np.float32))
    assert np.isfinite(gain).all()
    contrast, sigma = bank.scan_at(rng.standard_normal(bank.n_data), np.array([99.0]), np.zeros(1))
    assert np.isfinite(contrast).all()
    assert abs(contrast[0] / sigma[0]) < 1e-3


@pytest.mark.parametrize("kinds", [("vis2", "cp"), ("vis2",)])
def test_exact_map_is_chi2_of_the_model_and_its_best_the_least(kinds, rng) -> None:
    """Every position and contrast by the model itself."""
    likelihood = Likelihood(simulated(niriss(), [150.0, -80.0, 0.2], rng).only(list(kinds)))
    grid, contrasts = make_grid(100.0, 180.0, 30.0), (0.1, 0.2, 0.6)
    found = exact_map(likelihood, grid, np.empty(0), contrasts)
    expected = [
        likelihood.chi2(np.column_stack([grid.east_mas, grid.north_mas, np.full(len(grid), c)]))
        for c in contrasts
    ]
    np.testing.assert_allclose(found.chi2, expected, rtol=1e-9)
    least = [min(zip(column, contrasts, strict=True))[1] for column in np.transpose(expected)]
    np.testing.assert_array_equal(found.best, least)
    assert len(set(least)) > 1


def test_bright_seeds_cost_no_more_than_they_may(monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions, samples and contrasts of a field whose steps are neither finest nor coarsest."""
    made = []

    def kept(likelihood: Likelihood, grid: Grid, nuisance: np.ndarray, **_: object) -> ExactMap:
        made.append(len(grid) * len(likelihood.samples) * len(LADDER))
        return exact_map(likelihood, grid, nuisance)

    monkeypatch.setattr("amibayes.companion_search.seeds.exact_map", kept)
    # What 6 steps per fringe cost.
    likelihood, box = Likelihood(niriss()), Box(50.0, 300.0, 150.0)
    area = np.pi * (box.outer_mas**2 - box.inner_mas**2) / box.fringe_mas**2
    work = 36.0 * area * len(likelihood.samples) * len(LADDER)
    monkeypatch.setattr("amibayes.companion_search.seeds.EXACT_WORK", work)
    bright_seeds(likelihood, np.empty(0), box)
    assert made[0] == pytest.approx(work, rel=0.05)


def test_work_of_a_search_grows_with_positions_bands_and_rates() -> None:
    """By which the number of null draws is chosen: one product a datum, position and template."""
    data = join([epoch(F430M, 60000.0), epoch(F480M, 60100.0)])
    grid = make_grid(50.0, 300.0, 25.0)

    def bank(**options: object) -> TemplateBank:
        likelihood = Likelihood(data, BinaryModel(**options))  # type: ignore[arg-type]
        return TemplateBank(likelihood, grid, np.empty(0))

    plain = bank()
    assert plain.work == len(grid) * plain.n_rows
    banded = bank(bands=tuple(b.name for b in bands_of(data)))
    assert banded.work == 2 * len(grid) * banded.n_rows
    moving = bank(fastest_mas_yr=50.0)
    assert len(moving.rates_mas_yr) > 1
    assert moving.work == len(moving.rates_mas_yr) * len(grid) * moving.n_rows

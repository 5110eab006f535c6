"""The grid posterior against brute force, Monte Carlo, limits that are known, and itself."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from amibayes.companion_search.search import search
from amibayes.companion_search.with_extra_noise import noise_averaged
from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.quadrature import Marginal
from amibayes.models.binary import BinaryModel
from amibayes.posterior.grid import GridPosterior, grid_posterior, integrable
from amibayes.posterior.integrand import Integrand, polar_cells
from amibayes.posterior.nuisance import log_evidence_none
from amibayes.posterior.priors import Prior, default_prior, edit_prior, parse_setting

FIELD = (50.0, 400.0)


def problem(theta, seed: int = 1, model: BinaryModel | None = None, field=FIELD):
    data = simulated(niriss(), theta, np.random.default_rng(seed), model)
    likelihood = Likelihood(data, replace(model, companions=1) if model else None)
    return likelihood, default_prior(likelihood, *field)


def brute_force(likelihood: Likelihood, prior: Prior, theta) -> float:
    """ln Z of a compact mode: 61³ exact evaluations over ±7 errors around it."""
    axis = np.linspace(-7.0, 7.0, 61)
    box = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    lower = np.linalg.cholesky(likelihood.errors(theta))
    points = np.asarray(theta) + box @ lower.T
    sampled = np.column_stack([points[:, :2], np.log(points[:, 2])])
    log_f = likelihood.log_prob(points) + prior.log_density(sampled) - sampled[:, 2]
    return float(logsumexp(log_f) + 3 * np.log(axis[1] - axis[0]) + np.log(np.linalg.det(lower)))


def truncated(likelihood, start) -> np.ndarray:
    """Gauss–Newton from a good start: the mode, by no code of the search."""
    theta = np.array(start, dtype=float)
    for _ in range(20):
        jacobian = likelihood.jacobian(theta)
        theta += np.linalg.lstsq(jacobian, likelihood.residuals(theta)[:, 0], rcond=None)[0]
    return theta


@pytest.mark.parametrize(
    "contrast", [0.006, 0.8, *(pytest.param(c, marks=pytest.mark.slow) for c in (0.03, 0.3))]
)
def test_evidence_of_a_strong_companion_is_that_of_brute_force(contrast) -> None:
    likelihood, prior = problem([150.0, -80.0, contrast])
    mode = truncated(likelihood, [150.0, -80.0, contrast])
    grid = grid_posterior(likelihood, prior)
    assert grid.log_z == pytest.approx(brute_force(likelihood, prior, mode), abs=0.005)


@pytest.mark.parametrize("contrast", [pytest.param(0.0, marks=pytest.mark.slow), 0.0015])
@pytest.mark.parametrize(
    "wish", ["contrast=1e-5:1", "contrast=uniform:1e-4:0.02", "position=separation"]
)
def test_evidence_of_weak_data_is_the_prior_mean_of_the_likelihood(contrast, wish) -> None:
    """200 000 draws from the prior; 4.5 of their standard errors (2e-6 for all six)."""
    likelihood, prior = problem([150.0, -80.0, contrast])
    prior = edit_prior(prior, [parse_setting(wish)], ())
    grid = grid_posterior(likelihood, prior)
    draws = prior.draw(np.random.default_rng(7), 200_000)
    relative = np.exp(np.concatenate([likelihood.log_prob(t) for t in np.split(draws, 10)])
                      - grid.log_z)  # fmt: skip
    assert abs(relative.mean() - 1.0) < 0.003 + 4.5 * relative.std() / np.sqrt(len(draws))


def test_finer_cells_change_nothing() -> None:
    likelihood, prior = problem([150.0, -80.0, 0.004])
    grid, finer = (grid_posterior(likelihood, prior, step=s) for s in (1.5, 0.75))
    assert len(finer.cells) > 2 * len(grid.cells)
    assert grid.log_z == pytest.approx(finer.log_z, abs=0.005)
    for name in ("east_mas", "north_mas", "separation_mas", "contrast", "position_angle_deg"):
        _, low, high = finer.interval(name)
        assert np.allclose(grid.interval(name), finer.interval(name), atol=0.03 * (high - low))


def test_strong_companion_has_the_gaussian_of_its_fisher_matrix() -> None:
    likelihood, prior = problem([150.0, -80.0, 0.05])
    mode = truncated(likelihood, [150.0, -80.0, 0.05])
    sigma = np.sqrt(np.diag(likelihood.errors(mode)))
    grid = grid_posterior(likelihood, prior)
    for k, name in enumerate(("east_mas", "north_mas", "contrast")):
        median, low, high = grid.interval(name, 0.6827)
        assert median == pytest.approx(mode[k], abs=0.05 * sigma[k])
        assert 0.5 * (high - low) == pytest.approx(sigma[k], rel=0.05)
    median, low, high = grid.interval("delta_mag", 0.6827)
    in_magnitudes = 2.5 / np.log(10.0) * sigma[2] / mode[2]
    assert median == pytest.approx(-2.5 * np.log10(mode[2]), abs=0.05 * in_magnitudes)
    assert 0.5 * (high - low) == pytest.approx(in_magnitudes, rel=0.05)


def test_data_that_say_nothing_leave_the_prior() -> None:
    likelihood = Likelihood(niriss(vis2_error=1e4, closure_error_deg=1e5))
    prior = default_prior(likelihood, *FIELD)
    grid = grid_posterior(likelihood, prior)
    assert grid.log_z == pytest.approx(grid.log_z_none, abs=1e-4)
    for level in (0.05, 0.5, 0.9):
        rho = grid.marginal("separation_mas").quantile(level)
        assert prior.ring_cdf(rho) == pytest.approx(level, abs=0.002)
        assert grid.upper_limit(level) == pytest.approx(1e-5 ** (1.0 - level), rel=0.02)
        assert grid.upper_limit(level, uniform=True) == pytest.approx(level, abs=0.003)
    assert grid.cdf("east_mas", 0.0) == pytest.approx(0.5, abs=1e-3)


def test_masses_of_aliases_are_the_ratio_of_their_gaussians() -> None:
    """Two aliases of the mask share the posterior as brute force around each says."""
    likelihood, prior = problem([150.0, -80.0, 0.02], field=(94.0, 752.0))
    grid = grid_posterior(likelihood, prior)
    east, north = grid.cells.position
    far = grid.probability[np.hypot(east - 150.0, north + 80.0) > 200.0].sum()
    k = int(np.where(np.hypot(east - 150.0, north + 80.0) > 200.0, grid.probability, 0).argmax())
    near_mode = truncated(likelihood, [150.0, -80.0, 0.02])
    alias = truncated(likelihood, [east[k], north[k], 0.02])
    share = grid.mass_near(np.array([near_mode[:2], alias[:2]]), 90.0)
    ratio = brute_force(likelihood, prior, alias) - brute_force(likelihood, prior, near_mode)
    assert 0.0 < far < 1.0
    assert np.log(share[1] / share[0]) == pytest.approx(ratio, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    "free", [("background",), ("diameter_mas",), ("diameter_mas", "background")]
)
def test_nuisance_parameters_are_integrated(free) -> None:
    """Against importance sampling over all dimensions by an independent Gaussian proposal.

    50 000 draws of a t distribution; 5 standard errors and the stated 0.005.
    """
    model = BinaryModel(**{name: "free" for name in free})
    truth = [150.0, -80.0, 0.02] + [{"diameter_mas": 25.0, "background": 0.05}[n] for n in free]
    likelihood, prior = problem(truth, model=model, field=(120.0, 220.0))
    grid = grid_posterior(likelihood, prior, step=2.0)
    mode = truncated(likelihood, truth)
    rng, n = np.random.default_rng(3), 50_000
    scatter = 1.2 * np.linalg.cholesky(likelihood.errors(mode))
    z = rng.standard_normal((n, len(mode))) / np.sqrt(rng.chisquare(6, (n, 1)) / 6)
    theta = mode + z @ scatter.T
    theta = theta[(theta[:, 2:] > 0).all(axis=1)]
    z = np.linalg.solve(scatter, (theta - mode).T).T
    log_q = multivariate_t(np.zeros(len(mode)), np.eye(len(mode)), df=6).logpdf(z)
    log_q -= np.log(np.linalg.det(scatter))
    sampled = theta.copy()
    sampled[:, 2] = np.log(theta[:, 2])
    log_w = likelihood.log_prob(theta) + prior.log_density(sampled) - sampled[:, 2] - log_q
    relative = np.exp(log_w - grid.log_z)
    error = np.sqrt((relative**2).sum() / n - relative.sum() ** 2 / n**2) / np.sqrt(n)
    assert abs(relative.sum() / n - 1.0) < 0.005 + 5.0 * error
    for name in free:
        k = 3 + free.index(name)
        weight = relative / relative.sum()
        mean = float(weight @ theta[:, k])
        median, low, high = grid.interval(name)
        assert abs(median - mean) < 0.15 * (high - low)


def test_evidence_without_a_companion() -> None:
    likelihood, prior = problem([0.0, 0.0, 0.0])
    alone = likelihood.with_model(BinaryModel(companions=0))
    assert log_evidence_none(likelihood, prior) == pytest.approx(
        float(alone.log_prob(np.empty((1, 0)))[0]), abs=1e-12
    )


def test_thirty_six_data_take_less_than_two_seconds() -> None:
    likelihood, prior = problem([150.0, -80.0, 0.01], field=(94.0, 752.0))
    begin = time.process_time()
    grid_posterior(likelihood, prior)
    assert time.process_time() - begin < 4.0  # 1.1 s where nothing else runs


def test_cells_tile_the_field() -> None:
    cells = polar_cells(10.0, 100.0, 7.0)
    cut = cells.halved()
    for tiles in (cells, cut):
        area = 0.5 * (tiles.outer**2 - tiles.inner**2) * (tiles.last - tiles.first)
        assert area.sum() == pytest.approx(np.pi * (100.0**2 - 10.0**2), rel=1e-12)
        assert tiles.size.max() <= 7.0 * 1.01


def test_marginal_of_boxes(rng) -> None:
    low = rng.uniform(-1, 1, 30)
    width = rng.uniform(0.01, 1.0, 30)
    weight = rng.uniform(0.1, 1.0, 30)
    boxes = Marginal(low, low + width, weight)
    x = np.linspace(-1.5, 2.5, 101)
    direct = (np.clip((x[:, None] - low) / width, 0, 1) * weight).sum(axis=1) / weight.sum()
    np.testing.assert_allclose(boxes.cdf(x), direct, atol=1e-12)
    inside = np.linspace(0.01, 0.99, 50)
    np.testing.assert_allclose(boxes.cdf(boxes.quantile(inside)), inside, atol=1e-12)


@pytest.mark.parametrize(
    "text", ["contrast", "contrast=", "contrast=1:0.1", "contrast=0:1", "position=1:2",
             "contrast=normal:1:2", "diameter=x:1", "=1:2", "position=contrast", "contrast=1"],
)  # fmt: skip
def test_impossible_priors_are_refused(text) -> None:
    with pytest.raises(UsageError):
        parse_setting(text)


def test_settings_change_the_prior_they_name() -> None:
    prior = Prior(50.0, 400.0, nuisance=((0.0, 99.0),))
    wishes = ["contrast=uniform:1e-4:0.5", "position=separation", "diameter=0:3", "contrast=1e-3:1"]
    changed = edit_prior(prior, map(parse_setting, wishes), ("diameter_mas",))
    assert changed == Prior(50.0, 400.0, 1e-3, 1.0, ((0.0, 3.0),), "uniform", "separation")
    with pytest.raises(UsageError, match="'background' is not a free parameter"):
        edit_prior(prior, [parse_setting("background=0:1")], ("diameter_mas",))


@pytest.mark.parametrize("contrast", ["log-uniform", "uniform"])
@pytest.mark.parametrize("position", ["area", "separation"])
def test_draws_and_density_of_a_prior_agree(contrast, position) -> None:
    """Means of the density over a box weighted draw: ∫ p = 1, and cdf of draws uniform."""
    prior = Prior(50.0, 400.0, 1e-3, 0.5, ((0.0, 2.0),), contrast, position)
    rng, n = np.random.default_rng(4), 200_000
    x = np.column_stack([rng.uniform(-400, 400, (n, 2)), rng.uniform(-7, 0, n),
                         rng.uniform(-1, 3, n)])  # fmt: skip
    density = np.exp(prior.log_density(x)) * 800.0**2 * 7.0 * 4.0
    assert abs(density.mean() - 1.0) < 5.0 * density.std() / np.sqrt(n)
    theta = prior.draw(rng, n)
    for ranks in (prior.ring_cdf(np.hypot(*theta[:, :2].T)), prior.contrast_cdf(theta[:, 2])):
        assert abs(ranks.mean() - 0.5) < 5.0 / np.sqrt(12 * n)
        assert abs((ranks**2).mean() - 1 / 3) < 5.0 * np.sqrt(4 / 45 / n)


@pytest.mark.parametrize("degrees", [0.0, 35.0, 250.0])
def test_cells_have_the_width_of_their_shape(degrees: float) -> None:
    """Scatter along east and north of points in a cell 4 mas deep and 12 mas wide."""
    angle, rng = np.radians(degrees), np.random.default_rng(1)
    cells = SimpleNamespace(
        centre=(np.array([300.0]), np.array([angle])),
        position=300.0 * np.array([[np.sin(angle)], [np.cos(angle)]]),
        **{"inner": np.array([298.0]), "outer": np.array([302.0])},
        **{"first": np.array([angle - 0.02]), "last": np.array([angle + 0.02])},
    )
    one = SimpleNamespace(cells=cells, probability=np.ones(1))
    rho, turn = rng.uniform(298.0, 302.0, 40_000), rng.uniform(angle - 0.02, angle + 0.02, 40_000)
    for direction, drawn in (((1, 0), rho * np.sin(turn)), ((0, 1), rho * np.cos(turn))):
        found = GridPosterior._along(one, *direction)
        width = float((found.high - found.low)[0])
        assert width / np.sqrt(12.0) == pytest.approx(drawn.std(), rel=0.03)


def test_evidence_of_a_star_that_does_not_fit_has_its_tails() -> None:
    """Extra noise, unknown, takes the place of the companion: the disc is then hardly known."""
    model = BinaryModel(diameter_mas="free")
    data = simulated(niriss(), [150.0, -80.0, 0.05, 20.0], np.random.default_rng(7), model)
    result = search(Likelihood(data, model), FIELD)
    likelihood = noise_averaged(result, None, data)[0].likelihood
    prior = default_prior(likelihood, *FIELD)
    alone, (one,) = single_likelihood(likelihood), prior.ranges
    x = np.linspace(one.low, 150.0, 30_001)
    log = alone.log_prob(x[:, None]) + one.log_density(x)
    expected = log.max() + np.log(np.trapezoid(np.exp(log - log.max()), x))
    assert alone.chi2(result.single_theta[None])[0] > 10.0 * likelihood.n_independent
    assert log_evidence_none(likelihood, prior) == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, True),
        ({"diameter_mas": "free"}, True),
        ({"companion_diameter_mas": "free"}, False),
        ({"fastest_mas_yr": 50.0}, False),
        ({"companions": 2}, False),
        ({"companion_diameter_mas": "free", "fastest_mas_yr": 50.0}, False),
    ],
)
def test_models_whose_dimensions_the_grid_has(options: dict[str, object], *, expected) -> None:
    likelihood = Likelihood(niriss(), BinaryModel(**options))  # type: ignore[arg-type]
    assert integrable(likelihood) is expected


def test_gains_of_cells_are_those_of_their_noise() -> None:
    """Twice that in ln L where errors are stated; no more than the data can give else."""
    likelihood, prior = problem([150.0, -80.0, 0.01])
    peak = np.array([0.0, 3.0, 40.0])
    work = Integrand(likelihood, prior)
    np.testing.assert_allclose(work.delta_chi2(work.best_none + peak), 2.0 * peak, rtol=1e-9)
    data = replace(
        likelihood.observables, covariance_kind="estimated", n_integrations=60, scatter=None
    )
    estimated = Integrand(Likelihood(data), prior)
    gains = np.array([0.0, 3.0, 1e4])
    found = estimated.delta_chi2(estimated.best_none + gains)
    exact = estimated.likelihood.noise.delta_chi2(gains)
    np.testing.assert_allclose(found[:2], exact[:2])
    assert found[2] == pytest.approx(max(estimated.most, 2e4))

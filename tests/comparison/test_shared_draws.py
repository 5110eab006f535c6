"""Evidences of data sets together: against sums over grids, each by itself, and dynesty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from test_comparison import STAR, TRUTHS, base_of, cube_of, fitted

from amibayes.comparison import confusion
from amibayes.comparison.fit_models import fit_model
from amibayes.comparison.fitting import least_squares
from amibayes.comparison.hypotheses import prior_of
from amibayes.comparison.integral import Effort, integrate
from amibayes.comparison.mixture import PriorDraws
from amibayes.comparison.pooled import PooledEffort, pooled_evidences
from amibayes.comparison.unit_cube import CubeModel
from amibayes.posterior.nested import NestedSampler
from amibayes.posterior.sampler import draw_posterior
from amibayes.units import FloatArray


def data_sets(base, n: int) -> FloatArray:
    """The data of a base with more noise each, as if they were observed again."""
    noise = base.noise.draw(n, np.random.default_rng(8))
    return base.observables.data[:, None] + noise


def fits_of(model: CubeModel, data: FloatArray, starts: int) -> tuple[FloatArray, FloatArray]:
    """Fits of data sets from random points."""
    n, d = data.shape[1], model.n_dim
    cube = np.random.default_rng(1).random((n * starts, d))
    found, chi2 = least_squares(model, cube, np.repeat(data, starts, axis=1))
    return found.reshape(n, starts, d), chi2.reshape(n, starts)


def pooled(model: CubeModel, data: FloatArray, starts: int = 20) -> tuple[FloatArray, FloatArray]:
    prior = PriorDraws.of(model, 2048, np.random.default_rng(2))
    fits = fits_of(model, data, starts)
    return pooled_evidences(model, data, *fits, np.random.default_rng(3), prior, PooledEffort())


def test_evidences_of_discs_against_a_grid() -> None:
    """ln Z of a face-on disc of two parameters, summed over a fine grid of its prior."""
    base = base_of("disc", [0.01, 150.0, 1.0, 0.0])
    full = cube_of("disc", base)
    around = (replace(full.likelihood.model.surroundings[0], inclined=False),)
    likelihood = base.with_model(replace(full.likelihood.model, surroundings=around))
    model = CubeModel(full.hypothesis, likelihood, prior_of(likelihood, STAR, ()))
    data = data_sets(base, 6)
    node = (np.arange(300) + 0.5) / 300
    grid = np.stack(np.meshgrid(node, node), axis=-1).reshape(-1, 2)
    predicted = model.predict(grid)
    expected = [logsumexp(model.log_prob_of(predicted, one)) for one in data.T]
    log_z, error = pooled(model, data)
    off = log_z - (np.array(expected) - np.log(len(grid)))
    assert np.all(np.abs(off) < 4.5 * error + 0.01)
    assert error.max() < 0.1


def test_shared_draws_give_what_each_data_set_gives_alone() -> None:
    base = base_of("companion", [110.0, -75.0, 0.004])
    model = cube_of("ring", base)
    data = data_sets(base, 3)
    log_z, error = pooled(model, data)
    cube, chi2 = fits_of(model, data, 20)
    for k, one in enumerate(data.T):
        alone = integrate(model, one, cube[k], chi2[k], np.random.default_rng(k)).diagnostics
        both = np.hypot(error[k], alone["log_z_error"])
        assert log_z[k] == pytest.approx(alone["log_z"], abs=4.5 * both)


def test_pairs_of_models_and_data_have_their_chi2_also_across_the_circle() -> None:
    """A binary of nearly equal stars has closure phases all round the circle."""
    base = base_of("companion", [110.0, -75.0, 0.9], None)
    model = cube_of("companion", base)
    data = data_sets(base, 4)
    theta = np.array([110.0, -75.0, 0.9]) + np.array([[0.0, 0.0, 0.0], [0.1, 0.1, -0.01]])
    predicted = model.predict(model.cube(theta))
    whiten = model.likelihood.noise.whiten
    expected = [(whiten(model.difference(predicted, d[:, None])) ** 2).sum(axis=0) for d in data.T]
    np.testing.assert_allclose(model.chi2_of_pairs(predicted, data), np.transpose(expected))


def test_likelihoods_of_pairs_hold_also_across_the_circle() -> None:
    """Closure phases of nearly equal stars are near ±π, where differences change their sign."""
    base = base_of("companion", [110.0, -75.0, 0.9], None)
    model = cube_of("companion", base)
    data = data_sets(base, 4)
    rng = np.random.default_rng(6)
    theta = np.array([110.0, -75.0, 0.9]) + rng.standard_normal((200, 3)) * [60.0, 60.0, 0.05]
    predicted = model.predict(model.cube(theta))
    found = model.log_prob_of_many(predicted, data, np.full(4, 1e7))
    expected = np.stack([model.log_prob_of(predicted, one) for one in data.T], axis=1)
    apart = np.abs(model.difference(predicted, data[:, :1])[base.observables.n_vis2 :])
    assert 20 < (apart.max(axis=0) > 3.0).sum() < 180
    np.testing.assert_allclose(found, expected)


def test_what_is_far_away_is_left_out_and_nothing_else() -> None:
    base = base_of("companion", TRUTHS["companion"])
    model = cube_of("companion", base)
    data = data_sets(base, 3)
    at = model.cube(np.array(TRUTHS["companion"]))
    rng = np.random.default_rng(4)
    cube = model.inside(at + rng.standard_normal((500, 3)) * rng.choice([0.003, 0.1], (500, 1)))
    predicted = model.predict(cube)
    best = model.chi2_of_pairs(model.predict(at), data)[0]
    found = model.log_prob_of_many(predicted, data, best)
    expected = np.stack([model.log_prob_of(predicted, one) for one in data.T], axis=1)
    left = np.isfinite(found)
    np.testing.assert_allclose(found[left], expected[left])
    assert 50 < left.sum() < left.size
    # What was left out holds less than 1e-8 of any data set's likelihood.
    lost = logsumexp(np.where(left, -np.inf, expected), axis=0) - logsumexp(expected, axis=0)
    assert lost.max() < np.log(1e-8)


def test_light_that_is_not_there_costs_little() -> None:
    """A bright companion and a ring that is none: the fit stands at four edges of the prior.

    The evidence is at most a few e-folds below that of the companion alone: some of the
    decades of flux that the prior allows do not show.
    """
    base = base_of("companion", [110.0, -75.0, 0.04])
    companion = fitted("companion", base)
    both = fit_model(cube_of("ring+companion", base), [companion], np.random.default_rng(0))
    data, rng = base.observables.data, np.random.default_rng(1)
    effort = Effort(4096, 2048)
    alone, beside = (
        integrate(f.model, data, f.cube, f.chi2, rng, effort=effort).diagnostics
        for f in (companion, both)
    )
    assert beside["log_z_error"] < 0.3
    assert -3.0 < beside["log_z"] - alone["log_z"] < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("truth", ["companion", "ring", "crescent"])
@pytest.mark.parametrize("name", ["companion", "ring", "crescent"])
def test_evidence_is_that_of_nested_sampling(truth: str, name: str) -> None:
    """By importance sampling, alone and shared with other data sets, and by dynesty."""
    pytest.importorskip("dynesty")
    faint = {"companion": [110.0, -75.0, 0.004], "ring": [0.01, 250.0, 0.6, 30.0, 0.2]}
    faint["crescent"] = [0.01, 250.0, 0.6, 30.0, 0.2, 0.8, 200.0]
    base = base_of(truth, faint[truth])
    found, data = fitted(name, base), base.observables.data
    alone = integrate(found.model, data, found.cube, found.chi2, np.random.default_rng(1))
    sampler = NestedSampler(live_points=250)
    nested = draw_posterior(
        found.model.likelihood, found.model.prior, np.random.default_rng(2), sampler
    ).diagnostics
    log_z, error = pooled(found.model, np.column_stack([data, data_sets(base, 3)]), 60)
    pairs = [(alone.diagnostics["log_z"], alone.diagnostics["log_z_error"]), (log_z[0], error[0])]
    for value, its_error in pairs:
        both = np.hypot(its_error, nested["log_z_error"])
        assert value == pytest.approx(nested["log_z"], abs=4.5 * both)


def test_draws_that_miss_the_posterior_give_way_to_laplace(monkeypatch) -> None:
    """Only where they are too small: ln Z is that of a careful integral then."""
    base = base_of("companion", TRUTHS["companion"])
    fit = fitted("companion", base)
    data = np.repeat(base.observables.data[:, None], 2, axis=1)
    missed = np.array([-1e3, 1e3]), np.ones(2)
    monkeypatch.setattr(confusion, "pooled_evidences", lambda *_: missed)
    prior = PriorDraws.of(fit.model, 16, np.random.default_rng(1))
    tried = np.repeat(fit.cube[None], 2, axis=0), np.repeat(fit.chi2[None], 2, axis=0)
    best = np.full(2, -np.inf)
    found = confusion._evidence(fit, data, tried, np.random.default_rng(2), prior, best)
    rng = np.random.default_rng(3)
    careful = integrate(fit.model, data[:, 0], fit.cube, fit.chi2, rng).diagnostics["log_z"]
    assert found[0] == pytest.approx(careful, abs=0.3)
    assert found[1] == 1e3

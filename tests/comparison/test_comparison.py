"""Fits against brute force, evidences against integrals, verdicts against truths."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy.special import logsumexp

from amibayes.companion_search.search import search
from amibayes.comparison.best_fits import NoiseSetting, _best_noise, best_fits
from amibayes.comparison.compare import compare_sky_models
from amibayes.comparison.fit_models import embedded, fit_model
from amibayes.comparison.fitting import least_squares
from amibayes.comparison.hypotheses import Hypothesis, hypotheses, prior_of
from amibayes.comparison.integral import Effort, integrate, log_z_laplace
from amibayes.comparison.summary import _interval
from amibayes.comparison.unit_cube import CubeModel
from amibayes.comparison.verdict import Confusion, choose
from amibayes.data.systematics import Systematics
from amibayes.errors import UsageError
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior, with_noise
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.binary import BinaryModel
from amibayes.posterior.priors import Prior, PriorSetting

STAR = Prior(60.0, 400.0, contrast_min=1e-4)

SLOW = pytest.mark.slow

TRUTHS = {
    "companion": [110.0, -75.0, 0.02],
    "disc": [0.05, 150.0, 0.6, 30.0],
    "ring": [0.05, 250.0, 0.6, 30.0, 0.2],
    "crescent": [0.05, 250.0, 0.6, 30.0, 0.2, 0.8, 200.0],
    "ring+companion": [110.0, -75.0, 0.02, 0.05, 300.0, 0.6, 30.0, 0.2],
}


def base_of(name: str, theta: list[float], seed: int | None = 1) -> Likelihood:
    """NIRISS data of a model, and the likelihood of a star without a disc of its own."""
    model = Hypothesis(name).model(BinaryModel())
    rng = None if seed is None else np.random.default_rng(seed)
    return Likelihood(simulated(niriss(), theta, rng, model))


def cube_of(name: str, base: Likelihood) -> CubeModel:
    one = Hypothesis(name)
    likelihood = one.likelihood(base)
    star = single_likelihood(base).parameters.names
    return CubeModel(one, likelihood, prior_of(likelihood, STAR, star))


def fitted(name: str, base: Likelihood, seed: int = 0):
    star = fit_model(cube_of("star", base), (), np.random.default_rng(0))
    return fit_model(cube_of(name, base), [star], np.random.default_rng(seed))


@pytest.mark.parametrize("name", ["companion", "ring", "crescent"])
def test_the_cube_and_back(name: str, rng) -> None:
    model = cube_of(name, base_of("companion", TRUTHS["companion"]))
    cube = rng.random((50, model.n_dim))
    np.testing.assert_allclose(model.cube(model.theta(cube)), cube, atol=1e-9)


@pytest.mark.parametrize("name", ["companion", "ring", "crescent"])
def test_slopes_by_the_cube_against_differences(name: str, rng) -> None:
    model = cube_of(name, base_of(name, TRUTHS[name]))
    cube = rng.uniform(0.2, 0.8, (3, model.n_dim))
    predicted, slopes = model.linear(cube)
    np.testing.assert_allclose(predicted, model.predict(cube), atol=1e-12)
    h = 1e-5
    for k in range(model.n_dim):
        step = np.eye(model.n_dim)[k] * h
        change = (model.predict(cube + step) - model.predict(cube - step)) / (2.0 * h)
        white = model.likelihood.noise.whiten(change).T
        np.testing.assert_allclose(slopes[:, :, k], white, atol=2e-4 * np.abs(white).max() + 1e-4)


@pytest.mark.parametrize(
    "truth",
    ["companion", "disc", *(pytest.param(t, marks=pytest.mark.slow) for t in ("ring", "crescent"))],
)
@pytest.mark.parametrize("name", ["companion", "disc", "ring", "crescent"])
def test_search_is_as_good_as_brute_force(truth: str, name: str) -> None:
    """Fits from hundreds of random points find nothing that the search does not."""
    base = base_of(truth, TRUTHS[truth])
    found = fitted(name, base)
    starts = np.random.default_rng(99).random((600, found.model.n_dim))
    data = np.tile(base.observables.data[:, None], (1, len(starts)))
    _, chi2 = least_squares(found.model, starts, data)
    assert found.chi2[0] < chi2.min() + 1.0


@pytest.mark.parametrize(("truth", "narrowed"), [("companion", False), ("disc", True)])
def test_the_field_is_the_default_one_again_where_other_light_explains_the_data(
    truth: str, narrowed: bool
) -> None:
    """A search that looked farther out did so for a companion, which it did not find inside."""
    base = base_of(truth, TRUTHS[truth])
    result = SimpleNamespace(likelihood=base, modes=[SimpleNamespace(theta=TRUTHS["companion"])])
    asked = [Hypothesis(name) for name in ("star", "companion", "disc")]
    wide, default = Prior(60.0, 700.0, contrast_min=1e-4), (70.0, 380.0)
    streams = [np.random.default_rng(k) for k in range(4)]
    fits, _ = best_fits(asked, result, wide, None, NoiseSetting(), (), default, streams)
    found = fits[1].model.prior
    expected = default if narrowed else (60.0, 700.0)
    assert (found.inner_mas, found.outer_mas) == expected
    assert expected[0] <= np.hypot(*fits[1].theta[:2]) <= expected[1]


def test_least_squares_finds_the_truth() -> None:
    base = base_of("crescent", TRUTHS["crescent"], None)
    found = fitted("crescent", base)
    np.testing.assert_allclose(found.theta, TRUTHS["crescent"], rtol=1e-3)


@pytest.mark.parametrize("least", [1e-3, 5e-3])
def test_a_prior_without_faint_companions_finds_the_bright_one(least: float) -> None:
    """Its least contrast is that of the linear templates, or above it."""
    base = base_of("companion", TRUTHS["companion"])
    model = cube_of("companion", base)
    model = replace(model, prior=replace(model.prior, contrast_min=least))
    found = fit_model(
        model,
        [fit_model(cube_of("star", base), (), np.random.default_rng(0))],
        np.random.default_rng(0),
    )
    (bank,) = found.banks
    assert np.isfinite(bank.faint).all()
    seeds = model.theta(bank.seeds(base.observables.data[:, None])[0])
    assert np.hypot(*(seeds[:, :2] - TRUTHS["companion"][:2]).T).min() < 40.0
    np.testing.assert_allclose(found.theta[:2], TRUTHS["companion"][:2], atol=6.0)


def test_evidence_of_a_disc_against_a_grid() -> None:
    """ln Z of a face-on disc of two parameters, summed over a fine grid of its prior."""
    base = base_of("disc", [0.01, 150.0, 1.0, 0.0])
    full = cube_of("disc", base)
    surroundings = (replace(full.likelihood.model.surroundings[0], inclined=False),)
    likelihood = base.with_model(replace(full.likelihood.model, surroundings=surroundings))
    model = CubeModel(full.hypothesis, likelihood, prior_of(likelihood, STAR, ()))
    data = base.observables.data
    node = (np.arange(400) + 0.5) / 400
    grid = np.stack(np.meshgrid(node, node), axis=-1).reshape(-1, 2)
    expected = logsumexp(model.log_prob(grid, data)) - np.log(len(grid))
    starts = np.random.default_rng(1).random((30, 2))
    cube, chi2 = least_squares(model, starts, np.tile(data[:, None], (1, 30)))
    found = integrate(
        model, data, cube, chi2, np.random.default_rng(2), effort=Effort(2000, 2000)
    ).diagnostics
    assert found["log_z"] == pytest.approx(expected, abs=5.0 * found["log_z_error"] + 0.01)


def test_evidence_error_is_its_scatter() -> None:
    base = base_of("crescent", [0.01, 250.0, 0.6, 30.0, 0.2, 0.8, 200.0])
    found = fitted("crescent", base)
    draws = [
        integrate(
            found.model,
            base.observables.data,
            found.cube,
            found.chi2,
            np.random.default_rng(k),
            effort=Effort(1000, 1000, 0),
        ).diagnostics
        for k in range(12)
    ]
    scatter = np.std([d["log_z"] for d in draws], ddof=1)
    stated = np.mean([d["log_z_error"] for d in draws])
    # The scatter of 12 has an error of 20 %; the error of the error is as large again.
    assert 0.3 < scatter / stated < 3.0


@pytest.mark.parametrize(
    "truth",
    ["companion", *(pytest.param(t, marks=SLOW) for t in ("ring", "crescent", "ring+companion"))],
)
def test_bright_truths_are_chosen(truth: str) -> None:
    base = base_of(truth, TRUTHS[truth])
    result = search(base, (60.0, 400.0))
    names = dict.fromkeys(["star", "companion", "ring", "crescent", truth])
    found = compare_sky_models(
        result, STAR, np.random.default_rng(3), models=list(names), confusion_draws=0
    )
    assert found.verdict.statement in (truth, "extended light" if truth == "ring" else truth)
    best = {m.name: m for m in found.models}[truth]
    assert best.p_fit > 1e-4
    assert found.probability.sum() == pytest.approx(1.0)


def test_a_lone_star_is_one() -> None:
    base = base_of("star", [])
    result = search(base, (60.0, 400.0))
    found = compare_sky_models(
        result,
        STAR,
        np.random.default_rng(3),
        models=["star", "companion", "disc"],
        confusion_draws=4,
    )
    assert found.verdict.statement == "star"
    names, share = found.confusion.taken_for()
    assert names == ("star", "companion", "disc", "undecided")
    np.testing.assert_allclose(share.sum(axis=1), 1.0)
    assert share[0, 0] > 0.5


@pytest.mark.slow
def test_noise_is_that_of_the_best_model() -> None:
    """A ring in a search for a companion looks like noise; the comparison takes that back."""
    base = base_of("ring", [0.2, 250.0, 0.6, 30.0, 0.2])
    from amibayes.companion_search.with_extra_noise import search_with_noise
    from amibayes.likelihood.extra_noise import NoisePrior

    prior = NoisePrior(0.05, np.radians(3.0))
    result, noise = search_with_noise(base, (60.0, 400.0), prior=prior)
    assert noise.vis2 > 0.0
    found = compare_sky_models(
        result,
        STAR,
        np.random.default_rng(3),
        models=["companion", "ring"],
        stated=base.observables,
        noise=NoiseSetting(noise, prior),
        confusion_draws=0,
    )
    assert found.noise.vis2 == 0.0
    assert found.verdict.statement == "ring"


def test_a_crescent_begins_where_the_ring_is() -> None:
    base = base_of("ring", TRUTHS["ring"])
    ring, crescent = cube_of("ring", base), cube_of("crescent", base)
    at = ring.cube(np.array(TRUTHS["ring"]))[0]
    same = embedded(crescent, ring, at)
    np.testing.assert_allclose(crescent.predict(same[None]), ring.predict(at[None]), atol=1e-12)


def test_names_that_are_none_are_refused() -> None:
    with pytest.raises(UsageError, match="no model of the sky"):
        hypotheses(["star", "spiral"])
    with pytest.raises(UsageError, match="both"):
        hypotheses(["two+companion"])


def test_priors_can_be_changed() -> None:
    base = base_of("ring", TRUTHS["ring"])
    likelihood = Hypothesis("ring").likelihood(base)
    wish = [PriorSetting("ring_diameter", None, (100.0, 200.0))]
    prior = prior_of(likelihood, STAR, (), wish)
    assert prior.nuisance[1] == (100.0, 200.0)
    drawn = prior.from_cube(np.random.default_rng(1).random((1000, 5)))
    assert drawn[:, 1].min() >= 100.0
    # Log-uniform: half of them below the geometric mean, within 5 sigma.
    assert (drawn[:, 1] < np.sqrt(2e4)).mean() == pytest.approx(0.5, abs=0.08)


def test_a_model_that_holds_the_chosen_one_is_no_rival() -> None:
    """A ring too faint to be seen beside the companion does not make the companion doubtful."""
    models = hypotheses(["star", "companion", "ring+companion", "ring"])
    log_z, even = np.array([0.0, 30.0, 29.0, 5.0]), np.zeros(4)
    assert choose(models, log_z, even, None).statement == "companion"
    assert choose(models, log_z + np.eye(4)[2] * 3.0, even, None).statement == "undecided"
    assert choose(models, log_z + np.eye(4)[2] * 9.0, even, None).statement == "ring+companion"
    assert choose(models, np.array([9.0, 7.0, 6.0, 7.0]), even, None).statement == "star"


def confusion(odds: float, models) -> Confusion:
    """Data sets of two models, whose ln odds are the same in all."""
    log_z = np.array([[[odds, 0.0]] * 40, [[0.0, odds]] * 40])
    return Confusion(models, log_z, np.full(2, -np.log(2.0)))


def test_choice_by_odds_and_by_confusion() -> None:
    models = hypotheses(["companion", "ring"])
    half = np.full(2, -np.log(2.0))
    sure = choose(models, np.array([10.0, 0.0]), half, confusion(10.0, models))
    assert sure.statement == "companion"
    assert sure.p_confused == pytest.approx(1.0 / 41.0)
    close = choose(models, np.array([1.0, 0.0]), half, confusion(10.0, models))
    assert close.statement == "undecided"
    # Rings that look like companions: all of them favour a companion by as much.
    lucky = confusion(10.0, models)
    lucky.log_z[1] = [10.0, 0.0]
    assert choose(models, np.array([10.0, 0.0]), half, lucky).statement == "undecided"


def test_laplace_of_a_strong_fit_is_near_the_integral() -> None:
    base = base_of("companion", TRUTHS["companion"])
    found = fitted("companion", base)
    data = base.observables.data
    sampled = integrate(found.model, data, found.cube, found.chi2, np.random.default_rng(1))
    laplace = log_z_laplace(found.model, data, found.cube, found.chi2)
    assert laplace == pytest.approx(sampled.diagnostics["log_z"], abs=1.0)


@pytest.mark.parametrize("of_search", [ExtraNoise(0.3), ExtraNoise()])
def test_noise_is_that_of_the_most_likely_model_with_its_own(of_search: ExtraNoise) -> None:
    """A companion of 10 % that the star alone would take for noise; errors are as stated."""
    base = base_of("companion", [110.0, -75.0, 0.1])
    fits = [fitted(name, base) for name in ("star", "companion")]
    setting = NoiseSetting(of_search, NoisePrior())
    clean = base.observables
    noisy = with_noise(base, of_search)
    likely = _best_noise(fits, noisy, clean, setting)
    assert (likely.of.name, likely.noise.any) == ("companion", False)
    at = fits[1].theta[None]
    assert likely.likelihood.log_prob(at) == pytest.approx(base.log_prob(at))


def test_the_averaged_noise_has_the_errors_that_data_are_simulated_with() -> None:
    """With coherent errors, which are largest in closure phases of faint fringes."""
    model = BinaryModel(1, diameter_mas=210.0)
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1), model)
    floor = Systematics(data.setups[0].source, 0.03, np.radians(0.5), 0.005)
    prior = NoisePrior(0.05, np.radians(3.0), True, (floor,))
    base = Likelihood(data, model)
    found = compare_sky_models(
        search(base, (60.0, 400.0)),
        STAR,
        np.random.default_rng(3),
        models=["star", "companion"],
        stated=data,
        noise=NoiseSetting(prior=prior),
        confusion_draws=0,
    )
    noise = found.models[0].fit.model.likelihood.noise
    drawn = noise.draw(2000, np.random.default_rng(4))
    for term in noise.terms:
        size = (term.white(drawn) ** 2).sum(axis=0).mean() / term.n_independent
        assert 0.5 < size < 2.0


@pytest.mark.parametrize("turn", [360.0, 180.0])
@pytest.mark.parametrize("middle", [0.0, 0.25, 0.5, 0.75])
def test_angles_spread_over_most_of_a_turn_are_cut_opposite_their_mean(
    turn: float, middle: float
) -> None:
    """A uniform distribution of two thirds of a turn: 68 % of it about its middle."""
    x = np.linspace(-1.0 / 3.0, 1.0 / 3.0, 4001)
    values = turn * ((middle + x) % 1.0)
    found = _interval(0.0, values, np.full(4001, 1.0 / 4001), turn)
    half = 0.68 * turn / 3.0
    assert (found.upper - found.median, found.median - found.lower) == pytest.approx(
        (half, half), abs=1e-3 * turn
    )
    assert (found.median / turn - middle + 0.5) % 1.0 == pytest.approx(0.5, abs=1e-3)
    assert -1e-9 * turn <= found.median < turn


@pytest.mark.parametrize(("turn", "middle"), [(360.0, 2.0), (180.0, 175.0), (0.0, -3.0)])
def test_intervals_of_angles_do_not_care_where_the_turn_begins(turn: float, middle: float) -> None:
    """Quantiles of a normal distribution, weighted unevenly, that goes across the turn's end."""
    x = np.linspace(-60.0, 60.0, 4001)
    weights = np.exp(-0.5 * (x / 8.0) ** 2)
    values = (middle + x) % turn if turn else middle + x
    found = _interval(middle, values, weights / weights.sum(), turn)
    one = 8.0 * 0.99446
    assert (found.median, found.lower, found.upper) == pytest.approx(
        (middle, middle - one, middle + one), abs=0.05
    )

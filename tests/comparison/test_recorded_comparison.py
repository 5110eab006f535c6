"""Numbers of compared models as they were recorded: a change of any of them is seen.

`pytest tests/comparison/test_recorded_comparison.py --force-regen` records them anew.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from recorded_numbers import numbers_of
from test_comparison import TRUTHS, base_of, cube_of

from amibayes.companion_search.search import search
from amibayes.comparison.best_fits import NoiseSetting, _simpler
from amibayes.comparison.compare import compare_sky_models, is_degenerate, largest_log_prob
from amibayes.comparison.fit_models import (
    ModelFit,
    embedded,
    fit_model,
    innermost,
    n_starts,
    references,
)
from amibayes.comparison.fitting import SeedBank, least_squares
from amibayes.comparison.hypotheses import (
    Hypothesis,
    groups,
    hypotheses,
    periodic,
    prior_of,
    split_settings,
)
from amibayes.comparison.integral import Effort, integrate, log_z_laplace
from amibayes.comparison.mixture import (
    Mixture,
    PriorDraws,
    WeightedDraws,
    first_mixture,
    laplace_shapes,
    off_edges,
    weighted,
)
from amibayes.comparison.pooled import PooledEffort, pooled_evidences
from amibayes.comparison.summary import _interval, intervals, weighted_quantile
from amibayes.comparison.verdict import Choice, Confusion, candidates, choose
from amibayes.likelihood.extra_noise import NoisePrior
from amibayes.likelihood.likelihood import Likelihood
from amibayes.posterior.priors import Prior, PriorSetting

TOLERANCE = {"rtol": 0.0, "atol": 1e-4}
NAMES = ("companion", "crescent", "two", "ring+companion", "halo")
EFFORT = Effort(prior=256, modes=256, repeats=1, centres=4, rounds=2)


def points_of(model: Any, n: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 0.9, (n, model.n_dim))


@pytest.fixture(scope="module")
def base() -> Likelihood:
    return base_of("companion", TRUTHS["companion"])


@pytest.fixture(scope="module")
def fits(base: Likelihood) -> list[ModelFit]:
    """The star, a companion and a ring, from few points each."""
    star = fit_model(cube_of("star", base), (), np.random.default_rng(0))
    found = [star]
    for name, truth in (("companion", "companion"), ("ring", "ring")):
        model = cube_of(name, base)
        start = model.cube(np.array(TRUTHS[truth]))
        data = np.repeat(base.observables.data[:, None], 3, axis=1)
        starts = np.clip(start + np.array([[0.0], [0.01], [-0.02]]), 0.0, 1.0)
        cube, chi2 = least_squares(model, starts, data, 8)
        order = np.argsort(chi2)
        found.append(ModelFit(model, cube[order], chi2[order], ()))
    return found


def test_models_of_the_unit_cube(base: Likelihood, num_regression) -> None:
    numbers: dict[str, Any] = {}
    for name in NAMES:
        model = cube_of(name, base)
        cube = points_of(model, 3)
        data = base.observables.data
        predicted, slopes = model.linear(cube)
        many = np.column_stack([data, predicted[:, 0] + 0.001, predicted[:, 1]])
        best = np.array([40.0, 3.0, 3.0])
        chi2 = np.array([40.0, 400.0])
        shapes = laplace_shapes(model, cube, np.array([1.0, 3.0, 1.5]))
        found = {
            "theta": model.theta(cube),
            "back": model.cube(model.theta(cube)),
            "predicted": predicted,
            "slopes": slopes.transpose(0, 2, 1) @ slopes,
            "log_prob": model.log_prob(cube, data),
            "of_many": model.log_prob_of_many(predicted, many, best),
            "pairs": model.chi2_of_pairs(predicted, many),
            "inflation": model.inflation(chi2),
            "apart": model.apart(cube, 1.0 - cube[:1]),
            "inside": model.inside(cube + 0.7),
            "brighter": model.brighter_first(cube),
            "names": model.log_names,
            "turning": model.turning,
            "periodic": periodic(model.likelihood),
            "groups": groups(model.likelihood),
            "prior": model.prior,
            "shapes": shapes,
            "off_edges": off_edges(model, np.round(cube), 0.3 * shapes),
            "laplace": log_z_laplace(model, data, cube, np.array([50.0, 40.0, 45.0])),
            "starts": n_starts(model),
            "fitted": least_squares(model, cube, np.repeat(data[:, None], 3, axis=1), 2),
        }
        numbers |= numbers_of(**{name: found})
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_mixtures(base: Likelihood, num_regression) -> None:
    numbers: dict[str, Any] = {}
    for name in ("companion", "two"):
        model = cube_of(name, base)
        n_dim, rng = model.n_dim, np.random.default_rng(3)
        centre = points_of(model, 2)
        root = 0.05 * np.eye(n_dim) + 0.01 * np.tri(n_dim, k=-1)
        mixture = Mixture(model, centre, np.stack([root, 2.0 * root]), np.array([0.3, 0.7]))
        other = Mixture(model, 1.0 - centre, np.stack([root, root]), np.array([0.6, 0.4]))
        both = mixture.beside(other)
        drawn = both.draw(60, rng)
        log_prob = -0.5 * (((drawn - centre[0]) / 0.1) ** 2).sum(axis=1)
        weights = WeightedDraws(drawn, log_prob[:, None], log_prob[:, None] + 3.0, 80)
        adapted = both.adapted(weights)
        prior = PriorDraws.of(model, 40, rng)
        known = model.log_prob_of(prior.predicted, base.observables.data)[:, None]
        log_prob = partial(model.log_prob, data=base.observables.data)
        again = weighted(both, prior, known, lambda x, of=log_prob: of(x)[:, None], 50, rng)
        starts = points_of(model, 6, 2)
        chi2 = np.array([40.0, 41.0, 50.0, 43.0, 300.0, 44.0])
        first = first_mixture(model, starts[None], chi2[None], 3)
        numbers |= numbers_of(
            **{
                name: {
                    "drawn": drawn,
                    "parts": both.log_parts(drawn),
                    "log_z": weights.log_z,
                    "adapted": (adapted.centre, adapted.scatter, adapted.share),
                    "again": again,
                    "first": (first.centre, first.scatter, first.share),
                }
            }
        )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_fits_and_evidences(base: Likelihood, fits: list[ModelFit], num_regression) -> None:
    _, one, ring = fits
    data = base.observables.data
    noise = 0.3 * np.sqrt(base.observables.covariance.variance)
    many = np.column_stack([data, data + noise, data - noise])
    draws = integrate(one.model, data, one.cube, one.chi2, np.random.default_rng(2), effort=EFFORT)
    prior = PriorDraws.of(one.model, 256, np.random.default_rng(3))
    pooled = pooled_evidences(
        one.model,
        many,
        np.repeat(one.cube[None], 3, axis=0),
        np.repeat(one.chi2[None], 3, axis=0),
        np.random.default_rng(4),
        prior,
        PooledEffort(256, 256, 4, 1),
    )
    columns, flux = one.model.groups[0]
    bank = SeedBank.of(one.model, one.cube[0], columns, flux, 5)
    seeds = bank.seeds(many)
    numbers = numbers_of(
        chi2=[f.chi2 for f in fits],
        theta=[f.theta for f in fits],
        best=[largest_log_prob(f) for f in fits],
        integrated=(draws.samples, draws.log_prob, draws.weights),
        evidence=draws.diagnostics,
        pooled=pooled,
        seeds=seeds,
        bank=(bank.without, bank.faint.sum(axis=1), bank.bright.sum(axis=1)),
        embedded=[
            embedded(cube_of("two", base), one.model, one.cube[0]),
            embedded(cube_of("crescent", base), ring.model, ring.cube[0]),
            embedded(cube_of("ring+companion", base), one.model, one.cube[0]),
        ],
        references=[references(f).shape for f in fits[1:]],
        innermost=[innermost(f.model, f.cube, f.chi2) for f in fits],
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_compared_models(monkeypatch: pytest.MonkeyPatch, num_regression) -> None:
    monkeypatch.setattr("amibayes.comparison.compare.DRAWS_VALUES", 10)
    monkeypatch.setattr("amibayes.comparison.confusion.QUICK", PooledEffort(128, 128, 4, 1))
    monkeypatch.setattr("amibayes.comparison.confusion.THOROUGH", PooledEffort(128, 256, 4, 1))
    monkeypatch.setattr("amibayes.comparison.fitting.MAX_BANK", 1024)
    base = base_of("companion", [150.0, -80.0, 0.01])
    result = search(base, (140.0, 200.0), check=False)
    found = compare_sky_models(
        result,
        Prior(140.0, 200.0, contrast_min=1e-4),
        np.random.default_rng(2),
        models=("star", "companion"),
        stated=base.observables,
        noise=NoiseSetting(prior=NoisePrior()),
        confusion_draws=3,
    )
    assert found.confusion is not None
    model = found.models[1]
    numbers = numbers_of(
        log_z=[(m.log_z, m.log_z_error) for m in found.models],
        fit=[(m.chi2, m.ndof, m.p_fit) for m in found.models],
        theta=model.theta,
        probability=found.probability,
        small=is_degenerate(model),
        confusion=found.confusion.log_z,
        intervals=intervals(model),
        p_confused=found.verdict.p_confused,
    )
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-3})


def test_choices_and_summaries(base: Likelihood, num_regression) -> None:
    asked = hypotheses(("star", "companion", "two", "ring", "ring+companion", "crescent"))
    rng = np.random.default_rng(5)
    log_prior = np.full(len(asked), -np.log(len(asked)))
    simulated = 3.0 * rng.standard_normal((6, 30, 6)) + 4.0 * np.eye(6)[:, None]
    confusion = Confusion(asked, simulated, log_prior)
    cases = [
        choose(asked, 6.0 * np.eye(6)[k] + 2.0 * np.eye(6)[(k + 3) % 6], log_prior, confusion)
        for k in range(6)
    ]
    near = choose(asked, np.array([0.0, 3.0, 3.0, 0.0, 0.0, 0.0]), log_prior, confusion)
    values = np.random.default_rng(6).normal(2.0, 20.0, 200)
    weights = np.random.default_rng(7).random(200)
    weights /= weights.sum()
    probability = np.random.default_rng(8).dirichlet(np.ones(6) * 0.3, 50)
    settings = [PriorSetting("ring_diameter", None, (30.0, 200.0))]
    numbers = numbers_of(
        choices=[(v.probability, v.p_confused, len(v.statement)) for v in (*cases, near)],
        taken=confusion.taken_for()[1],
        probability=confusion.probability,
        made=[Choice.of(asked, g).made(probability).sum() for _, g in candidates(asked)],
        holders=[Choice.of(asked, g).holders for _, g in candidates(asked)],
        within=[[a.within(b) for b in asked] for a in asked],
        simpler=[len(_simpler(one)) for one in asked],
        intervals=[
            _interval(1.0, values % turn if turn else values, weights, turn)
            for turn in (0.0, 180.0, 360.0)
        ],
        quantile=weighted_quantile(values, weights, (0.1, 0.5, 0.9)),
        prior=prior_of(Hypothesis("ring").likelihood(base), Prior(60.0, 400.0), (), settings),
        split=[len(x) for x in split_settings(settings, ("ring",), background=False)],
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)

"""Evidences of models that do not fit, where noise of unknown amount makes up for it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.comparison.best_fits import NoiseSetting
from amibayes.comparison.compare import Compared, compare_sky_models
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions, noise_prior
from amibayes.posterior.nested import NestedSampler
from amibayes.posterior.priors import default_prior
from amibayes.posterior.sampler import draw_posterior, log_mean

WIDE = 6.0
"""Fall of ln L at which the box around the best fit ends."""


@pytest.fixture(scope="module")
def crescent() -> Compared:
    """Of a companion at 342 mas: an edge-on ellipse at edges of its prior, χ² of 200 per datum."""
    data = simulated(niriss(), [334.6, -68.8, 0.0417], np.random.default_rng(1))
    options = SearchOptions(separation_mas=(60.0, 400.0))
    found = search_field(data, options)
    grid = found.result.grid
    both = compare_sky_models(
        found.result,
        default_prior(found.result.likelihood, grid.inner_mas, grid.outer_mas),
        np.random.default_rng(2),
        models=("companion", "crescent"),
        stated=data,
        noise=NoiseSetting(found.noise, noise_prior(data, options)),
        confusion_draws=0,
    )
    assert both.verdict.statement == "companion"
    return both.models[1]


def test_evidence_holds_that_of_a_box_around_the_best_fit(crescent: Compared) -> None:
    """A mean of the likelihood over a part of the prior: a bound from below."""
    model, best = crescent.fit.model, crescent.fit.cube[0]
    data = model.likelihood.observables.data
    node = np.linspace(0.0, 1.0, 401)
    low, high = np.empty((2, model.n_dim))
    for k in range(model.n_dim):
        line = np.tile(best, (len(node), 1))
        line[:, k] = node
        value = model.log_prob(line, data)
        inside = node[value > value.max() - WIDE]
        low[k], high[k] = inside.min(), inside.max()
    n = 40_000
    cube = low + np.random.default_rng(3).random((n, model.n_dim)) * (high - low)
    log_mean_in_box, error = log_mean(model.log_prob(cube, data), n)
    bound = log_mean_in_box + np.log(high - low).sum()
    both = np.hypot(float(error), crescent.log_z_error)
    assert both < 0.6
    assert crescent.log_z > bound - 4.5 * both


@pytest.mark.slow
def test_evidence_is_that_of_nested_sampling(crescent: Compared) -> None:
    pytest.importorskip("dynesty")
    model = crescent.fit.model
    nested = draw_posterior(
        model.likelihood, model.prior, np.random.default_rng(4), NestedSampler(live_points=250)
    ).diagnostics
    both = np.hypot(nested["log_z_error"], crescent.log_z_error)
    assert crescent.log_z == pytest.approx(nested["log_z"], abs=4.5 * both)

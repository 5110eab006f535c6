"""A bound of the contrast is stated where the data make it, not the prior."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from helpers import niriss, simulated

from amibayes.likelihood.likelihood import Likelihood
from amibayes.posterior.grid import grid_posterior
from amibayes.posterior.priors import default_prior
from amibayes.report.result import upper_limit


def bounded(vis2_error: float, closure_error_deg: float, rng):
    """The bound of a star alone, as a report has it."""
    sheet = niriss(vis2_error=vis2_error, closure_error_deg=closure_error_deg)
    likelihood = Likelihood(simulated(sheet, [0.0, 0.0, 0.0], rng))
    prior = default_prior(likelihood, 50.0, 400.0)
    grid = grid_posterior(likelihood, prior)
    tested = SimpleNamespace(detected=False)
    posterior = SimpleNamespace(prior=prior)
    parts = {"significance": tested, "posterior": posterior, "grid": grid}
    return upper_limit(SimpleNamespace(statement="no companion", **parts))


def test_a_bound_by_the_data_is_that_of_a_uniform_contrast(rng) -> None:
    limit = bounded(0.005, 0.3, rng)
    assert limit is not None
    assert limit["contrast"] > limit["contrast_stated_prior"]
    assert 1e-3 < limit["contrast"] < 0.02
    assert limit["prior"].startswith("contrast uniform from ")


@pytest.mark.parametrize("detected", [False, True])
def test_a_bound_by_the_prior_is_not_stated(rng, detected: bool) -> None:
    assert bounded(1e4, 1e5, rng) is None
    if detected:
        report = SimpleNamespace(
            significance=SimpleNamespace(detected=True), posterior=1, grid=SimpleNamespace()
        )
        assert upper_limit(report) is None

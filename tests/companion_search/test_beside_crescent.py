"""A companion beside lopsided light, whose visibility without it is complex."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.companion_search.exact_map import exact_map
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.search import search
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.comparison.hypotheses import EXTENDED
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel

CRESCENT = np.array([0.05, 220.0, 0.7, 40.0, 0.2, 0.9, 250.0])
MODEL = BinaryModel(1, surroundings=(EXTENDED["crescent"],))


def likelihood_of(contrast: float, rng: np.random.Generator | None = None) -> Likelihood:
    theta = [-120.0, 90.0, contrast, *CRESCENT]
    return Likelihood(simulated(niriss(0.003, 0.1), theta, rng, MODEL), MODEL)


@pytest.mark.parametrize("place", [(-120.0, 90.0), (120.0, -90.0), (40.0, 200.0)])
def test_templates_are_the_model_s_slopes(place: tuple[float, float]) -> None:
    """By differences of the model in the contrast, at positions and at their opposites."""
    likelihood = likelihood_of(0.0)
    bank = TemplateBank(likelihood, make_grid(94.0, 300.0, 25.0), CRESCENT)
    rest = np.random.default_rng(1).normal(size=likelihood.n_independent)
    contrast, sigma = bank.scan_at(rest, *(np.array([p]) for p in place))
    ends = likelihood.predict([[*place, c, *CRESCENT] for c in (2e-6, 0.0)])
    slope = likelihood.noise.whiten((ends[:, :1] - ends[:, 1:]) / 2e-6)[:, 0]
    slope = bank.project(slope[:, None])[:, 0]
    assert 1.0 / sigma[0] ** 2 == pytest.approx(slope @ slope, rel=1e-4)
    assert contrast[0] == pytest.approx(slope @ rest / (slope @ slope), rel=1e-4)


def test_the_bank_s_positions_have_the_same_templates() -> None:
    """Half planes are scanned together: mirror images differ by more than a sign here."""
    likelihood = likelihood_of(0.0)
    grid = make_grid(94.0, 300.0, 40.0)
    bank = TemplateBank(likelihood, grid, CRESCENT)
    rest = np.random.default_rng(2).normal(size=likelihood.n_independent)
    contrast, sigma = bank.scan(rest)
    each = bank.scan_at(rest, grid.east_mas, grid.north_mas)
    assert contrast == pytest.approx(each[0], rel=1e-4, abs=1e-9)
    assert sigma == pytest.approx(each[1], rel=1e-4)


def test_exact_map_is_chi2_of_the_model() -> None:
    likelihood = likelihood_of(0.02)
    grid = make_grid(94.0, 300.0, 60.0)
    found = exact_map(likelihood, grid, CRESCENT, (0.0, 0.1))
    places = np.column_stack([grid.east_mas, grid.north_mas])
    for k, contrast in enumerate((0.0, 0.1)):
        sets = np.hstack(
            [places, np.full((len(places), 1), contrast), np.tile(CRESCENT, (len(places), 1))]
        )
        assert found.chi2[k] == pytest.approx(likelihood.chi2(sets), rel=1e-6)


def test_a_companion_beside_a_crescent_is_found() -> None:
    likelihood = likelihood_of(0.015, np.random.default_rng(3))
    found = search(likelihood, (94.0, 300.0), single=CRESCENT)
    error = np.sqrt(np.diag(likelihood.errors(found.theta)))
    assert (np.abs(found.theta[:3] - [-120.0, 90.0, 0.015]) < 5.0 * error[:3]).all()

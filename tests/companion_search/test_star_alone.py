"""The fit of a star alone, where its closure phases turn by 180° at the nulls of its V²."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import simulated
from test_global_search import coverage

from amibayes.companion_search.optimise import fit_single
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.binary import BinaryModel

MODEL = BinaryModel(diameter_mas="free", limb_darkening="free")


@pytest.mark.parametrize("seed", range(3))
def test_a_limb_darkened_star_of_several_lobes_is_fitted_as_well_as_by_brute_force(
    seed: int,
) -> None:
    """Against a grid of 15 000 stars, and the truth."""
    rng = np.random.default_rng(seed)
    diameter, darkening = rng.uniform(2.0, 4.0), rng.uniform(0.1, 0.6)
    truth = BinaryModel(diameter_mas=diameter, limb_darkening=darkening)
    data = simulated(coverage("mirc6t", 0.01, 0.01), [5.0, 5.0, 0.0], rng, truth)
    likelihood = Likelihood(data, MODEL)
    star, deviance = fit_single(likelihood)
    alone = single_likelihood(likelihood)
    sizes, exponents = np.linspace(1.5, 4.5, 500), np.linspace(0.0, 1.0, 31)
    grid = [np.column_stack([sizes, np.full_like(sizes, a)]) for a in exponents]
    least = min(float(alone.chi2(thetas).min()) for thetas in grid)
    at_truth = float(alone.chi2(np.array([[diameter, darkening]]))[0])
    assert deviance < min(least, at_truth) + 1.0
    assert alone.chi2(star[None])[0] == pytest.approx(deviance)

"""68 % intervals of a contrast, from images to the t likelihood, at few integrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_extraction_statistics import pair

from amibayes.calibration import calibrate
from amibayes.cube import Cube
from amibayes.extraction import extract
from amibayes.inference.likelihood import Likelihood

PLACE = (140.0, -90.0)


def part(cube: Cube, first: int, n: int) -> Cube:
    """Some integrations of a cube."""
    arrays = {name: getattr(cube, name) for name in ("images", "error", "dq", "mjd")}
    cut = {k: None if a is None else a[first : first + n] for k, a in arrays.items()}
    return replace(cube, **cut)


def below(target: Cube, calibrator: Cube) -> float:
    """Posterior probability of a contrast below zero, the truth, at a known place."""
    data = calibrate(extract(target), [extract(calibrator)]).observables
    assert data.freedom is not None
    likelihood = Likelihood(data)
    sigma = np.sqrt(1.0 / np.linalg.inv(likelihood.errors([*PLACE, 1e-6]))[2, 2])
    contrast = sigma * np.linspace(-8.0, 8.0, 321)
    theta = np.column_stack([np.full((321, 2), PLACE), contrast])
    log = likelihood.log_prob(theta)
    weight = np.exp(log - log.max())
    return float((weight[:160].sum() + 0.5 * weight[160]) / weight.sum())


@pytest.mark.slow
@pytest.mark.parametrize(("n", "trials"), [(20, 60), (50, 40), (200, 25)])
def test_intervals_cover_from_the_images_on(n: int, trials: int) -> None:
    """Target and calibrator of n integrations each, 1e7 photons each; binomial chance 1e-4."""
    cubes = pair(1e7 * trials, n * trials, 77)
    found = [below(*(part(c, k * n, n) for c in cubes)) for k in range(trials)]
    inside = int((np.abs(np.array(found) - 0.5) < 0.34).sum())
    assert stats.binomtest(inside, trials, 0.68).pvalue > 1e-4, inside

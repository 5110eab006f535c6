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
from amibayes.likelihood.likelihood import Likelihood
from amibayes.units import FloatArray

PLACES = [(r * np.sin(a), r * np.cos(a)) for a in np.arange(6) for r in (120.0, 220.0)]
"""East and north, mas: far enough apart that their contrasts are nearly independent."""


def part(cube: Cube, first: int, n: int) -> Cube:
    """Some integrations of a cube."""
    arrays = {name: getattr(cube, name) for name in ("images", "error", "dq", "mjd")}
    cut = {k: None if a is None else a[first : first + n] for k, a in arrays.items()}
    return replace(cube, **cut)


def below(target: Cube, calibrator: Cube) -> FloatArray:
    """Posterior probability of a contrast below zero, the truth, at each of the places."""
    data = calibrate(extract(target), [extract(calibrator)]).observables
    assert data.freedom is not None
    likelihood = Likelihood(data)
    return np.array([_below(likelihood, place) for place in PLACES])


def _below(likelihood: Likelihood, place: tuple[float, float]) -> float:
    sigma = np.sqrt(1.0 / np.linalg.inv(likelihood.errors([*place, 1e-6]))[2, 2])
    contrast = sigma * np.linspace(-8.0, 8.0, 161)
    log = likelihood.log_prob(np.column_stack([np.full((161, 2), place), contrast]))
    weight = np.exp(log - log.max())
    return float((weight[:80].sum() + 0.5 * weight[80]) / weight.sum())


@pytest.mark.slow
@pytest.mark.parametrize(("n", "trials"), [(20, 120), (50, 80), (200, 30)])
def test_intervals_cover_from_the_images_on(n: int, trials: int) -> None:
    """Target and calibrator of n integrations each, 1e7 photons each, a dozen places each.

    The error is that of the scatter between trials, whose coverages are independent.
    """
    cubes = pair(1e7 * trials, n * trials, 77, n_groups=2)
    found = np.array([below(*(part(c, k * n, n) for c in cubes)) for k in range(trials)])
    inside = (np.abs(found - 0.5) < 0.34).mean(axis=1)
    error = inside.std(ddof=1) / np.sqrt(trials)
    # Chance of this 1e-4.
    assert abs(inside.mean() - 0.68) < stats.t.isf(5e-5, trials - 1) * error, inside.mean()

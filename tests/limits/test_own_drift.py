"""How much brighter a companion must be where drift is fitted to residuals that hold it."""

from __future__ import annotations

import numpy as np
import pytest

from amibayes.limits.own_drift import _crossing, _smooth


def test_errors_of_mean_changes_are_those_of_many_draws() -> None:
    """Of rings with a common scatter; a parabola in 1/separation is followed without a bias."""
    rng, separation = np.random.default_rng(1), np.geomspace(2.0, 30.0, 12)
    inverse = separation.min() / separation
    truth = 0.05 + 0.1 * inverse + 0.4 * inverse**2
    draws = [
        _smooth(truth[:, None] + 0.3 * rng.normal(size=(12, 6)), separation) for _ in range(900)
    ]
    off = np.array([mean - truth for mean, _ in draws])
    error = np.sqrt((np.array([one for _, one in draws]) ** 2).mean(axis=0))
    assert off.std(axis=0) == pytest.approx(error, rel=0.12)
    assert (np.abs(off.mean(axis=0)) < 4.5 * error / 30.0).all()


@pytest.mark.parametrize("n_rings", [1, 2])
def test_few_rings_have_their_own_means(n_rings: int) -> None:
    change = np.random.default_rng(2).normal(size=(n_rings, 40))
    mean, error = _smooth(change, np.array([2.0, 5.0])[:n_rings])
    assert mean == pytest.approx(change.mean(axis=1))
    assert error == pytest.approx(np.full(n_rings, 1.0 / np.sqrt(40.0)), rel=0.4)


@pytest.mark.parametrize("start", [-7.0, -4.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, 1.5])
def test_the_contrast_of_detection_is_found_from_anywhere(start: float, noise: float) -> None:
    """Of a root that is noise at first, and goes with the contrast then."""
    found = _crossing(lambda x: float(np.hypot(np.exp(x) / 0.004, noise)), 5.0, start)
    assert found == pytest.approx(np.log(0.004 * np.sqrt(25.0 - noise**2)), abs=0.03)


def test_what_is_never_detected_ends_at_equal_stars() -> None:
    assert _crossing(lambda x: float(np.exp(0.5 * x)), 5.0, -3.0) == 0.0

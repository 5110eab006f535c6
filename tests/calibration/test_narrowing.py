"""Shared errors narrowed by calibrators of different charge, against draws of the constant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss
from scipy.sparse import csr_array

from amibayes.calibration import calibrate
from amibayes.calibration.narrowing import narrowed
from amibayes.calibration.transfer import Transfer
from amibayes.data.observables import Observables
from amibayes.data.shared_errors import SharedErrors
from amibayes.units import FloatArray

NAME = "charge migration 1 (x 3.6e-07)"


def star(change: FloatArray, seed: int, constant: float, fresh: bool = True) -> Observables:
    """A star whose data are off by ``constant`` times ``change``, with noise."""
    bare = niriss()
    noise = bare.covariance.draw(np.random.default_rng(seed), 1)[:, 0] if fresh else 0.0
    off, n = constant * change + noise, bare.n_vis2
    moved = replace(
        bare,
        vis2=replace(bare.vis2, value=bare.vis2.value + off[:n]),
        closure_phase=replace(bare.closure_phase, value=bare.closure_phase.value + off[n:]),
    )
    return moved.with_shared_errors(SharedErrors((NAME,), change[:, None]))


def template(size: float) -> FloatArray:
    """V² all moved by so many of their errors, closure phases not."""
    sigma = np.sqrt(niriss().covariance.variance)
    return np.where(np.arange(len(sigma)) < niriss().n_vis2, size * sigma, 0.0)


def test_calibrators_of_different_charge_tell_the_constant() -> None:
    change, pulls = template(4.0), []
    for seed in range(16):
        constant = float(np.random.default_rng(9000 + seed).standard_normal())
        target = star(change, 3 * seed, constant)
        others = [star(share * change, 3 * seed + k, constant) for k, share in ((1, 0.5), (2, 0.1))]
        found = calibrate([target], others, method="weighted").observables
        n = found.n_vis2
        mean = found.data[:n].mean() - 1.0
        sigma = np.sqrt(found.covariance.dense()[:n, :n].mean())
        pulls.append(mean / sigma)
    # Without it the target keeps 0.7 · 4 errors of all its V²; the mean of 21 is good to 0.3.
    alone = calibrate([target], others[:1], method="weighted").observables
    before = np.sqrt(alone.covariance.dense()[:n, :n].mean())
    assert sigma < 0.6 * before
    # rms of 16 draws: 18 % Monte Carlo error
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.7)


def test_calibrators_of_equal_charge_tell_nothing_of_it() -> None:
    change = template(4.0)
    others = [star(0.5 * change, k, 0.0) for k in (1, 2)]
    both = calibrate([star(change, 0, 0.0)], others, method="weighted").observables
    assert both.shared is not None
    assert both.shared.changes[0, 0] == pytest.approx(0.5 * change[0], rel=0.05)


def test_scatter_between_calibrators_is_not_taken_for_the_constant() -> None:
    change = template(2.0)
    rough = 20.0 * niriss().covariance.draw(np.random.default_rng(5), 1)[:, 0]
    others = [star(0.5 * change, 1, 0.0), star(0.1 * change + rough, 2, 1.0)]
    others[1] = (
        others[1]
        .without_shared_errors()
        .with_shared_errors(SharedErrors((NAME,), 0.1 * change[:, None]))
    )
    found = calibrate([star(change, 0, 0.0)], others, method="weighted").observables
    assert found.shared is not None
    assert np.abs(found.shared.changes[0, 0]) > 0.6 * change[0]


def test_the_number_that_was_narrowed_is_told() -> None:
    change, step, pulls = template(4.0), 1.2e-7, []
    for seed in range(16):
        constant = float(np.random.default_rng(700 + seed).standard_normal())
        target = star(change, 3 * seed, constant)
        others = [star(share * change, 3 * seed + k, constant) for k, share in ((1, 0.5), (2, 0.1))]
        told = calibrate([target], others, method="weighted").told
        assert told is not None
        number = told.number({NAME: step})
        assert number is not None
        # What is taken out too much by one error makes data that are off by its change.
        pulls.append((number[0] + constant * step) / number[1])
    assert number[1] < 0.5 * step
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.7)
    assert told.number({"another": step}) is None
    assert told.number({}) is None


def test_nothing_is_told_by_one_calibrator() -> None:
    change = template(4.0)
    found = calibrate([star(change, 0, 0.0)], [star(0.5 * change, 1, 0.0)], method="weighted")
    assert found.told is None


@pytest.mark.parametrize("n_stars", [2, 3])
def test_errors_of_constants_grow_as_the_calibrators_scatter(n_stars: int) -> None:
    """Against least squares of all data at once, with the response of every datum free."""
    rng = np.random.default_rng(n_stars)
    n, n_constants = 4, 2
    sigma = rng.uniform(0.5, 1.5, (n_stars, n))
    changes = rng.normal(size=(n_stars, n, n_constants)) * 6.0
    values = rng.normal(size=(n_stars, n)) * 5.0
    names = ("one", "other")
    stars = [
        Transfer(v, csr_array(np.diag(s**2)), np.ones(n, bool), shared=SharedErrors(names, c))
        for v, s, c in zip(values, sigma, changes, strict=True)
    ]
    found = narrowed(stars)
    assert found is not None
    columns = np.concatenate([np.tile(np.eye(n), (n_stars, 1)), np.concatenate(changes)], axis=1)
    white = columns / sigma.ravel()[:, None]
    best = np.linalg.lstsq(white, values.ravel() / sigma.ravel(), rcond=None)[0]
    left = np.sum((values.ravel() / sigma.ravel() - white @ best) ** 2)
    scale = left / (n * n_stars - n - n_constants)
    assert scale > 2.0
    free = np.linalg.inv(white.T @ white)[n:, n:] * scale
    expected = np.linalg.inv(np.linalg.inv(free) + np.eye(n_constants))
    np.testing.assert_allclose(found.root @ found.root.T, expected, rtol=1e-9)
    np.testing.assert_allclose(found.mean, expected @ np.linalg.solve(free, best[n:]), rtol=1e-9)

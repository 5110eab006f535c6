"""How much brighter a companion must be where drift is fitted to residuals that hold it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import simulated
from interferometer import four_telescopes

from amibayes.companion_search.search import search
from amibayes.detection.exposure_noise import exposure_noise
from amibayes.detection.statistic import make_statistic, statistic_of
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.limits.critical import CriticalContrasts
from amibayes.limits.own_drift import _crossing, _piece, _Searched, _smooth, _spread


def test_errors_of_mean_changes_are_those_of_many_draws() -> None:
    """Of rings with numbers and scatters of their own; a parabola is followed without a bias."""
    rng, inverse = np.random.default_rng(1), np.geomspace(15.0, 1.0, 12)
    truth = 0.05 + 0.1 * inverse / 15.0 + 0.4 * (inverse / 15.0) ** 2
    number, scatter = np.arange(14, 2, -1), np.linspace(0.4, 0.1, 12)
    draws = [
        _smooth(
            [m + s * rng.normal(size=n) for m, s, n in zip(truth, scatter, number, strict=True)],
            inverse,
        )
        for _ in range(900)
    ]
    off = np.array([mean - truth for mean, _ in draws])
    error = np.sqrt((np.array([one for _, one in draws]) ** 2).mean(axis=0))
    assert off.std(axis=0) == pytest.approx(error, rel=0.12)
    assert (np.abs(off.mean(axis=0)) < 4.5 * error / 30.0).all()


@pytest.mark.parametrize("n_rings", [1, 2])
def test_few_rings_have_their_own_means(n_rings: int) -> None:
    change = np.random.default_rng(2).normal(size=(n_rings, 40))
    mean, error = _smooth(list(change), np.array([5.0, 2.0])[:n_rings])
    assert mean == pytest.approx(change.mean(axis=1))
    assert error == pytest.approx(change.std(axis=1, ddof=1) / np.sqrt(40.0))


def test_the_spread_of_contrasts_is_that_of_many() -> None:
    """Where the variance of the change goes with the square of its mean; errors by many draws."""
    rng, factor, number = np.random.default_rng(3), np.linspace(0.6, 0.05, 10), np.arange(24, 4, -2)
    truth = np.sqrt(1.0 + 0.5 * factor**2 / 0.25**2)
    draws = []
    for _ in range(900):
        kept = [0.25 * rng.normal(size=n) - 5.0 for n in number]
        own = [
            k + f + np.sqrt(0.5) * f * rng.normal(size=len(k))
            for k, f in zip(kept, factor, strict=True)
        ]
        draws.append(_spread(kept, own, factor))
    width, ratio, error = (np.array([one[k] for one in draws]) for k in range(3))
    assert np.sqrt((width**2).mean()) == pytest.approx(0.25, rel=0.01)
    assert ratio.mean(axis=0) == pytest.approx(truth, rel=0.03)
    assert ratio.std(axis=0) == pytest.approx(np.sqrt((error**2).mean(axis=0)), rel=0.25)


def test_logarithms_are_spread_about_the_median_of_their_ring() -> None:
    log = np.random.default_rng(4).normal(-6.0, 0.2, (2, 5, 41))
    shape = log[:, :, 0]
    none = CriticalContrasts(
        np.exp(log), np.exp(log), np.ones_like(shape), log, log, np.zeros(2), np.ones(2, dtype=bool)
    )
    wider = none.less_sensitive(np.array([1.5, 1.0]), np.array([1.3, 1.0]))
    found = np.log(wider.detected)
    before, after = np.median(log, axis=(1, 2)), np.median(found, axis=(1, 2))
    assert after - before == pytest.approx([np.log(1.5), 0.0])
    assert found.std(axis=(1, 2)) / log.std(axis=(1, 2)) == pytest.approx([1.3, 1.0])
    assert (wider.located >= wider.detected).all()
    assert wider.sigma[:, 0] == pytest.approx([1.5, 1.0])


@pytest.mark.parametrize("start", [-7.0, -4.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, 1.5])
def test_the_contrast_of_detection_is_found_from_anywhere(start: float, noise: float) -> None:
    """Of a root that is noise at first, and goes with the contrast then."""
    scale = np.array([0.004, 0.001, 0.02])
    found = _crossing(
        lambda which, x: np.hypot(np.exp(x) / scale[which], noise), 5.0, np.full(3, start)
    )
    assert found == pytest.approx(np.log(scale * np.sqrt(25.0 - noise**2)), abs=0.03)


def test_what_is_never_detected_ends_at_equal_stars() -> None:
    assert _crossing(lambda which, x: np.exp(0.5 * x), 5.0, np.array([-3.0])) == 0.0


def test_contrasts_of_detection_are_those_of_searches_of_real_data(rng) -> None:
    """Each contrast searched as data of its own, with the noise that a search would take."""
    sheet = four_telescopes(6, channels=1)
    likelihood = Likelihood(sheet.with_data(simulated(sheet, [0.0, 0.0, 0.0], rng).data))
    result = search(likelihood, (2.0, 8.0))
    test, goal = statistic_of(result), 4.0
    places = np.array([[3.0, 1.0], [-4.0, 4.0]])
    found = _piece(_Searched.of(test), goal**2, (places, 0.02, np.random.default_rng(7)))
    noise = test.likelihood.noise.draw(2, np.random.default_rng(7)).T
    contrast = np.geomspace(0.003, 0.3, 40)
    for place, own, after in zip(places, noise, found["own"], strict=True):
        changes = test.change_by(np.column_stack([np.tile(place, (40, 1)), contrast]))
        star = single_likelihood(likelihood).predict(np.atleast_2d(test.single))
        roots = []
        for data in (star + changes + own[:, None]).T:
            one = Likelihood(sheet.with_data(data))
            noisy = one.with_noise(exposure_noise(one, test.single).noise)
            there = make_statistic(noisy, test.bank.grid, test.single)
            contrast_there, _ = there.bank.scan_at(
                there.bank.reduce(there.observed), *place[:, None]
            )
            roots.append(np.sqrt(there.value) if contrast_there[0] > 0.0 else 0.0)
        assert np.exp(after) == pytest.approx(np.interp(goal, roots, contrast), rel=0.1)

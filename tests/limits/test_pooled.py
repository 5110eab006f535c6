"""Quantiles of rings that are pooled: their error, and what rings that differ keep."""

from __future__ import annotations

import numpy as np
import pytest

from amibayes.limits.components import over_components
from amibayes.limits.critical import CriticalContrasts
from amibayes.limits.pooled import Pooled, quantiles

SHARES = np.array([0.3, 0.5, 0.8])


def rings(rng: np.random.Generator, means: np.ndarray, n_noise: int = 12) -> Pooled:
    """Twelve angles each; ln c is normal, and independent between realisations of the noise."""
    values = rng.normal(means[:, None, None], 0.3, (len(means), 12, n_noise))
    return Pooled(values, np.zeros(len(means)) - 5.0, np.ones(len(means), dtype=bool))


@pytest.mark.parametrize("apart", [0.0, 1.0])
def test_the_stated_error_is_the_scatter_of_repetitions(apart: float) -> None:
    """Rings alike are known from all, rings far apart each from its own values."""
    rng, means = np.random.default_rng(8), apart * np.arange(4.0)
    found = [rings(rng, means).contrast(SHARES) for _ in range(60)]
    spread = np.log([contrast for contrast, _ in found]).std(axis=0, ddof=1).mean()
    stated = np.mean([error for _, error in found])
    alone, together = (0.3 * np.sqrt(np.pi / 2.0 / n) for n in (144, 4 * 144))
    # A median's error, to 1/√(2·60·4) = 5 %; the outer quantiles have 6 and 14 % more, and rings
    # that are alike seem to differ now and then by as much as their errors.
    assert spread == pytest.approx(1.07 * (alone if apart else together), rel=0.3)
    assert stated == pytest.approx(spread, rel=0.3)


def test_rings_that_differ_keep_their_own_quantiles() -> None:
    pooled = rings(np.random.default_rng(2), np.array([0.0, 0.5, 1.5]), 40)
    own = np.array([quantiles(ring, SHARES) for ring in pooled.values])
    np.testing.assert_allclose(np.log(pooled.contrast(SHARES)[0]) + 5.0, own, atol=0.02)


def test_a_share_that_is_not_reached_has_no_contrast() -> None:
    values = np.where(np.arange(20.0) < 12, 0.0, np.inf)[None, :, None] * np.ones((1, 1, 3))
    pooled = Pooled(values + np.zeros((1, 1, 3)), np.array([-5.0]), np.ones(1, dtype=bool))
    contrast, _ = pooled.contrast(np.array([0.5, 0.9]))
    assert contrast[0, 0] == pytest.approx(np.exp(-5.0))
    assert np.isnan(contrast[0, 1])


def test_the_error_allows_for_companions_that_no_contrast_shows() -> None:
    """Of 40 on one ring: some realisations of the noise show more of them than others."""
    rng = np.random.default_rng(4)
    found = []
    for _ in range(400):
        hidden = rng.random((1, 20, 2)) < 0.1
        values = np.where(hidden, np.inf, rng.normal(0.0, 0.3, hidden.shape))
        found.append(Pooled(values, np.zeros(1) - 5.0, np.ones(1, dtype=bool)).contrast(SHARES))
    contrast, error = np.array(found)[:, :, 0].swapaxes(0, 1)
    assert np.isfinite(contrast[:, :2]).all()
    spread = np.log(contrast[:, :2]).std(axis=0)
    np.testing.assert_allclose(np.nanmean(error[:, :2], axis=0), spread, rtol=0.25)
    # Eight tenths end at a value, or are not reached: chance decides.
    assert np.isnan(error[:, 2]).mean() > 0.1


def test_contrasts_are_those_of_the_injections_where_places_are_alike() -> None:
    """Whatever the contrast error that all places have."""
    sigma = np.full((2, 30), 3e-4)
    located = np.geomspace(1e-3, 4e-3, 300).reshape(1, 30, 10) * np.ones((2, 1, 1))
    still = np.zeros_like(located)
    critical = CriticalContrasts(
        located, located, sigma, still, still, np.zeros(2), np.zeros(2, dtype=bool)
    )
    found = Pooled.of(critical, over_components(critical)).contrast(SHARES)[0]
    np.testing.assert_allclose(found[0], np.quantile(located[0], SHARES), rtol=5e-3)

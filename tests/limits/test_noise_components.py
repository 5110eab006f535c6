"""The chance of one component of the noise is taken out of critical contrasts, and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import stats

from amibayes.companion_search.search import search
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.detection.statistic import BankStatistic, statistic_of
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.components import NODES, over_components
from amibayes.limits.critical import CriticalContrasts, Draws, critical_contrasts, directions_of
from amibayes.limits.pooled import Pooled
from amibayes.limits.rings import Rings
from amibayes.units import offset

SHARES = np.array([0.05, 0.5, 0.95])


def drawn(rng: np.random.Generator, *, curved: float = 0.0, rings: int = 1) -> CriticalContrasts:
    """c/σ = u − w·z + curved·(w·z)², u of mean 5 and scatter 0.5, w known to 20 %; σ = 0.01."""
    shape = (rings, 30, 4)
    z, u = rng.standard_normal(shape), 5.0 + 0.5 * rng.standard_normal(shape)
    width = np.exp(rng.normal(0.0, 0.2, shape))
    level = u - width * z + curved * (width * z) ** 2
    sigma, ring = np.full(shape[:2], 0.01), np.zeros(rings)
    return CriticalContrasts(0.01 * level, 0.01 * level, sigma, z, width, ring, ring.astype(bool))


@pytest.mark.parametrize("curved", [0.0, 0.08])
def test_quantiles_are_the_true_ones_and_scatter_less(curved: float) -> None:
    """Against 10⁶ draws of the same law; plain quantiles of 120 trials scatter twice as much.

    400 repetitions tell a mean to a twentieth of the scatter (4.5 sigma: 0.22 of it), besides what
    Hazen's rule misses of a tail of 120 values, 0.02.
    """
    rng = np.random.default_rng(4)
    z, u = rng.standard_normal((2, 1_000_000))
    width = np.exp(rng.normal(0.0, 0.2, z.size))
    law = 5.0 + 0.5 * u - width * z + curved * (width * z) ** 2
    truth = np.quantile(law, SHARES)
    every = [drawn(rng, curved=curved) for _ in range(400)]
    smooth = np.array([np.quantile(over_components(one), SHARES) for one in every])
    plain = np.array([np.quantile(one.located / 0.01, SHARES) for one in every])
    scatter = smooth.std(axis=0)
    assert (np.abs(smooth.mean(axis=0) - truth) < 0.22 * scatter + 0.02).all()
    assert (scatter < 0.7 * plain.std(axis=0)).all()


def test_nodes_of_all_trials_together_are_normal() -> None:
    """Of a contrast that is the component alone: mean, variance and tail of the normal law."""
    one = drawn(np.random.default_rng(1))
    only = replace(one, width=np.ones_like(one.width), located=0.01 * (50.0 - one.component))
    values = 50.0 - over_components(only).ravel()
    assert values.mean() == pytest.approx(0.0, abs=0.01)
    assert values.var() == pytest.approx(1.0, abs=0.01)
    assert np.mean(values > 1.645) == pytest.approx(0.05, abs=0.002)
    assert over_components(only).shape == (1, 30, NODES, 4)


def test_trials_count_as_they_are_where_the_rest_is_not_known() -> None:
    """A companion that is never found, and noise that is not linear in the component."""
    both = drawn(np.random.default_rng(2), rings=3)
    located, width = both.located.copy(), both.width.copy()
    located[0, 3, 1], width[1] = np.inf, 0.0
    found = over_components(replace(both, located=located, width=width))
    plain = np.repeat((located / 0.01)[:, :, None], NODES, axis=2)
    np.testing.assert_array_equal(found[:2], plain[:2])
    assert (found[2] != plain[2]).all()


def test_rings_of_one_kind_share_their_slope_and_other_kinds_do_not() -> None:
    """Where a companion counts anywhere the slope is another one: 0.2, not 1."""
    one = drawn(np.random.default_rng(3), rings=2)
    slow = one.located[1] + 0.01 * 0.8 * (one.width * one.component)[1]
    located = np.stack([one.located[0], slow])
    kinds = replace(one, located=located, by_detection=np.array([False, True]))
    inner, outer = over_components(kinds).std(axis=2).mean(axis=(1, 2))
    assert inner == pytest.approx(1.0, rel=0.1)
    assert outer == pytest.approx(0.2, rel=0.4)


def statistic(n_integrations: int) -> BankStatistic:
    """NIRISS; with the covariance of so many integrations, or with a known one for 0 of them."""
    sheet = niriss()
    if n_integrations:
        freedom = Freedom(float(n_integrations), 20.0)
        sheet = replace(sheet, freedom=freedom, covariance_kind="estimated")
        sheet = replace(sheet, scatter=sheet.covariance.sparse)
    data = simulated(sheet, [0.0, 0.0, 0.0], np.random.default_rng(6))
    return statistic_of(search(Likelihood(data), (50.0, 400.0)))


@pytest.mark.parametrize("n_integrations", [0, 60])
def test_noise_says_whether_it_is_linear(n_integrations: int) -> None:
    """Noise of a sum of normals is the sum of their noise, or not."""
    test = statistic(n_integrations)
    first, second = (test.bank.normals(3, np.random.default_rng(k)) for k in (1, 2))
    parts = [test.noise(x, np.random.default_rng(5)) for x in (first, second, first + second)]
    apart = np.abs(parts[0] + parts[1] - parts[2]).max()
    assert test.linear_noise == (n_integrations == 0)
    assert (apart < 1e-9) == test.linear_noise


def test_components_of_a_ring_are_one_of_each_part_of_the_normal_law() -> None:
    """And widths are the drawn scatter: a mean of 1, of 36 data known to 12 %."""
    test, angle = statistic(0), np.arange(0.0, 360.0, 18.0)
    east, north = (x[None] for x in offset(200.0, angle))
    rings = Rings(np.array([200.0]), east, north)
    directions = directions_of(test, rings, typical=40.0, most_ambiguous=0.5)
    found = critical_contrasts(test, 25.0, rings, directions, Draws(6, 3, stated_probable=False))
    level = np.sort(stats.norm.cdf(found.component[0]), axis=0) * len(angle)
    np.testing.assert_array_equal(np.floor(level), np.arange(20)[:, None] * np.ones(6))
    assert found.width.mean() == pytest.approx(1.0, abs=0.1)
    assert 0.05 < found.width.std() < 0.25
    assert isinstance(Pooled.of(found, over_components(found)), Pooled)

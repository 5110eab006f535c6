"""Fits to exposures drawn anew scatter as fits to new data do, whatever the errors say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import NIRISS_HOLES, simulated

from amibayes.companion_search.search import search
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.errors import DataError
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.posterior.bootstrap import _numbered, bootstrap, exposures_of

TRUTH = np.array([120.0, -60.0, 0.05])


def exposures(n: int, source: str = "a") -> Observables:
    """Five holes of the mask that turn with the sky, an exposure every few minutes."""
    parts = []
    for k in range(n):
        c, s = np.cos(0.1 * k), np.sin(0.1 * k)
        parts.append(
            point_source(
                NIRISS_HOLES[:5] @ np.array([[c, s], [-s, c]]),
                4.8e-6,
                0.1e-6,
                vis2_error=0.01,
                closure_error_rad=0.02,
                mjd=60000.0 + 0.003 * k,
            )
        )
    data = join(parts)
    return replace(data, setups=tuple(replace(s, source=source) for s in data.setups))


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_spread_is_that_of_new_data(factor) -> None:
    """24 exposures, errors right or understated: within 5 of its own errors and 15 %."""
    rng = np.random.default_rng(6)
    sheet = exposures(24)
    wide = replace(sheet, covariance=sheet.covariance)
    noise = simulated(wide, TRUTH, None)
    draw = factor * sheet.covariance.draw(rng, 1)[:, 0]
    data = noise.with_data(noise.data + draw)
    result = search(Likelihood(data), (80.0, 200.0))
    found = bootstrap(result, ExtraNoise(), 60, rng)
    expected = factor * np.sqrt(np.diag(result.theta_covariance))
    ratio = found.samples.std(axis=0, ddof=1) / expected
    # 60 fits tell a spread to 9 %, 24 exposures to 15 %.
    assert np.abs(ratio - 1.0).max() < 5 * np.hypot(0.09, 0.15)
    median, low, high = found.interval("separation_mas")
    assert low < median < high
    assert median == pytest.approx(np.hypot(*TRUTH[:2]), abs=5 * factor * expected[:2].max())
    assert found.interval("position_angle_deg")[0] == pytest.approx(116.6, abs=3.0)
    assert found.n_exposures == 24


def test_exposures_hold_both_kinds_and_files_have_their_own() -> None:
    data = join([exposures(3, "a"), exposures(2, "b")])
    label = exposures_of(data)
    assert np.array_equal(np.unique(label), np.arange(5))
    mjd = np.concatenate([data.vis2.mjd, data.closure_phase.mjd])
    for k in range(5):
        assert len(np.unique(mjd[label == k])) == 1
        assert (label[: data.n_vis2] == k).any()
        assert (label[data.n_vis2 :] == k).any()


def test_unequal_tables_are_paired_by_time() -> None:
    data = exposures(4)
    kept = data.select(
        np.ones(len(data.vis2), bool), data.closure_phase.mjd > data.closure_phase.mjd.min()
    )
    label = exposures_of(kept)
    mjd = np.concatenate([kept.vis2.mjd, kept.closure_phase.mjd])
    assert len(np.unique(label)) == 4
    assert all(len(np.unique(mjd[label == k])) == 1 for k in range(4))


def test_few_exposures_are_refused(rng) -> None:
    data = simulated(exposures(4), TRUTH, rng)
    result = search(Likelihood(data), (80.0, 200.0))
    with pytest.raises(DataError, match="4 exposures, too few"):
        bootstrap(result, ExtraNoise(), 5, rng)


@pytest.mark.parametrize(("seconds", "exposures"), [(0.0, 1), (50.0, 1), (70.0, 2)])
def test_tables_whose_mean_dates_differ_by_a_minute_are_of_one_exposure(
    seconds: float, exposures: int
) -> None:
    """V² and closure phases of a file, and those of another file at the same time."""
    keys = np.array([[0, 0, 1], [0, 1, 2], [0, 0, 0]])
    number = _numbered(keys, 60000.0 + np.array([0.0, seconds, 0.0]) / 86400.0)
    assert len(set(number[:2].tolist())) == exposures
    assert number[2] not in number[:2]

"""The search finds what was put in, with errors that mean what they say."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import stats

from amibayes.companion_search import search as search_module
from amibayes.companion_search.field import (
    COARSE_STEPS_PER_FRINGE,
    MAX_WORK,
    WORK_PER_POSITION,
    _affordable,
    _holds,
    default_separation,
    resolution_mas,
    resolves_stars,
)
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.scan import ScanResult
from amibayes.companion_search.search import search
from amibayes.companion_search.second_companion import search_second
from amibayes.companion_search.seeds import may_be_bright, peaks
from amibayes.data.point_source import point_source
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box
from amibayes.units import MAS, offset


@pytest.mark.parametrize("contrast", [0.002, 0.02, 0.2, 0.5, 0.9])
@pytest.mark.parametrize("channels", [1, 3])
def test_noiseless_binaries_come_back(contrast: float, channels: int) -> None:
    theta = [110.0, -75.0, contrast]
    result = search(Likelihood(simulated(niriss(channels=channels), theta, None)), (50.0, 400.0))
    np.testing.assert_allclose(result.theta, theta, rtol=1e-3)
    assert result.chi2_binary < 1e-3
    assert result.modes[0].theta == tuple(result.theta)


def test_a_second_companion_may_be_looked_for_where_none_is_of_use() -> None:
    """Light nowhere improves the fit of data without noise: the second one has none."""
    result = search(Likelihood(niriss()), (60.0, 300.0))
    two = search_second(result)
    assert [c.contrast for c in two.companions] == [0.0, 0.0]
    assert two.chi2 == pytest.approx(result.chi2_single, abs=1e-9)


def test_diameter_and_background_are_fitted_along(rng) -> None:
    stations = rng.uniform(-60, 60, (6, 2))
    sheet = point_source(
        stations, [1.6e-6, 1.7e-6], 0.05e-6, vis2_error=0.01, closure_error_rad=0.01
    )
    model = BinaryModel(diameter_mas="free", background="free")
    truth = [6.0, -9.0, 0.03, 0.9, 0.05]
    likelihood = Likelihood(simulated(sheet, truth, rng, model), model)
    assert resolves_stars(likelihood)
    result = search(likelihood, (1.0, 20.0))
    pulls = (result.theta - truth) / np.sqrt(np.diag(result.theta_covariance))
    assert np.abs(pulls).max() < 4.5
    assert result.nuisance("diameter_mas") == result.theta[3]
    assert result.ndof == likelihood.n_independent - 5


def recoveries(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pulls (n, 3) of separation, position angle and contrast, and reduced chi2."""
    sheet = niriss()
    pulls, reduced = np.empty((n, 3)), np.empty(n)
    for k in range(n):
        rho, angle = rng.uniform(100, 350), rng.uniform(0, 360)
        east, north = offset(rho, angle)
        contrast = 10 ** rng.uniform(-2.0, -0.5)
        data = simulated(sheet, [float(east), float(north), contrast], rng)
        c = search(Likelihood(data), (50.0, 400.0)).companion
        turn = (c.position_angle_deg - angle + 180.0) % 360.0 - 180.0
        pulls[k] = [
            (c.separation_mas - rho) / c.separation_error_mas,
            turn / c.position_angle_error_deg,
            (c.contrast - contrast) / c.contrast_error,
        ]
        reduced[k] = search_chi2(data, c)
    return pulls, reduced


def search_chi2(data, companion) -> float:
    theta = [[companion.east_mas, companion.north_mas, companion.contrast]]
    return float(Likelihood(data).chi2(theta)[0]) / (data.n_independent - 3)


@pytest.mark.slow
def test_pulls_of_200_binaries_are_standard_normal() -> None:
    """Mean 0 ± 1/√n, width 1 ± 1/√2n; bounds of 5 sigma, 1e-5 false failures for all."""
    n = 200
    pulls, reduced = recoveries(n, np.random.default_rng(42))
    assert np.abs(pulls.mean(axis=0)).max() < 5.0 / np.sqrt(n)
    assert np.abs(pulls.std(axis=0, ddof=1) - 1.0).max() < 5.0 / np.sqrt(2 * n)
    for column in pulls.T:
        assert stats.kstest(column, "norm").pvalue > 1e-5
    assert abs(reduced.mean() - 1.0) < 5.0 * np.sqrt(2.0 / 33 / n)


def test_search_finds_the_best_of_a_brute_force_scan(rng) -> None:
    """Against 30 000 exact model evaluations, on noise alone where many modes compete."""
    for _ in range(5):
        likelihood = Likelihood(simulated(niriss(), [0.0, 0.0, 0.0], rng))
        result = search(likelihood, (50.0, 400.0))
        east, north = rng.uniform(-400, 400, (2, 30_000))
        keep = (np.hypot(east, north) > 50) & (np.hypot(east, north) < 400)
        theta = np.column_stack([east, north, 10 ** rng.uniform(-4, -1.5, 30_000)])[keep]
        best = result.chi2_single - max(m.delta_chi2 for m in result.modes)
        assert best <= likelihood.chi2(theta).min() + 1e-6


def test_default_field_and_resolution() -> None:
    inner, outer = default_separation(Likelihood(niriss()))
    longest, shortest = 5.2801, 1.3203
    assert inner == pytest.approx(4.817e-6 / longest / 2 / MAS, rel=2e-3)
    assert outer == pytest.approx(4.817e-6 / shortest / MAS, rel=2e-3)
    assert not resolves_stars(Likelihood(niriss()))


def test_aliases_of_the_hexagonal_mask_are_named_and_the_inner_one_is_reported(rng) -> None:
    data = simulated(niriss(), [150.0, -80.0, 0.01], rng)
    result = search(Likelihood(data))
    assert result.companion.separation_mas == pytest.approx(170.0, abs=20.0)
    assert any("repeats itself" in text for text in result.warnings)
    assert any(m.companion.separation_mas > 600 for m in result.modes)


def test_refined_solution_stays_inside_the_field() -> None:
    result = search(Likelihood(simulated(niriss(), [200.0, 0.0, 0.05], None)), (220.0, 400.0))
    assert 220.0 - 1e-6 <= result.companion.separation_mas <= 400.0 + 1e-6


def test_contrast_error_agrees_with_the_scatter_of_the_bank(rng) -> None:
    result = search(Likelihood(simulated(niriss(), [150.0, -80.0, 0.01], rng)), (50.0, 400.0))
    k = int(result.bank_delta_chi2.argmax())
    assert result.companion.contrast_error == pytest.approx(result.bank_sigma[k], rel=0.2)


def test_impossible_requests_say_so() -> None:
    likelihood = Likelihood(niriss())
    with pytest.raises(UsageError, match="no position"):
        search(likelihood, (100.0, 100.001))
    three = point_source(np.eye(3)[:, :2], 2e-6, 1e-8, vis2_error=0.1, closure_error_rad=0.1)
    with pytest.raises(DataError, match="1 independent data for 3 parameters"):
        search(Likelihood(three.only(("cp",))))


def test_peaks_are_distinct_and_ordered(rng) -> None:
    result = search(Likelihood(simulated(niriss(), [0.0, 0.0, 0.0], rng)), (50.0, 400.0))
    gain = result.bank_delta_chi2
    chosen = peaks(result.grid, gain, 188.0)
    assert (np.diff(gain[chosen]) <= 0).all()
    east, north = result.grid.east_mas[chosen], result.grid.north_mas[chosen]
    apart = np.hypot(east[:, None] - east, north[:, None] - north) + 1e9 * np.eye(len(chosen))
    assert apart.min() >= 94.0
    assert gain[chosen[0]] == gain.max()


def test_as_many_peaks_as_asked_for_and_further_ones_while_they_are_near_the_best() -> None:
    """Peaks of known heights, far apart: heights within 25 of the best are kept beyond five."""
    grid = make_grid(50.0, 1200.0, 20.0)
    places = [(r * np.sin(t), r * np.cos(t)) for r in (500.0, 1000.0) for t in np.arange(6.0)]
    at = [int(np.hypot(grid.east_mas - e, grid.north_mas - n).argmin()) for e, n in places]
    for heights, kept in (
        ([60.0, 58.0, 56.0, 54.0, 52.0, 50.0, 48.0, 46.0, 34.0, 33.0, 32.0, 31.0], 8),
        ([60.0, *np.arange(30.0, 19.0, -1.0)], 5),
        ([60.0, *np.arange(59.0, 48.0, -1.0)], 9),
    ):
        gain = np.full(len(grid), 1e-3)
        gain[at] = heights
        chosen = peaks(grid, gain, 60.0, 5, 9)
        assert chosen.tolist() == at[:kept]


@pytest.mark.parametrize("outer_mas", [2700.0, 3300.0])
def test_a_large_field_is_searched_at_a_bounded_cost(
    outer_mas: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the finest and the coarsest lattice positions times data are a given number."""
    monkeypatch.setattr(search_module, "AFFORDABLE_WORK", 1e6)
    likelihood = Likelihood(niriss())
    fringe = resolution_mas(likelihood)
    grid = search_module._grid(likelihood, Box(1000.0, outer_mas, fringe))
    assert search_module.MIN_STEPS < fringe / grid.step_mas < search_module.MAX_STEPS
    assert len(grid) * likelihood.n_independent == pytest.approx(1e6, rel=0.02)


@pytest.mark.parametrize(
    ("contrast", "gain", "bright"), [(0.01, 50.0, False), (0.1, 50.0, True), (0.01, 500.0, True)]
)
def test_bright_companions_are_those_of_a_large_contrast_or_a_large_gain(
    contrast: float, gain: float, bright: bool
) -> None:
    each = np.array([contrast, 1e-4])
    survey = ScanResult(each, each, np.array([gain, 0.0]), each[:, None])
    assert may_be_bright(survey, np.array([0])) == bright


@pytest.mark.parametrize("contrast", [0.0, 0.02])
def test_a_place_outside_holds_where_a_companion_is_there(contrast: float, rng) -> None:
    """Noise alone gains less than the limit of modes, however large χ² is."""
    place = np.array([430.0, 60.0])
    likelihood = Likelihood(simulated(niriss(channels=3), [*place, contrast], rng))
    within = make_grid(60.0, 250.0, 20.0)
    box = Box(60.0, 500.0, resolution_mas(likelihood))
    assert _holds(likelihood, within, np.empty(0), place, box, None) == (contrast > 0.0)


def test_the_reach_of_a_look_outside_is_what_its_work_affords() -> None:
    """As many positions, counted on their grid, times the work of one."""
    likelihood = Likelihood(niriss())
    box = Box(50.0, 1e6, resolution_mas(likelihood))
    _, reach = _affordable(likelihood, box)
    positions = len(make_grid(0.0, reach, box.fringe_mas / COARSE_STEPS_PER_FRINGE))
    work = positions * (len(likelihood.samples) + WORK_PER_POSITION)
    assert work == pytest.approx(MAX_WORK, rel=0.01)

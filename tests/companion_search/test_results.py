"""What a result of a search says: errors carried over, tables, maps and likelihood gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from helpers import niriss, simulated
from scipy import stats

from amibayes.companion_search.exact_map import exact_map
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.result import (
    Companion,
    Mode,
    SearchResult,
    _errors,
    companions_of,
    is_opposite,
    null_likelihood,
)
from amibayes.companion_search.search import search
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.binary import BinaryModel

TRUTH = (150.0, -80.0, 0.02)


@pytest.fixture(scope="module")
def result() -> SearchResult:
    data = simulated(niriss(), TRUTH, np.random.default_rng(1))
    return search(Likelihood(data, BinaryModel(background="free")), (120.0, 200.0), check=False)


def test_a_companion_on_the_sky() -> None:
    star = SkyCoord(30.0 * units.deg, 60.0 * units.deg)
    one = Companion(150.0, -80.0, 0.02)
    east, north = star.spherical_offsets_to(one.coordinates(star))
    assert (east.to_value(units.mas), north.to_value(units.mas)) == pytest.approx((150.0, -80.0))
    assert one.separation_mas == pytest.approx(170.0)
    assert one.position_angle_deg == pytest.approx(90.0 + np.degrees(np.arctan2(80.0, 150.0)))
    assert one.delta_mag == pytest.approx(-2.5 * np.log10(0.02))
    assert np.isnan(Companion(1.0, 2.0, 0.0, contrast_error=0.01).delta_mag_error)


def test_errors_of_a_companion_are_those_of_drawn_ones() -> None:
    """Carried over to the first order, for errors much smaller than the place."""
    root = np.array([[0.9, 0.0, 0.0], [0.5, 0.4, 0.0], [2e-4, -1e-4, 3e-4]])
    covariance = root @ root.T
    found = Companion(*TRUTH, *_errors(TRUTH, covariance))
    drawn = TRUTH + np.random.default_rng(2).standard_normal((200_000, 3)) @ root.T
    east, north, contrast = drawn.T
    expected = {
        "east_error_mas": east.std(),
        "north_error_mas": north.std(),
        "contrast_error": contrast.std(),
        "separation_error_mas": np.hypot(east, north).std(),
        "position_angle_error_deg": np.degrees(np.arctan2(east, north)).std(),
        "delta_mag_error": (-2.5 * np.log10(contrast)).std(),
    }
    for name, value in expected.items():
        assert getattr(found, name) == pytest.approx(float(value), rel=0.01), name
    on_star = Companion(0.0, 0.0, 0.1, *_errors((0.0, 0.0, 0.1), covariance))
    assert on_star.north_error_mas == found.north_error_mas
    assert np.isnan([on_star.separation_error_mas, on_star.position_angle_error_deg]).all()


def test_companions_of_a_pair() -> None:
    model = BinaryModel(companions=2)
    parameters = Likelihood(niriss(), model).parameters
    theta = np.array([150.0, -80.0, 0.02, -90.0, 110.0, 0.01])
    covariance = np.diag(np.arange(1.0, 7.0) ** 2)
    first, second = companions_of(parameters, theta, covariance)
    assert (first.east_mas, first.north_mas, first.contrast) == (150.0, -80.0, 0.02)
    assert (second.east_mas, second.north_mas, second.contrast) == (-90.0, 110.0, 0.01)
    assert (second.east_error_mas, second.north_error_mas, second.contrast_error) == (4, 5, 6)
    assert np.isnan(companions_of(parameters, theta)[0].east_error_mas)


def test_opposite_places() -> None:
    mode = Mode((1.0, 2.0, 0.1), 5.0, (Companion(30.0, -40.0, 0.1),))
    assert is_opposite(mode, np.array([-30.0, 40.006]))
    assert not is_opposite(mode, np.array([-30.0, 40.02]))
    assert not is_opposite(mode, np.array([30.0, -40.0]))
    assert repr(mode) == "<Mode: 50.00 mas, PA 143.13°, contrast 0.1, Δχ² 5.0>"


def test_tables_and_maps(result: SearchResult) -> None:
    table, best = result.to_table(), result.modes[0]
    assert len(table) == len(result.modes)
    assert table["separation_mas"][0].to_value(units.mas) == pytest.approx(best.separation_mas)
    maps = result.to_xarray()
    for name, values in (
        ("delta_chi2_map", result.bank_delta_chi2),
        ("contrast_map", result.bank_contrast),
        ("contrast_error_map", result.bank_sigma),
    ):
        assert int(np.isfinite(maps[name]).sum()) == len(result.grid)
        for k in (0, 7, len(result.grid) - 1):
            east, north = result.grid.east_mas[k], result.grid.north_mas[k]
            there = maps[name].sel(east_mas=east, north_mas=north, method="nearest")
            assert float(there) == pytest.approx(values[k])
            assert float(there.east_mas) == pytest.approx(east)
            assert float(there.north_mas) == pytest.approx(north)
    assert maps["delta_mag"].values == pytest.approx([m.delta_mag for m in result.modes])
    assert list(maps["mode"].values) == list(range(len(result.modes)))
    assert maps.attrs["ndof"] == result.ndof
    assert maps.attrs["chi2_single"] == pytest.approx(result.chi2_single)


def test_gains_and_parameters(result: SearchResult) -> None:
    positive = result.bank_contrast > 0.0
    assert positive.any()
    assert not positive.all()
    gain = (result.bank_contrast / result.bank_sigma) ** 2 * positive
    np.testing.assert_allclose(result.bank_delta_chi2, gain)
    assert result.delta_chi2 == pytest.approx(result.chi2_single - result.chi2_binary)
    ratio = result.ndof * result.chi2_single / result.chi2_binary
    expected = stats.norm.isf(0.5 * stats.chi2.sf(ratio, result.ndof))
    assert result.candid_n_sigma == pytest.approx(expected, rel=1e-6)
    assert result.nuisance("background") == pytest.approx(result.theta[3])
    assert result.nuisance("diameter_mas") == 0.0
    with pytest.raises(UsageError, match="nothing"):
        result.nuisance("nothing")
    alone = single_likelihood(result.likelihood)
    (value, error) = result.star_alone()["background"]
    assert value == pytest.approx(result.single_theta[0])
    x = value + error * np.array([-1.0, 0.0, 1.0])
    chi2 = alone.chi2(x[:, None])
    assert chi2[0] + chi2[2] - 2.0 * chi2[1] == pytest.approx(2.0, rel=0.02)
    assert result.position_at(61000.0) == pytest.approx(tuple(result.theta[:2]))


def test_gains_of_measured_errors(result: SearchResult) -> None:
    """−2 ln L of a t distribution of ν + 1 − n degrees, (ν + n) ln(1 + χ²/(ν − 2))."""
    data = replace(result.likelihood.observables, freedom=Freedom(40.0, 39.0))
    other = replace(result, likelihood=Likelihood(data, result.likelihood.model))
    degrees, n = other.likelihood.degrees, other.likelihood.n_independent
    assert np.isfinite(degrees)

    def loss(chi2: np.ndarray) -> np.ndarray:
        return np.asarray((degrees + n) * np.log1p(chi2 / (degrees - 2.0)))

    gain = other.bank_gain
    single = np.array(other.chi2_single)
    np.testing.assert_allclose(other.bank_delta_chi2, loss(single) - loss(single - gain))
    more = replace(other, joint_gain=gain + 1e6)
    np.testing.assert_allclose(more.bank_delta_chi2, loss(single))
    assert null_likelihood(other)[1] is None


def test_rivals_are_neither_aliases_nor_far_worse(result: SearchResult) -> None:
    best = result.modes[0]
    others = tuple(replace(best, delta_chi2=best.delta_chi2 - x) for x in (1.0, 8.9, 9.1))
    several = replace(result, modes=(best, *others), aliases=(others[0],))
    assert several.rivals == (others[1],)
    assert replace(several, aliases=()).rivals == others[:2]


@pytest.mark.parametrize(
    ("model", "nuisance"),
    [
        (BinaryModel(), []),
        (BinaryModel(diameter_mas="free", background="free"), [40.0, 0.2]),
    ],
)
@pytest.mark.parametrize("kinds", [["vis2", "cp"], ["vis2"]])
def test_exact_maps_are_chi2_of_the_model(
    model: BinaryModel, nuisance: list[float], kinds: list[str]
) -> None:
    data = simulated(niriss(channels=2), TRUTH, np.random.default_rng(3)).only(kinds)
    likelihood = Likelihood(data, model)
    grid, contrasts = make_grid(100.0, 160.0, 30.0), (0.1, 0.6, 0.95)
    found = exact_map(likelihood, grid, np.array(nuisance), contrasts)
    for j, contrast in enumerate(contrasts):
        theta = np.column_stack([*grid.places, np.full(len(grid), contrast)])
        theta = np.hstack([theta, np.tile(nuisance, (len(grid), 1))])
        np.testing.assert_allclose(found.chi2[j], likelihood.chi2(theta), rtol=1e-6)
    least = found.chi2.min(axis=0)
    np.testing.assert_allclose(found.gain, least.max() - least)
    assert set(np.unique(found.best)) <= set(contrasts)

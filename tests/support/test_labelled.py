"""Results as labelled arrays hold the numbers of the containers, with names and units."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from helpers import niriss, simulated

import amibayes as ab
from amibayes.support.annotations import fits
from amibayes.support.labelled import unit_of

pytest.importorskip("xarray", exc_type=ImportError)

RNG = np.random.default_rng(1)
FOUND = ab.search(ab.Likelihood(simulated(niriss(), [90.0, 0.0, 0.03], RNG)), (60.0, 150.0))


def test_a_search_is_a_map_with_its_best_position() -> None:
    data = FOUND.to_xarray()
    best = data.delta_chi2_map.where(data.delta_chi2_map == data.delta_chi2_map.max(), drop=True)
    assert best.item() == pytest.approx(FOUND.bank_delta_chi2.max())
    grid = FOUND.grid
    for axis, at in (("east_mas", grid.east_mas), ("north_mas", grid.north_mas)):
        assert np.abs(data[axis]).max() == pytest.approx(np.abs(at).max())
    near = data.sel(east_mas=90.0, north_mas=0.0, method="nearest")
    assert near.delta_chi2_map.item() > 0.8 * best.item()
    assert near.contrast_map.item() == pytest.approx(0.03, rel=0.2)
    assert data.separation_mas.values.tolist() == [m.separation_mas for m in FOUND.modes]
    assert data.east_mas.attrs["units"] == data.separation_mas.attrs["units"] == "mas"
    assert data.attrs["ndof"] == FOUND.ndof


def test_a_posterior_has_chains_and_draws() -> None:
    prior = ab.Prior(60.0, 150.0)
    posterior = ab.sample(FOUND, prior, np.random.default_rng(1), max_steps=200)
    data = posterior.to_xarray()
    steps = posterior.n_steps - posterior.n_burn
    assert dict(data.sizes) == {"chain": posterior.n_walkers, "draw": steps}
    kept = posterior.chain[posterior.n_burn :]
    np.testing.assert_array_equal(data.contrast.values, kept[..., 2].T)
    np.testing.assert_allclose(data.separation_mas, np.hypot(kept[..., 0], kept[..., 1]).T)
    assert data.separation_mas.attrs["units"] == "mas"


def test_limits_are_curves_over_separation() -> None:
    limit = ab.analytic_limit(FOUND, "absil", n_separations=4)
    data = limit.to_xarray()
    np.testing.assert_array_equal(data.delta_mag, limit.delta_mag)
    assert data.contrast_spread.dims == ("separation_mas", "quantile")
    assert data.interp(separation_mas=100.0).delta_mag.attrs["units"] == "mag"


def test_a_measured_limit_has_its_completeness() -> None:
    tested = ab.significance(ab.statistic_of(FOUND), 3000, RNG)
    limit = ab.detection_limit(FOUND, tested, RNG, n_separations=2, trials=2)
    data = limit.to_xarray()
    np.testing.assert_array_equal(data.trials, limit.trials)
    np.testing.assert_array_equal(data.delta_mag_50, limit.columns()["delta_mag_50"])
    assert data.completeness.max() <= 1.0


def test_without_xarray_the_extra_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ab.UsageError, match=r"pip install 'amibayes\[xarray\]'"):
        FOUND.to_xarray()


@pytest.mark.parametrize(
    ("name", "unit"),
    [("east_mas", "mas"), ("delta_mag", "mag"), ("delta_mag_error", "mag"), ("contrast", "")],
)
def test_units_are_in_the_names(name: str, unit: str) -> None:
    assert unit_of(name) == unit


def test_the_public_protocols_are_those_of_the_parts() -> None:
    assert fits(FOUND.likelihood.noise, ab.NoiseModel)
    assert fits(ab.statistic_of(FOUND), ab.Statistic)
    assert all(fits(part, ab.Component) for part in FOUND.likelihood.model.components)
    assert not fits(FOUND, ab.NoiseModel)

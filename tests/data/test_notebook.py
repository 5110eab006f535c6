"""Results as a notebook shows them, and as astropy tables."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import Table
from helpers import niriss, simulated

from amibayes.companion_search.result import Companion, SearchResult
from amibayes.companion_search.search import search
from amibayes.data.observables import Observables
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.completeness import detection_limit
from amibayes.pipeline.false_alarm import false_alarm
from amibayes.pipeline.options import SearchOptions
from amibayes.posterior.ensemble import sample
from amibayes.posterior.grid import grid_posterior
from amibayes.posterior.priors import default_prior


@pytest.fixture(scope="module")
def data() -> Observables:
    return simulated(niriss(), [110.0, -75.0, 0.02], np.random.default_rng(1))


@pytest.fixture(scope="module")
def found(data: Observables) -> SearchResult:
    return search(Likelihood(data), (50.0, 400.0))


def texts(html: str) -> list[str]:
    """Cells of a table."""

    class Cells(HTMLParser):
        seen: tuple[str, ...] = ()

        def handle_data(self, data: str) -> None:
            self.seen += (data,)

    parser = Cells()
    parser.feed(html)
    return list(parser.seen)


def test_a_companion_has_a_place_on_the_sky() -> None:
    star = SkyCoord(10.0 * u.deg, -60.0 * u.deg)
    companion = Companion(110.0, -75.0, 0.02)
    place = companion.coordinates(star)
    assert star.separation(place).to_value(u.mas) == pytest.approx(companion.separation_mas)
    angle = star.position_angle(place).to_value(u.deg)
    assert angle == pytest.approx(companion.position_angle_deg, abs=1e-6)
    east, north = star.spherical_offsets_to(place)
    assert (east.to_value(u.mas), north.to_value(u.mas)) == pytest.approx((110.0, -75.0), rel=1e-5)


def test_search_result(found: SearchResult) -> None:
    table = found.to_table()
    assert isinstance(table, Table)
    assert len(table) == len(found.modes)
    assert table["separation_mas"].unit == u.mas
    assert table["separation_mas"][0].to_value("mas") == found.modes[0].companion.separation_mas
    assert table["delta_chi2"][0] == found.modes[0].delta_chi2
    shown = texts(found._repr_html_())
    assert "separation (mas)" in shown
    assert f"{found.companion.separation_mas:.5g}" in shown
    assert "<script>" not in replace(found, warnings=("<script>",))._repr_html_()


def test_posterior(found: SearchResult) -> None:
    prior = default_prior(found.likelihood, 50.0, 400.0)
    posterior = sample(found, prior, np.random.default_rng(1))
    table = posterior.to_table()
    assert len(table) == len(posterior.samples)
    np.testing.assert_array_equal(table["contrast"], posterior.column("contrast"))
    np.testing.assert_array_equal(
        table["separation_mas"].to_value("mas"), posterior.column("separation_mas")
    )
    assert repr(posterior).startswith(f"<Posterior: {len(posterior.samples)} samples of east_mas")
    assert f"{posterior.interval('delta_mag')[0]:.5g}" in texts(posterior._repr_html_())


def test_limits_and_weights_in_a_line(found: SearchResult) -> None:
    options = SearchOptions(null_draws=3000)
    weight = false_alarm(found, options, np.random.default_rng(1), None, None)
    limit = detection_limit(
        found, weight, np.random.default_rng(2), trials=100, separation_mas=[100.0, 300.0]
    )
    assert repr(limit).startswith(f"<DetectionLimit: injection, {limit.completeness:.0%}")
    assert repr(limit).endswith("2 separations>")
    table = limit.to_table()
    np.testing.assert_array_equal(table["contrast"], limit.contrast)
    assert table["separation_mas"].unit == u.mas
    assert table.meta["completeness"] == limit.completeness
    shown = texts(limit._repr_html_())
    assert f"{limit.delta_mag[0]:.2f}" in shown
    companion = found.companion
    assert f"{companion.contrast:.5g}" in texts(companion._repr_html_())
    assert repr(found).startswith(f"<SearchResult: {companion.separation_mas:.2f} mas, PA")
    grid = grid_posterior(found.likelihood, default_prior(found.likelihood, 50.0, 400.0))
    assert repr(grid).startswith(f"<GridPosterior: {len(grid.cells)} cells, ln Z {grid.log_z:.3f}")


def test_observables(data: Observables) -> None:
    vis2, closure = data.to_table(), data.to_table("closure_phase")
    assert (len(vis2), len(closure)) == (21, 35)
    np.testing.assert_array_equal(vis2["vis2"], data.vis2.value)
    assert closure["closure_phase"].unit == u.rad
    np.testing.assert_array_equal(closure["error"].to_value("rad"), data.errors[1])
    assert {"u1", "v1", "u2", "v2", "wavelength", "mjd", "stations", "flag"} <= set(
        closure.colnames
    )
    np.testing.assert_array_equal(vis2["u"].to_value("m"), data.vis2.u_m[:, 0])
    assert vis2["stations"][0].count("-") == 1
    assert closure["stations"][0].count("-") == 2
    shown = texts(data._repr_html_())
    assert shown[shown.index("squared visibilities") + 1] == "21"
    hostile = replace(data, notes=("<img src=x>",))._repr_html_()
    assert "<img" not in hostile


def test_tables_can_be_written(data: Observables, tmp_path) -> None:
    path = tmp_path / "vis2.ecsv"
    data.to_table().write(path)
    np.testing.assert_allclose(Table.read(path)["vis2"], data.vis2.value)

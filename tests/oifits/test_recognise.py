"""Which files are products of the jwst pipeline, and what is told of their tables."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from jwst_products import binary, integrations, product

from amibayes.data.point_source import point_source
from amibayes.oifits.audit import audit
from amibayes.oifits.correlations import Pairs, consistent_pairs
from amibayes.oifits.products import product_of
from amibayes.oifits.tables import open_oifits
from amibayes.oifits.uv_stations import _shortest


def test_products_have_one_table_of_each_kind(tmp_path) -> None:
    """With two tables of V² the repairs would not know which one they belong to."""
    rng = np.random.default_rng(1)
    made = product("ami-oi", integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng))
    made.writeto(tmp_path / "one.fits")
    made.append(made["OI_VIS2"].copy())
    made.writeto(tmp_path / "two.fits")
    assert product_of(open_oifits(tmp_path / "one.fits")) is not None
    assert product_of(open_oifits(tmp_path / "two.fits")) is None


def test_repairs_are_named_where_some_triangles_have_no_amplitude(tmp_path) -> None:
    rng = np.random.default_rng(2)
    made = product("ami-oi", integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng))
    made["OI_T3"].data["T3AMP"][4] = 0.0
    made.writeto(tmp_path / "one.fits")
    assert "product-closure-error" in {f.code for f in audit(tmp_path / "one.fits").findings}


@pytest.mark.parametrize(("kind", "told"), [("RADIUS", True), ("FWHM", False)])
def test_a_field_of_view_is_wrong_only_as_a_radius(kind: str, told: bool, tmp_path) -> None:
    rng = np.random.default_rng(2)
    made = product("ami-oi", integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng))
    made["OI_ARRAY"].data["FOVTYPE"] = kind
    made["OI_ARRAY"].data["DIAMETER"] = 0.8
    made.writeto(tmp_path / "one.fits")
    found = [f.what for f in audit(tmp_path / "one.fits").findings if f.code == "product-array"]
    assert any("RADIUS" in what for what in found) == told


def test_the_shortest_distance_is_that_of_any_two() -> None:
    places = np.array([[0.0, 0.0], [1.0, 0.0], [30.0, 0.0], [0.0, 30.0]])
    for order in permutations(range(4)):
        assert _shortest(places[list(order)]) == 1.0


def test_correlations_of_triangles_are_held_against_shared_baselines() -> None:
    """A baseline in common makes a third: a fifth of that with the other sign is a contradiction, a
    tenth is not, whatever the variance of the V²."""
    data = point_source(
        np.random.default_rng(1).uniform(-3.0, 3.0, (8, 2)), 4.8e-6, 1e-7,
        vis2_error=300.0, closure_error_rad=0.01, covariance="assumed",
    )  # fmt: skip
    dense = data.covariance.dense()
    first, second = np.array([(i, j) for i, j in zip(*np.triu_indices(len(dense), 1), strict=True)
                              if abs(dense[i, j]) > 1e-12]).T  # fmt: skip
    for sign, kept in ((1.0, True), (-1.0, False), (-0.2, False), (-0.1, True)):
        pairs = Pairs(first, second, sign * dense[first, second])
        found, note = consistent_pairs(pairs, np.diag(dense), data.closure_phase)
        assert (len(found.first) == len(first)) == kept
        assert ("contradict" in note) != kept

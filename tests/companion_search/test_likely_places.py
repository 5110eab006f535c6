"""Where V² alone sends the exact map, and what that leaves of a wide field."""

from __future__ import annotations

import numpy as np
import pytest
from brute_force import case, coverage

from amibayes.companion_search import seeds
from amibayes.companion_search.exact_map import LADDER, exact_map, likely_places
from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.optimise import tolerance_of
from amibayes.companion_search.search import search
from amibayes.detection.outlying_rows import OutlyingRow, model_is_wrong
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel


def test_places_are_those_of_the_least_chi2_of_vis2() -> None:
    drawn = case("pionier", 5003, smeared=True)
    likelihood, nuisance = drawn.likelihood, np.array([1.0])
    grid = make_grid(2.0, 25.0, 0.4)
    alone = Likelihood(likelihood.observables.only(["vis2"]), likelihood.model)
    chi2 = exact_map(alone, grid, nuisance).chi2[:, : len(grid) // 2]
    chosen = likely_places(likelihood, grid, nuisance)
    assert chosen is not None
    n = len(grid) // 2
    assert set(np.argsort(chi2.min(axis=0))[: int(0.03 * n)]) <= set(chosen.tolist())
    for row in chi2:
        assert set(np.argsort(row)[: int(0.01 * n)]) <= set(chosen.tolist())
    assert len(chosen) <= (0.03 + 0.01 * len(LADDER)) * n + 1 + len(LADDER)


def test_elsewhere_the_map_is_as_bad_as_its_worst() -> None:
    likelihood = case("pionier", 5003, smeared=True).likelihood
    grid, nuisance = make_grid(2.0, 8.0, 0.4), np.array([1.0])
    whole = exact_map(likelihood, grid, nuisance).chi2
    among = np.array([3, 17, 40])
    some = exact_map(likelihood, grid, nuisance, among=among).chi2
    there = np.concatenate([among, among + len(grid) // 2])
    np.testing.assert_allclose(some[:, there], whole[:, there], rtol=1e-12)
    others = np.delete(some, there, axis=1)
    np.testing.assert_array_equal(others, some[:, there].max(axis=1)[:, None] + 0 * others)


def test_without_vis2_nothing_is_left_out() -> None:
    data = coverage("pionier", 0.01, 0.01).only(["cp"])
    likelihood = Likelihood(data, BinaryModel(diameter_mas="free"))
    assert likely_places(likelihood, make_grid(2.0, 8.0, 0.4), np.array([1.0])) is None


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("pionier", 5003),
        pytest.param("mirc6t", 5000, marks=pytest.mark.slow),
        pytest.param("mirc6t", 5010, marks=pytest.mark.slow),
    ],
)
def test_a_bright_companion_in_a_wide_field_is_found_all_the_same(
    name: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = case(name, seed, smeared=True)
    evaluated = []

    def noted(*given: object, among: np.ndarray | None, **options: object) -> object:
        evaluated.append(None if among is None else 2 * len(among) / len(given[1]))  # type: ignore[arg-type]
        return exact_map(*given, among=among, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(seeds, "exact_map", noted)
    found = {}
    for staged in (np.inf, 0.0):
        monkeypatch.setattr(seeds, "STAGED", staged)
        evaluated.clear()
        found[staged] = search(drawn.likelihood, drawn.field, check=False).chi2_binary
        assert all((share is None) == (staged > 0.0) for share in evaluated)
        assert all(share is None or share < 0.1 for share in evaluated)
    assert found[0.0] == pytest.approx(found[np.inf], abs=1e-2)


def test_fits_far_from_the_data_end_in_units_of_chi2_per_datum() -> None:
    likelihood = case("pionier", 5003).likelihood
    n = likelihood.n_independent
    assert tolerance_of(likelihood, 0.5 * n) == pytest.approx(1e-3)
    np.testing.assert_allclose(tolerance_of(likelihood, np.array([n, 50.0 * n])), [1e-3, 5e-2])


def test_a_model_is_wrong_where_all_rows_are_far_off() -> None:
    """A star of 3 mas taken for a point: not one row of many; the same row of a point alone is."""
    data = coverage("mirc6t", 0.005, 0.01)
    point, disc = (Likelihood(data, BinaryModel(diameter_mas=d)) for d in (0.0, 3.0))
    theta = np.array([5.0, 5.0, 0.0])
    row = OutlyingRow("vis2", 0, int(data.vis2.row[0]), "a", ("A", "B"), 6e4, "closure phase", 9.0)
    assert resolution_mas(point) < 3.0
    assert model_is_wrong(data, disc, theta, [row])
    spoilt = data.data.copy()
    spoilt[: data.n_vis2][data.vis2.row == row.row] = 0.0
    assert not model_is_wrong(data.with_data(spoilt), point, theta, [row])
    assert model_is_wrong(data.with_data(spoilt), point, theta, [])

"""Stations, channels and dates by which numbers of a calibrator serve those of a target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oi_builders import random_observables

from amibayes.calibration.matching import (
    _channel_map,
    _lookup,
    _nearest,
    _station_map,
    foreign,
    keys_of,
    match,
    sharing,
    station_positions,
)
from amibayes.data.observables import Observables, join

PLACES = np.array([[0.0, 0.0], [10.0, 1.0], [3.0, 14.0], [-8.0, 5.0], [6.0, -9.0]])


def star(seed: int = 1, name: str = "star", mjd: float = 0.0) -> Observables:
    one = random_observables(
        np.random.default_rng(seed), n_stations=4, n_channels=3, kind="assumed", name=name
    )
    dated = {k: replace(getattr(one, k), mjd=getattr(one, k).mjd + mjd) for k in TABLES}
    return replace(one, **dated)


TABLES = ("vis2", "closure_phase")


def with_setup(data: Observables, **changes: object) -> Observables:
    return replace(data, setups=tuple(replace(s, **changes) for s in data.setups))


def test_places_that_baselines_imply() -> None:
    """Every baseline (a, b) is the position of b less that of a, whatever their common shift."""
    one = star()
    found = station_positions(one, 0)
    first, second = one.vis2.stations.T
    vectors = np.column_stack([one.vis2.u_m[:, 0], one.vis2.v_m[:, 0]])
    np.testing.assert_allclose(found[second] - found[first], vectors, atol=1e-6)
    some = one.select(~(one.vis2.stations == 3).any(axis=1), np.ones(len(one.closure_phase), bool))
    alone = station_positions(some, 0)
    assert np.isnan(alone).any(axis=1).tolist() == [False, False, False, True]
    none = one.select(np.zeros(len(one.vis2), bool), np.ones(len(one.closure_phase), bool))
    assert np.isnan(station_positions(none, 0)).all()
    both = join([star(2, "a"), star(3, "b")])
    np.testing.assert_allclose(station_positions(both, 1), station_positions(star(3, "b"), 0))


@pytest.mark.parametrize("shift", [0.0, 7.0])
def test_shifted_constellations(shift: float) -> None:
    order = np.array([3, 0, 4, 1, 2])
    moved = PLACES[order] + shift
    assert _nearest(PLACES, moved).tolist() == order.tolist()
    # Stations that stand elsewhere have no partner; those left agree still.
    moved[2] += 3.0
    assert _nearest(PLACES, moved).tolist() == [3, 0, -1, 1, 2]
    shortest = np.hypot(*(PLACES[:, None] - PLACES)[np.triu_indices(5, 1)].T).min()
    for part, same in ((0.019, 4), (0.021, -1)):
        near = PLACES[order] + shift
        near[2, 0] += part * shortest
        assert _nearest(PLACES, near)[2] == same
    # One station, and equal pairs, are those of any two.
    assert _nearest(PLACES, PLACES[:1]).tolist() == [-1]
    line = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    assert _nearest(line, line[:2]).tolist() == [-1, -1]
    missing = np.where(np.arange(5)[:, None] == 2, np.nan, PLACES[order])
    assert _nearest(PLACES, missing).tolist() == [3, 0, -1, 1, 2]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("b", "A", "y", "z"), [1, 0, -1, -1]),  # two names, of which one is the first
        (("x", "y", "c", "D"), [-1, -1, 2, 3]),
        (("c", "x", "y", "z"), [3, 1, 0, 2]),  # one name is not enough: by their places
    ],
)
def test_stations_by_name_or_place(names: tuple[str, ...], expected: list[int]) -> None:
    one = with_setup(star(), stations=("A", "B", "C", "D"))
    place = one.setups[0].station_xyz_m
    assert place is not None
    order = np.array([3, 1, 0, 2])
    other = with_setup(one, stations=names, station_xyz_m=place[order])
    configuration = keys_of(one).configurations[0]
    assert _station_map(configuration, other, 0).tolist() == expected
    # Without places of the stations, by those that the baselines imply.
    bare = with_setup(one, stations=names, station_xyz_m=None)
    by_baselines = expected if names[0] != "c" else [0, 1, 2, 3]
    assert _station_map(configuration, bare, 0).tolist() == by_baselines
    wrong = with_setup(one, stations=names, station_xyz_m=10.0 * place)
    assert _station_map(configuration, wrong, 0).tolist() == by_baselines


def test_channels_are_one_within_a_tenth_of_their_width() -> None:
    target = star().setups[0]
    wave, band = target.wavelength_m, target.band_m
    for part, same in ((0.09, True), (0.11, False), (-0.09, True), (-0.11, False)):
        other = replace(target, wavelength_m=wave + part * band)
        assert _channel_map(target, other).tolist() == ([0, 1, 2] if same else [-1, -1, -1])
    narrow = replace(target, band_m=np.zeros(3))
    for part, same in ((0.9e-3, True), (1.1e-3, False)):
        other = replace(narrow, wavelength_m=wave[::-1] * (1.0 + part))
        assert _channel_map(narrow, other).tolist() == ([2, 1, 0] if same else [-1, -1, -1])


def test_rows_are_looked_up_in_a_table() -> None:
    rng = np.random.default_rng(4)
    table = np.unique(rng.integers(-1, 4, (60, 6)), axis=0)
    rng.shuffle(table)
    rows = np.vstack([rng.integers(-1, 5, (40, 6)), table[::3]])
    expected = [
        next((k for k, one in enumerate(table) if np.array_equal(one, row)), -1) for row in rows
    ]
    assert _lookup(table, rows).tolist() == expected
    assert _lookup(table, rows[:0]).tolist() == []
    assert _lookup(table[:0], rows[:2]).tolist() == [-1, -1]


def test_keys_tell_epochs_channels_and_stations_apart() -> None:
    night = star(1, mjd=0.0)
    data = join([night, star(1, mjd=1.0), star(1, mjd=5.0)])
    keys = keys_of(data, 2.0)
    dates = np.unique(np.concatenate([data.vis2.mjd, data.closure_phase.mjd]))
    first, last = dates[dates < dates[0] + 3.0], dates[dates > dates[0] + 3.0]
    expected = [[first[0] - 2.0, first[-1] + 2.0], [last[0] - 2.0, last[-1] + 2.0]]
    np.testing.assert_allclose(keys.epochs, expected)
    assert keys_of(data).epochs.tolist() == [[-np.inf, np.inf]]
    # Six baselines and four triangles in three channels and two epochs; three files are one.
    assert len(keys.configurations) == 1
    assert (keys.n_vis2, len(keys)) == (36, 60)
    assert keys.periodic.tolist() == [False] * 36 + [True] * 24
    assert len(keys.key) == len(keys.sign) == len(data.data)
    n = data.n_vis2
    assert set(keys.key[:n]) == set(range(36))
    assert set(keys.key[n:]) == set(range(36, 60))
    sets = keys.closure_sets()
    assert [len(one) for one in sets] == [4] * 6
    assert sorted(np.concatenate(sets)) == list(range(36, 60))
    for one in sets:
        assert len(np.unique(keys.table[one, :3], axis=0)) == 1
    alone = keys_of(replace(data, covariance_kind="diagonal"))
    assert [len(one) for one in alone.closure_sets()] == [1] * 12
    assert keys_of(data.only(["vis2"])).closure_sets() == []


def test_turned_triangles_have_the_other_sign() -> None:
    one = star()
    turned = one.closure_phase.stations[:, [1, 0, 2]]
    other = replace(one, closure_phase=replace(one.closure_phase, stations=turned))
    keys = keys_of(one)
    found = match(other, keys)
    n = one.n_vis2
    np.testing.assert_array_equal(np.sort(found.entry), np.arange(len(one.data)))
    by_entry = np.argsort(found.entry)
    np.testing.assert_array_equal(found.key[by_entry], keys.key)
    np.testing.assert_array_equal(found.sign[by_entry][:n], keys.sign[:n])
    np.testing.assert_array_equal(found.sign[by_entry][n:], -keys.sign[n:])


def test_only_unflagged_numbers_of_the_epoch_serve() -> None:
    one, late = star(), star(mjd=3.0)
    keys = keys_of(one, 1.0)
    assert len(match(late, keys).key) == 0
    assert len(match(late, keys_of(one)).key) == len(late.data)
    flags = np.arange(len(one.vis2)) % 3 == 0, np.arange(len(one.closure_phase)) % 4 == 1
    some = one.flagged(*flags)
    found = match(some, keys_of(one))
    kept = np.concatenate([~flags[0], ~flags[1]])
    np.testing.assert_array_equal(np.sort(found.entry), np.arange(kept.sum()))
    np.testing.assert_array_equal(found.key[np.argsort(found.entry)], keys_of(one).key[kept])


def test_one_number_is_enough_to_serve() -> None:
    one = star()
    last = np.arange(len(one.vis2)) < len(one.vis2) - 1
    single = one.flagged(last, np.ones(len(one.closure_phase), dtype=bool))
    assert sharing([one, single]).all()


def test_names_of_instruments() -> None:
    """Setups of the target's instrument serve, and where there are none all of them."""
    one, other = star(1, "A"), star(1, "B")
    keys = keys_of(one)
    assert foreign(one, keys) == ""
    assert foreign(join([one, other]), keys) == ""
    said = foreign(with_setup(other, source="b.fits"), keys)
    assert "is of INSNAME B and not of A: it was matched by stations and wavelength" in said
    assert len(match(join([one, other]), keys).key) == len(one.data)
    assert len(match(other, keys).key) == len(other.data)
    far = with_setup(other, wavelength_m=2.0 * other.setups[0].wavelength_m)
    assert sharing([one, other, far]).tolist() == [
        [True, True, False],
        [True, True, False],
        [False, False, True],
    ]

"""What an audit says of stations, (u, v) and closure phases, with the numbers in it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oi_builders import HOLES_M, MaskFile, random_observables

from amibayes.data.observables import Observables
from amibayes.oifits.audit import audit
from amibayes.oifits.audit.finding import Finding
from amibayes.oifits.audit.geometry import (
    _closes,
    _legs,
    _turned,
    closures_that_do_not_close,
    four_triangles,
    uv_against_stations,
)
from amibayes.oifits.audit.scale import uv_of_another_scale
from amibayes.oifits.tables import OIFits

HERE = OIFits(Path("a"), {}, ())


def mask_file(**options: int) -> MaskFile:
    return MaskFile(np.random.default_rng(1), n_channels=1, **options)


def found(made: MaskFile, folder: Path, code: str) -> list[Finding]:
    path = made.write(folder / "a.oifits")
    return [f for f in audit(path).findings if f.code == code]


def data(n_stations: int = 5, n_exposures: int = 2) -> Observables:
    """Sound observables: closure phases of a sky, with a little noise."""
    rng = np.random.default_rng(2)
    made = random_observables(
        rng, n_stations=n_stations, n_exposures=n_exposures, kind="diagonal", n_channels=2
    )
    phase = rng.normal(size=(n_stations, n_stations))
    phase = phase - phase.T
    a, b, c = made.closure_phase.stations.T
    noise = made.errors[1] * rng.normal(size=len(a))
    closing = np.angle(np.exp(1j * (phase[a, b] + phase[b, c] + phase[c, a] + noise)))
    return made.with_data(np.concatenate([made.vis2.value, closing]))


def changed(made: Observables, which: str, rows: list[int], **columns: object) -> Observables:
    """Other numbers in some rows (all channels) of a table: a function of the old."""
    table = getattr(made, which)
    put = {}
    for name, how in columns.items():
        values = getattr(table, name).copy()
        hit = np.isin(table.row, rows)
        values[hit] = how(values[hit])  # type: ignore[operator]
        put[name] = values
    return replace(made, **{which: replace(table, **put)})


def test_sound_observables_are_left_alone() -> None:
    made = data()
    for check in (
        uv_against_stations,
        uv_of_another_scale,
        closures_that_do_not_close,
    ):
        assert list(check(HERE, [made])) == []


def test_sides_off_their_baselines_are_counted() -> None:
    """Of 20 triangles (two sides each, one entry of every row) three are off on one side."""
    made = data()
    moved = changed(made, "closure_phase", [1, 4, 9], u_m=lambda u: u + np.array([[0.0, 0.4]]))
    (said,) = uv_against_stations(HERE, [moved])
    assert said.code == "uv-stations"
    assert said.severity == "error"
    assert said.what.startswith("(u, v) of 3 sides of triangles (of 40) are not those")
    # A hundredth of the baseline is allowed, three are not.
    for share, off in ((1.015, 0), (1.03, 3)):
        near = changed(
            made, "closure_phase", [1, 4, 9], u_m=lambda u, s=share: u * [[1.0, s]],
            v_m=lambda v, s=share: v * [[1.0, s]],
        )  # fmt: skip
        agree, reverse, compared = _legs(near, 1.0)
        assert compared.all()
        assert (~agree & ~reverse).sum() == off
        assert (~agree & ~reverse)[:, 0].sum() == 0


def test_sides_that_run_backwards_are_counted() -> None:
    made = data()
    back = changed(made, "closure_phase", [2, 3], u_m=lambda u: -u, v_m=lambda v: -v)
    (said,) = uv_against_stations(HERE, [back])
    assert (said.severity, said.code) == ("warning", "uv-direction")
    assert said.what.startswith("(u, v) of 4 sides of triangles run against")
    # All of them backwards is a matter of convention.
    rows = list(range(20))
    every = changed(made, "closure_phase", rows, u_m=lambda u: -u, v_m=lambda v: -v)
    assert list(uv_against_stations(HERE, [every])) == []


def test_sides_are_compared_with_baselines_of_their_time() -> None:
    """Within half an hour; the Earth turns a baseline meanwhile."""
    made = data(n_exposures=1)
    rows = list(range(10))
    for days, compared, agrees in ((0.019, True, True), (0.021, False, False)):
        late = changed(made, "closure_phase", rows, mjd=lambda t, d=days: t + d)
        agree, _, done = _legs(late, 1.0)
        assert done.all() == done.any() == compared
        assert agree.all() == agrees
        turned = 0.02 + 2 * np.pi * 0.019
        for share, fits in ((0.97, True), (1.03, False)):
            factor = 1.0 + share * turned
            far = changed(late, "closure_phase", rows, u_m=lambda u, f=factor: u * f,
                          v_m=lambda v, f=factor: v * f)  # fmt: skip
            assert _legs(far, 1.0)[0].all() == (fits and compared)
    none = made.select(np.zeros(len(made.vis2), bool), np.ones(len(made.closure_phase), bool))
    assert [part.shape for part in _legs(none, 1.0)] == [(10, 2)] * 3


def test_sides_of_exposures_without_times_are_compared_with_any_of_them() -> None:
    """Files whose MJD is 0, or that of the night: exposures of a turning sky have one date."""
    made = data(n_exposures=3)
    for which in ("vis2", "closure_phase"):
        made = changed(made, which, list(range(99)), mjd=lambda t: 0.0 * t + 59000.0)
        rows = list(range(10, 20))  # of the second exposure
        made = changed(made, which, rows, u_m=lambda u: 1.2 * u, v_m=lambda v: 1.2 * v)
    assert list(uv_against_stations(HERE, [made])) == []
    moved = changed(made, "closure_phase", [1, 4, 9], u_m=lambda u: u + np.array([[0.0, 0.4]]))
    assert list(uv_against_stations(HERE, [moved]))


def test_the_other_direction_of_stations_turns_a_side() -> None:
    made = data(n_exposures=1)
    other = changed(
        made, "vis2", [0, 5], stations=lambda s: s[:, ::-1], u_m=lambda u: -u, v_m=lambda v: -v
    )
    agree, reverse, _ = _legs(other, 1.0)
    assert agree.all()
    assert not reverse.any()


@pytest.mark.parametrize("factor", [0.9, 1.08])
def test_a_common_factor_is_told(factor: float) -> None:
    made = data()
    rows = list(range(20))
    other = changed(made, "closure_phase", rows, u_m=lambda u: u / factor, v_m=lambda v: v / factor)
    codes = {f.code: f.what for f in uv_against_stations(HERE, [other])}
    assert list(codes) == ["uv-factor"]
    assert f"are {factor:.4f} times those of the same sides" in codes["uv-factor"]


def test_baselines_longer_than_their_stations_apart_are_counted() -> None:
    made = data(n_exposures=2)
    long = changed(made, "vis2", [3, 7], u_m=lambda u: 1.2 * u, v_m=lambda v: 1.2 * v)
    long = changed(long, "vis2", [5], u_m=lambda u: 1.4 * u, v_m=lambda v: 1.4 * v)
    (said,) = uv_of_another_scale(HERE, [long])
    assert (said.severity, said.code, said.where) == ("error", "uv-length", "NRM")
    assert said.what == ("3 baselines of 20 longer than the distance of the stations "
                         "(up to 1.4 times)")  # fmt: skip
    for share, told in ((1.015, 0), (1.03, 1)):
        every = list(range(20))
        near = changed(
            made, "vis2", every, u_m=lambda u, s=share: u * s, v_m=lambda v, s=share: v * s
        )
        assert len(list(uv_of_another_scale(HERE, [near]))) == told
    unknown = replace(long, setups=(replace(long.setups[0], station_xyz_m=None),))
    assert list(uv_of_another_scale(HERE, [unknown])) == []


def test_sums_over_four_triangles_are_zero_but_for_noise() -> None:
    made = data()
    sums = four_triangles(made)
    # Two exposures and two channels, five times four of five stations each.
    assert [s.sign.shape for s in sums] == [(5, 10)] * 4
    left = [s.sign @ s.phase for s in sums]
    turns = np.concatenate(left) / (2 * np.pi)
    assert np.abs(turns - np.round(turns)).max() < 0.05
    sigma = np.concatenate([np.sqrt(np.abs(s.sign) @ s.variance) for s in sums])
    exact = (np.angle(np.exp(1j * np.concatenate(left))) / sigma) ** 2
    np.testing.assert_allclose(np.concatenate([s.chi2() for s in sums]), exact)
    assert 0.3 < exact.mean() < 3.0


def test_triangles_that_are_turned_round_are_named() -> None:
    made = data()
    stations = made.setups[0].stations
    sign = np.ones(len(made.closure_phase))
    sign[np.isin(made.closure_phase.row, [4, 14])] = -1.0  # one triangle, at both dates
    phases = sign * made.closure_phase.value
    back = made.with_data(np.concatenate([made.vis2.value, phases]))
    name = "-".join(stations[s] for s in made.closure_phase.select(sign < 0).stations[0])
    assert _turned(four_triangles(back)) == [name]
    (said,) = closures_that_do_not_close(HERE, [back])
    chi2 = np.concatenate([s.chi2() for s in four_triangles(back)])
    assert f"χ² of {chi2.mean():.3g} in the mean and up to {chi2.max():.3g} (20 sums)" in said.what
    assert f"; with {name} turned round they would close" in said.what
    assert said.remedy == "check STA_INDEX of OI_T3"
    noise = np.random.default_rng(3).normal(size=len(phases))
    wild = made.with_data(np.concatenate([made.vis2.value, phases + noise]))
    (said,) = closures_that_do_not_close(HERE, [wild])
    assert "would close" not in said.what
    assert said.remedy == "check STA_INDEX and the errors of OI_T3"
    # Two turned triangles are found one after the other.
    sign[np.isin(made.closure_phase.row, [7, 17])] = -1.0
    both = made.with_data(np.concatenate([made.vis2.value, sign * made.closure_phase.value]))
    assert len(_turned(four_triangles(both))) == 2


@pytest.mark.parametrize(
    ("chi2", "closes"),
    [
        ([3.9, 3.9], True), ([4.1, 4.1], False), ([0.0, 0.0, 0.0, 11.5, 0.0, 0.0], True),
        ([0.1] * 19 + [35.9], True), ([0.1] * 19 + [36.1], False),
    ],
)  # fmt: skip
def test_sums_close_in_the_mean_and_each_of_them(chi2: list[float], closes: bool) -> None:
    assert _closes(np.array(chi2)) == closes


def test_few_sums_say_nothing() -> None:
    made = data(n_stations=4)
    assert len(four_triangles(made)) == 4
    noise = np.random.default_rng(3).normal(size=len(made.closure_phase))
    wild = made.with_data(np.concatenate([made.vis2.value, noise]))
    assert list(closures_that_do_not_close(HERE, [wild])) == []


def three(index: np.ndarray) -> np.ndarray:
    index[[1, 4, 6], 1] = index[[1, 4, 6], 0]
    return index


def test_rows_that_name_a_station_twice_are_counted(tmp_path: Path) -> None:
    made = mask_file(holes_m=HOLES_M[:5], n_exposures=1)  # type: ignore[arg-type]
    made.change("OI_T3", three, "STA_INDEX")
    (said,) = found(made, tmp_path, "station-twice")
    assert (said.severity, said.where) == ("error", "OI_T3 (extension 5)")
    assert said.what == "3 rows name a station twice"


VIS2, T3 = "OI_VIS2 (extension 4)", "OI_T3 (extension 5)"
SPOILT: dict[str, tuple[Callable[[MaskFile], None], list[str]]] = {
    "all the same": (lambda f: f.change("OI_VIS2", lambda x: 0 * x + 1, "STA_INDEX"), [VIS2]),
    "absent": (lambda f: f.drop("STA_INDEX"), [VIS2, T3]),
}


@pytest.mark.parametrize("how", SPOILT)
def test_stations_that_tell_nothing_are_said(how: str, tmp_path: Path) -> None:
    made = mask_file(holes_m=HOLES_M[:5], n_exposures=1)  # type: ignore[arg-type]
    spoil, where = SPOILT[how]
    spoil(made)
    said = found(made, tmp_path, "stations")
    assert [f.where for f in said] == where
    assert all("STA_INDEX" in f.what and f.certain for f in said)
    assert not any(re.match("OI_", f.what) for f in said)


def test_coordinates_in_wavelengths_are_no_metres(tmp_path: Path) -> None:
    made = mask_file(holes_m=HOLES_M[:5], n_exposures=1)  # type: ignore[arg-type]
    made.change("OI_VIS2", lambda x: x / 2.1e-6, "UCOORD", "VCOORD")
    (said,) = found(made, tmp_path, "uv-in-wavelengths")
    assert (said.where, said.certain) == (VIS2, True)
    assert "metres" not in said.what
    assert "wavelengths" in said.what

"""Averages of channels, polarisations and exposures, and flagging, against dense algebra."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amibayes.calibration import average_polarisations, bin_channels, flag_by_rule, merge_epochs
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.errors import DataError, UsageError
from amibayes.oifits import read_oifits, write_oifits

STATIONS = np.array([(0.0, 0.0), (10.0, 3.0), (-4.0, 12.0), (7.0, -9.0)])


def noisy(
    rng: np.random.Generator, waves: list[float], mjd: float = 6e4, name: str = "I"
) -> Observables:
    sheet = point_source(
        STATIONS,
        waves,
        [2e-8] * len(waves),
        vis2_error=0.01,
        closure_error_rad=0.02,
        insname=name,
        mjd=mjd,
    )
    noise = sheet.covariance.draw(rng, 1)[:, 0]
    n = len(sheet.vis2)
    return replace(
        sheet,
        vis2=replace(sheet.vis2, value=0.8 + noise[:n]),
        closure_phase=replace(sheet.closure_phase, value=0.1 + noise[n:]),
    )


def test_channels_are_averaged(rng: np.random.Generator) -> None:
    waves = [1.60e-6, 1.62e-6, 1.64e-6, 1.66e-6, 1.68e-6]
    star = noisy(rng, waves)
    found = bin_channels(star, 2)
    np.testing.assert_allclose(found.setups[0].wavelength_m, [1.61e-6, 1.65e-6, 1.68e-6])
    np.testing.assert_allclose(found.setups[0].band_m, [4e-8, 4e-8, 2e-8])
    grid = star.vis2.value.reshape(6, 5)
    expected = np.stack([grid[:, :2].mean(1), grid[:, 2:4].mean(1), grid[:, 4]], axis=1)
    np.testing.assert_allclose(found.vis2.value, expected.ravel())
    phase = star.closure_phase.value.reshape(4, 5)
    expected = np.stack([phase[:, :2].mean(1), phase[:, 2:4].mean(1), phase[:, 4]], axis=1)
    np.testing.assert_allclose(found.closure_phase.value, expected.ravel())
    sigma = found.errors[0].reshape(6, 3)
    np.testing.assert_allclose(sigma, np.tile([0.01 / np.sqrt(2)] * 2 + [0.01], (6, 1)))
    assert found.covariance.rank == 18 + 9
    assert bin_channels(star, 1).covariance.rank == star.covariance.rank
    np.testing.assert_array_equal(bin_channels(star, 1).data, star.data)


def test_covariance_of_an_average_is_exact(rng: np.random.Generator) -> None:
    star = noisy(rng, [1.60e-6, 1.62e-6])
    errors = rng.uniform(0.5, 2.0, star.covariance.size)
    scale = np.diag(errors)
    dense = scale @ star.covariance.dense() @ scale
    from amibayes.data.covariance import dense_covariance

    uneven = replace(star.only(["vis2"]), covariance=dense_covariance(dense[:12, :12]))
    found = bin_channels(uneven, 2)
    weight = 1 / np.diag(dense)[:12].reshape(6, 2)
    matrix = np.zeros((6, 12))
    for i in range(6):
        matrix[i, 2 * i : 2 * i + 2] = weight[i] / weight[i].sum()
    np.testing.assert_allclose(found.vis2.value, matrix @ uneven.vis2.value)
    np.testing.assert_allclose(
        found.covariance.dense(), matrix @ dense[:12, :12] @ matrix.T, atol=1e-18
    )


def test_flagged_channels_do_not_count(rng: np.random.Generator) -> None:
    star = noisy(rng, [1.60e-6, 1.62e-6])
    flag = np.zeros(12, dtype=bool)
    flag[[0, 2, 3]] = True
    value = star.vis2.value.copy()
    value[flag] = np.nan
    used = star.covariance.select(np.flatnonzero(np.r_[~flag, np.ones(8, bool)]))
    star = replace(star, vis2=replace(star.vis2, value=value, flag=flag), covariance=used)
    found = bin_channels(star, 2)
    np.testing.assert_array_equal(found.vis2.flag, [False, True] + [False] * 4)
    np.testing.assert_allclose(found.vis2.value[0], value[1])
    assert found.covariance.size == 5 + 4


def test_average_of_uneven_closures_still_closes(rng: np.random.Generator) -> None:
    star = noisy(rng, [1.60e-6, 1.62e-6, 1.64e-6])
    matrix = closure_matrix(star.closure_phase.stations[::3])[0]
    phases = np.stack([matrix @ rng.normal(size=6) for _ in range(3)], axis=1) * 0.2
    star = replace(star, closure_phase=replace(star.closure_phase, value=phases.ravel()))
    kernel = kernel_basis(matrix)
    for size in (2, 3):
        found = bin_channels(star, size).closure_phase.value.reshape(4, -1)
        np.testing.assert_allclose(found, kernel @ kernel.T @ found, atol=1e-14)


def test_exposures_are_merged(rng: np.random.Generator, tmp_path: Path) -> None:
    first, second, late = (noisy(rng, [1.6e-6, 1.7e-6], mjd) for mjd in (6e4, 60000.01, 60001.0))
    merged = merge_epochs(one_setup(join([first, second, late])), 0.1)
    assert merged.n_vis2 == 24
    mean = (first.vis2.value + second.vis2.value) / 2
    np.testing.assert_allclose(merged.vis2.value[:12], mean)
    np.testing.assert_allclose(merged.vis2.mjd, np.repeat([60000.005, 60001.0], 12))
    np.testing.assert_allclose(merged.vis2.integration_s, np.repeat([2.0, 1.0], 12))
    assert merged.covariance.rank == 24 + 12
    write_oifits(tmp_path / "a.fits", merged)
    back = read_oifits(tmp_path / "a.fits")
    np.testing.assert_array_equal(back.data, merged.data)
    np.testing.assert_array_equal(back.covariance.dense(), merged.covariance.dense())


def one_setup(observables: Observables) -> Observables:
    """Exposures of one instrument as rows of one table."""
    parts = []
    for m in (observables.vis2, observables.closure_phase):
        _, row = np.unique(np.stack([m.setup, m.row]), axis=1, return_inverse=True)
        parts.append(replace(m, setup=np.zeros(len(m), dtype=np.intp), row=row.ravel()))
    return replace(
        observables, vis2=parts[0], closure_phase=parts[1], setups=observables.setups[:1]
    )


def test_exposures_at_other_baselines_are_not_merged(rng: np.random.Generator) -> None:
    first, second = noisy(rng, [1.6e-6]), noisy(rng, [1.6e-6], 60000.01)
    turned = replace(
        second, vis2=replace(second.vis2, u_m=second.vis2.u_m + 1.0, v_m=second.vis2.v_m - 1.0)
    )
    merged = merge_epochs(one_setup(join([first, turned])), 0.1)
    assert merged.n_vis2 == 12
    assert merged.n_closure_phases == 4


def test_turned_triangles_keep_their_sign(rng: np.random.Generator) -> None:
    first, second = noisy(rng, [1.6e-6]), noisy(rng, [1.6e-6], 60000.01)
    c = second.closure_phase
    other = replace(
        c,
        stations=c.stations[:, ::-1],
        value=-c.value,
        u_m=-c.u_m[:, ::-1],
        v_m=-c.v_m[:, ::-1],
    )
    plain = merge_epochs(one_setup(join([first, second])), 0.1)
    mixed = merge_epochs(one_setup(join([first, replace(second, closure_phase=other)])), 0.1)
    np.testing.assert_allclose(mixed.closure_phase.value, plain.closure_phase.value)
    np.testing.assert_array_equal(mixed.closure_phase.stations, plain.closure_phase.stations)


def test_polarisations(rng: np.random.Generator) -> None:
    one, two = (noisy(rng, [2.1e-6, 2.2e-6], name=f"GRAVITY_SC_P{i}") for i in (1, 2))
    found = average_polarisations(join([one, two]))
    assert [s.insname for s in found.setups] == ["GRAVITY_SC"]
    np.testing.assert_allclose(found.vis2.value, (one.vis2.value + two.vis2.value) / 2)
    np.testing.assert_allclose(
        found.closure_phase.value, (one.closure_phase.value + two.closure_phase.value) / 2
    )
    np.testing.assert_allclose(found.covariance.dense() * 2, one.covariance.dense(), rtol=1e-9)
    np.testing.assert_array_equal(found.vis2.integration_s, one.vis2.integration_s)
    with pytest.raises(UsageError, match="no two polarisations"):
        average_polarisations(one)


def test_bad_sizes(rng: np.random.Generator) -> None:
    star = noisy(rng, [1.6e-6])
    for call in (lambda: bin_channels(star, 0), lambda: merge_epochs(star, -1.0)):
        with pytest.raises(UsageError, match=r"bins of 0|window of -1"):
            call()


@pytest.mark.parametrize(
    ("rule", "vis2", "closure"),
    [
        ("vis2>0.8", lambda o: o.vis2.value > 0.8, None),
        ("vis2_error >= 0.02", lambda o: o.errors[0] >= 0.02, None),
        ("snr<79.5", lambda o: o.vis2.value / o.errors[0] < 79.5, None),
        ("cp_deg<=5.7", None, lambda o: np.degrees(o.closure_phase.value) <= 5.7),
        ("cp_error_deg>90", None, None),
        (
            "wavelength_um=1.6",
            lambda o: o.vis2.channel == 0,
            lambda o: o.closure_phase.channel == 0,
        ),
        ("baseline_m>12", "length", "length"),
        (
            "station=h2",
            lambda o: (o.vis2.stations == 1).any(axis=1),
            lambda o: (o.closure_phase.stations == 1).any(axis=1),
        ),
        ("mjd<1", None, None),
    ],
)
def test_flagging_rules(rng: np.random.Generator, rule: str, vis2, closure) -> None:  # type: ignore[no-untyped-def]
    star = noisy(rng, [1.6e-6, 1.7e-6])
    found = flag_by_rule(star, [rule])
    expected = [np.zeros(len(m), bool) for m in (star.vis2, star.closure_phase)]
    if vis2 == "length":
        where = STATIONS[star.vis2.stations]
        expected[0] = np.linalg.norm(where[:, 1] - where[:, 0], axis=1) > 12
        where = STATIONS[star.closure_phase.stations]
        sides = [
            np.linalg.norm(where[:, i] - where[:, j], axis=1) for i, j in ((0, 1), (1, 2), (0, 2))
        ]
        expected[1] = np.max(sides, axis=0) > 12
    else:
        expected = [
            e if rule_of is None else rule_of(star)
            for e, rule_of in zip(expected, (vis2, closure), strict=True)
        ]
    np.testing.assert_array_equal(found.vis2.flag, expected[0])
    np.testing.assert_array_equal(found.closure_phase.flag, expected[1])
    assert found.covariance.size == (~expected[0]).sum() + (~expected[1]).sum()


def test_rules_that_make_no_sense(rng: np.random.Generator) -> None:
    star = noisy(rng, [1.6e-6])
    for rule, said in (
        ("vis3>1", "the rule 'vis3>1' is not understood"),
        ("vis2", "the rule 'vis2' is not understood"),
        ("vis2>much", "the rule 'vis2>much' has no number"),
        ("station=Z9", "the rule 'station=Z9' names no station"),
        ("station>H1", "the rule 'station>H1' names no station"),
    ):
        with pytest.raises(UsageError, match=said):
            flag_by_rule(star, [rule])
    with pytest.raises(DataError, match="nothing is left by mjd>1"):
        flag_by_rule(star, ["mjd>1"])
    # Phases by themselves are data, and so are V².
    left = flag_by_rule(star, ["vis2>-9", "cp_deg<-1e9"])
    assert left.vis2.flag.all()
    assert not left.closure_phase.flag.any()
    left = flag_by_rule(star, ["vis2>1e9", "cp_deg>-1e9"])
    assert left.closure_phase.flag.all()
    assert not left.vis2.flag.any()
    first = float(np.degrees(np.sort(star.closure_phase.value)[0]))
    some = flag_by_rule(star, ["vis2>-9", f"cp_deg>{first}"])
    assert 0 < some.closure_phase.flag.sum() < len(some.closure_phase)


@pytest.mark.parametrize("usable", ["vis2", "closure_phase", None])
def test_bins_of_flagged_data_are_flagged_and_have_no_errors(usable: str | None) -> None:
    """Whichever kind it is, or both: the covariance is of what may be used."""
    data = noisy(np.random.default_rng(1), [1.60e-6, 1.62e-6, 1.64e-6, 1.66e-6])
    kept = [np.full(len(data.vis2), usable == "vis2")]
    kept += [np.full(len(data.closure_phase), usable == "closure_phase")]
    some = replace(
        data,
        vis2=replace(data.vis2, flag=~kept[0]),
        closure_phase=replace(data.closure_phase, flag=~kept[1]),
        covariance=data.covariance.select(np.flatnonzero(np.concatenate(kept))),
    )
    binned = bin_channels(some, 2)
    assert len(binned.vis2) == len(data.vis2) // 2
    assert len(binned.closure_phase) == len(data.closure_phase) // 2
    np.testing.assert_array_equal(binned.vis2.flag, usable != "vis2")
    np.testing.assert_array_equal(binned.closure_phase.flag, usable != "closure_phase")
    used = sum(map(len, kept)) - sum((~k).sum() for k in kept)
    assert binned.covariance.size == used // 2
    # Two independent channels of equal errors.
    np.testing.assert_allclose(
        2.0 * binned.covariance.variance, some.covariance.variance[: used // 2]
    )

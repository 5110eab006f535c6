"""Floors of calibration errors: for whom, how large, and what they do to the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import NIRISS_HOLES

from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.data.systematics import Systematics, n_exposures, systematics_of, table
from amibayes.likelihood.channel_noise import ChannelShare, Correlation, noise_with_channels
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise_fit import fit_noise
from amibayes.report.common import systematics_json


def exposures(n: int, insname: str = "PIONIER_Pnat", channels: int = 1) -> Observables:
    """The same four holes in a row of exposures of one file and one instrument."""
    one = point_source(
        NIRISS_HOLES[:4],
        np.linspace(1.6e-6, 1.7e-6, channels),
        0.02e-6,
        vis2_error=0.01,
        closure_error_rad=0.01,
        insname=insname,
    )
    tables = []
    for m in (one.vis2, one.closure_phase):
        many = m.select(np.tile(np.arange(len(m)), n))
        tables.append(replace(many, row=many.row + 1000 * np.repeat(np.arange(n), len(m))))
    stacked = join([one] * n)
    return replace(stacked, vis2=tables[0], closure_phase=tables[1], setups=one.setups)


def test_table_names_its_sources() -> None:
    assert all(floor.reference for floor in table())
    assert {"PIONIER", "GRAVITY", "MATISSE", "AMBER", "IONIC", "MIRC", "MIRCX"} <= {
        floor.instrument for floor in table()
    }


@pytest.mark.parametrize(("insname", "n"), [("MIRCX_H", 0.02), ("MIRC_H", 0.05), ("NIRISS", None)])
def test_an_instrument_is_known_by_the_beginning_of_its_name(insname, n) -> None:
    found = systematics_of(exposures(1, insname))
    assert [f.vis2 for f in found] == ([] if n is None else [n])


def test_many_exposures_tell_their_own_errors() -> None:
    few, many = exposures(9), exposures(10)
    source = few.setups[0].source
    assert (n_exposures(few, source), n_exposures(many, source)) == (9, 10)
    assert systematics_of(few)[0].instrument == "PIONIER"
    assert systematics_of(many) == ()


def test_numbers_are_taken_for_every_file_and_none_for_none() -> None:
    data = exposures(1, "OTHER")
    assert systematics_of(data) == ()
    (floor,) = systematics_of(data, (0.02, 0.5))
    assert (floor.vis2, floor.closure_phase_rad) == (0.02, pytest.approx(np.radians(0.5)))
    assert systematics_of(exposures(1), "none") == ()


def test_one_channel_gets_the_floor_in_quadrature() -> None:
    data = exposures(1)
    floor = Systematics(data.setups[0].source, 0.03, 0.02)
    variance = noise_with_channels(data, (), [floor]).covariance.variance
    np.testing.assert_allclose(variance[: data.n_vis2], 0.01**2 + 0.03**2, rtol=1e-9)
    np.testing.assert_allclose(variance[data.n_vis2 :], 0.01**2 + 0.02**2, rtol=1e-6)


def test_channels_share_the_floor_so_that_their_mean_keeps_it() -> None:
    data = exposures(1, channels=8)
    floor = Systematics(data.setups[0].source, 0.03, 0.02)
    noise = noise_with_channels(data, (), [floor])
    matrix = noise.covariance.dense()
    at = np.flatnonzero(data.vis2.row == data.vis2.row[0])
    block = matrix[np.ix_(at, at)]
    # Half of the floor is an offset, half a slope, whose mean is none; and curves beside it.
    assert block.mean() == pytest.approx(0.01**2 / 8 + 0.5 * 0.03**2, rel=1e-6)
    curves = 0.5 * 0.03**2 * (1 / 4 + 1 / 16)
    assert np.diag(block).mean() == pytest.approx(0.01**2 + 0.03**2 + curves, rel=1e-6)
    assert noise.floor


def test_noise_that_a_floor_explains_is_not_added_again(rng) -> None:
    data = exposures(1, channels=6)
    floor = Systematics(data.setups[0].source, 0.03, 0.02)
    draw = noise_with_channels(data, (), [floor]).draw(1, rng)[:, 0]
    noisy = data.with_data(data.data + draw)
    theta = np.array([100.0, 50.0, 0.0])
    with_floor = fit_noise(Likelihood(noisy), theta, prior=NoisePrior(floors=(floor,)))
    assert not with_floor.any
    assert with_floor.floors == (floor,)


def test_an_additive_visibility_error_is_what_is_left_near_a_null() -> None:
    data = exposures(1)
    value = np.full(data.n_vis2, 0.02)
    near = replace(data, vis2=replace(data.vis2, value=value))
    floor = Systematics(data.setups[0].source, 0.03, 0.0, visibility=0.02)
    variance = noise_with_channels(near, (), [floor]).covariance.variance[: data.n_vis2]
    # V² of (V + ε)² errs by 2Vε.
    expected = 0.01**2 + (0.03 * value) ** 2 + 4.0 * value * 0.02**2
    np.testing.assert_allclose(variance, expected, rtol=1e-9)


def test_result_has_how_much_larger_than_their_floor_errors_were_found() -> None:
    floors = tuple(Systematics(name, 0.02, 0.0, 0.01) for name in ("a", "b"))
    shares = (ChannelShare(vis2=Correlation(offset=4.0, slope=2.25), source="a"),)
    first, second = systematics_json(ExtraNoise(channels=shares, floors=floors))
    assert (first["vis2_offset_times"], first["vis2_slope_times"]) == (2.0, 1.5)
    assert first["closure_phase_offset_times"] == second["vis2_offset_times"] == 1.0


def test_floors_of_the_table_are_in_radians() -> None:
    """One degree of MIRC-X, which its publication states, is 0.0175."""
    (mircx,) = (one for one in table() if one.instrument == "MIRCX")
    assert mircx.closure_phase_rad == pytest.approx(np.pi / 180.0)
    assert (mircx.vis2, mircx.visibility) == (0.02, 0.005)

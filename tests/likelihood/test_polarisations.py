"""Two polarisations of an exposure err alike: covariance, fit and false alarms by own formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from channel_sets import STATIONS, with_draw

from amibayes.calibration import average_polarisations
from amibayes.companion_search.grid import make_grid
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.data.setup import rows_of_exposures, without_polarisation
from amibayes.data.systematics import Systematics, systematics_of
from amibayes.detection.statistic import make_statistic
from amibayes.likelihood.channel_noise import noise_with_channels
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.smooth_basis import smooth_basis
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions

CHANNELS = np.linspace(2.02e-6, 2.38e-6, 8)
ACROSS = np.linspace(-1.0, 1.0, 8) / np.sqrt((np.linspace(-1.0, 1.0, 8) ** 2).mean())
FLOOR = np.array([0.01, np.radians(0.5)])
PLACE, CONTRAST = np.array([4.0, 5.0]) * np.pi / 180.0 / 3.6e6, 0.03


def gravity(exposures: int = 3, names: tuple[str, ...] = ("P1", "P2"), n: int = 8) -> Observables:
    """Exposures of both polarisations while the sky turns, times apart by milliseconds."""
    parts = []
    for k in range(exposures):
        c, s = np.cos(0.2 * k), np.sin(0.2 * k)
        for late, name in enumerate(names):
            parts.append(
                point_source(
                    STATIONS @ np.array([[c, s], [-s, c]]), CHANNELS[:n], 1e-9, vis2_error=0.004,
                    closure_error_rad=0.004, insname=f"GRAVITY_SC_{name}",
                    mjd=60000.0 + 0.03 * k - 1e-8 * late,
                )
            )  # fmt: skip
    return join(parts)


def observed(sheet: Observables, contrast: float, rng: np.random.Generator) -> Observables:
    """A binary, with gains and phases of baselines that both polarisations have in common."""
    v, t = sheet.vis2, sheet.closure_phase

    def vis(u: np.ndarray, w: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
        turn = np.exp(-2j * np.pi * (u * PLACE[0] + w * PLACE[1]) / wavelength)
        return (1.0 + contrast * turn) / (1.0 + contrast)

    legs = [vis(t.u_m[:, k], t.v_m[:, k], t.wavelength_m) for k in (0, 1)]
    legs.append(np.conj(vis(t.u_m.sum(axis=1), t.v_m.sum(axis=1), t.wavelength_m)))
    exposure = [np.round((m.mjd - 60000.0) / 0.03).astype(int) for m in (v, t)]
    # Half of the variance is an offset, half a slope.
    gain, phase = np.sqrt(0.5) * rng.standard_normal((2, 2, exposure[0].max() + 1, 4, 4))
    at = exposure[0], v.stations[:, 0], v.stations[:, 1]
    vis2 = np.abs(vis(v.u_m[:, 0], v.v_m[:, 0], v.wavelength_m)) ** 2
    vis2 *= 1.0 + FLOOR[0] * (gain[0][at] + gain[1][at] * ACROSS[v.channel])
    closure = np.angle(np.prod(legs, axis=0))
    for i, j, sense in ((0, 1, 1.0), (1, 2, 1.0), (0, 2, -1.0)):
        at = exposure[1], t.stations[:, i], t.stations[:, j]
        shift = phase[0][at] + phase[1][at] * ACROSS[t.channel]
        closure += sense * FLOOR[1] / np.sqrt(3.0) * shift
    noise = sheet.covariance.draw(rng, 1)[:, 0]
    return sheet.with_data(np.concatenate([vis2, closure]) + noise)


@pytest.mark.parametrize("lengths", [(1, 1), (5, 5), (40, 40), (3, 1), (1, 4)])
def test_offset_and_slope_of_two_spectra_are_in_two_rows(lengths, rng) -> None:
    n = sum(lengths)
    weight = rng.uniform(0.5, 2.0, n)
    basis = smooth_basis(weight, lengths)
    turn = np.zeros((n, n))
    turn[basis.row, basis.column] = basis.value
    np.testing.assert_allclose(turn @ turn.T, np.eye(n), atol=1e-12)
    np.testing.assert_allclose(turn[0], weight / np.linalg.norm(weight))
    across = [np.linspace(-1.0, 1.0, k) if k > 1 else np.zeros(1) for k in lengths]
    slope = turn @ (weight * np.concatenate(across))
    np.testing.assert_allclose(slope[2:], 0.0, atol=1e-12)
    spectrum = np.repeat([0, 1], lengths)
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    exact = np.where(spectrum[:, None] == spectrum, 0.7**apart, 0.0)
    np.testing.assert_allclose(basis.variance(0.7), np.diag(turn @ exact @ turn.T))


def test_floor_is_common_to_the_polarisations_of_an_exposure() -> None:
    """V² of 1: means, and slopes, of both channels' spectra have half of the floor in common."""
    data = gravity(2).only(["vis2"])
    found = noise_with_channels(data, (), (Systematics("", 0.01, 0.0),)).covariance.dense()
    row = 6 * data.vis2.setup + data.vis2.row
    for shape in (np.ones(8), ACROSS):
        of_rows = np.zeros((24, len(row)))
        of_rows[row, np.arange(len(row))] = shape[data.vis2.channel] / 8.0
        exposure, baseline = np.divmod(np.arange(24), 12)[0], np.arange(24) % 6
        same = (exposure[:, None] == exposure) & (baseline[:, None] == baseline)
        expected = 0.5 * 0.01**2 * same + 0.004**2 / 8.0 * np.eye(24)
        np.testing.assert_allclose(of_rows @ found @ of_rows.T, expected, atol=1e-12)


def test_floor_of_single_channels_is_common_whole() -> None:
    data = gravity(1, n=1).only(["vis2"])
    found = noise_with_channels(data, (), (Systematics("", 0.01, 0.0),)).covariance.dense()
    same = np.kron(np.ones((2, 2)), np.eye(6))
    np.testing.assert_allclose(found, 0.004**2 * np.eye(12) + 0.01**2 * same, atol=1e-12)


def test_rows_of_an_exposure_are_those_of_both_polarisations() -> None:
    """Two exposures of six baselines; other instruments, and other times, stay by themselves."""
    pairs = gravity(2)
    expected = 12 * (pairs.vis2.setup // 2) + pairs.vis2.row
    np.testing.assert_array_equal(rows_of_exposures(pairs.setups, pairs.vis2), expected)
    for names in (("P1", "P1"), ("A", "B"), ("P1", "P3")):
        other = gravity(2, names)
        assert len(np.unique(rows_of_exposures(other.setups, other.vis2))) == 24
    late = replace(pairs.vis2, mjd=pairs.vis2.mjd + 0.01 * (pairs.vis2.setup % 2))
    assert len(np.unique(rows_of_exposures(pairs.setups, late))) == 24
    turned = replace(pairs.vis2, stations=np.array(pairs.vis2.stations))
    turned = replace(
        turned,
        stations=np.where((pairs.vis2.setup % 2 == 1)[:, None], turned.stations[:, ::-1],
                          turned.stations),
    )  # fmt: skip
    assert len(np.unique(rows_of_exposures(pairs.setups, turned))) == 24


@pytest.mark.parametrize(
    ("name", "expected"), [("GRAVITY_SC_P1", "GRAVITY_SC"), ("SC pol2", "SC"), ("CHIP1X", "CHIP1X")]
)
def test_names_without_polarisation(name, expected) -> None:
    assert without_polarisation(name) == expected


@pytest.mark.slow
def test_two_polarisations_tell_no_more_than_their_average_where_they_err_alike() -> None:
    """Four binaries: errors as of averages (1.4 times smaller before), and 12 pulls of 1 or less.

    The floor's curved part, which these data lack, makes them a little too small.
    """
    options = SearchOptions(separation_mas=(2.0, 12.0))
    pulls, ratios, truth = [], [], np.array([4.0, 5.0, CONTRAST])
    for seed in range(4):
        data = observed(gravity(), CONTRAST, np.random.default_rng(seed))
        both, mean = (search_field(d, options).result for d in (data, average_polarisations(data)))
        errors = [r.companion for r in (both, mean)]
        ratios.append(errors[0].east_error_mas / errors[1].east_error_mas)
        c = both.companion
        off = np.array([c.east_mas, c.north_mas, c.contrast]) - truth
        pulls.append(off / [c.east_error_mas, c.north_error_mas, c.contrast_error])
    assert np.median(ratios) == pytest.approx(1.0, abs=0.15)
    # 12 pulls: their rms is known to 0.2.
    assert 0.4 < np.sqrt(np.square(pulls).mean()) < 1.0 + 3 * 0.2


def test_single_stars_in_two_polarisations_are_no_companions() -> None:
    """Twelve null sets: four below 0.05 are a 0.2 % accident."""
    rng, grid, out = np.random.default_rng(5), make_grid(2.0, 12.0, 0.8), []
    sheet = gravity()
    for _ in range(12):
        draw = observed(sheet, 0.0, rng).data - sheet.data
        likelihood = Likelihood(with_draw(sheet, draw))
        noise = noise_with_channels(likelihood.observables, (), systematics_of(sheet))
        statistic = make_statistic(likelihood.with_noise(noise), grid, np.empty(0))
        null = statistic.draw_null(100, rng)
        out.append((1 + (null >= statistic.value).sum()) / 101.0)
    assert (np.array(out) < 0.05).sum() < 4

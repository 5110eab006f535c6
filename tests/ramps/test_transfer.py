"""Charge that passes between pixels: against analysis, and against light that drifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from charge_drift import drifting_ramp

from amibayes.instrument import load_instrument
from amibayes.optics import scene_image
from amibayes.ramps.transfer import KINDS, LINEARITY, gains, side_densities, side_operator
from amibayes.scene.sources import Scene
from amibayes.simulation.detector import Detector
from amibayes.simulation.ramps import read_ramps
from amibayes.units import FloatArray

PER_E, PEAK_E, N = 3.6e-7, 28_000.0, 24
PER_PIXEL = 20


SILENT = Detector(photon_noise=False, read_noise_e=0.0, dark_e_s=0.0, background_e_s=0.0)


def fine_image(filter_: str = "F480M") -> FloatArray:
    """A star off the middle of a pixel, on cells a twentieth of a pixel wide."""
    instrument = load_instrument("niriss", filter_)
    fine = replace(instrument, pixel_scale_rad=instrument.pixel_scale_rad / PER_PIXEL)
    channels = instrument.bandpass.channels()
    return scene_image(Scene(), fine, channels, N * PER_PIXEL, centre_px=(6.6, -4.2)).centred


def binned(fine: FloatArray, to: int = N) -> FloatArray:
    k = len(fine) // to
    return np.asarray(fine.reshape(to, k, to, k).sum(axis=(1, 3)))


def test_densities_at_sides_are_exact_for_cosines() -> None:
    n, frequency = 40, 0.35
    edge = np.arange(n + 1)
    along = np.sin(2.0 * np.pi * frequency * edge) / (2.0 * np.pi * frequency)
    at_side = np.cos(2.0 * np.pi * frequency * edge[1:-1])
    # Frequencies that do not fit the length leak: the middle is exact to a percent or so.
    found = (side_operator(n) @ np.diff(along))[10:-10]
    np.testing.assert_allclose(found, at_side[10:-10], atol=0.02)
    mean = 0.5 * (np.diff(along)[1:] + np.diff(along)[:-1])[10:-10]
    assert np.abs(mean - at_side[10:-10]).max() > 0.5


@pytest.mark.parametrize("filter_", ["F380M", "F480M"])
def test_densities_of_a_star_are_those_of_its_fine_image(filter_: str) -> None:
    fine = fine_image(filter_)
    along_x, along_y = side_densities(binned(fine))
    # Between two cells on either side of a pixel's edge, summed along the edge, per pixel.
    columns = fine.reshape(N, PER_PIXEL, N * PER_PIXEL).sum(axis=1)
    lines = fine.reshape(N * PER_PIXEL, N, PER_PIXEL).sum(axis=2)
    edge = np.arange(PER_PIXEL, N * PER_PIXEL, PER_PIXEL)
    true_x = 0.5 * (columns[:, edge] + columns[:, edge - 1]) * PER_PIXEL
    true_y = 0.5 * (lines[edge] + lines[edge - 1]) * PER_PIXEL
    # Mirrored ends and the mean of two cells cost some tenths of a percent.
    inside = np.s_[2:-2, 2:-2]
    for found, true in ((along_x, true_x), (along_y, true_y)):
        assert np.abs(found - true)[inside].max() < 8e-3 * true.max()


def test_charge_is_conserved_and_flows_to_the_fainter(rng: np.random.Generator) -> None:
    charge, current = rng.random((2, 3, 12, 14))
    moved = gains(KINDS, charge, current)
    for kind, gained in zip(KINDS, moved, strict=True):
        total = gained.sum(axis=(-1, -2))
        if kind != LINEARITY:
            np.testing.assert_allclose(total, 0.0, atol=1e-12)
    one = np.zeros((9, 9))
    one[4, 4] = 1.0
    by_x, by_y = gains(("x", "y"), one, np.ones((9, 9)))
    np.testing.assert_allclose(by_x[4, 3:6], [1.0, -2.0, 1.0])
    np.testing.assert_allclose(by_y[3:6, 4], [1.0, -2.0, 1.0])
    assert np.count_nonzero(np.abs(by_x) > 1e-12) == 3


def ramp_of(detector: Detector, rate: FloatArray, n_groups: int) -> FloatArray:
    return read_ramps(rate[None], detector, n_groups, np.random.default_rng(1)).reads[:, 0]


def test_the_simulator_agrees_with_light_that_drifts() -> None:
    fine = fine_image()
    n_groups, frame_s = 8, 0.07544
    rate = PEAK_E / (binned(fine).max() * n_groups * frame_s)
    noiseless = replace(SILENT, boundary_shift_x=PER_E, boundary_shift_y=PER_E)
    ours = ramp_of(noiseless, rate * binned(fine), n_groups)
    still = ramp_of(SILENT, rate * binned(fine), n_groups)
    np.testing.assert_allclose(ours.sum(axis=(1, 2)), still.sum(axis=(1, 2)), rtol=1e-12)
    peak = still[-1].argmax()
    last = (ours[-1] - ours[-2]).ravel()[peak]
    assert last / (still[-1].ravel()[peak] / n_groups) == pytest.approx(0.99, abs=0.003)
    # Cells are wrong by the first power of their width: two widths tell what none would give.
    coarse, finer = (
        drifting_ramp(rate * binned(fine, N * k), k, PER_E, frame_s, n_groups, 1)
        for k in (PER_PIXEL // 2, PER_PIXEL)
    )
    effect, expected = ours - still, 2.0 * finer - coarse - still
    assert np.abs(effect - expected).max() < 0.01 * np.abs(expected).max()
    assert float((effect * expected).sum() / (expected**2).sum()) == pytest.approx(1.0, abs=0.005)


def test_stripes_have_their_noise_and_are_shared_by_columns(rng: np.random.Generator) -> None:
    detector = replace(SILENT, stripe_noise_e=6.0)
    reads = read_ramps(np.zeros((100, 5, 64)), detector, 8, rng).reads
    np.testing.assert_array_equal(reads[..., 0, :], reads[..., 4, :])
    columns = reads[:, :, 0]
    # 900 series whose lowest frequencies hold much of the variance: known to 5 % or so.
    assert columns.std() == pytest.approx(6.0, rel=0.1)
    power = (np.abs(np.fft.rfft(columns * np.hanning(64))) ** 2).mean(axis=(0, 1))
    assert power[2:6].mean() / power[16:32].mean() == pytest.approx(24.0 / 4.0, rel=0.4)


def test_light_that_changes_from_frame_to_frame(rng: np.random.Generator) -> None:
    rate = rng.random((3, 2, 4, 4))
    reads = read_ramps(rate, SILENT, 3, rng).reads
    np.testing.assert_allclose(np.diff(reads, axis=0), rate * SILENT.frame_time_s)

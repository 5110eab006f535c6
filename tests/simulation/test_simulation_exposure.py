"""Whole exposures: means, variances, errors, pointing, and the same bits for any workers."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))
from simulated_star import Star, still

from amibayes.errors import UsageError
from amibayes.optics import psf
from amibayes.parallel import ProcessExecutor, SerialExecutor
from amibayes.simulation.detector import Detector, detector_preset
from amibayes.simulation.exposure import (
    Exposure,
    draw_pointings,
    record,
)
from amibayes.units import MAS, FloatArray

MIN_P = 1e-4
"""Chance of a false alarm that a test may have."""


def assert_unit_chi2(pull: FloatArray) -> None:
    """Reduced chi-squared of independent unit normals, within its Monte Carlo error."""
    total = float(np.sum(pull**2))
    p = 2.0 * min(stats.chi2.sf(total, pull.size), stats.chi2.cdf(total, pull.size))
    assert p > MIN_P, f"reduced chi2 {total / pull.size:.4f} of {pull.size}, p = {p:.1e}"


@pytest.mark.parametrize("zero_read", [True, False])
def test_mean_and_variance_maps_are_those_of_the_model(zero_read: bool) -> None:
    n = 2000
    star = Star(still(5, n), Detector(zero_read=zero_read))
    images = star.take()["images"].astype(float)
    sky = star.detector.dark_e_s + star.detector.background_e_s
    light = psf(star.instrument, star.channels, 40) * star.rate_e_s + sky
    model = light / star.maps.flat
    frames = 5 if zero_read else 4
    variance = star.recorder.fit.weights.variance / star.maps.flat**2
    # the least that photons and read noise allow, and the most that a straight line pays
    assert (variance > 0.999 * light / (frames * star.detector.frame_time_s)).all()
    assert_unit_chi2((images.mean(axis=0) - model) / np.sqrt(variance / n))
    ratio = images.var(axis=0, ddof=1) / variance
    assert_unit_chi2((ratio - 1.0) * np.sqrt((n - 1) / 2.0))


@pytest.mark.parametrize("preset", ["paper", "realistic"])
def test_stated_errors_are_the_scatter(preset: str) -> None:
    n = 1500
    star = Star(still(8, n, 32), detector_preset(preset))
    taken = star.take()
    good = (taken["dq"] == 0).all(axis=0)
    assert good.mean() > 0.9
    scatter = taken["images"].var(axis=0, ddof=1, dtype=float)[good]
    stated = (taken["error"].astype(float) ** 2).mean(axis=0)[good]
    light = star.recorder.light(np.zeros((1, 2)))[0][good]
    for low, high in ((0.0, 0.3), (0.3, 0.8), (0.8, 1.0)):
        inside = (light >= np.quantile(light, low)) & (light <= np.quantile(light, high))
        ratio = np.mean(scatter[inside] / stated[inside])
        assert np.sqrt(ratio) == pytest.approx(1.0, abs=0.02), f"{preset}: {low}–{high}"


def test_variance_with_jitter_is_noise_plus_moving_light() -> None:
    n = 2000
    star = Star(Exposure(5, n, dither_rad=0.0, n_pixels=32), Detector(flat_error=0.0))
    images = star.take()["images"].astype(float)
    light = star.recorder.light(star.pointings.jitter_px)
    pull = (images - light - 0.165) / np.sqrt(star.recorder.fit.weights.variance)
    assert_unit_chi2(pull.mean(axis=0) * np.sqrt(n))
    moving = light.var(axis=0, ddof=1)
    measured = images.var(axis=0, ddof=1) - star.recorder.fit.weights.variance
    brightest = np.argsort(moving, axis=None)[-100:]
    ratio = measured.ravel()[brightest].sum() / moving.ravel()[brightest].sum()
    assert ratio == pytest.approx(1.0, abs=0.05)


def fringe_offsets(star: Star, images: FloatArray) -> FloatArray:
    """Offsets in pixels from the phases of the fringes, as one would measure them."""
    pixel, uv = star.instrument.pixel_scale_rad, star.instrument.mask.uv_m
    frequency = uv * pixel / star.channels.mean_m
    place = np.arange(images.shape[-1]) - (images.shape[-1] - 1) / 2
    x = np.exp(-2j * np.pi * np.outer(frequency[:, 0], place))
    y = np.exp(-2j * np.pi * np.outer(frequency[:, 1], place))
    still_image = psf(star.instrument, star.channels, images.shape[-1])
    spectrum = np.einsum("by,nyx,bx->nb", y, images, x, optimize=True)
    reference = np.einsum("by,yx,bx->b", y, still_image, x, optimize=True)
    phase = np.angle(spectrum / reference)
    return phase @ np.linalg.pinv(-2.0 * np.pi * frequency.T)


def test_jitter_and_dither_are_recovered_from_the_images() -> None:
    n = 3000
    quiet = Detector(photon_noise=False, read_noise_e=0.0, flat_error=0.0)
    star = Star(Exposure(2, n, n_pixels=56), quiet)
    offsets = fringe_offsets(star, star.take()["images"].astype(float))
    offsets *= star.instrument.pixel_scale_rad / MAS
    truth = star.pointings.dither_px * star.instrument.pixel_scale_rad / MAS
    np.testing.assert_allclose(offsets.mean(axis=0), truth, atol=5 * 7 / np.sqrt(n) + 0.3)
    # 6000 numbers: their rms is known to 0.9 %
    assert offsets.std(axis=0).mean() == pytest.approx(7.0, rel=0.042)


def test_dither_is_15_mas_rms_over_exposures() -> None:
    exposure = Exposure(2, 1)
    seeds = np.random.SeedSequence(3).spawn(8000)
    dithers = np.array([draw_pointings(exposure, 65.6 * MAS, s).dither_px for s in seeds])
    assert np.std(dithers) * 65.6 == pytest.approx(15.0, rel=0.03)


def test_read_noise_is_recovered_from_a_dark_exposure() -> None:
    n, reads = 1000, 6
    dark = Detector(dark_e_s=0.0, background_e_s=0.0, flat_error=0.0, zero_read=False)
    star = Star(still(reads, n, 16), dark, rate_e_s=0.0)
    images = star.take()["images"].astype(float)
    # a straight line through n reads of noise σ has the slope error σ √(12 / n(n²−1))
    single = images.std() * dark.frame_time_s / np.sqrt(12.0 / (reads * (reads**2 - 1)))
    assert np.sqrt(2.0) * single == pytest.approx(21.0, rel=0.01)


def test_result_does_not_depend_on_the_number_of_workers() -> None:
    star = Star(Exposure(3, 100, n_pixels=24), detector_preset("realistic"))
    alone = star.take()
    executor = ProcessExecutor(2)
    together = star.take(executor)
    executor.close()
    for name, array in alone.items():
        assert array.tobytes() == together[name].tobytes()


def test_a_longer_exposure_begins_like_a_shorter_one() -> None:
    quiet = Detector(photon_noise=False, read_noise_e=0.0)
    short = Star(still(3, 40, 16), quiet)
    long = Star(still(3, 80, 16), quiet)
    np.testing.assert_array_equal(short.take()["images"][:32], long.take()["images"][:32])


def test_integrations_do_not_repeat_their_noise() -> None:
    images = Star(still(2, 64, 16), Detector()).take()["images"]
    noise = (images - images.mean(axis=0)).reshape(64, -1)
    correlation = np.corrcoef(noise) - np.eye(64)
    assert np.abs(correlation).max() < 5.0 / np.sqrt(noise.shape[1])


def test_frames_jitter_about_their_integration() -> None:
    silent = Detector(
        photon_noise=False, read_noise_e=0.0, dark_e_s=0.0, background_e_s=0.0, flat_error=0.0
    )
    moving = replace(still(60, 3, 16), keep_ramps=True, frame_jitter_rad=7.0 * MAS)
    star = Star(moving, silent)
    (chunk,) = record(star.recorder, star.pointings, star.seeds[2], SerialExecutor())
    assert chunk.ramps is not None
    light = np.diff(chunk.ramps, axis=1).reshape(-1, 256)
    px = 7.0 / 65.6
    at = star.recorder.image.at(np.array([[px, 0.0], [0.0, px], [0.0, 0.0]])).reshape(3, 256)
    slope = (at[:2] - at[2]).T
    light = light * (at[2] @ at[2]) / (light @ at[2]).mean()
    found = np.linalg.lstsq(slope, (light - at[2]).T, rcond=None)[0]
    # 240 places: their rms is known to 5 %; the image bends a little on the way.
    assert found.std() == pytest.approx(1.0, abs=0.25)
    assert abs(np.corrcoef(found[0, :-1], found[0, 1:])[0, 1]) < 0.4


def test_ramps_are_kept_on_request() -> None:
    star = Star(replace(still(4, 3, 16), keep_ramps=True), Detector(zero_read=False))
    (chunk,) = record(star.recorder, star.pointings, star.seeds[2], SerialExecutor())
    assert chunk.ramps is not None
    assert chunk.ramps.shape == (3, 4, 16, 16)
    again = np.einsum("nkyx,kyx->nyx", chunk.ramps, star.recorder.fit.weights.reads)
    np.testing.assert_allclose(again / star.maps.flat, chunk.images, rtol=1e-4, atol=1.0)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"n_groups": 1}, "n_groups is 1; a slope needs 2"),
        ({"n_integrations": 0}, "n_integrations is 0; it must be 1 or more"),
        ({"n_pixels": 2}, "n_pixels is 2; it must be 8 or more"),
        ({"jitter_rad": -1.0}, "jitter is -1"),
        ({"dither_rad": float("nan")}, "dither_rad is NaN"),
    ],
)
def test_exposures_that_make_no_sense(numbers: dict[str, float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Exposure(**({"n_groups": 5, "n_integrations": 10} | numbers))


def test_scene_that_saturates_is_one_line() -> None:
    star = Star(still(5, 4, 16), Detector(), rate_e_s=1e8)
    with pytest.raises(UsageError, match=r"the scene saturates: a slope needs 2 groups") as raised:
        star.take()
    assert "\n" not in str(raised.value)

"""The detector: each effect alone against what it must do, and the slope fit against algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from amibayes.cube import DO_NOT_USE, JUMP_DET, SATURATED
from amibayes.cube.ramps import GAIN_E_DN
from amibayes.errors import UsageError
from amibayes.simulation.detector import PRESETS, Detector, detector_preset, draw_maps
from amibayes.simulation.ramps import (
    ADC_WAVES,
    BIAS_DN,
    Ramps,
    converted,
    linearised,
    linearity_coefficients,
    measured_signal,
    read_ramps,
    to_neighbours,
)
from amibayes.simulation.slopes import SlopeFit, electron_variance, group_flags, slope_weights

QUIET = Detector(
    photon_noise=False, read_noise_e=0.0, dark_e_s=0.0, background_e_s=0.0, flat_error=0.0
)
FRAME = QUIET.frame_time_s


def dense_covariance(electrons: float, noise: float, m: int) -> np.ndarray:
    """Covariance of the differences of m + 1 reads, from the reads' own."""
    reads = electrons * np.minimum.outer(np.arange(m + 1), np.arange(m + 1)) + noise**2 * np.eye(
        m + 1
    )
    difference = np.eye(m, m + 1, 1) - np.eye(m, m + 1)
    return difference @ reads @ difference.T


@pytest.mark.parametrize("m", [1, 2, 7, 20])
def test_weights_are_generalised_least_squares(m: int) -> None:
    detector = Detector()
    electrons = np.array([[0.01, 3.0, 220.5, 4000.0]])
    weights = slope_weights(electrons, m, detector)
    for k, value in enumerate(electrons[0]):
        inverse = np.linalg.inv(dense_covariance(value, detector.single_read_noise_e, m))
        total = inverse.sum()
        expected = inverse.sum(axis=0) / total / FRAME
        np.testing.assert_allclose(weights.increments[:, 0, k], expected, rtol=1e-8, atol=1e-12)
        assert weights.variance[0, k] == pytest.approx(1.0 / total / FRAME**2, rel=1e-9)
    np.testing.assert_allclose(weights.increments.sum(axis=0) * FRAME, 1.0, rtol=1e-12)
    np.testing.assert_allclose(weights.reads.sum(axis=0), 0.0, atol=1e-10)


def test_limits_of_read_noise_and_of_photons() -> None:
    n = 8  # reads: a straight line through them has the variance 12 σ²/(n (n² − 1)) per frame²
    dark = slope_weights(np.array([[1e-9]]), n - 1, Detector())
    expected = 12.0 * Detector().single_read_noise_e ** 2 / (n * (n**2 - 1)) / FRAME**2
    assert dark.variance[0, 0] == pytest.approx(expected, rel=1e-6)
    bright = slope_weights(np.array([[1e4]]), n - 1, Detector(read_noise_e=0.0))
    assert bright.variance[0, 0] == pytest.approx(1e4 / (n - 1) / FRAME**2, rel=1e-12)


def test_read_noise_is_that_of_the_difference_of_two_reads(rng: np.random.Generator) -> None:
    detector = replace(QUIET, read_noise_e=21.0)
    reads = read_ramps(np.zeros((400, 16, 16)), detector, 4, rng).reads
    assert reads.shape[0] == 5
    # 0.25 million differences: rms known to 0.2 %
    assert np.std(np.diff(reads, axis=0)[::2]) == pytest.approx(21.0, rel=0.01)


def test_dark_and_background_fill_the_ramp() -> None:
    detector = replace(QUIET, dark_e_s=0.5, background_e_s=1.5)
    reads = read_ramps(np.full((1, 4, 4), 10.0), detector, 3, np.random.default_rng(1)).reads
    np.testing.assert_allclose(reads[:, 0, 0, 0], 12.0 * FRAME * np.arange(4), rtol=1e-12)
    without = replace(detector, zero_read=False)
    reads = read_ramps(np.full((1, 4, 4), 10.0), without, 3, np.random.default_rng(1)).reads
    np.testing.assert_allclose(reads[:, 0, 0, 0], 12.0 * FRAME * np.arange(1, 4), rtol=1e-12)


def test_increments_of_a_ramp_are_independent_poisson_numbers(rng: np.random.Generator) -> None:
    detector = replace(QUIET, photon_noise=True)
    reads = read_ramps(np.full((100, 20, 20), 50.0 / FRAME), detector, 5, rng).reads
    steps = np.diff(reads, axis=0)
    n = steps.size  # 200 000; index of dispersion has the error sqrt(2/n) = 0.0032
    assert steps.mean() == pytest.approx(50.0, abs=5.0 * np.sqrt(50.0 / n))
    assert steps.var() / 50.0 == pytest.approx(1.0, abs=0.016)
    assert np.corrcoef(steps[0].ravel(), steps[1].ravel())[0, 1] == pytest.approx(0.0, abs=0.025)


def test_capacitance_shows_a_pixel_in_its_neighbours() -> None:
    charge = np.zeros((1, 9, 9))
    charge[0, 4, 4] = 1000.0
    signal = measured_signal(charge, replace(QUIET, interpixel_capacitance=0.006))
    assert signal[0, 4, 4] == pytest.approx(976.0)
    assert signal[0, 4, 5] == signal[0, 3, 4] == pytest.approx(6.0)
    assert signal[0, 5, 5] == 0.0
    assert signal.sum() == pytest.approx(1000.0)


def test_migration_takes_from_the_bright_and_gives_to_its_neighbours() -> None:
    charge = np.full((1, 5, 5), 20000.0)
    charge[0, 2, 2] = 30000.0
    signal = measured_signal(charge, replace(QUIET, migration=PRESETS["realistic"].migration))
    assert signal[0, 2, 2] == pytest.approx(0.99 * 30000.0)
    assert signal[0, 2, 1] == pytest.approx(20000.0 + 0.01 * 30000.0 / 4)
    assert signal[0, 0, 0] == 20000.0
    assert signal.sum() == pytest.approx(charge.sum())


def test_nonlinearity_is_undone_where_it_is_known() -> None:
    detector = replace(QUIET, nonlinearity=0.05)
    charge = np.linspace(0.0, 7e4, 50).reshape(1, 5, 10)
    signal = measured_signal(charge, detector)
    assert signal[0, -1, -1] == pytest.approx(7e4 * (1 - 0.05 * 7e4 / 72000))
    np.testing.assert_allclose(linearised(signal, detector), charge, rtol=1e-12, atol=1e-9)
    off = linearised(signal, replace(detector, linearity_error=0.1))
    assert off[0, -1, -1] / 7e4 - 1 == pytest.approx(0.1 * 0.05 * 7e4 / 72000, rel=0.2)


def fit_of(rate: np.ndarray, detector: Detector, n_groups: int) -> SlopeFit:
    maps = draw_maps(detector, rate.shape, np.random.default_rng(1))
    return SlopeFit(rate, detector, maps, n_groups)


def test_saturated_reads_are_left_out() -> None:
    rate = np.full((4, 4), 1000.0)
    rate[1, 1] = 5.5 * 72000 / 10 / FRAME  # full after the first group
    rate[2, 2] = 2.2 * 72000 / 10 / FRAME  # full in the fifth of seven groups
    rate[0, 0] = 15.0 * 72000 / 10 / FRAME  # never a good group
    detector = replace(QUIET, read_noise_e=21.0, zero_read=False)
    ramps = read_ramps(np.tile(rate, (300, 1, 1)), detector, 7, np.random.default_rng(3))
    assert ramps.n_good is not None
    assert ramps.n_good[0, [0, 1, 2, 3], [0, 1, 2, 3]].tolist() == [0, 1, 4, 7]
    slopes = fit_of(rate, detector, 7)(ramps)
    assert slopes.dq[0, [0, 1, 2, 3], [0, 1, 2, 3]].tolist() == [
        SATURATED | DO_NOT_USE,
        SATURATED | DO_NOT_USE,
        SATURATED,
        0,
    ]
    flags = group_flags(ramps, slopes)
    assert flags.shape == (300, 7, 4, 4)
    for k, good in enumerate((0, 1, 4, 7)):
        assert flags[0, :, k, k].tolist() == [0] * good + [SATURATED] * (7 - good)
    assert np.isnan(slopes.images[:, 1, 1]).all()
    assert slopes.images[:, 2, 2].mean() == pytest.approx(rate[2, 2], rel=1e-3)
    ratio = slopes.images[:, 2, 2].var() / slopes.variance[0, 2, 2]
    assert ratio == pytest.approx(1.0, abs=5 * np.sqrt(2 / 299))


def test_cosmic_rays_are_found_and_left_out(rng: np.random.Generator) -> None:
    rate = np.full((40, 40), 2000.0)
    noisy = Detector(zero_read=False, flat_error=0.0, cosmic_rays_s=3e-3)
    ramps = read_ramps(np.tile(rate, (100, 1, 1)), noisy, 7, rng)
    slopes = fit_of(rate, noisy, 7)(ramps)
    hit = (slopes.dq & JUMP_DET) > 0
    # exponential charges: 0.8 of each in its pixel, 0.05 in each neighbour, seen above 5 sigma
    sigma = np.sqrt((2000.0 * FRAME + 21.0**2) * 6 / 5)
    seen = np.exp(-5 * sigma / 0.8 / 3000) + 4 * np.exp(-5 * sigma / 0.05 / 3000)
    expected = 3e-3 * 6 * FRAME * seen
    assert hit.mean() == pytest.approx(expected, rel=0.15)  # some 550 hits: 0.05 rms
    pull = (slopes.images - rate - 0.165) / np.sqrt(slopes.variance)
    assert pull[hit].mean() == pytest.approx(0.0, abs=0.25)
    assert pull[hit].std() == pytest.approx(1.0, abs=0.15)
    assert (slopes.variance[hit] > slopes.variance[~hit].max()).all()
    clean = replace(noisy, cosmic_rays_s=1e-12)
    ramps = read_ramps(np.tile(rate, (100, 1, 1)), clean, 7, rng)
    assert ((fit_of(rate, clean, 7)(ramps).dq & JUMP_DET) > 0).mean() < 1e-4


def test_ramp_with_a_jump_is_fitted_as_two_ramps() -> None:
    detector = replace(QUIET, read_noise_e=21.0, cosmic_rays_s=1e-12, photon_noise=True)
    electrons, m = 300.0, 6
    rng = np.random.default_rng(2)
    steps = rng.normal(electrons, 30.0, m)
    steps[2] += 5000.0
    reads = np.concatenate([[0.0], np.cumsum(steps)]).reshape(-1, 1, 1, 1)
    rate = np.full((1, 1), electrons / FRAME)
    ramps = Ramps(reads, None)
    slopes = fit_of(rate, detector, m)(ramps)
    # The third difference is that of the fourth read.
    assert group_flags(ramps, slopes)[0, :, 0, 0].tolist() == [0, 0, 0, JUMP_DET, 0, 0, 0]
    keep = [0, 1, 3, 4, 5]
    covariance = dense_covariance(electrons, detector.single_read_noise_e, m)[np.ix_(keep, keep)]
    inverse = np.linalg.inv(covariance)
    expected = inverse.sum(axis=0) @ steps[keep] / inverse.sum() / FRAME
    assert slopes.dq[0, 0, 0] == JUMP_DET
    assert slopes.images[0, 0, 0] == pytest.approx(expected, rel=1e-6)
    assert slopes.variance[0, 0, 0] == pytest.approx(1 / inverse.sum() / FRAME**2, rel=1e-6)


def test_bad_pixels_are_flagged_and_of_no_use() -> None:
    detector = replace(QUIET, bad_pixel_fraction=0.1)
    rate = np.full((60, 60), 100.0)
    maps = draw_maps(detector, rate.shape, np.random.default_rng(4))
    fraction = maps.bad.mean()
    assert stats.binomtest(int(maps.bad.sum()), 3600, 0.1).pvalue > 1e-4
    assert not (maps.dead & maps.hot).any()
    fit = SlopeFit(rate, detector, maps, 3)
    slopes = fit(read_ramps(rate[None], detector, 3, np.random.default_rng(1)))
    assert ((slopes.dq & DO_NOT_USE) > 0).mean() == fraction
    assert np.isnan(slopes.images[0, maps.dead]).all()
    assert (slopes.images[0, maps.hot] > 1e4).all()
    np.testing.assert_allclose(slopes.images[0, ~maps.bad], 100.0, rtol=1e-10)


def test_flat_error_is_fixed_and_as_large_as_asked() -> None:
    detector = replace(QUIET, flat_error=1e-3)
    rate = np.full((100, 100), 100.0)
    slopes = fit_of(rate, detector, 3)(
        read_ramps(np.tile(rate, (2, 1, 1)), detector, 3, np.random.default_rng(1))
    )
    np.testing.assert_array_equal(slopes.images[0], slopes.images[1])
    assert slopes.images[0].std() / 100.0 == pytest.approx(1e-3, rel=0.04)


def test_switching_one_effect_leaves_the_others_as_they_were() -> None:
    one = draw_maps(
        Detector(flat_error=0.0, bad_pixel_fraction=0.1), (30, 30), np.random.default_rng(1)
    )
    two = draw_maps(Detector(bad_pixel_fraction=0.1), (30, 30), np.random.default_rng(1))
    np.testing.assert_array_equal(one.bad, two.bad)
    assert (one.flat == 1.0).all()


def test_neighbours_lose_nothing_inside_the_array(rng: np.random.Generator) -> None:
    charge = np.zeros((2, 8, 8))
    charge[:, 2:6, 2:6] = rng.random((2, 4, 4))
    np.testing.assert_allclose(to_neighbours(charge, 0.25).sum(), charge.sum())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"read_noise_e": -1.0}, "detector.read_noise_e is -1; it must be at least 0"),
        ({"frame_time_s": 0.0}, "detector.frame_time_s is 0; it must be above 0"),
        ({"interpixel_capacitance": 0.4}, "at most 0.1"),
        ({"dark_e_s": float("nan")}, "detector.dark_e_s is nan"),
        ({"gain": 1.0}, "a detector has no 'gain'"),
    ],
)
def test_detectors_that_make_no_sense(changes: dict[str, float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        detector_preset("paper", changes)
    with pytest.raises(UsageError, match="choose from paper, realistic"):
        detector_preset("ideal")


def test_ramps_have_the_flat_field_and_slopes_do_not(rng: np.random.Generator) -> None:
    detector = replace(QUIET, flat_field=0.02)
    maps = draw_maps(detector, (16, 16), rng)
    assert maps.sensitivity.std() == pytest.approx(0.02, rel=0.2)
    light = np.full((1, 16, 16), 1e4) * maps.sensitivity
    ramps = read_ramps(light, detector, 4, rng)
    np.testing.assert_allclose(ramps.reads[-1], 4.0 * light * FRAME, rtol=1e-12)
    slopes = SlopeFit(light[0], detector, maps, 4)(ramps)
    np.testing.assert_allclose(slopes.images, 1e4, rtol=1e-12)


def test_the_converter_errs_by_its_waves() -> None:
    # Counts are known from the definition, x / (1 + Σ(s sin + c cos)), the bias frame likewise.
    detector = replace(QUIET, adc_nonlinearity=1.0)
    reads = np.linspace(0.0, 3e4, 901).reshape(1, 1, 1, -1)

    def counts(x: np.ndarray | float) -> np.ndarray:
        waves = sum(
            s * np.sin(2 * np.pi * x / p) + c * np.cos(2 * np.pi * x / p) for p, s, c in ADC_WAVES
        )
        return np.asarray(x / (1.0 + waves))

    expected = GAIN_E_DN * (counts(reads / GAIN_E_DN + BIAS_DN) - counts(BIAS_DN))
    found = converted(reads, detector)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert 3.0 < np.abs(found - reads).max() < 12.0
    assert converted(reads, QUIET) is reads


def test_coefficients_of_linearity_do_what_the_detector_does() -> None:
    detector = replace(QUIET, nonlinearity=0.06, linearity_error=0.01)
    counts = np.linspace(0.0, 40e3, 12).reshape(3, 4)
    expected = linearised(counts * GAIN_E_DN, detector) / GAIN_E_DN
    coefficients = linearity_coefficients(detector, (3, 4))
    found = (coefficients * counts ** np.arange(len(coefficients))[:, None, None]).sum(axis=0)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_light_without_photon_noise_has_no_variance() -> None:
    rate = np.full((4, 4), 100.0)
    noisy = replace(QUIET, photon_noise=True, interpixel_capacitance=0.0)
    assert not electron_variance(rate, QUIET).any()
    np.testing.assert_allclose(electron_variance(rate, noisy), 100.0 * FRAME)

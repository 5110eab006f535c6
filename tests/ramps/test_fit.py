"""Coefficients of migration, fitted to ramps whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amibayes.cube import DO_NOT_USE, JUMP_DET, Cube
from amibayes.cube.container import flag_bits
from amibayes.cube.ramps import GAIN_E_DN, RampFile
from amibayes.cube.timing import GroupTiming
from amibayes.instrument import load_instrument
from amibayes.optics import scene_image
from amibayes.ramps.curvature import Curvature, curvature_of, filled
from amibayes.ramps.fit import MigrationFit, fit_migration
from amibayes.ramps.transfer import KINDS, gains
from amibayes.scene.sources import Scene
from amibayes.simulation.detector import Detector
from amibayes.simulation.ramps import read_ramps
from amibayes.units import FloatArray

TRUE, PEAK_E, N, FRAME_S = 3.6e-7, 28e3, 40, 0.07544


class Held:
    """An array that is read like an HDU."""

    def __init__(self, array: Any) -> None:
        self.section = array


def ramp_file(
    seed: int, n_int: int, n_groups: int, detector: Detector, *, flags: Any = None
) -> RampFile:
    """Ramps of a star whose brightest pixel ends at 28 000 electrons, jittered."""
    rng = np.random.default_rng(seed)
    instrument = load_instrument("niriss", "F480M")
    image = scene_image(
        Scene(), instrument, instrument.bandpass.channels(), N, centre_px=(0.2, -0.3), reach_px=0.5
    )
    light = image.at(0.1 * rng.standard_normal((n_int, 2)).clip(-4, 4))
    rate = PEAK_E / (image.centred.max() * n_groups * detector.frame_time_s)
    reads = read_ramps(np.maximum(rate * light, 0.0), detector, n_groups, rng).reads
    hdus = {"SCI": Held(reads.swapaxes(0, 1))}
    if flags is not None:
        hdus["GROUPDQ"] = Held(flags(reads.swapaxes(0, 1)))
    template = Cube(np.empty((0, N, N)), 3e-7, "NIRISS", "F480M", unit="electron/s")
    timing = GroupTiming(n_groups, FRAME_S, FRAME_S, first_s=FRAME_S)
    return RampFile(template, n_int, hdus, None, timing)


def measured(*arguments: Any, **options: Any) -> Curvature:
    found = curvature_of(ramp_file(*arguments, **options))
    assert found is not None
    return found


MOVING = Detector(zero_read=False, boundary_shift_x=TRUE, boundary_shift_y=TRUE)
SILENT = replace(MOVING, photon_noise=False, read_noise_e=0.1, dark_e_s=0.0)


def pulls(fit: MigrationFit, true: FloatArray) -> FloatArray:
    return np.asarray((fit.migration.value - true) / fit.migration.error)


def test_without_noise_the_coefficients_come_back() -> None:
    different = replace(SILENT, boundary_shift_y=0.5 * TRUE)
    exposures = [measured(k, 8, n, different) for k, n in enumerate((4, 8))]
    fit = fit_migration(exposures)
    # Currents change a little faster than linearly: 1 % of 1 %, and coefficients by half of it.
    np.testing.assert_allclose(fit.migration.value[:2], [TRUE, 0.5 * TRUE], rtol=0.01)
    assert abs(fit.migration.value[2]) < 0.01 * TRUE
    predicted, change = fit.predicted(exposures[1]), exposures[1].change
    used = exposures[1].used
    assert np.abs(predicted - change)[used].max() < 0.02 * np.abs(change).max()


@pytest.mark.parametrize("true", [0.0, TRUE])
def test_estimates_scatter_by_their_errors(true: float) -> None:
    detector = replace(MOVING, boundary_shift_x=true, boundary_shift_y=true)
    fits = [fit_migration([measured(k, 10, 6, detector)]) for k in range(8)]
    off = np.array(
        [pulls(f, np.array([true, true, 0.0])) for f in fits if len(f.migration.value) == 3]
    )
    # 24 pulls, somewhat correlated: rms to 0.2, means to 0.4.
    assert len(off) >= 7
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.7)
    assert np.abs(off.mean(axis=0)).max() < 1.5
    assert sum(f.explained for f in fits) >= 7


@pytest.mark.slow
@pytest.mark.parametrize("n_groups", [5, 8, 19])
def test_bias_and_pulls(n_groups: int) -> None:
    n = 100
    fits = [fit_migration([measured(1000 + k, 20, n_groups, MOVING)]) for k in range(n)]
    # Those of the sides: linearity has a prior, and scatters by less than its error.
    off = np.array(
        [pulls(f, np.array([TRUE, TRUE, *[0.0] * (len(f.migration.value) - 2)]))[:2] for f in fits]
    )
    assert np.abs(off.mean(axis=0)).max() < 4.2 / np.sqrt(n)
    np.testing.assert_allclose(off.std(axis=0), 1.0, atol=4.2 / np.sqrt(2 * n))


def test_exposures_together_are_better_than_alone() -> None:
    parts = [measured(k, 10, 8, MOVING) for k in range(3)]
    alone = [fit_migration([p]).migration.error[0] for p in parts]
    together = fit_migration(parts)
    expected = 1.0 / np.sqrt(np.sum(1.0 / np.square(alone)))
    assert together.migration.error[0] == pytest.approx(expected, rel=0.1)
    assert np.abs(pulls(together, np.array([TRUE, TRUE, 0.0]))).max() < 4.5
    assert together.chi2_without > together.chi2 + 10.0


def test_few_groups_are_refused() -> None:
    assert curvature_of(ramp_file(1, 4, 3, MOVING)) is None
    assert curvature_of(ramp_file(1, 4, 4, MOVING)) is not None


def test_flagged_ramps_do_not_matter() -> None:
    clean = measured(3, 16, 8, MOVING)

    def flags(ramps: FloatArray) -> Any:
        found = np.zeros(ramps.shape, np.uint8)
        ramps[2, 4:, 20, 20] += 8e3
        found[2, 4, 20, 20] = JUMP_DET
        ramps[:, :, 9, 9] = 0.0
        found[:, :, 9, 9] = DO_NOT_USE
        return found

    spoilt = measured(3, 16, 8, MOVING, flags=flags)
    assert not spoilt.used[8:11, 8:11].any()
    assert spoilt.used.sum() == clean.used.sum() - 9
    a, b = (fit_migration([c]).migration for c in (clean, spoilt))
    np.testing.assert_allclose(a.value, b.value, atol=float(0.5 * a.error.min()))


def test_linearity_is_told_from_migration() -> None:
    bent = replace(
        SILENT, boundary_shift_x=0.0, boundary_shift_y=0.0, nonlinearity=0.02, linearity_error=0.1
    )
    plain = measured(1, 8, 8, bent)
    # As of ten thousand times as many integrations, beside which the prior says nothing.
    found = fit_migration([replace(plain, sigma=plain.sigma / 100.0)]).migration
    per_e = dict(zip(found.kinds, found.value, strict=True))
    # q (1 − ε q) undone with 1.1 ε: the current is off by 2 · 0.1 ε per electron.
    assert per_e["linearity"] == pytest.approx(2.0 * 0.1 * 0.02 / 72000.0, rel=0.05)
    assert max(abs(per_e["x"]), abs(per_e["y"])) < 0.05 * per_e["linearity"]


def test_what_correlates_pixels_widens_the_errors() -> None:
    striped = replace(MOVING, stripe_noise_e=40.0)
    fit = fit_migration([measured(5, 40, 8, striped)])
    assert fit.error_scale > 1.1


def test_ramps_that_change_otherwise_are_not_explained() -> None:
    file = ramp_file(7, 40, 8, MOVING)
    reads = file.hdus["SCI"].section
    # A third of the image loses charge early in the ramp, as after a bright star before.
    reads[:, :, 5:18, 5:35] += 60.0 * np.exp(-np.arange(8) / 1.5)[:, None, None]
    found = curvature_of(file)
    assert found is not None
    assert not fit_migration([found]).explained


def test_group_averages_have_the_covariance_of_their_reads(rng: np.random.Generator) -> None:
    timing = GroupTiming(5, 0.4, 0.1, n_frames=3, first_s=0.1)
    n = 200_000
    steps = np.diff(np.concatenate([[0.0], timing.read_s.ravel()]))
    photons = np.cumsum(rng.poisson(50.0 * steps / 0.4, (n, 15)), axis=1)
    groups = photons.reshape(n, 5, 3).mean(axis=2)
    found = np.cov(np.diff(groups, axis=1).T)
    np.testing.assert_allclose(found, 50.0 * timing.photon_covariance, atol=0.7)
    assert timing.middle_s[0] == pytest.approx(0.4)
    one = GroupTiming(5, 0.4, 0.4)
    np.testing.assert_allclose(one.photon_covariance, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(
        one.read_covariance, 2 * np.eye(4) - np.eye(4, k=1) - np.eye(4, k=-1)
    )


def test_fields_of_a_fit_are_plain_numbers() -> None:
    content = fit_migration([measured(2, 6, 5, MOVING)]).as_json()
    assert content["source"] == "fit"
    assert content["coefficients"]["x"]["error_per_e"] > 0.0
    assert SimpleNamespace(**content).n_exposures == 1


def test_further_kinds_are_fitted_where_the_ramps_ask_for_them() -> None:
    plain = measured(11, 8, 8, SILENT)
    kinds = ("x", "y", "diagonal")
    pattern = gains(kinds, plain.current, plain.current)
    sigma = plain.sigma / 100.0  # as of many more integrations
    rng = np.random.default_rng(2)
    noise = np.where(plain.used, sigma, 0.0) * rng.standard_normal(sigma.shape)
    true = np.array([TRUE, TRUE, 0.2 * TRUE])
    exposure = replace(
        plain,
        time_s=0.0,
        change=np.tensordot(true, pattern, axes=1) + noise,
        sigma=sigma,
        batches=plain.batches[:0],
        gains=gains(KINDS, plain.current, plain.current),
    )
    found = fit_migration([exposure]).migration
    assert found.kinds == ("x", "y", "linearity", "diagonal")
    off = (found.value - [TRUE, TRUE, 0.0, 0.2 * TRUE]) / found.error
    assert np.abs(off).max() < 4.5


def test_capacitance_between_pixels_hardly_matters() -> None:
    coupled = replace(SILENT, interpixel_capacitance=0.006)
    found = fit_migration([measured(3, 8, 8, coupled)]).migration
    np.testing.assert_allclose(found.value[:2], TRUE, rtol=0.01)


@pytest.mark.parametrize("flag", [DO_NOT_USE, flag_bits(("DEAD",))])
def test_pixels_flagged_for_the_whole_exposure_are_not_used(flag: int) -> None:
    file = ramp_file(3, 8, 6, MOVING)
    flags = np.zeros((N, N), dtype=np.uint32)
    flags[9, 9] = flag
    file.hdus["PIXELDQ"] = Held(flags)
    found = curvature_of(file)
    assert found is not None
    assert not found.used[9, 9]
    assert found.used[20, 20]


def test_one_integration_has_no_batches() -> None:
    assert len(measured(3, 1, 6, MOVING).batches) == 0
    assert len(measured(3, 4, 6, MOVING).batches) == 4


def test_ramps_of_few_integrations_are_explained() -> None:
    """Their read noise is known to a per cent only, and so is χ²."""
    fits = [fit_migration([measured(seed, 2, 10, MOVING)]) for seed in range(12)]
    p = np.array([[fit.p_value, fit.bend_p_value] for fit in fits])
    # 24 numbers that are uniform, or nearly: one below 4e-5 with a probability of 1e-3.
    assert p.min() > 4e-5
    assert 0.2 < p.mean() < 0.8


def test_errors_do_not_depend_on_the_unit() -> None:
    """The same reads in electrons and in DN of 1.6 electrons."""
    electrons = ramp_file(3, 8, 6, MOVING)
    in_dn = replace(
        electrons,
        template=replace(electrons.template, unit="DN"),
        hdus={"SCI": Held(np.asarray(electrons.hdus["SCI"].section[:]) / GAIN_E_DN)},
    )
    a, b = curvature_of(electrons), curvature_of(in_dn)
    used = a.used & b.used
    np.testing.assert_allclose(a.sigma[used], b.sigma[used], rtol=1e-3)


def test_holes_in_an_even_image_are_filled_with_its_level() -> None:
    """Also where most of the neighbours, and a corner, are missing."""
    rng = np.random.default_rng(1)
    good = rng.uniform(size=(20, 20)) < 0.4
    good[0, 0] = False
    image = np.where(good, 37.0, np.nan)
    np.testing.assert_allclose(filled(image, good), 37.0, rtol=1e-12)

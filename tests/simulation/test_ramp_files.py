"""Simulated ramps: what their file holds, and that they read back as the simulated slopes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from amibayes.cli import main
from amibayes.cube import DO_NOT_USE, JUMP_DET, SATURATED, Cube, read_cube
from amibayes.units import FloatArray

SCENE = """
name = "AB Dor"
[star]
magnitude = 6.0
filter = "F380M"
[instrument]
filter = "F430M"
[exposure]
n_pixels = 32
ramps = true
n_groups = {n_groups}
n_integrations = {n_integrations}
[detector]
preset = "{preset}"
"""

SPOILT = """
cosmic_rays_s = 4e-3
bad_pixel_fraction = 0.02
full_well_e = 18000.0
flat_error = 0.0
"""
"""A hundred times the cosmic rays, and bright pixels that fill up within the ramp. No error of the
flat field, which slopes have and ramps have not."""

N_GROUPS, N_INT = 10, 48


def simulated(folder: Path, preset: str, changes: str = "", n_groups: int = N_GROUPS) -> Path:
    text = SCENE.format(n_groups=n_groups, n_integrations=N_INT, preset=preset) + changes
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    assert main(["simulate", str(path), "--out", str(folder), "--seed", "2", "--quiet"]) == 0
    return folder


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("spoilt"), "realistic", SPOILT)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("plain"), "paper", n_groups=4)


def cubes(folder: Path) -> tuple[Cube, Cube]:
    slopes, ramps = (read_cube(folder / f"AB_Dor_{kind}.fits") for kind in ("calints", "ramp"))
    return slopes, ramps


def pulls(slopes: Cube, ramps: Cube) -> FloatArray:
    assert slopes.error is not None
    return np.asarray((ramps.images - slopes.images) / slopes.error)


def test_ramps_are_read_as_the_slopes_of_the_same_exposure(plain: Path) -> None:
    slopes, ramps = cubes(plain)
    assert ramps.unit == slopes.unit == "electron/s"
    assert ramps.orientation == slopes.orientation
    assert ramps.pixel_scale_rad == pytest.approx(slopes.pixel_scale_rad)
    np.testing.assert_array_equal(ramps.mjd, slopes.mjd)  # type: ignore[arg-type]
    # The flat field is taken off the slopes only; weights differ a little.
    off = pulls(slopes, ramps)
    assert np.median(np.abs(off)) < 0.02
    assert np.abs(off).max() < 0.4
    assert not ramps.dq.any()  # type: ignore[union-attr]


def test_spoilt_ramps_are_read_as_the_simulated_slopes(spoilt: Path) -> None:
    """Cosmic rays, bad pixels and saturation; without flags they were off by up to 660 errors."""
    slopes, ramps = cubes(spoilt)
    assert slopes.dq is not None
    assert slopes.error is not None
    assert ramps.error is not None
    np.testing.assert_array_equal(ramps.dq, slopes.dq)  # type: ignore[arg-type]
    np.testing.assert_array_equal(ramps.bad, slopes.bad)
    off, ratio = pulls(slopes, ramps), ramps.error / slopes.error
    for flag in (0, JUMP_DET, SATURATED):
        those = (slopes.dq == flag) & ~slopes.bad
        assert those.sum() > 100
        # What is left are weights, which follow from the noise that the ramps themselves show.
        assert np.abs(off[those]).max() < 0.2
        assert np.sqrt((off[those] ** 2).mean()) < 0.02
        assert np.mean(ratio[those]) == pytest.approx(1.0, abs=0.03)


def test_flags_are_those_of_the_simulator(spoilt: Path) -> None:
    slopes, _ = cubes(spoilt)
    assert slopes.dq is not None
    with fits.open(spoilt / "AB_Dor_ramp.fits") as hdus:
        hdus.verify("exception")
        assert hdus[0].header["DATAMODL"] == "RampModel"
        assert hdus["PIXELDQ"].header["BITPIX"] == 32
        assert hdus["GROUPDQ"].header["BITPIX"] == 8
        reads, groups, pixels = (hdus[name].data for name in ("SCI", "GROUPDQ", "PIXELDQ"))
    assert reads.shape == groups.shape == (N_INT, N_GROUPS, 32, 32)
    assert (groups.dtype, pixels.dtype) == (np.uint8, np.uint32)
    # Bad pixels are those that every slope is flagged for; nobody else sets DO_NOT_USE here.
    np.testing.assert_array_equal(pixels, np.bitwise_and.reduce(slopes.dq, axis=0) & DO_NOT_USE)
    assert 5 < np.count_nonzero(pixels) < 40
    jumps = (groups & JUMP_DET) > 0
    np.testing.assert_array_equal(jumps.sum(axis=1), (slopes.dq & JUMP_DET) > 0)
    steps = np.diff(reads.astype(float), axis=1)
    n, group, y, x = np.nonzero(jumps)
    np.testing.assert_array_equal(steps[n, :, y, x].argmax(axis=1), group - 1)
    full = (groups & SATURATED) > 0
    np.testing.assert_array_equal(full.any(axis=1), (slopes.dq & SATURATED) > 0)
    assert (full[:, 1:] >= full[:, :-1]).all()  # once full, always full
    assert reads[full].min() > 0.9 * 18000.0


def test_file_of_ramps_without_effects_has_no_flags(plain: Path) -> None:
    with fits.open(plain / "AB_Dor_ramp.fits") as hdus:
        hdus.verify("exception")
        # With the read after the reset, which the paper's detector keeps.
        assert hdus["SCI"].data.shape == hdus["GROUPDQ"].data.shape == (N_INT, 5, 32, 32)
        assert hdus[0].header["NGROUPS"] == 5
        assert not hdus["GROUPDQ"].data.any()
        assert not hdus["PIXELDQ"].data.any()
        steps = np.diff(hdus["SCI"].data.astype(float), axis=1).mean(axis=(0, 1))
    slopes = read_cube(plain / "AB_Dor_calints.fits").images.mean(axis=0)
    assert steps.sum() / 0.07544 == pytest.approx(slopes.sum(), rel=2e-3)

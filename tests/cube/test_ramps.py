"""Ramps as slopes: the truth is that of photons and reads drawn here."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from amibayes.cube import DO_NOT_USE, JUMP_DET, SATURATED, open_cube, read_cube
from amibayes.cube.ramps import RampFile
from amibayes.cube.reference_files import _part
from amibayes.errors import DataError

GAIN, READ_DN, TIME_S = 1.61, 9.0, 0.07544
SHAPE = (40, 8, 16, 16)


def rate_dn_s() -> np.ndarray:
    y, x = np.indices(SHAPE[2:]) - 7.5
    return np.asarray(30_000.0 * np.exp(-(x**2 + y**2) / 8.0) + 20.0)


def ramp_file(path: Path, rng: np.random.Generator, **change: Any) -> Path:
    per_group = rate_dn_s() * TIME_S * GAIN
    charge = np.cumsum(rng.poisson(per_group, SHAPE), axis=1) / GAIN
    ramps = charge + rng.normal(0.0, READ_DN, SHAPE) + 500.0
    flags = np.zeros(SHAPE, np.uint8)
    hdus = {"SCI": ramps.astype(np.float32), "GROUPDQ": flags}
    hdus["PIXELDQ"] = np.zeros(SHAPE[2:], np.uint32)
    hdus |= change.pop("hdus", lambda found: {})(hdus)
    primary = fits.PrimaryHDU()
    keywords = {"INSTRUME": "NIRISS", "FILTER": "F480M", "TGROUP": TIME_S, "PIXELSCL": 0.0656}
    primary.header.update(keywords | change)
    images = [fits.ImageHDU(array, name=name) for name, array in hdus.items()]
    fits.HDUList([primary, *images]).writeto(path)
    return path


def test_slopes_and_errors_are_true(tmp_path: Path, rng: np.random.Generator) -> None:
    cube = read_cube(ramp_file(tmp_path / "a_ramp.fits", rng))
    assert cube.images.shape == (SHAPE[0], *SHAPE[2:])
    assert cube.unit == "DN/s"
    assert cube.error is not None
    pull = (cube.images - rate_dn_s()) / cube.error
    # 10 240 numbers: mean to 0.01, standard deviation to 0.007.
    assert abs(pull.mean()) < 0.05
    assert pull.std() == pytest.approx(1.0, abs=0.04)
    assert not cube.bad.any()


def test_jumps_and_saturation_are_left_out(tmp_path: Path, rng: np.random.Generator) -> None:
    def spoilt(found: dict[str, Any]) -> dict[str, Any]:
        found["SCI"][3, 4:, 5, 6] += 5e4
        found["GROUPDQ"][3, 4, 5, 6] = JUMP_DET
        found["SCI"][4, 5:, 7, 7] = np.nan
        found["GROUPDQ"][5, 6:, 8, 8] = SATURATED
        found["SCI"][5, 6:, 8, 8] = 6e4
        found["GROUPDQ"][6, :, 2, 2] = DO_NOT_USE
        found["PIXELDQ"][1, 1] = DO_NOT_USE
        return {}

    cube = read_cube(ramp_file(tmp_path / "a_ramp.fits", rng, hdus=spoilt))
    assert cube.error is not None
    assert cube.dq is not None
    for at in ((3, 5, 6), (4, 7, 7), (5, 8, 8)):
        assert abs(cube.images[at] - rate_dn_s()[at[1:]]) < 5.0 * cube.error[at]
        assert cube.error[at] > 1.03 * np.median(cube.error[:, at[1], at[2]])
    assert [cube.dq[at] for at in ((3, 5, 6), (4, 7, 7), (5, 8, 8), (6, 2, 2), (7, 2, 2))] == [
        JUMP_DET, JUMP_DET, SATURATED, DO_NOT_USE, 0,
    ]  # fmt: skip
    assert cube.bad[6, 2, 2]
    assert cube.bad[:, 1, 1].all()
    assert cube.bad.sum() == 1 + SHAPE[0]


def test_a_few_integrations_are_those_of_the_whole(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    path = ramp_file(tmp_path / "a_ramp.fits", rng)
    with open_cube(path) as file:
        part = file.read(5, 9)
    np.testing.assert_array_equal(part.images, read_cube(path).images[5:9])


def test_ramps_without_slopes_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    short = ramp_file(
        tmp_path / "a.fits",
        rng,
        hdus=lambda found: {k: v[:, :1] for k, v in found.items() if v.ndim == 4},
    )
    with pytest.raises(DataError, match="1 group"):
        read_cube(short)
    with pytest.raises(DataError, match="TGROUP"):
        read_cube(ramp_file(tmp_path / "b.fits", rng, TGROUP=None))
    wrong = ramp_file(tmp_path / "c.fits", rng, hdus=lambda found: {"PIXELDQ": np.zeros((3, 3))})
    with pytest.raises(DataError, match="PIXELDQ has the shape"):
        read_cube(wrong)


@pytest.mark.parametrize("state", ["COMPLETE", "SKIPPED"])
def test_ramps_that_the_charge_migration_step_has_cut_are_told(
    state: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    cube = read_cube(ramp_file(tmp_path / "a_ramp.fits", rng, S_CHGMIG=state))
    assert any("charge_migration step" in note for note in cube.notes) == (state == "COMPLETE")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"NGROUPS": 5}, r"axes \(40, 8, 16, 16\), and NGROUPS is 5"),
        ({"NFRAMES": "x"}, "NFRAMES"),
        ({"hdus": lambda found: {"GROUPDQ": np.zeros(SHAPE)}}, "GROUPDQ holds floating"),
        ({"hdus": lambda found: {"SCI": np.zeros(SHAPE, np.float32)}}, "every pixel is flagged"),
        (
            {"hdus": lambda found: {"PIXELDQ": np.full(SHAPE[2:], DO_NOT_USE, np.uint32)}},
            "every pixel is flagged",
        ),
        ({"hdus": lambda found: {k: v[0] for k, v in found.items() if v.ndim == 4}}, "three axes"),
    ],
)
def test_ramps_that_are_not_what_the_header_says_are_refused(
    change: dict[str, Any], match: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    with pytest.raises(DataError, match=match):
        read_cube(ramp_file(tmp_path / "a_ramp.fits", rng, **change))


def test_electrons_are_told_by_every_spelling(tmp_path: Path, rng: np.random.Generator) -> None:
    for unit in ("electron", "electrons", "e-"):
        path = ramp_file(tmp_path / f"{unit}_ramp.fits", rng, BUNIT=unit)
        assert read_cube(path).unit == "electron/s"
    assert read_cube(ramp_file(tmp_path / "dn_ramp.fits", rng, BUNIT="DN")).unit == "DN/s"


def test_the_time_of_a_group_follows_from_its_frames(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    change = {"TFRAME": TIME_S / 5.0, "NFRAMES": 4, "GROUPGAP": 1}
    path = ramp_file(tmp_path / "a_ramp.fits", rng, **change)
    fits.delval(path, "TGROUP")
    cube = read_cube(path)
    assert np.median(cube.images / rate_dn_s()) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("n", [2, 3, 40])
def test_read_noise_is_true_of_few_integrations_too(n: int, tmp_path: Path) -> None:
    found = []
    for seed in range(12):
        rng = np.random.default_rng([n, seed])
        path = ramp_file(
            tmp_path / f"{seed}_ramp.fits",
            rng,
            hdus=lambda parts: {k: v[:n] for k, v in parts.items() if v.ndim == 4},
        )
        with open_cube(path) as file:
            assert isinstance(file, RampFile)
            found.append(file.noise[1])
    # 128 faint pixels in each of twelve files: to 0.6 % for n = 2, photons included.
    assert np.sqrt(np.mean(found)) == pytest.approx(READ_DN, rel=0.025)


def test_read_variance_is_known_as_well_as_stated(tmp_path: Path) -> None:
    """Estimates of sixty files scatter as a variance of the stated degrees of freedom does."""
    found = []
    for k in range(60):
        path = ramp_file(tmp_path / f"{k}_ramp.fits", np.random.default_rng([8, k]))
        with open_cube(path) as file:
            assert isinstance(file, RampFile)
            found.append(file.noise[1])
            degrees = file.noise_degrees
    # 60 draws know their own variance to 18 %.
    scatter = np.var(found, ddof=1) / np.mean(found) ** 2
    assert 1.0 / 2.2 < 2.0 / scatter / degrees < 2.2


@pytest.mark.parametrize(("x", "y", "nx", "ny"), [(1, 1, 4, 3), (3, 2, 4, 3), (5, 4, 4, 3)])
@pytest.mark.parametrize("part", [False, True])
def test_reference_files_are_cut_to_the_subarray(
    x: int, y: int, nx: int, ny: int, *, part: bool
) -> None:
    """Pixels by their place on a detector of 8 × 6; a file of the subarray is taken whole."""
    detector = np.arange(48.0).reshape(6, 8) + 100.0 * np.arange(2)[:, None, None]
    expected = detector[:, y - 1 : y - 1 + ny, x - 1 : x - 1 + nx]
    corner = {"SUBSTRT1": x, "SUBSTRT2": y, "SUBSTRT3": 2}
    primary = fits.PrimaryHDU()
    if part:
        primary.header.update(corner)
    held = expected if part else detector
    images = [fits.ImageHDU(held, name="COEFFS"), fits.ImageHDU(held[1], name="DQ")]
    hdus = fits.HDUList([primary, *images])
    buffer = io.BytesIO()
    hdus.writeto(buffer)
    with fits.open(io.BytesIO(buffer.getvalue())) as opened:
        found = _part(opened, "COEFFS", corner, (ny, nx))
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(_part(opened, "DQ", corner, (ny, nx)), expected[1])
        # Beyond the detector there is nothing.
        assert part or _part(opened, "COEFFS", corner | {"SUBSTRT1": 9}, (ny, nx)) is None

"""Cubes: what a header says, files in and out, and one clear line for what cannot be used."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from flagged_cube import make_cube

from amibayes.cube import (
    DO_NOT_USE,
    DQ_FLAGS,
    Cube,
    cube_stream,
    open_cube,
    read_cube,
    write_cube,
)
from amibayes.cube.read import holds_light
from amibayes.errors import DataError, RunError, UsageError
from amibayes.units import DEGREE, MAS


def test_what_is_written_is_read(tmp_path: Path, rng: np.random.Generator) -> None:
    cube = make_cube(rng)
    write_cube(tmp_path / "a_calints.fits", cube)
    back = read_cube(tmp_path / "a_calints.fits")
    for name in ("images", "dq", "mjd"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cube, name))
    np.testing.assert_allclose(back.error, cube.error, rtol=1e-7)
    assert (back.instrument, back.filter, back.unit) == ("NIRISS", "F430M", "electron/s")
    assert back.pixel_scale_rad == pytest.approx(cube.pixel_scale_rad, rel=1e-12)
    assert back.orientation.position_angle_rad == pytest.approx(123.4 * DEGREE, rel=1e-12)
    assert back.orientation.parity == -1
    assert back.integration_time_s == cube.integration_time_s
    assert back.header["TARGPROP"] == "AB-DOR"


def test_a_file_rewritten_is_the_same_cube(tmp_path: Path, rng: np.random.Generator) -> None:
    write_cube(tmp_path / "a.fits", make_cube(rng))
    write_cube(tmp_path / "b.fits", read_cube(tmp_path / "a.fits"))
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()


def test_written_file_keeps_the_standard(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "a.fits"
    write_cube(path, make_cube(rng))
    with fits.open(path) as hdus:
        hdus.verify("exception")
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "SCI", "ERR", "DQ", "INT_TIMES"]
        assert hdus["DQ"].data.dtype == np.uint32
        assert hdus["SCI"].header["BITPIX"] == -32
    assert path.stat().st_size % 2880 == 0


def test_chunks_in_any_order_and_size_are_the_whole(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    cube = make_cube(rng, n=7)
    with cube_stream(tmp_path / "a.fits", cube, 7, mjd=cube.mjd) as stream:
        for start, stop in ((4, 7), (0, 1), (1, 4)):
            part = slice(start, stop)
            stream.write(start, cube.images[part], cube.error[part], cube.dq[part])  # type: ignore[index]
    with open_cube(tmp_path / "a.fits") as file:
        assert file.n_integrations == 7
        chunks = list(file.chunks(3))
    assert [chunk.n_integrations for chunk in chunks] == [3, 3, 1]
    np.testing.assert_array_equal(np.concatenate([c.images for c in chunks]), cube.images)
    np.testing.assert_array_equal(np.concatenate([c.dq for c in chunks]), cube.dq)


def test_reading_in_chunks_keeps_memory_flat(tmp_path: Path) -> None:
    cube = Cube(np.ones((1, 80, 80)), 65.6 * MAS, "NIRISS", "F430M", error=np.ones((1, 80, 80)))
    with cube_stream(tmp_path / "a.fits", cube, 2000) as stream:
        for start in range(2000):
            stream.write(start, cube.images * start, cube.error, cube.dq)
    tracemalloc.start()
    with open_cube(tmp_path / "a.fits") as file:
        means = np.concatenate([c.images.mean(axis=(1, 2)) for c in file.chunks(50)])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(means, np.arange(2000.0))
    assert peak < 40e6  # the whole cube would be 256 MB


def test_orientation_of_a_jwst_file_is_that_of_its_wcs(data: Path) -> None:
    path = data / "cubes" / "niriss_f480m_calints.fits"
    cube = read_cube(path)
    assert cube.images.shape == (69, 80, 80)
    assert (cube.instrument, cube.filter, cube.unit) == ("NIRISS", "F480M", "DN/s")
    assert cube.integration_time_s == pytest.approx(5 * 0.07544)
    with fits.open(path) as hdus:
        wcs = WCS(hdus["SCI"].header, naxis=2)
    x0, y0 = wcs.wcs.crpix - 1.0
    centre = wcs.pixel_to_world(x0, y0)
    for dx, dy in ((1.0, 0.0), (0.0, 1.0), (3.0, -2.0)):
        point = wcs.pixel_to_world(x0 + dx, y0 + dy)
        east, north = cube.orientation.to_sky((dx, dy))
        expected = centre.position_angle(point).deg
        assert np.degrees(np.arctan2(east, north)) % 360 == pytest.approx(
            expected, abs=0.4
        )  # the WCS has shear
    assert cube.pixel_scale_rad == pytest.approx(65.57 * MAS, rel=1e-3)


def test_cube_without_orientation_is_north_up_east_left(data: Path) -> None:
    cube = read_cube(data / "cubes" / "niriss_f480m_target.fits")
    assert (cube.filter, cube.unit) == ("F480M", "photoelectrons")
    assert cube.orientation.to_sky((1.0, 0.0)).tolist() == [-1.0, 0.0]
    east, north = cube.orientation.to_sky((160.0, 117.0))
    assert np.degrees(np.arctan2(east, north)) % 360 == pytest.approx(306.2, abs=0.05)


def test_pixel_scale_of_a_known_instrument_may_be_left_out(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "a.fits", (2, 9, 9), INSTRUME="NIRISS", FILTER="F430M")
    assert read_cube(path).pixel_scale_rad == pytest.approx(65.6 * MAS)


def write_plain(path: Path, shape: tuple[int, ...], **keys: Any) -> Path:
    rng = np.random.default_rng(1)
    hdu = fits.PrimaryHDU(rng.normal(size=shape))
    for key, value in keys.items():
        hdu.header[key] = value
    hdu.writeto(path)
    return path


def test_plain_image_with_options(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "a.fits", (9, 11))
    cube = read_cube(
        path, instrument="SPHERE", filter="K1", pixel_scale_rad=12 * MAS, position_angle_deg=30.0
    )
    assert cube.images.shape == (1, 9, 11)
    assert (cube.instrument, cube.filter) == ("SPHERE", "K1")
    assert cube.orientation.position_angle_rad == pytest.approx(30 * DEGREE)
    assert not cube.bad.any()


def test_option_wins_over_the_header(tmp_path: Path) -> None:
    path = write_plain(
        tmp_path / "a.fits", (2, 9, 9), INSTRUME="NIRISS", FILTER="F380M", PIXELSCL=0.0656
    )
    assert read_cube(path).filter == "F380M"
    assert read_cube(path, filter="F480M").filter == "F480M"
    assert read_cube(path, pixel_scale_rad=1.0 * MAS).pixel_scale_rad == 1.0 * MAS


@pytest.mark.parametrize(
    ("keyword", "value", "comment", "mas"),
    [
        ("PIXSCL", 12.255, "[mas/pixel] plate scale", 12.255),
        ("PIXSCAL", 0.0123, "pixel scale in arcsec", 12.3),
        ("PIXSCALE", 0.0123, "", 12.3),
        ("SECPIX1", 0.01432, "arcsec/pixel", 14.32),
        ("PIXELSCL", 65.6, "milliarcseconds per pixel", 65.6),
        ("PIXSCALE", 3.4e-6, "[deg] per pixel", 12.24),
        ("PIXSCALE", 6.0e-8, "[rad]", 12.376),
    ],
)
def test_pixel_scales_have_the_unit_of_their_comment(
    tmp_path: Path, keyword: str, value: float, comment: str, mas: float
) -> None:
    path = write_plain(tmp_path / "a.fits", (2, 9, 9), INSTRUME="X", FILTER="Y")
    fits.setval(path, keyword, value=value, comment=comment)
    assert read_cube(path).pixel_scale_rad == pytest.approx(mas * MAS, rel=1e-4)


def test_wcs_gives_scale_and_orientation(tmp_path: Path) -> None:
    angle, step = np.radians(20.0), 0.05 / 3600
    path = write_plain(
        tmp_path / "a.fits",
        (9, 9),
        INSTRUME="X",
        FILTER="Y",
        CTYPE1="RA---TAN",
        CTYPE2="DEC--TAN",
        CDELT1=-step,
        CDELT2=step,
        PC1_1=np.cos(angle),
        PC1_2=-np.sin(angle),
        PC2_1=np.sin(angle),
        PC2_2=np.cos(angle),
    )
    cube = read_cube(path)
    assert cube.pixel_scale_rad == pytest.approx(50 * MAS)
    assert cube.orientation.parity == -1
    assert cube.orientation.position_angle_rad == pytest.approx(angle)


def test_bad_pixels_are_flags_and_missing_values(rng: np.random.Generator) -> None:
    images = rng.normal(size=(2, 8, 8))
    images[0, 0, 0] = np.nan
    dq = np.zeros(images.shape, np.uint32)
    dq[1, 2, 3] = DO_NOT_USE
    dq[1, 4, 4] = 4
    error = np.ones(images.shape)
    error[0, 5, 5] = 0.0
    cube = Cube(images, 3e-7, "X", "Y", error=error, dq=dq)
    assert np.argwhere(cube.bad).tolist() == [[0, 0, 0], [0, 5, 5], [1, 2, 3]]
    with pytest.raises(ValueError, match="read-only"):
        cube.images[0, 0, 0] = 1.0


JWST = {"INSTRUME": "NIRISS", "FILTER": "F430M", "PIXELSCL": 0.0656}


def write_calints(path: Path, **arrays: Any) -> Path:
    hdus: list[Any] = [fits.PrimaryHDU()]
    hdus[0].header.update(JWST)
    hdus += [fits.ImageHDU(array, name=name) for name, array in arrays.items()]
    fits.HDUList(hdus).writeto(path)
    return path


def with_times(path: Path, number: list[int], **segment: int) -> Path:
    """Three images with the times of the integrations of these numbers."""
    write_calints(path, SCI=IMAGES)
    columns = [
        fits.Column("integration_number", "J", array=np.array(number)),
        fits.Column("int_mid_MJD_UTC", "D", array=60000.0 + np.array(number)),
    ]
    with fits.open(path, mode="append") as hdus:
        hdus.append(fits.BinTableHDU.from_columns(columns, name="INT_TIMES"))
    for key, value in segment.items():
        fits.setval(path, key, value=value)
    return path


def test_times_of_a_segment_are_found_in_the_table_of_the_exposure(tmp_path: Path) -> None:
    path = with_times(tmp_path / "a.fits", list(range(1, 83)), INTSTART=40, INTEND=42)
    assert read_cube(path).mjd.tolist() == [60040.0, 60041.0, 60042.0]
    with open_cube(path) as file:
        assert file.read(1, 2).mjd.tolist() == [60041.0]
    own = with_times(tmp_path / "b.fits", [40, 41, 42], INTSTART=1, INTEND=3)
    assert read_cube(own).mjd.tolist() == [60040.0, 60041.0, 60042.0]


@pytest.mark.parametrize(
    "segment",
    [{}, {"INTSTART": 40}, {"INTSTART": 40, "INTEND": 43}, {"INTSTART": 82, "INTEND": 84}],
)
def test_times_that_cannot_be_told_are_refused(segment: dict[str, int], tmp_path: Path) -> None:
    path = with_times(tmp_path / "a.fits", list(range(1, 83)), **segment)
    with pytest.raises(DataError, match="INT_TIMES has 82 rows for 3 images") as raised:
        read_cube(path)
    assert "INTSTART" in raised.value.remedy


IMAGES = np.random.default_rng(3).normal(size=(3, 8, 8))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"SCI": np.ones((2, 3, 4, 8, 8))}, "5-dimensional data"),
        ({"SCI": np.ones((2, 4, 8, 8))}, "does not say TGROUP"),
        ({"SCI": np.ones(8)}, r"has the shape \(8,\)"),
        ({"SCI": IMAGES, "DQ": np.zeros((8, 8), np.int32)}, "DQ has the shape"),
        ({"SCI": IMAGES, "ERR": np.ones((3, 8, 9))}, "ERR has the shape"),
        ({"SCI": np.full((3, 8, 8), np.nan)}, "every pixel is flagged"),
        ({"SCI": np.zeros((3, 8, 8))}, "every pixel is flagged"),
        ({"SCI": IMAGES, "DQ": np.ones((3, 8, 8), np.int32)}, "every pixel is flagged"),
        ({}, "holds no image"),
    ],
)
def test_unfit_arrays_are_one_line(tmp_path: Path, arrays: Any, message: str) -> None:
    path = write_calints(tmp_path / "a.fits", **arrays)
    with pytest.raises(DataError, match=message) as raised:
        read_cube(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"INSTRUME": None}, "does not say its instrument"),
        ({"FILTER": None}, "does not say its filter .give filter"),
        ({"PIXELSCL": None, "INSTRUME": "X"}, "does not say its pixel scale"),
        ({"PIXELSCL": -1.0}, "is no pixel scale"),
        ({"PIXELSCL": "small"}, "not a finite number"),
        ({"PUPIL": "CLEARP"}, "not taken through the mask"),
        ({"ROLL_REF": "north"}, "not a finite number"),
        ({"ROLL_REF": 1.0, "VPARITY": 3}, "neither 1 nor -1"),
    ],
)
def test_unfit_headers_are_one_line(tmp_path: Path, keys: Any, message: str) -> None:
    merged = {key: value for key, value in (JWST | keys).items() if value is not None}
    with pytest.raises(DataError, match=message):
        read_cube(write_plain(tmp_path / "a.fits", (3, 8, 8), **merged))


def test_damaged_files_are_one_line(tmp_path: Path, rng: np.random.Generator) -> None:
    whole = tmp_path / "whole.fits"
    write_cube(whole, make_cube(rng, size=(30, 32)))
    content = whole.read_bytes()
    cut = tmp_path / "cut.fits"
    for length in (0, 100, 2880, 9000, 20000, len(content) - 2880):
        cut.write_bytes(content[:length])
        with pytest.raises(DataError, match=r"cut\.fits: "):
            read_cube(cut)
    with pytest.raises(DataError, match="is not there"):
        read_cube(tmp_path / "none.fits")
    with pytest.raises(DataError, match="is a folder"):
        read_cube(tmp_path)


def test_all_dark_cube_is_found_in_chunks_too(tmp_path: Path) -> None:
    path = write_calints(tmp_path / "a.fits", SCI=np.full((4, 8, 8), np.nan))
    with open_cube(path) as file, pytest.raises(DataError, match="every pixel"):
        list(file.chunks(2))


def test_times_of_another_number_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    cube = make_cube(rng)
    with pytest.raises(DataError, match="mjd has the shape"):
        Cube(cube.images, 3e-7, "X", "Y", mjd=np.zeros(3))


def test_failed_writing_leaves_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    cube = make_cube(rng)
    with (
        pytest.raises(ValueError, match="planes of"),
        cube_stream(tmp_path / "a.fits", cube, 5) as stream,
    ):
        stream.write(0, cube.images[:1, :2])
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(RunError, match="cannot be written"):
        write_cube(tmp_path / "no" / "a.fits", cube)


def wcs_file(path: Path, matrix: np.ndarray, **keywords: Any) -> Path:
    header = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "INSTRUME": "NIRISS"})
    header.update({"FILTER": "F480M"} | keywords)
    for i, j in np.ndindex(2, 2):
        header[f"PC{i + 1}_{j + 1}"] = matrix[i, j] / (1.8e-5, 1.7e-5)[i]
    header["CDELT1"], header["CDELT2"] = 1.8e-5, 1.7e-5
    image = np.random.default_rng(1).normal(size=(2, 80, 80))
    fits.PrimaryHDU(image, header).writeto(path)
    return path


def test_orientation_is_that_of_the_wcs_and_contradictions_are_named(tmp_path: Path) -> None:
    angle = 37.0 * DEGREE
    c, s = np.cos(angle), np.sin(angle)
    matrix = 1.82e-5 * np.array([[-c, s], [s, c]]) @ np.array([[1.0, 0.0], [0.004, 1.003]])
    same = read_cube(wcs_file(tmp_path / "a.fits", matrix, ROLL_REF=36.5, V3I_YANG=0.5))
    assert same.notes == ()
    assert same.pixels_known
    np.testing.assert_allclose(
        same.orientation.matrix * same.pixel_scale_rad, matrix * DEGREE, rtol=1e-10
    )
    other = read_cube(wcs_file(tmp_path / "b.fits", matrix, ROLL_REF=35.5, V3I_YANG=0.5, VPARITY=1))
    assert "from ROLL_REF" in other.notes[0]
    assert "VPARITY" in other.notes[1]
    assert other.orientation == same.orientation


@pytest.mark.parametrize("parity", [-1, 1])
def test_wcs_and_roll_of_jwst_are_one_orientation(tmp_path: Path, parity: int) -> None:
    # The relation of jwst's calc_rotation_matrix.
    angle = (40.0 - parity * 7.0) * DEGREE
    c, s = np.cos(angle), np.sin(angle)
    matrix = 1.82e-5 * np.array([[parity * c, s], [-parity * s, c]])
    roll = {"ROLL_REF": 40.0, "V3I_YANG": 7.0, "VPARITY": parity}
    by_wcs = read_cube(wcs_file(tmp_path / "a.fits", matrix, **roll))
    assert by_wcs.notes == ()
    by_roll = read_cube(write_plain(tmp_path / "b.fits", (3, 8, 8), **(JWST | roll)))
    assert by_wcs.orientation.is_like(by_roll.orientation)
    write_cube(tmp_path / "c.fits", by_roll)
    assert read_cube(tmp_path / "c.fits").orientation.is_like(by_roll.orientation)


def test_raw_ramps_are_refused_with_the_step_that_comes_next(data: Path) -> None:
    with pytest.raises(DataError, match=r"uncal.*calwebb_detector1"):
        read_cube(data / "cubes" / "niriss_f480m_uncal.fits")


def test_flags_have_the_names_and_bits_of_jwst(tmp_path: Path) -> None:
    known = {"DO_NOT_USE": 0, "SATURATED": 1, "JUMP_DET": 2, "NON_SCIENCE": 9, "DEAD": 10,
             "HOT": 11, "UNRELIABLE_SLOPE": 24, "REFERENCE_PIXEL": 31}  # fmt: skip
    assert {name: DQ_FLAGS[name] for name in known} == {n: 1 << b for n, b in known.items()}
    dq = np.zeros(IMAGES.shape, np.uint32)
    for k, name in enumerate(("SATURATED", "JUMP_DET", "HOT", "DEAD", "REFERENCE_PIXEL")):
        dq[0, 0, k] = DQ_FLAGS[name]
    path = write_calints(tmp_path / "a.fits", SCI=IMAGES, DQ=dq)
    assert read_cube(path).bad[0, 0, :5].tolist() == [False, False, False, True, True]
    hot = read_cube(path, bad_flags=("HOT", "SATURATED")).bad[0, 0, :5]
    assert hot.tolist() == [True, False, True, False, False]
    with pytest.raises(UsageError, match="did you mean JUMP_DET"):
        _ = read_cube(path, bad_flags=("JUMP_DETT",)).bad


def test_a_single_usable_pixel_that_differs_is_light() -> None:
    cube = make_cube(np.random.default_rng(1), 2)
    even = replace(cube, images=np.full_like(cube.images, 7.0), dq=None, error=None)
    images = even.images.copy()
    images[1, 2, 3] = 8.0
    assert holds_light(replace(even, images=images))
    assert not holds_light(even)
    one = np.where(np.arange(images.size).reshape(images.shape) == 0, 7.0, np.nan)
    assert not holds_light(replace(even, images=one))

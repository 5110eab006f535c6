"""Headers as the instruments write them: which instrument, mask, filter, pixel and orientation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from amibayes.cube import read_cube
from amibayes.cube.header import integration_time_of, pixel_scale_of, wcs_matrix
from amibayes.errors import DataError
from amibayes.instrument import instrument_names, load_instrument
from amibayes.units import MAS

IRDIS = {
    "INSTRUME": "SPHERE",
    "ESO DET ID": "IRDIS",
    "ESO INS1 OPTI1 TYPE": "MASK_SAM",
    "ESO INS1 OPTI2 NAME": "D_K12",
    "ESO INS1 FILT NAME": "B_Ks",
    "ESO INS COMB IFLT": "DB_K12",
    "ESO INS4 COMB ROT": "PUPIL",
    "ESO DET SEQ1 DIT": 2.0,
}
IFS = {
    "INSTRUME": "SPHERE",
    "ESO DET ID": "IFS",
    "ESO INS4 OPTI14 NAME": "ST_SAM",
    "ESO INS2 OPTI2 NAME": "PRI_YJH",
}
GPI = {
    "INSTRUME": "GPI",
    "APODIZER": "APOD_NRM_G6208",
    "IFSFILT": "IFSFILT_K1_G1214",
    "OBSMODE": "NRM_K1",
}
VISIR = {
    "INSTRUME": "VISIR",
    "ESO INS FILT1 NAME": "11_3_SAM",
    "ESO INS PFOV": 0.045,
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CD1_1": -0.0453 / 3600.0,
    "CD1_2": 0.0,
    "CD2_1": 0.0,
    "CD2_2": 0.0453 / 3600.0,
}
VAMPIRES = {"INSTRUME": "VAMPIRES", "U_MASK": "SAM-18-Nudged", "FILTER01": "750-50"}


def written(folder: Path, cards: dict[str, Any]) -> Path:
    hdu = fits.PrimaryHDU(np.random.default_rng(1).random((2, 40, 40)))
    for key, value in cards.items():
        hdu.header[f"HIERARCH {key}" if len(key) > 8 else key] = value
    path = folder / "cube.fits"
    hdu.writeto(path, overwrite=True)
    return path


@pytest.mark.parametrize(
    ("cards", "name", "band", "pixel_mas", "holes"),
    [
        (IRDIS | {"ESO INS1 OPTI2 NAME": "K1"}, "SPHERE", "K1", 12.27, 7),
        (IFS, "SPHERE_IFS", "YJH", 7.46, 7),
        (GPI, "GPI", "K1", 14.1667, 10),
        (GPI | {"IFSFILT": "H"}, "GPI", "H", 14.1667, 10),
        (VISIR, "VISIR", "11_3_SAM", 45.3, 7),
        (VAMPIRES, "VAMPIRES", "750-50", 6.24, 17),
        (VAMPIRES | {"U_MASK": "SAM-7"}, "VAMPIRES_SAM7", "750-50", 6.24, 7),
    ],
)
def test_a_header_names_instrument_mask_and_filter(
    cards: dict[str, Any], name: str, band: str, pixel_mas: float, holes: int, tmp_path: Path
) -> None:
    cube = read_cube(written(tmp_path, cards))
    assert (cube.instrument, cube.filter) == (name, band)
    assert cube.pixel_scale_rad / MAS == pytest.approx(pixel_mas)
    assert load_instrument(cube.instrument, cube.filter).mask.n_holes == holes
    # Only VISIR's header here says how the sky lies on the detector.
    assert bool(cube.notes) == ("CTYPE1" not in cards)
    assert not read_cube(written(tmp_path, cards), position_angle_deg=10.0).notes


@pytest.mark.parametrize(
    ("cards", "said"),
    [
        (IRDIS, r"its filter D_K12 is K1 or K2 \(give filter\)"),
        (IRDIS | {"ESO INS1 OPTI1 TYPE": "MASK_CLEAR"}, "OPTI1 TYPE is MASK_CLEAR"),
        (IFS | {"ESO INS4 OPTI14 NAME": "ST_ALC"}, "OPTI14 NAME is ST_ALC"),
        (GPI | {"APODIZER": "APOD_H_G6205"}, "APODIZER is APOD_H_G6205"),
        (IRDIS | {"ESO DET ID": "ZIMPOL"}, r"of SPHERE with ESO DET ID ZIMPOL.*give instrument"),
        (VAMPIRES | {"U_MASK": "LyotStop"}, "of VAMPIRES with U_MASK LyotStop"),
        (GPI | {"CTYPE3": "WAVE"}, "an image of each wavelength"),
        (VISIR | {"ESO INS FILT1 NAME": "PAH2"}, "FILT1 NAME is PAH2"),
        (VAMPIRES | {"FILTER01": "Open"}, "does not say its filter"),
    ],
)
def test_what_is_not_a_cube_of_the_mask_is_refused(
    cards: dict[str, Any], said: str, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=said):
        read_cube(written(tmp_path, cards))


def test_a_cube_that_was_cut_out_and_says_little_is_read_as_before(tmp_path: Path) -> None:
    cube = read_cube(written(tmp_path, {"INSTRUME": "SPHERE", "FILTER": "K1"}))
    assert (cube.instrument, cube.filter) == ("SPHERE", "K1")


def test_an_option_says_which_of_two_filters(tmp_path: Path) -> None:
    assert read_cube(written(tmp_path, IRDIS), filter="K2").filter == "K2"


@pytest.mark.parametrize("name", instrument_names())
def test_every_name_of_a_filter_in_a_header_is_one_of_the_instrument(name: str) -> None:
    from amibayes.instrument import header_rules

    for found in header_rules(name).filters.values():
        for one in found.split(" or "):
            assert not one or load_instrument(name, one).bandpass.name == one


@pytest.mark.parametrize(
    ("header", "matrix"),
    [
        ({"CD1_1": -2e-5, "CD1_2": 1e-5, "CD2_1": 1e-5, "CD2_2": 2e-5},
         [[-2e-5, 1e-5], [1e-5, 2e-5]]),
        ({"CD1_1": -2e-5, "CD2_2": 2e-5}, [[-2e-5, 0.0], [0.0, 2e-5]]),
        ({"CDELT1": -2e-5, "CDELT2": 3e-5}, [[-2e-5, 0.0], [0.0, 3e-5]]),
        ({"CDELT1": -2e-5, "CDELT2": 3e-5, "PC1_2": 0.6, "PC2_1": -0.6},
         [[-2e-5, -1.2e-5], [-1.8e-5, 3e-5]]),
        ({"CDELT1": -2e-5, "CDELT2": 3e-5, "PC1_1": 0.8, "PC2_2": 0.7},
         [[-1.6e-5, 0.0], [0.0, 2.1e-5]]),
        ({"CDELT1": -2e-5}, None),
        ({}, None),
    ],
)  # fmt: skip
def test_matrices_of_a_wcs_are_those_of_the_standard(
    header: dict[str, float], matrix: list[list[float]] | None
) -> None:
    """CD as it is, PC times CDELT, the unit matrix where neither is given (astropy's too)."""
    axes = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"}
    found = wcs_matrix(axes | header, "a")
    assert wcs_matrix(header, "a") is None
    if matrix is None:
        assert found is None
        return
    assert found is not None
    np.testing.assert_allclose(np.degrees(found), matrix, rtol=1e-12)
    np.testing.assert_allclose(np.degrees(found), WCS(axes | header).pixel_scale_matrix)


@pytest.mark.parametrize(
    ("scale", "comment", "mas"),
    [
        (0.0656, "", 65.6),
        (65.6, "[mas] side of a pixel", 65.6),
        (0.0656, "arcsec per pixel", 65.6),
        (9.9, "", 9900.0),
        (0.011, "mas", 0.011),
        (10.1, "", None),
        (0.009, "mas", None),
        (0.0, "", None),
        (-0.0656, "", None),
    ],
)
def test_pixel_scales_are_of_a_size_that_pixels_have(
    scale: float, comment: str, mas: float | None
) -> None:
    header, comments = {"PIXELSCL": scale}, {"PIXELSCL": comment}
    if mas is None:
        with pytest.raises(DataError, match="is no pixel scale"):
            pixel_scale_of(header, "a", comments)
    else:
        found = pixel_scale_of(header, "a", comments)
        assert found is not None
        assert np.degrees(found) * 3.6e6 == pytest.approx(mas)


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        ({"EFFINTTM": 1.5, "TGROUP": 0.5, "NGROUPS": 7}, 1.5),
        ({"TGROUP": 0.5, "TFRAME": 0.1, "NGROUPS": 7}, 3.5),
        ({"TFRAME": 0.1, "NGROUPS": 7}, 0.7),
        ({"TGROUP": 0.5}, None),
        ({"NGROUPS": 7}, None),
        ({}, None),
    ],
)
def test_time_of_an_integration(header: dict[str, float], seconds: float | None) -> None:
    found = integration_time_of(header, "a")
    assert found == (None if seconds is None else pytest.approx(seconds))

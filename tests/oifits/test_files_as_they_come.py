"""Files of many pipelines: what they leave out or write otherwise changes no number.

Each spoilt file is held against the sound file it was made of: the same data, and the same
covariance, which depends on the sides that triangles share.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from oi_builders import MaskFile

from amibayes.data.observables import Observables
from amibayes.errors import DataError
from amibayes.extraction.reading import read_observations
from amibayes.instrument import load_instrument
from amibayes.oifits import read_oifits
from amibayes.oifits.audit import audit

Spoil = Callable[[MaskFile], None]


@pytest.fixture
def made(rng: np.random.Generator) -> MaskFile:
    return MaskFile(rng)


def assert_same(found: Observables, sound: Observables) -> None:
    np.testing.assert_allclose(found.data, sound.data)
    np.testing.assert_allclose(found.vis2.u_m, sound.vis2.u_m)
    np.testing.assert_allclose(found.closure_phase.mjd, sound.closure_phase.mjd, atol=1e-8)
    assert found.n_independent == sound.n_independent
    np.testing.assert_allclose(found.covariance.dense(), sound.covariance.dense(), atol=1e-16)


def no_stations(made: MaskFile) -> None:
    made.drop("STA_INDEX")


def zero_stations(made: MaskFile) -> None:
    for name in {"OI_VIS2", "OI_T3"} & set(made.tables):
        made.change(name, np.zeros_like, "STA_INDEX")


def repeated_stations(made: MaskFile) -> None:
    made.change("OI_VIS2", lambda s: np.tile([1, 2], (len(s), 1)), "STA_INDEX")
    made.change("OI_T3", lambda s: np.tile([1, 2, 3], (len(s), 1)), "STA_INDEX")


def rounded(made: MaskFile) -> None:
    zero_stations(made)
    made.change("OI_VIS2", lambda x: np.round(x, 3), "UCOORD", "VCOORD")
    made.change("OI_T3", lambda x: np.round(x, 3), "U1COORD", "V1COORD", "U2COORD", "V2COORD")


def no_array(made: MaskFile) -> None:
    del made.tables["OI_ARRAY"]
    for name in ("OI_VIS2", "OI_T3"):
        del made.keywords[name]["ARRNAME"]


def no_array_no_stations(made: MaskFile) -> None:
    no_array(made)
    no_stations(made)


def no_flags(made: MaskFile) -> None:
    made.drop("FLAG")


def flags_as_letters(made: MaskFile) -> None:
    for name in ("OI_VIS2", "OI_T3"):
        made.put(name, "FLAG", ["FF"] * len(made.tables[name]["MJD"][1]), form="2A")


def flags_as_bytes(made: MaskFile) -> None:
    for name in ("OI_VIS2", "OI_T3"):
        values = np.full((len(made.tables[name]["MJD"][1]), 2), ord("F"), np.uint8)
        made.put(name, "FLAG", values, form="2B")


def version_two(made: MaskFile) -> None:
    for keywords in made.keywords.values():
        keywords["OI_REVN"] = 2


def no_mjd(made: MaskFile) -> None:
    made.drop("MJD")


def mjd_zero(made: MaskFile) -> None:
    for name in ("OI_VIS2", "OI_T3"):
        made.change(name, np.zeros_like, "MJD")


def no_mjd_no_stations(made: MaskFile) -> None:
    no_mjd(made)
    no_stations(made)


def no_target_id(made: MaskFile) -> None:
    made.drop("TARGET_ID")


VARIANTS: tuple[Spoil, ...] = (
    no_stations,
    zero_stations,
    repeated_stations,
    no_array,
    no_array_no_stations,
    no_flags,
    flags_as_letters,
    flags_as_bytes,
    version_two,
    no_mjd,
    mjd_zero,
    no_mjd_no_stations,
    no_target_id,
)


@pytest.mark.parametrize(
    "compressed", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["plain", "gz"]
)
@pytest.mark.parametrize("spoil", VARIANTS, ids=lambda f: f.__name__)
def test_what_is_left_out_changes_no_number(
    made: MaskFile, tmp_path: Path, spoil: Spoil, compressed: bool
) -> None:
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    assert sound.notes == ()
    spoil(made)
    path = made.write(tmp_path / "spoilt.fits")
    if compressed:
        packed = gzip.compress(path.read_bytes())
        path = tmp_path / "spoilt.fits.gz"
        path.write_bytes(packed)
    assert_same(read_oifits(path), sound)


def test_rounded_coordinates_still_tell_stations(made: MaskFile, tmp_path: Path) -> None:
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    rounded(made)
    found = read_oifits(made.write(tmp_path / "spoilt.fits"))
    np.testing.assert_allclose(found.covariance.dense(), sound.covariance.dense(), atol=1e-16)
    assert len(found.setups[0].stations) == 7


REDUNDANT_M = np.array(
    [(0, 0), (2.92, 0), (4.38, -2.52), (-1.46, -2.52), (0, -5.04), (1.46, -5.88), (3.36, -4.57)]
)
"""Two pairs of its baselines are alike."""


@pytest.mark.parametrize("name", ["sphere", "gpi", "redundant"])
def test_other_masks(rng: np.random.Generator, tmp_path: Path, name: str) -> None:
    """Baselines that two pairs of holes share must not join triangles that share no hole."""
    holes = REDUNDANT_M
    if name != "redundant":
        holes = np.asarray(load_instrument(name, {"sphere": "H2", "gpi": "H"}[name]).mask.holes_m)
    made = MaskFile(rng, holes_m=holes, n_exposures=2)
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    zero_stations(made)
    found = read_oifits(made.write(tmp_path / "spoilt.fits"))
    assert len(found.setups[0].stations) == len(holes)
    np.testing.assert_allclose(found.covariance.dense(), sound.covariance.dense(), atol=1e-16)


def test_any_order_of_rows_and_corners(made: MaskFile, rng: np.random.Generator, tmp_path: Path):
    """Triangles in another order in every exposure, walked the other way round or shifted."""
    keys = [("U1COORD", "V1COORD"), ("U2COORD", "V2COORD")]
    t3 = made.tables["OI_T3"]
    first, second = (np.stack([t3[k][1] for k in pair], axis=1) for pair in keys)
    corners = t3["STA_INDEX"][1].copy()
    turn = rng.integers(0, 2, len(first)).astype(bool)
    # a → b → c becomes b → c → a: the sides 2 and −(1 + 2).
    new_first = np.where(turn[:, None], second, first)
    new_second = np.where(turn[:, None], -(first + second), second)
    corners[turn] = np.roll(corners[turn], -1, axis=1)
    order = rng.permutation(len(first))
    order = order[np.argsort(t3["MJD"][1][order], kind="stable")]
    made.change("OI_T3", lambda x: x[order], *[k for k in t3 if "COORD" not in k])
    for pair, legs in zip(keys, (new_first, new_second), strict=True):
        for i, column in enumerate(pair):
            made.change("OI_T3", lambda _, i=i, legs=legs: legs[order, i], column)
    made.put("OI_T3", "STA_INDEX", corners[order])
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    zero_stations(made)
    found = read_oifits(made.write(tmp_path / "spoilt.fits"))
    np.testing.assert_allclose(found.covariance.dense(), sound.covariance.dense(), atol=1e-16)


def test_triangles_alone(made: MaskFile, tmp_path: Path) -> None:
    del made.tables["OI_VIS2"]
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    zero_stations(made)
    found = read_oifits(made.write(tmp_path / "spoilt.fits"))
    np.testing.assert_allclose(found.covariance.dense(), sound.covariance.dense(), atol=1e-16)


def test_baselines_alone(made: MaskFile, tmp_path: Path) -> None:
    del made.tables["OI_T3"]
    zero_stations(made)
    found = read_oifits(made.write(tmp_path / "spoilt.fits"))
    assert found.n_vis2 == 3 * 21 * 2
    assert len(np.unique(found.vis2.stations[::2], axis=0)) == 21


@pytest.mark.parametrize("factor", [0.75, 1.031, 2.0])
def test_common_factor_of_the_triangles(made: MaskFile, tmp_path: Path, factor: float) -> None:
    """A program that took another mean wavelength for the triangles."""
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    zero_stations(made)
    made.change("OI_T3", lambda x: x / factor, "U1COORD", "V1COORD", "U2COORD", "V2COORD")
    found = read_oifits(made.write(tmp_path / "spoilt.fits"))
    assert any(f"{factor:.4f} times those of the triangles" in note for note in found.notes)
    assert len(found.setups[0].stations) == 7
    np.testing.assert_allclose(found.covariance.dense(), sound.covariance.dense(), atol=1e-16)


def test_null_flags_are_no_flags(made: MaskFile, tmp_path: Path) -> None:
    path = made.write(tmp_path / "a.fits")
    sound = read_oifits(path)
    raw = bytearray(path.read_bytes())
    with fits.open(path) as hdus:
        for hdu in (hdus["OI_VIS2"], hdus["OI_T3"]):
            start, width = hdu.fileinfo()["datLoc"], hdu.header["NAXIS1"]
            for row in range(len(hdu.data)):
                raw[start + (row + 1) * width - 2 : start + (row + 1) * width] = b"\0\0"
    path.write_bytes(raw)
    assert_same(read_oifits(path), sound)


def test_flags_in_letters_are_obeyed(made: MaskFile, tmp_path: Path) -> None:
    n = len(made.tables["OI_VIS2"]["MJD"][1])
    made.put("OI_VIS2", "FLAG", ["FT", *["FF"] * (n - 1)], form="2A")
    found = read_oifits(made.write(tmp_path / "a.fits"))
    assert list(np.flatnonzero(found.vis2.flag)) == [1]


def test_closure_phases_that_are_all_zero_are_none(made: MaskFile, tmp_path: Path) -> None:
    """Files of V² alone may hold them, with errors as if they were measured."""
    made.change("OI_T3", np.zeros_like, "T3PHI")
    path = made.write(tmp_path / "a.fits")
    found = read_oifits(path)
    assert found.closure_phase.flag.all()
    assert not found.vis2.flag.any()
    assert any("exactly 0, as all of the table" in note for note in found.notes)
    assert "blank-phases" in {f.code for f in audit(path).findings}


def test_some_closure_phases_may_be_zero(made: MaskFile, tmp_path: Path) -> None:
    made.change("OI_T3", lambda x: np.where(np.arange(x.size).reshape(x.shape), 0.0, x), "T3PHI")
    assert not read_oifits(made.write(tmp_path / "a.fits")).closure_phase.flag.any()


def test_arrays_of_variable_length(made: MaskFile, tmp_path: Path) -> None:
    sound = made.write(tmp_path / "sound.fits")
    with fits.open(sound) as hdus:
        for number, hdu in enumerate(hdus):
            if hdu.name not in {"OI_VIS2", "OI_T3"}:
                continue
            columns = [
                fits.Column(c.name, "PD()", array=np.array(hdu.data[c.name], dtype=object))
                if c.format == "2D"
                else c
                for c in hdu.columns
            ]
            own = {k: hdu.header[k] for k in ("EXTNAME", "INSNAME", "ARRNAME") if k in hdu.header}
            hdus[number] = fits.BinTableHDU.from_columns(columns, fits.Header(own))
        hdus.writeto(tmp_path / "a.fits")
    assert_same(read_oifits(tmp_path / "a.fits"), read_oifits(sound))


def test_several_targets(made: MaskFile, tmp_path: Path) -> None:
    """Rows of two targets without stations: each is identified by itself."""
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    for column, more in (("TARGET_ID", [1, 2]), ("TARGET", ["alf Test", "bet Test"])):
        made.put("OI_TARGET", column, more)
    for column in ("RAEP0", "DECEP0"):
        made.put("OI_TARGET", column, [10.0, 20.0])
    zero_stations(made)
    for name in ("OI_VIS2", "OI_T3"):
        for column, (form, values, unit) in made.tables[name].items():
            more = 2 if column == "TARGET_ID" else np.asarray(values)
            both = np.concatenate([values, np.broadcast_to(more, np.shape(values))])
            made.tables[name][column] = form, both, unit
    path = made.write(tmp_path / "two.fits")
    with pytest.raises(DataError, match="several targets: alf Test, bet Test"):
        read_oifits(path)
    for name in ("alf Test", "bet test"):
        assert_same(read_oifits(path, target=name), sound)


@pytest.mark.parametrize(
    ("unit", "scale"), [("m", 1.0), ("", 1.0), ("Mlambda", 1e-6), ("cycles/rad", 1.0)]
)
def test_coordinates_in_wavelengths(
    rng: np.random.Generator, tmp_path: Path, unit: str, scale: float
) -> None:
    made = MaskFile(rng, n_channels=1)
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    columns = {"OI_VIS2": ["UCOORD", "VCOORD"]}
    columns["OI_T3"] = ["U1COORD", "V1COORD", "U2COORD", "V2COORD"]
    for name, names in columns.items():
        for column in names:
            values = made.tables[name][column][1] / made.wavelength_m[0] * scale
            made.put(name, column, values, unit=unit)
    found = read_oifits(made.write(tmp_path / "a.fits"))
    np.testing.assert_allclose(found.vis2.u_m, sound.vis2.u_m, rtol=1e-6)
    np.testing.assert_allclose(found.closure_phase.v_m, sound.closure_phase.v_m, rtol=1e-6)
    assert any("UCOORD is in wavelengths" in note and "converted" in note for note in found.notes)


def test_coordinates_in_wavelengths_of_several_channels(made: MaskFile, tmp_path: Path) -> None:
    made.change("OI_VIS2", lambda x: x / 2.1e-6, "UCOORD", "VCOORD")
    with pytest.raises(DataError, match=r"UCOORD is in wavelengths .*2 channels"):
        read_oifits(made.write(tmp_path / "a.fits"))


def test_bytes_in_the_wrong_order_are_named(made: MaskFile, tmp_path: Path) -> None:
    swapped = np.asarray(made.wavelength_m, ">f4").byteswap()
    made.put("OI_WAVELENGTH", "EFF_WAVE", swapped)
    with pytest.raises(DataError, match="bytes are in the reverse of FITS's order"):
        read_oifits(made.write(tmp_path / "a.fits"))


def test_the_real_cause_is_named(made: MaskFile, tmp_path: Path) -> None:
    for name in ("OI_VIS2", "OI_T3"):
        made.change(name, np.zeros_like, "VIS2ERR" if name == "OI_VIS2" else "T3PHIERR")
    with pytest.raises(DataError, match="0 of 126 flagged in the file, 126 without a usable error"):
        read_oifits(made.write(tmp_path / "a.fits"))


def test_a_file_of_an_aperture_masking_pipeline(data: Path) -> None:
    found = read_oifits(data / "oifits" / "uvonly_sam.oifits")
    assert (found.n_vis2, found.n_closure_phases) == (252, 420)
    assert found.n_independent == 252 + 6 * 2 * 15
    assert len(found.setups[0].stations) == 7


def test_what_an_audit_calls_an_error_stands_in_the_notes(made: MaskFile, tmp_path: Path) -> None:
    made.change("OI_T3", lambda x: x / 1.05, "U1COORD", "V1COORD", "U2COORD", "V2COORD")
    path = made.write(tmp_path / "a.fits")
    (found,) = read_observations(path)
    assert any("(u, v) of baselines are 1.0500 times" in note for note in found.notes)
    assert {f.code for f in audit(path).findings if f.severity == "error"} >= {"uv-factor"}

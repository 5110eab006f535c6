"""``audit --fix``: what is certain is fixed, and every other byte stays."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from oi_builders import MaskFile
from test_files_as_they_come import (
    assert_same,
    mjd_zero,
    no_flags,
    no_stations,
    no_target_id,
    repeated_stations,
    zero_stations,
)

from amibayes.oifits import read_oifits
from amibayes.oifits.audit import audit, repair


@pytest.fixture
def made(rng: np.random.Generator) -> MaskFile:
    return MaskFile(rng)


def fixed(path: Path, copy: Path) -> set[str]:
    found = audit(path)
    return {f.code for f in repair(found.oifits, list(found.findings), copy)}


def segments(path: Path) -> dict[str, bytes]:
    """The bytes of every HDU."""
    raw = path.read_bytes()
    with fits.open(path) as hdus:
        places = {hdu.name: hdu.fileinfo() for hdu in list(hdus)[::-1]}  # the first of a name
    return {n: raw[p["hdrLoc"] : p["datLoc"] + p["datSpan"]] for n, p in places.items()}


def in_wavelengths(made: MaskFile) -> None:
    made.change("OI_VIS2", lambda x: x / 2.1e-6, "UCOORD", "VCOORD")


CASES: dict[str, tuple[Callable[[MaskFile], Any], str, set[str]]] = {
    "no stations": (no_stations, "stations", {"OI_VIS2", "OI_T3"}),
    "zero": (zero_stations, "stations", {"OI_VIS2", "OI_T3"}),
    "repeated": (repeated_stations, "stations", {"OI_VIS2", "OI_T3"}),
    "no flags": (no_flags, "column-missing", {"OI_VIS2", "OI_T3"}),
    "no target": (no_target_id, "column-missing", {"OI_VIS2", "OI_T3"}),
    "no date": (mjd_zero, "date", {"OI_VIS2", "OI_T3"}),
}


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gz"])
@pytest.mark.parametrize("name", CASES)
def test_fixed_files_say_themselves_what_had_to_be_guessed(
    made: MaskFile, tmp_path: Path, name: str, packed: bool
) -> None:
    spoil, code, tables = CASES[name]
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    spoil(made)
    path, copy = made.write(tmp_path / "spoilt.fits"), tmp_path / "fixed.fits"
    before = segments(path)
    if packed:
        packed_path = tmp_path / "spoilt.fits.gz"
        packed_path.write_bytes(gzip.compress(path.read_bytes()))
        path, copy = packed_path, tmp_path / "fixed.fits.gz"
    assert code in fixed(path, copy)
    assert copy.read_bytes()[:2] == (b"\x1f\x8b" if packed else b"SI")
    again = audit(copy)
    assert code not in {f.code for f in again.findings if f.certain}
    found = read_oifits(copy)
    assert found.notes == ()
    assert_same(found, sound)
    if not packed:
        after = segments(copy)
        assert {k for k in before if after[k] != before[k]} == tables


def test_an_error_without_a_unit_is_converted_with_its_phase(
    made: MaskFile, tmp_path: Path
) -> None:
    """A file whose errors have the unit of the phases and do not say so."""
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    made.put("OI_T3", "T3PHI", np.radians(made.tables["OI_T3"]["T3PHI"][1]), unit="rad")
    made.put("OI_T3", "T3PHIERR", np.radians(made.tables["OI_T3"]["T3PHIERR"][1]), unit="")
    path, copy = made.write(tmp_path / "spoilt.fits"), tmp_path / "fixed.fits"
    assert fixed(path, copy) >= {"unit"}
    found = read_oifits(copy)
    np.testing.assert_allclose(found.data, sound.data)
    np.testing.assert_allclose(found.covariance.dense(), sound.covariance.dense())
    with fits.open(copy) as hdus:
        units = {c.name: c.unit for c in hdus["OI_T3"].columns}
        assert units["T3PHI"] == units["T3PHIERR"] == "deg"
        assert 0.5 <= hdus["OI_T3"].data["T3PHIERR"].min() <= 0.7


def test_null_flags_become_false(made: MaskFile, tmp_path: Path) -> None:
    path, copy = made.write(tmp_path / "a.fits"), tmp_path / "b.fits"
    sound = read_oifits(path)
    raw = bytearray(path.read_bytes())
    with fits.open(path) as hdus:
        start, width = hdus["OI_VIS2"].fileinfo()["datLoc"], hdus["OI_VIS2"].header["NAXIS1"]
    for row in range(5):
        raw[start + (row + 1) * width - 2 : start + (row + 1) * width] = b"\0\0"
    path.write_bytes(raw)
    assert any("10 value(s) of FLAG are NULL" in f.what for f in audit(path).findings)
    assert "flag-null" in fixed(path, copy)
    assert "flag-null" not in {f.code for f in audit(copy).findings}
    assert_same(read_oifits(copy), sound)
    assert segments(copy)["OI_T3"] == segments(path)["OI_T3"]


def test_coordinates_in_wavelengths_become_metres(rng: np.random.Generator, tmp_path: Path) -> None:
    made = MaskFile(rng, n_channels=1)
    sound = read_oifits(made.write(tmp_path / "sound.fits"))
    in_wavelengths(made)
    path, copy = made.write(tmp_path / "a.fits"), tmp_path / "b.fits"
    assert "uv-in-wavelengths" in fixed(path, copy)
    np.testing.assert_allclose(read_oifits(copy).vis2.u_m, sound.vis2.u_m, rtol=1e-6)
    assert segments(copy)["OI_T3"] == segments(path)["OI_T3"]


def test_a_public_file_of_a_masking_pipeline(data: Path, tmp_path: Path) -> None:
    path, copy = data / "oifits" / "uvonly_sam.oifits", tmp_path / "fixed.fits"
    assert fixed(path, copy) == {"stations", "flag-null", "unit-spelling"}
    found, sound = read_oifits(copy), read_oifits(path)
    assert found.notes == ()
    assert_same(found, sound)

"""Masses from a user's table: what it may hold, what is said of it, and where it ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy import constants, units
from astropy.table import Table

from amibayes.errors import DataError
from amibayes.limits.mass_table import read_mass_table
from amibayes.report.limits import _curve_line

MASS = np.array([1.0, 2.0, 5.0, 10.0, 20.0])
MAGNITUDE = np.array([14.0, 12.5, 10.0, 8.0, 6.5])


@pytest.mark.parametrize("form", ["ecsv", "csv"])
def test_mass_of_a_magnitude_and_back(tmp_path: Path, form: str) -> None:
    path = tmp_path / f"tracks.{form}"
    table = Table({"mass_mjup": MASS, "absolute_mag": MAGNITUDE})
    table.write(path, format=f"ascii.{form}")
    masses = read_mass_table(path, primary_magnitude=3.0)
    np.testing.assert_allclose(masses.mass_at(MAGNITUDE - 3.0), MASS)
    # Log-linear: halfway in magnitude is the geometric mean.
    np.testing.assert_allclose(masses.mass_at(np.array([6.0])), np.sqrt(50.0))
    np.testing.assert_allclose(masses.delta_mag_at(MASS), MAGNITUDE - 3.0)
    assert np.isnan(masses.mass_at(np.array([2.0, 20.0, np.nan]))).all()
    assert masses.unit == "M_Jup"


def test_differences_need_no_magnitude_of_the_star_and_units_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "tracks.ecsv"
    Table({"mass": MASS * units.Unit("jupiterMass"), "delta_mag": MAGNITUDE}).write(path)
    masses = read_mass_table(path)
    np.testing.assert_allclose(masses.mass_at(MAGNITUDE), MASS)
    assert masses.unit == "jupiterMass"


def test_magnitudes_have_the_unit_that_the_table_gives(tmp_path: Path) -> None:
    path = tmp_path / "tracks.ecsv"
    table = Table({"mass_mjup": MASS, "delta_mag": 1000.0 * MAGNITUDE})
    table["delta_mag"].unit = "mmag"
    table.write(path)
    np.testing.assert_allclose(read_mass_table(path).mass_at(MAGNITUDE), MASS)
    table["delta_mag"].unit = "Jy"
    table.write(path, overwrite=True)
    with pytest.raises(DataError, match="no unit of magnitudes"):
        read_mass_table(path)


def test_a_table_of_a_spreadsheet_may_begin_with_the_mark_of_utf8(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text("mass_mjup,delta_mag\n10,7\n80,4\n", encoding="utf-8-sig")
    assert read_mass_table(path).mass.tolist() == [80.0, 10.0]


def test_masses_change_units(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text("mass_msun,delta_mag\n0.01,7\n0.08,4\n")
    masses = read_mass_table(path).converted_to("M_Jup")
    ratio = constants.M_sun / constants.M_jup
    np.testing.assert_allclose(masses.mass, np.array([0.08, 0.01]) * ratio, rtol=1e-6)
    with pytest.raises(ValueError, match="convertible"):
        masses.converted_to("m")


def test_limits_outside_the_table_are_counted() -> None:
    curve = {
        "observables": ["vis2", "cp"],
        "separation_mas": [100.0, 200.0, 300.0],
        "delta_mag": [5.0, 6.0, None],
        "mass": [20.0, None, None],
        "mass_unit": "M_Jup",
        "mass_table_delta_mag": [3.0, 5.5],
    }
    line = _curve_line(curve)
    assert line.endswith("mass 20 to 20 M_Jup; 1 of 2 outside the table of masses (3 to 5.5)")
    inside = _curve_line({**curve, "delta_mag": [5.0, None, None]})
    assert inside.endswith("mass 20 to 20 M_Jup")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mass,absolute_mag\n1,14\n2,12\n", "primary_magnitude=M"),
        ("weight,delta_mag\n1,14\n2,12\n", "no column mass"),
        ("mass,colour\n1,14\n2,12\n", "no column delta_mag"),
        ("mass,delta_mag\n1,14\n", "two rows"),
        ("mass,delta_mag\n1,14\n2,14\n", "two rows"),
        ("mass,delta_mag\n-1,14\n2,12\n", "above zero"),
        ("mass,delta_mag\n2,14\n1,12\n", "one age"),
        ("mass,delta_mag\nheavy,14\n1,12\n", "no number"),
        ("mass,delta_mag\n,14\n1,12\n", "no number"),
        ("# %ECSV 1.0\nnothing\n", "neither an ECSV nor a CSV"),
        ("", "no column mass"),
        ("\x00\xff", "is no text"),
    ],
)
def test_faults_are_named_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "tracks.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=message) as caught:
        read_mass_table(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)

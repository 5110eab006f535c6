"""Masses from a user's table: what it may hold, what is said of it, and where it ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy import units
from astropy.table import Table

from amibayes.errors import DataError
from amibayes.limits.mass_table import read_mass_table

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

"""What is flagged, averaged and divided out before a fit is the same in every command."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from oi_builders import MaskFile, random_observables

from amibayes.calibration import (
    average_polarisations,
    bin_channels,
    diameters_of,
    flag_by_rule,
    merge_epochs,
    reduce_data,
    without_disc,
)
from amibayes.cli.main import build_parser
from amibayes.cli.options import data_options
from amibayes.data.shared_errors import SharedErrors
from amibayes.errors import DataError, UsageError
from amibayes.oifits import read_oifits
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.prepare import prepare
from amibayes.pipeline.run import Run
from amibayes.scene.disc import uniform_disc

WORDS = ["--flag", "vis2>0.9", "--bin-channels", "2", "--merge-epochs", "1"]


@pytest.fixture
def path(rng: np.random.Generator, tmp_path: Path) -> Path:
    made = MaskFile(rng, n_exposures=2, n_channels=4, turn_deg=0.1)
    return made.write(tmp_path / "a.fits")


@pytest.mark.parametrize("kind", ["diagonal", "assumed", "given"])
def test_scaled_covariance_is_that_of_scaled_data(rng: np.random.Generator, kind: str) -> None:
    covariance = random_observables(rng, kind=kind).covariance
    factors = rng.uniform(0.5, 2.0, covariance.size)
    if kind != "diagonal":
        factors[21:] = 1.0  # closure phases keep their kernel space
    found = covariance.scaled(factors)
    expected = factors[:, None] * covariance.dense() * factors
    np.testing.assert_allclose(found.dense(), expected, atol=1e-18)
    assert found.rank == covariance.rank
    x = covariance.draw(rng, 1)[:, 0]
    np.testing.assert_allclose(
        x @ covariance.solve(x), (factors * x) @ found.solve(factors * x), rtol=1e-8
    )


def test_a_calibrator_freed_of_its_disc_is_a_point(rng: np.random.Generator) -> None:
    point = random_observables(rng, kind="assumed")
    m = point.vis2
    frequency = np.hypot(m.u_m[:, 0], m.v_m[:, 0]) / m.wavelength_m
    squared = uniform_disc(frequency, 40.0)[0] ** 2
    resolved = replace(point, vis2=replace(m, value=m.value * squared))
    found = without_disc(resolved, 40.0)
    np.testing.assert_allclose(found.data, point.data)
    np.testing.assert_allclose(found.errors[0], point.errors[0] / squared)
    assert without_disc(resolved, 0.0) is resolved
    # The error of the diameter: half of the difference that both ends of it make.
    charge = SharedErrors(("charge",), 0.01 * point.data[:, None])
    unsure = without_disc(without_disc(resolved.with_shared_errors(charge), 20.0), 34.0, 0.02)
    ends = [without_disc(without_disc(resolved, 20.0), d).data for d in (34.02, 33.98)]
    assert unsure.shared is not None
    with pytest.raises(UsageError, match="already"):
        without_disc(unsure, 5.0, 0.01)
    np.testing.assert_allclose(unsure.shared.changes[:, 1], (ends[0] - ends[1]) / 2, rtol=1e-4)
    own = unsure.without_shared_errors().covariance.dense()
    every = unsure.shared.changes @ unsure.shared.changes.T
    np.testing.assert_allclose(unsure.covariance.dense(), own + every, atol=1e-12)


def test_reduction_is_its_steps_in_their_order(path: Path) -> None:
    data = read_oifits(path)
    found = reduce_data(data, flag=["vis2>0.9"], channels=2, epochs_days=1.0)
    expected = merge_epochs(bin_channels(flag_by_rule(data, ["vis2>0.9"]), 2), 1.0)
    np.testing.assert_array_equal(found.data, expected.data)
    assert reduce_data(data) is data
    with pytest.raises(UsageError, match="no two polarisations"):
        reduce_data(data, polarisations=True)
    assert average_polarisations is not None


@pytest.mark.parametrize("command", ["search", "limits", "vet", "calibrate"])
def test_every_command_has_the_options(command: str, tmp_path: Path) -> None:
    rules = tmp_path / "rules.txt"
    rules.write_text("# what the night report says\nvis2>0.9\n\nstation=H1  # shutter\n")
    words = [command, "T", *(["--cal", "C"] if command != "vet" else [])]
    words += ["--flag", str(rules), *WORDS, "--calibrator-diameters", "0.3"]
    arguments = build_parser(command).parse_args(words)
    assert arguments.calibrator_diameters == "0.3"
    assert data_options.reduction_of(arguments) == {
        "flag": ("vis2>0.9", "station=H1", "vis2>0.9"),
        "polarisations": False,
        "channels": 2,
        "epochs_days": 1.0,
    }


def test_a_search_reduces_its_data(path: Path) -> None:
    options = SearchOptions(flag=("vis2>0.9",), bin_channels=2, merge_epochs_days=1.0)
    rng = np.random.default_rng(1)
    found = prepare([path], [], options, rng, Run()).observables
    expected = reduce_data(read_oifits(path), flag=["vis2>0.9"], channels=2, epochs_days=1.0)
    np.testing.assert_array_equal(found.data, expected.data)
    np.testing.assert_allclose(found.covariance.dense(), expected.covariance.dense())


def test_a_search_takes_diameters_of_calibrators(
    rng: np.random.Generator, path: Path, tmp_path: Path
) -> None:
    """V² of the target rise by those of the calibrator's disc: it was fainter on long baselines."""
    cal = MaskFile(rng, n_exposures=2, n_channels=4, turn_deg=0.1).write(tmp_path / "c.fits")
    found = {}
    for diameter in (None, "30"):
        options = SearchOptions(calibrator_diameters=diameter)
        prepared = prepare([path], [cal], options, rng, Run())
        found[diameter] = prepared.observables
    m = found["30"].vis2
    disc = uniform_disc(np.hypot(m.u_m[:, 0], m.v_m[:, 0]) / m.wavelength_m, 30.0)[0]
    np.testing.assert_allclose(m.value / found[None].vis2.value, disc**2, rtol=2e-3)


def test_diameters_need_calibrators() -> None:
    arguments = build_parser("search").parse_args(["search", "T", "--calibrator-diameters", "0.3"])
    with pytest.raises(UsageError, match="needs calibrators"):
        data_options.search_settings(arguments)
    assert isinstance(arguments, argparse.Namespace)
    assert diameters_of(None, []) is None


def test_a_table_of_the_jsdc_gives_the_diameter_in_the_band_of_the_data(path: Path) -> None:
    """Columns of VizieR II/346; spaces of names do not matter."""
    data = read_oifits(path)
    setup = replace(data.setups[0], target="HD_100", wavelength_m=np.array([1.6e-6, 1.7e-6]))
    star = replace(data, setups=(setup,))
    table = path.with_name("jsdc.csv")
    table.write_text("Name,LDD,e_LDD,UDDH,UDDK\nHD 99,9,9,9,9\nHD 100,0.52,0.03,0.50,0.51\n")
    assert diameters_of(table, [star]) == [(0.50, 0.03)]
    infrared = replace(star, setups=(replace(setup, wavelength_m=np.array([2.2e-6])),))
    assert diameters_of(table, [infrared]) == [(0.51, 0.03)]
    thermal = replace(star, setups=(replace(setup, wavelength_m=np.array([3.7e-6, 3.9e-6])),))
    table.write_text("Name,LDD,e_LDD,UDDH,UDDK,UDDL,UDDM\nHD 100,0.52,0.03,0.50,0.51,0.53,0.54\n")
    assert diameters_of(table, [thermal]) == [(0.53, 0.03)]
    table.write_text("Name,LDD\nHD 100,0.52\n")
    with pytest.raises(DataError, match="or those of the JSDC"):
        diameters_of(table, [star])


def test_a_table_of_diameters_has_its_own_units_and_one_line_for_each(path: Path) -> None:
    """Angles with a unit are converted; an error that is left out is not known, and none."""
    data = read_oifits(path)
    setup = replace(data.setups[0], target="HD_100")
    star = replace(data, setups=(setup,))
    table = path.with_name("sizes.ecsv")
    rows = Table({"name": ["HD 100"], "diameter_mas": [0.0005], "error_mas": [0.00003]})
    rows["diameter_mas"].unit = rows["error_mas"].unit = "arcsec"
    rows.write(table)
    np.testing.assert_allclose(diameters_of(table, [star]), [(0.5, 0.03)])
    table = path.with_name("sizes.csv")
    text = "name,diameter_mas,error_mas\nHD 100,0.5,0.03\nHD 100,0.5,0.03\nHD 99,0.4,\n"
    table.write_text(text, encoding="utf-8-sig")  # as spreadsheets do
    other = replace(data, setups=(replace(setup, target="HD 99"),))
    assert diameters_of(table, [star, other]) == [(0.5, 0.03), (0.4, 0.0)]
    table.write_text(text + "HD 100,0.9,0.03\n")
    with pytest.raises(DataError, match="several diameters"):
        diameters_of(table, [star])


@pytest.mark.parametrize("given", ["nan", "-5", "0.3:-1", "inf", "0.3:nan"])
def test_a_diameter_is_no_less_than_zero(given: str, path: Path) -> None:
    star = read_oifits(path)
    with pytest.raises(DataError, match="calibrator_diameters: has a diameter of"):
        diameters_of(given, [star])
    with pytest.raises(UsageError, match="neither a table nor a list"):
        diameters_of("0.3:0.01:7", [star])

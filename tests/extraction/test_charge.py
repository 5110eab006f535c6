"""Charge migration from ramps and slopes to the files and words of every command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run

from amibayes.extraction.charge import CubeMigration
from amibayes.extraction.reading import contents_of
from amibayes.instrument import load_instrument
from amibayes.optics import scene_image
from amibayes.parallel import SerialExecutor
from amibayes.report.noise import migration_json, migration_lines
from amibayes.scene.sources import Point, Scene
from amibayes.simulation.detector import Detector, draw_maps
from amibayes.simulation.exposure import Exposure
from amibayes.simulation.observation import Observation
from amibayes.simulation.observe import prepare_exposure, write_exposure

TRUE, PEAK_E, GROUPS = 6.0e-7, 28e3, 6
INSTRUMENT = load_instrument("niriss", "F480M")
MOVING = Detector(zero_read=False, boundary_shift_x=TRUE, boundary_shift_y=TRUE)
FAST = ("--null-draws", 0, "--no-posterior", "--no-limits", "--diameter", 0)


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A target and two calibrators, one as bright and one of a fifth: slopes, ramps beside."""
    folder = tmp_path_factory.mktemp("visit")
    share = scene_image(Scene(), INSTRUMENT, INSTRUMENT.bandpass.channels()).centred.max()
    for k, (ratio, n) in enumerate(((1.0, 40), (1.0, 40), (0.2, 80))):
        rate = ratio * PEAK_E / (share * GROUPS * MOVING.frame_time_s)
        observation = Observation(
            Scene((Point(),), f"star {k}"), INSTRUMENT,
            Exposure(GROUPS, n, keep_ramps=True, n_pixels=56),
            replace(MOVING), count_rate_e_s=rate,
        )  # fmt: skip
        maps = draw_maps(MOVING, (56, 56), np.random.default_rng(11))
        prepared = prepare_exposure(observation, np.random.SeedSequence([11, k]), maps)
        write_exposure(folder / f"star{k}_calints.fits", prepared, SerialExecutor())
    return folder


def files(folder: Path, ending: str) -> tuple[Path, str, Path, Path]:
    target, *others = (folder / f"star{k}_{ending}" for k in range(3))
    return target, "--cal", *others


def searched(given: tuple[Any, ...], out: Path) -> dict[str, Any]:
    assert run("search", *given, "--out", out, *FAST) == 0
    found: dict[str, Any] = json.loads((out / "result.json").read_text())
    return dict(found["noise"]["charge_migration"])


@pytest.fixture(scope="module")
def of_ramps(visit: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("of_ramps") / "out"
    return out, searched(files(visit, "ramp.fits"), out)


def test_a_search_of_ramps_shows_what_was_fitted(of_ramps: tuple[Path, dict[str, Any]]) -> None:
    out, charge = of_ramps
    assert charge["source"] == "fit"
    assert abs(charge["value_per_e"] - TRUE) < 4.5 * charge["error_per_e"]
    assert (out / "charge_migration.png").is_file()
    report = (out / "report.html").read_text()
    assert "across the fringes along a row and a column" in report
    assert "were it all that changes along the ramps" in report.casefold()


@pytest.mark.slow
def test_what_extract_writes_is_reported_as_from_the_ramps(
    visit: Path, tmp_path: Path, of_ramps: tuple[Path, dict[str, Any]], capsys: Any
) -> None:
    target, _, *others = files(visit, "ramp.fits")
    extracted = tmp_path / "extracted"
    assert run("extract", target, *others, "--out", extracted) == 0
    (entry, *_) = json.loads((extracted / "extract.json").read_text())["extractions"]
    stated = CubeMigration.of_header(contents_of(extracted / "star0_ramp.oifits").header)
    assert stated is not None
    for key, value in stated.as_json().items():
        if key != "coefficients":
            assert entry["charge_migration"][key] == pytest.approx(value)
    given = files(extracted, "ramp.oifits")
    found = searched(given, tmp_path / "out")
    assert not (tmp_path / "out" / "charge_migration.png").exists()
    for key in ("value_per_e", "error_per_e", "p_value", "narrowed_value_per_e"):
        assert found[key] == pytest.approx(of_ramps[1][key], rel=1e-6)
    assert found["coefficients"]["x"]["value_per_e"] == pytest.approx(
        of_ramps[1]["coefficients"]["x"]["value_per_e"]
    )
    capsys.readouterr()
    assert run("calibrate", *given, "--out", tmp_path / "calibrated") == 0
    assert "taken out, fitted to ramps, p = " in capsys.readouterr().out


def test_slopes_alone_tell_the_narrowed_value(visit: Path, tmp_path: Path) -> None:
    found = searched((*files(visit, "calints.fits"), "--no-pictures"), tmp_path / "out")
    assert found["source"] == "instrument"
    assert (found["value_per_e"], found["error_per_e"]) == pytest.approx((3.6e-7, 1.2e-7))
    assert found["narrowed_error_per_e"] < 0.8 * found["error_per_e"]
    assert abs(found["narrowed_value_per_e"] - TRUE) < 4.0 * found["narrowed_error_per_e"]
    assert found["narrowed_value_per_e"] > 4.2e-7
    assert "Calibrators whose charges differ" in (tmp_path / "out" / "report.html").read_text()


def test_calibrators_of_equal_charge_narrow_nothing(visit: Path, tmp_path: Path) -> None:
    target, _, one, _ = files(visit, "calints.fits")
    found = searched((target, "--cal", one, "--no-pictures"), tmp_path / "out")
    assert found["narrowed_value_per_e"] is None
    assert found["narrowed_error_per_e"] is None


def test_calibrate_and_vet_print_what_was_taken_out(
    visit: Path, tmp_path: Path, capsys: Any
) -> None:
    target, _, *others = files(visit, "ramp.fits")
    assert run("calibrate", target, "--cal", *others, "--out", tmp_path / "calibrated") == 0
    assert "pixels per electron taken out, fitted to ramps, p = " in capsys.readouterr().out
    fast = ("--null-draws", 1, "--no-limits", "--separation", "150:250", "--out", tmp_path / "v")
    _, _, *slopes = files(visit, "calints.fits")
    assert run("vet", *slopes, *fast) == 0
    assert "pixels per electron taken out, of the instrument's file" in capsys.readouterr().out
    assert migration_lines(migration_json(None, None)) == []
    (line,) = migration_lines(migration_json(CubeMigration(), None))
    assert "not taken out" in line


@pytest.mark.slow
def test_limits_of_ramps_tell_and_show_it(visit: Path, tmp_path: Path) -> None:
    given = files(visit, "ramp.fits")
    fast = ("--criterion", "absil", "--null-draws", 0, "--separations", 3, "--out", tmp_path / "l")
    assert run("limits", *given, *fast) == 0
    content = json.loads((tmp_path / "l" / "limits.json").read_text())
    assert content["noise"]["charge_migration"]["source"] == "fit"
    assert (tmp_path / "l" / "charge_migration.png").is_file()

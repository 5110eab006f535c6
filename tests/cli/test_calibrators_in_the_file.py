"""Calibrators in the target's own file: one OIFITS file of several stars."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import run
from helpers import named_star

from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.oifits import read_oifits, write_oifits

HOLES = np.random.default_rng(5).uniform(-30, 30, (5, 2))
FAST = ("--null-draws", "0", "--no-posterior", "--no-limits", "--no-pictures", "--quiet")


def star(rng: np.random.Generator, name: str, mjd: float) -> Observables:
    sheet = point_source(
        HOLES, [1.6e-6, 1.7e-6], [1e-7] * 2, vis2_error=0.01, closure_error_rad=0.01, mjd=mjd
    )
    return named_star(sheet, name, rng)


STARS = ("SCI", "Cal 1", "Cal 2", "Cal 3")


@pytest.fixture
def night(tmp_path: Path) -> Path:
    """A file of a target and three calibrators, and a file of each."""
    rng = np.random.default_rng(20201211)
    made = [star(rng, name, 6e4 + k / 50) for k, name in enumerate(STARS)]
    for name, each in zip(STARS, made, strict=True):
        write_oifits(tmp_path / f"{name}.oifits", each)
    write_oifits(tmp_path / "all.oifits", join(made))
    return tmp_path / "all.oifits"


def alone(night: Path, *names: str) -> list[str]:
    return [str(night.with_name(f"{name}.oifits")) for name in names]


@pytest.mark.slow
def test_one_file_is_as_good_as_one_for_each_star(night: Path, tmp_path: Path) -> None:
    one, each = tmp_path / "one", tmp_path / "each"
    words = ("calibrate", night, "--target", "sci", "--cal", night)
    assert run(*words, "--out", one, "--quiet") == 0
    assert run("calibrate", *alone(night, "SCI"), "--cal", *alone(night, *STARS[1:]),
               "--out", each, "--quiet") == 0  # fmt: skip
    a, b = (read_oifits(folder / "calibrated.oifits") for folder in (one, each))
    np.testing.assert_array_equal(a.data, b.data)
    np.testing.assert_array_equal(a.covariance.dense(), b.covariance.dense())


def test_a_search_names_file_and_star(night: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("search", night, "--target", "SCI", "--cal", night, "--separation", "3:8", *FAST)
    assert run(*words, "--out", out) == 0
    content = json.loads((out / "result.json").read_text())
    assert [(i["path"], i["role"]) for i in content["inputs"]] == [
        (str(night), "target"),
        (str(night), "calibrator"),
    ]
    paths = [c["path"] for c in content["calibration"]["calibrators"]]
    assert paths == [f"{night} ({name})" for name in STARS[1:]]
    assert run(*words, "--out", out, "--resume") == 0
    again = json.loads((out / "result.json").read_text())
    assert again["fit"] == content["fit"]
    assert run(*words, "--cal-target", "Cal 1,Cal 3", "--out", out, "--resume") == 2
    assert run(*words, "--cal-target", "Cal 1,cal 3", "--out", tmp_path / "two") == 0
    content = json.loads((tmp_path / "two" / "result.json").read_text())
    paths = [c["path"] for c in content["calibration"]["calibrators"]]
    assert paths == [f"{night} ({name})" for name in ("Cal 1", "Cal 3")]


def test_the_target_of_another_file_is_no_calibrator(night: Path, tmp_path: Path) -> None:
    """`--target` is not asked of calibrators' files, and the star itself is left out."""
    out = tmp_path / "out"
    words = ("--separation", "3:8", *FAST, "--out", out)
    assert run("search", *alone(night, "SCI"), "--target", "SCI", "--cal", night, *words) == 0
    content = json.loads((out / "result.json").read_text())
    assert len(content["calibration"]["calibrators"]) == 3
    words = (*words, "--overwrite")
    cal = alone(night, "Cal 1")
    assert run("search", night, "--target", "SCI", "--cal", *cal, *words) == 0
    content = json.loads((out / "result.json").read_text())
    assert [c["path"] for c in content["calibration"]["calibrators"]] == cal


def test_vetting_takes_the_stars_of_a_file(night: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("--cal-target", "Cal 1,Cal 2,Cal 3", "--null-draws", "20", "--no-limits")
    assert run("vet", night, *words, "--separation", "3:8", "--out", out, "--quiet") == 0
    vetted = json.loads((out / "vetting.json").read_text())["calibrators"]
    assert [c["path"] for c in vetted] == [f"{night} ({name})" for name in STARS[1:]]


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["all", "--cal", "all"], 3, "choose one of them with --target"),
        (["all", "all", "--target", "SCI", "--cal", "all"], 2, "is given twice"),
        (["all", "--target", "SCI", "--cal", "all", "all"], 2, "is given twice"),
        (["SCI", "--target", "SCI", "--cal", "SCI"], 2, "is given twice"),
        (["all", "--target", "SCI", "--cal", "all", "--cal-target", "Cal 9"], 2, "holds Cal 9"),
        (["SCI", "--cal", "Cal 1", "all", "--cal-target", "Cal 1"], 3, "holds the data of another"),
    ],
)
@pytest.mark.parametrize("command", ["calibrate", "search"])
def test_what_is_refused(
    command: str,
    words: list[str],
    status: int,
    message: str,
    night: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    files = {name: str(night.with_name(f"{name}.oifits")) for name in ("all", *STARS)}
    named = [
        word if words[k - 1].endswith("target") else files.get(word, word)
        for k, word in enumerate(words)
    ]
    assert run(command, *named, "--out", tmp_path / "out") == status
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("sized", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_calibrate_warns_of_calibrators_taken_for_points(
    night: Path, tmp_path: Path, sized: bool, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    """`search` did; the file that `calibrate` writes has the same diameters in it."""
    monkeypatch.setattr("amibayes.pipeline.warnings.NOTABLE_LOSS", 0.001)  # of short baselines
    words = ["calibrate", night, "--target", "sci", "--cal", night, "--out", tmp_path / "out"]
    if sized:
        words += ["--calibrator-diameters", "0.3,0.3,0.3"]
    assert run(*words, "--json") == 0
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert any("taken for points" in text for text in warnings) is not sized
    assert run(*words, "--overwrite") == 0
    said = capsys.readouterr().out
    assert ("WARNING     calibrators were taken for points" in said) is not sized

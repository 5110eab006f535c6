"""Detection limits from the command line: files, words, exit status, and what a kill leaves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from commands import run
from helpers import error_of

FAST = ("--separations", 4, "--trials", 20, "--null-draws", 8000, "--separation", "60:400")


def test_whole_job(star: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert run("limits", star, "--out", out, *FAST) == 0
    summary = capsys.readouterr().out.strip().split("\n")
    assert len(summary) <= 20
    assert {p.name for p in out.iterdir()} == {
        "limits.json", "limits.ecsv", "limits.png", "completeness.png",
    }  # fmt: skip
    content = json.loads((out / "limits.json").read_text())
    assert [c["observables"] for c in content["curves"]] == [["vis2", "cp"], ["vis2"], ["cp"]]
    assert content["method"] == "injection"
    assert content["delta_mag"] == content["curves"][0]["delta_mag"]
    assert content["separation_mas"] == pytest.approx(np.linspace(60, 400, 4))
    assert content["n_trials"] == 4 * 20
    assert np.shape(content["completeness_map"]["trials"]) == (4, 14)
    assert np.max(content["completeness_map"]["trials"]) == 20
    text = (out / "limits.json").read_text()
    assert str(out) not in text
    assert "timing" not in text
    table = Table.read(out / "limits.ecsv")
    assert table["separation"].unit == "mas"
    np.testing.assert_allclose(table["delta_mag_cp"], content["curves"][2]["delta_mag"])


@pytest.mark.parametrize(
    "method",
    [
        "absil",
        pytest.param("candid", marks=pytest.mark.slow),
        pytest.param("posterior", marks=pytest.mark.slow),
        "closure-phase",
    ],
)
def test_closed_criteria(star: Path, tmp_path: Path, capsys, method: str) -> None:
    out = tmp_path / "out"
    assert run("limits", star, "--out", out, *FAST, "--criterion", method, "--json") == 0
    content = json.loads(capsys.readouterr().out)
    assert content["method"] == method
    assert content["completeness_map"] is None
    assert len(content["curves"]) == (1 if method == "closure-phase" else 3)
    assert all(3.5 < mag < 9.0 for mag in content["delta_mag"])
    assert {p.name for p in out.iterdir()} == {"limits.json", "limits.ecsv", "limits.png"}


def test_resume_starts_afresh_and_tells_a_finished_run_again(star, tmp_path, capsys) -> None:
    words = (star, *FAST, "--observables", "cp", "--json", "--resume", "--out", tmp_path / "out")
    assert run("limits", *words) == 0
    first = capsys.readouterr().out
    stamp = (tmp_path / "out" / "limits.json").stat().st_mtime_ns
    assert run("limits", *words) == 0
    assert capsys.readouterr().out == first == (tmp_path / "out" / "limits.json").read_text()
    assert (tmp_path / "out" / "limits.json").stat().st_mtime_ns == stamp
    assert run("limits", *words, "--seed", 2) == 2
    assert "other data or options" in error_of(capsys)


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (("--null-draws", 100), 2, "--null-draws"),
        (("--criterion", "closure-phase", "--observables", "vis2"), 2, "closure phases alone"),
        (("--calibration", "weighted"), 2, "needs calibrators"),
        (("--primary-magnitude", 3), 2, "--mass-table"),
        (("--mass-table", "nowhere.ecsv"), 3, "nowhere.ecsv: cannot be read"),
        (("--criterion", "magic"), 2, "invalid choice"),
        (("--trials", 0), 2, "not a positive number"),
    ],
)
def test_bad_requests_are_one_line(star, tmp_path, capsys, words, status, message) -> None:
    assert run("limits", star, "--out", tmp_path / "out", *words) == status
    assert message in error_of(capsys)


def test_missing_target_is_one_line(tmp_path, capsys) -> None:
    assert run("limits", tmp_path / "none.oifits", "--out", tmp_path / "out") == 3
    assert "none.oifits" in error_of(capsys)

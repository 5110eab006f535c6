"""Many targets from a table: one folder each, one summary, and no failure that stops the rest."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from commands import run
from helpers import error_of, niriss, simulated
from PIL import Image

from amibayes.errors import DataError, RunError
from amibayes.oifits import write_oifits
from amibayes.pipeline.batch import read_targets
from amibayes.plots.style import save
from amibayes.plots.survey import Found, LimitCurve, survey_plot

TRUTH = [110.0, -75.0, 0.02]
CLOSED = ("--criterion", "absil", "--separations", 5, "--null-draws", 0, "--observables", "cp")
QUICK = ("--no-posterior", "--null-draws", 3000, "--no-limits", "--separation", "50:400")


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    """A binary, a single star with two calibrators, a file that is none, and one missing."""
    write_oifits(tmp_path / "bin.oifits", simulated(niriss(), TRUTH, np.random.default_rng(1)))
    for k, name in enumerate(["single", "c1", "c2"]):
        data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(10 + k))
        write_oifits(tmp_path / f"{name}.oifits", data)
    (tmp_path / "broken.oifits").write_text("not a FITS file")
    path = tmp_path / "targets.ecsv"
    table = Table(
        {
            "target": ["bin.oifits", "single.oifits", "broken.oifits", "gone*.oifits"],
            "cal": ["", "c?.oifits", "", ""],
            "name": ["HD 1", "", "", "gone"],
            "separation": ["80:300", "", "", ""],
        }
    )
    table.write(path)
    return path


def test_a_survey_does_what_it_can_and_says_what_it_could_not(survey, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    assert run("search", "--batch", survey, "--out", out, *QUICK) == 4
    captured = capsys.readouterr()
    said = captured.out.strip().split("\n")
    assert said[0] == "targets     2 of 4 done, 2 failed"
    assert "DETECTED" in next(line for line in said if line.startswith("HD_1"))
    assert "not detected" in next(line for line in said if line.startswith("single"))
    complaints = captured.err.strip().split("\n")
    assert [line.split(": ")[1] for line in complaints] == ["broken", "gone"]
    summary = json.loads((out / "survey.json").read_text())
    assert [e["status"] for e in summary["targets"]] == ["done", "done", "failed", "failed"]
    first, second, third, _ = summary["targets"]
    assert first["detected"] is True
    assert abs(first["separation_mas"] - np.hypot(*TRUTH[:2])) < 5 * first["separation_error_mas"]
    assert second["calibrators"] == ["c1.oifits", "c2.oifits"]
    assert "broken.oifits" in third["error"]
    own = json.loads((out / "HD_1" / "result.json").read_text())
    assert own["data"]["separation_mas"] == [80.0, 300.0]
    table = Table.read(out / "survey.ecsv")
    assert list(table["status"]) == ["done", "done", "failed", "failed"]
    assert table["separation_mas"].mask.tolist() == [False, False, True, True]
    assert str(table["separation_mas"].unit) == "mas"
    assert (out / "survey.png").is_file()


def test_resume_leaves_what_is_finished_and_ends_with_the_same_bytes(
    survey, tmp_path, capsys
) -> None:
    words = ("limits", "--batch", survey, *CLOSED, "--quiet")
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert run(*words, "--out", whole) == 4
    expected = (whole / "survey.json").read_bytes()
    shutil.copytree(whole, cut)
    # As a killed run leaves it: the second target begun, nothing of it told.
    content = json.loads(expected)
    for entry in content["targets"][1:]:
        entry["status"] = "pending"
    (cut / "survey.json").write_text(json.dumps(content))
    before = (cut / "HD_1" / "limits.json").stat().st_mtime_ns
    (cut / "single" / "limits.json").unlink()
    assert run(*words, "--out", cut) == 2
    assert run(*words, "--out", cut, "--resume") == 4
    assert (cut / "survey.json").read_bytes() == expected
    assert (cut / "survey.ecsv").read_bytes() == (whole / "survey.ecsv").read_bytes()
    assert (cut / "HD_1" / "limits.json").stat().st_mtime_ns == before
    assert (cut / "single" / "limits.json").is_file()
    # Other data under the same name are not taken for finished.
    other = simulated(niriss(), TRUTH, np.random.default_rng(99))
    write_oifits(tmp_path / "bin.oifits", other, overwrite=True)
    assert run(*words, "--out", cut, "--resume") == 4
    assert "other data" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("columns", "status", "words"),
    [
        ({"file": ["a"]}, 3, "no column 'target'"),
        ({"target": ["a.oifits", "b/a.oifits"]}, 3, "two targets are called 'a'"),
        ({"target": np.array([], dtype=str)}, 3, "holds no target"),
        ({"target": ["a"], "diametre": ["1"]}, 2, "did you mean 'diameter'"),
        ({"target": ["a"], "diameter": ["wide"]}, 2, "neither a number nor 'free'"),
        ({"target": ["a"], "out": ["elsewhere"]}, 2, "no option of a target"),
        ({"target": ["a", ""], "name": ["x", "y"]}, 3, "row 2: has no file"),
    ],
)
def test_a_bad_table_is_refused_before_anything_is_done(
    columns, status, words, tmp_path, capsys
) -> None:
    path = tmp_path / "bad.ecsv"
    Table(columns).write(path)
    assert run("search", "--batch", path, "--out", tmp_path / "out") == status
    assert words in error_of(capsys)
    assert not (tmp_path / "out").exists()


def test_no_table_and_no_target_are_told_apart(tmp_path, capsys) -> None:
    out = ("--out", tmp_path / "out")
    assert run("search", "--batch", tmp_path / "absent.ecsv", *out) == 3
    assert "absent.ecsv" in error_of(capsys)
    (tmp_path / "junk.ecsv").write_text("%ECSV nonsense\n1 2\n3\n")
    assert run("search", "--batch", tmp_path / "junk.ecsv", *out) == 3
    error_of(capsys)
    assert run("search", *out) == 2
    assert "target" in error_of(capsys)
    assert run("search", "x.oifits", "--batch", tmp_path / "junk.ecsv", *out) == 2
    error_of(capsys)


def test_cells_hold_several_files_and_options_of_any_type(tmp_path: Path) -> None:
    for name in ("a1", "a2", "b c"):
        (tmp_path / f"{name}.fits").touch()
    path = tmp_path / "t.csv"
    path.write_text(
        "target,cal,diameter,keep_all,null_draws\n"
        "a?.fits,,0.8,True,\n"
        "b c.fits;a1.fits,a1.fits a2.fits,free,False,500\n",
        encoding="utf-8-sig",  # as spreadsheets do
    )
    first, second = read_targets(path)
    assert first.files(first.target) == [str(tmp_path / "a1.fits"), str(tmp_path / "a2.fits")]
    assert second.files(second.target) == [str(tmp_path / "b c.fits"), str(tmp_path / "a1.fits")]
    assert second.files(second.cal) == first.files(first.target)
    assert (first.name, second.name) == ("a", "b_c")
    assert dict(first.options) == {"diameter": "0.8", "keep_all": "True"}
    assert second.options["null_draws"] == 500
    with pytest.raises(DataError, match="no file fits"):
        first.files(("zzz*",))


@pytest.mark.usefixtures("full_pictures")
@pytest.mark.parametrize("n", [3, 40])
def test_the_picture_of_few_and_of_many(n: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    curves = {}
    for k in range(n):
        rho = np.linspace(50, 400, 15) * (0.05 if k % 3 == 2 else 1.0)
        mag = 6.0 + 1.5 * np.tanh(rho / rho.max() * 3) + 0.4 * rng.standard_normal()
        mag[rng.integers(15)] = np.nan
        curves[f"HD {100 + k}"] = LimitCurve(rho, mag)
    found = {"HD 100": Found(120.0, 4.5, 3.0, 0.1), "HD 101": Found(260.0, 5.5, np.nan, np.nan)}
    save(survey_plot(curves, found), tmp_path / "picture.png")
    assert np.array(Image.open(tmp_path / "picture.png")).std() > 1


# With the process beside this one that draws for all targets, as a user has it.
@pytest.mark.usefixtures("full_pictures")
@pytest.mark.slow
def test_limits_of_a_survey(survey, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    assert run("limits", "--batch", survey, "--out", out, *CLOSED) == 4
    assert "limits" in capsys.readouterr().out
    summary = json.loads((out / "survey.json").read_text())
    first, second, third, _ = summary["targets"]
    assert [e["status"] for e in (first, second, third)] == ["done", "done", "failed"]
    assert first["limits"]["separation_mas"] == pytest.approx(np.linspace(80, 300, 5))
    curve = first["limits"]["delta_mag"]
    assert first["limit_delta_mag_best"] == max(curve)
    assert first["limit_delta_mag_worst"] == min(curve)
    assert Table.read(out / "survey.ecsv")["limit_delta_mag"].unit == "mag"
    assert (out / "survey.png").is_file()


def test_targets_that_are_handed_out_together_are_the_same_and_fail_alone(
    survey, tmp_path, monkeypatch
) -> None:
    words = ("limits", "--batch", survey, *CLOSED, "--quiet", "--no-pictures")
    assert run(*words, "--out", tmp_path / "one") == 4
    monkeypatch.setattr("amibayes.cli.options.batch.TASKS", 2)
    assert run(*words, "--out", tmp_path / "two") == 4
    one, two = ((tmp_path / n / "survey.json").read_bytes() for n in ("one", "two"))
    assert one == two

    def losing(function, pieces, executor, *, lost, progress=None):
        """A worker that dies of the first target, in whatever company."""
        for k, piece in enumerate(pieces):
            first = piece[0] if isinstance(piece, list) else piece
            died = first.name == "HD_1"
            yield lost(k, RunError("piece lost its worker")) if died else function(piece)

    monkeypatch.setattr("amibayes.parallel.run_job", losing)
    assert run(*words, "--out", tmp_path / "three") == 4
    entries = json.loads((tmp_path / "three" / "survey.json").read_text())["targets"]
    assert [e["status"] for e in entries] == ["failed", "done", "failed", "failed"]
    assert entries[0]["error"] == "piece lost its worker"
    assert entries[1:] == json.loads(one)["targets"][1:]

"""The main job from the command line: its files, its words, its exit status."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commands import run
from helpers import error_of, niriss, simulated

from amibayes.oifits import read_oifits, write_oifits

RESULT = "result.json"
TRUTH = [110.0, -75.0, 0.02]


@pytest.fixture
def calibrators(tmp_path: Path) -> list[Path]:
    paths = []
    for k in range(3):
        paths.append(tmp_path / f"cal{k}.oifits")
        data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(10 + k))
        write_oifits(paths[-1], data)
    return paths


KEYS = {
    "amibayes", "seed", "request", "options", "inputs", "data", "fit", "significance", "modes",
    "posterior", "calibration", "limits", "noise", "robust", "evidence", "warnings", "timing_s",
    "verdict", "consistency", "bootstrap", "models", "confusion", "model_verdict", "limits_beside",
}  # fmt: skip


@pytest.mark.usefixtures("full_pictures")
def test_whole_job(target: Path, calibrators: list[Path], tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    words = (target, "--cal", *calibrators, "--out", out, "--separation", "60:250")
    assert run("search", *words) == 0
    summary = capsys.readouterr().out.strip().split("\n")
    assert len(summary) <= 20
    assert summary[0].startswith("verdict     COMPANION: ")
    result = json.loads((out / "result.json").read_text())
    assert set(result) == KEYS
    fit = result["fit"]
    assert abs(fit["east_mas"] - TRUTH[0]) < 5 * fit["errors"]["east_mas"]
    assert abs(fit["contrast"] - TRUTH[2]) < 5 * fit["errors"]["contrast"]
    assert fit["chi2r_binary"] == pytest.approx(fit["chi2_binary"] / fit["ndof"])
    assert result["significance"]["detected"] is True
    assert result["significance"]["n_null_draws"] == 10_000
    assert [c["kept"] for c in result["calibration"]["calibrators"]] == [True] * 3
    assert result["calibration"]["method"] == "hierarchical"
    assert result["posterior"]["converged"] is True
    assert len(result["limits"]["separation_mas"]) == len(result["limits"]["delta_mag"])
    assert [i["role"] for i in result["inputs"]] == ["target"] + ["calibrator"] * 3
    assert all(len(i["sha256"]) == 64 for i in result["inputs"])
    for name in (
        "map", "fit", "coverage", "correlation", "null", "corner", "chains", "limits",
        "completeness", "calibrators",
    ):  # fmt: skip
        assert (out / f"{name}.png").stat().st_size > 5000, name
    assert (out / "report.html").stat().st_size > 1e5
    again = tmp_path / "again"
    calibrated = out / "calibrated.oifits"
    assert run("search", calibrated, "--out", again, "--separation", "60:250", "--null-draws", 0,
               "--no-posterior", "--no-limits", "--no-pictures") == 0  # fmt: skip
    second = json.loads((again / "result.json").read_text())
    assert second["fit"]["chi2_binary"] == pytest.approx(fit["chi2_binary"], rel=1e-10)
    assert second["significance"]["detected"] is None
    assert second["posterior"] is None


@pytest.mark.slow
def test_json_on_standard_output_is_the_file_and_the_seed_decides(target, tmp_path, capsys) -> None:
    words = (target, "--separation", "50:400", "--null-draws", 500, "--json", "--no-limits")
    results = []
    for k in range(2):
        assert run("search", *words, "--out", tmp_path / str(k)) == 0
        text = capsys.readouterr().out
        assert text == (tmp_path / str(k) / "result.json").read_text()
        results.append(json.loads(text))
        results[-1].pop("timing_s")
    assert results[0] == results[1]
    assert run("search", *words, "--out", tmp_path / "2", "--seed", 9) == 0
    other = json.loads(capsys.readouterr().out)
    assert other["significance"]["threshold"] != results[0]["significance"]["threshold"]
    assert other["fit"] == results[0]["fit"]


FAST = ("--null-draws", "0", "--no-posterior", "--no-limits")
NARROW = (*FAST, "--separation", "80:200")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--separation", "400:50"), "LOW < HIGH"),
        (("--separation", "fifty"), "not LOW:HIGH"),
        (("--observables", "vis"), "not vis2, cp"),
        (("--diameter", "-1"), "negative"),
        (("--null-draws", "-5"), "negative"),
        (("--clip", "0"), "not a positive"),
        (("--calibration", "weighted"), "needs calibrators"),
        (("--seperation", "50:400"), "did you mean --separation"),
        (("--separation", "100:100.0001"), "no position"),
        (("--prior", "contrast"), "is no prior"),
        (("--prior", "contrast=1:1e-5"), "is empty or impossible"),
        (("--prior", "background=0:1"), "not a free parameter"),
        (("--companions", "3"), "not a list out of 0,1,2"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(words, message, target, tmp_path, capsys) -> None:
    assert run("search", target, *FAST, "--out", tmp_path / "out", *words) == 2
    assert message in error_of(capsys)


def test_nothing_is_overwritten_and_no_file_is_taken_twice(target, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    assert run("search", target, *NARROW, "--out", out) == 0
    before = (out / "result.json").read_bytes()
    capsys.readouterr()
    assert run("search", target, *NARROW, "--out", out) == 2
    assert "is there already" in error_of(capsys)
    assert (out / "result.json").read_bytes() == before
    assert run("search", target, *NARROW, "--out", out, "--overwrite", "--quiet") == 0
    assert capsys.readouterr().out == ""
    assert run("search", target, target, *NARROW, "--out", tmp_path / "twice") == 2
    assert "is given twice" in error_of(capsys)
    assert run("search", target, "--cal", target, *NARROW, "--out", tmp_path / "twice") == 2
    assert "is given twice" in error_of(capsys)


def bad_files(folder: Path, target: Path) -> dict[str, Path]:
    files = {name: folder / f"{name}.fits" for name in ("empty", "text", "image", "flagged", "cut")}
    files["empty"].write_bytes(b"")
    files["text"].write_text("target,V2\nAX Cir,0.9\n")
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(files["image"])
    data = read_oifits(target)
    shutil.copy(target, files["flagged"])
    with fits.open(files["flagged"], mode="update") as hdus:
        for hdu in hdus:
            if hdu.name in ("OI_VIS2", "OI_T3"):
                hdu.data["FLAG"][:] = True
    files["cut"].write_bytes(target.read_bytes()[:-4000])
    files["directory"] = folder / "directory.fits"
    files["directory"].mkdir()
    files["missing"] = folder / "missing.fits"
    assert data.n_vis2
    return files


@pytest.mark.parametrize(
    "kind", ["empty", "text", "image", "flagged", "cut", "directory", "missing"]
)
def test_unreadable_data_are_one_line_and_status_3(kind, target, tmp_path, capsys) -> None:
    path = bad_files(tmp_path, target)[kind]
    assert run("search", path, *FAST, "--out", tmp_path / "out") == 3
    line = error_of(capsys)
    assert f"{kind}.fits" in line
    assert not (tmp_path / "out" / "result.json").exists()


def test_public_corrupted_file(data: Path, tmp_path, capsys) -> None:
    path = data / "oifits" / "corrupted" / "truncated.fits"
    assert run("search", path, *FAST, "--out", tmp_path / "out") == 3
    assert "truncated.fits" in error_of(capsys)


def test_folder_that_cannot_be_made(target, tmp_path, capsys) -> None:
    (tmp_path / "file").write_text("in the way")
    assert run("search", target, *FAST, "--out", tmp_path / "file" / "out") == 2
    assert "cannot be made a folder" in error_of(capsys)


@pytest.mark.slow
def test_default_field_is_widened_to_a_companion_outside_it(data: Path, tmp_path, capsys) -> None:
    path = data / "oifits" / "axcir_pionier.oifits"
    assert run("search", path, *FAST, "--out", tmp_path / "out", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert any("field was widened" in w and "28.9 mas" in w for w in result["warnings"])
    assert result["fit"]["separation_mas"] == pytest.approx(29.2, abs=0.1)
    assert result["fit"]["diameter_mas"] > 0.5


@pytest.mark.slow
def test_too_few_null_draws_say_nothing(target, tmp_path, capsys) -> None:
    words = (target, "--separation", "50:400", "--null-draws", 100, "--no-posterior", "--json")
    assert run("search", *words, "--out", tmp_path / "out") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["significance"]["detected"] is None
    assert any("100 null draws cannot measure" in w for w in result["warnings"])


@pytest.mark.slow
def test_resume_and_overwrite_leave_no_foreign_results(target, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    other = tmp_path / "other.oifits"
    write_oifits(other, simulated(niriss(), TRUTH, np.random.default_rng(99)))
    assert run("search", target, "--separation", "50:400", "--null-draws", 1000, "--out", out) == 0
    capsys.readouterr()
    assert run("search", other, *FAST, "--out", out, "--resume") == 2
    assert "result of other data or options" in error_of(capsys)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert run("search", target, *FAST, "--out", out, "--resume") == 2, "other options"
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert run("search", other, *FAST, "--out", out, "--overwrite", "--quiet") == 0
    left = sorted(p.name for p in out.iterdir())
    pictures = ["correlation.png", "coverage.png", "fit.png", "map.png", "maps.fits", "nsigma.png"]
    assert left == [*pictures, "report.html", RESULT]


def test_unusable_field_is_refused(target, tmp_path, capsys) -> None:
    assert (
        run("search", target, *FAST, "--separation", "1:100000000", "--out", tmp_path / "out") == 2
    )
    assert "positions between" in error_of(capsys)


@pytest.mark.slow
def test_evidence_prior_and_upper_limit_are_in_the_result(tmp_path, capsys) -> None:
    path = tmp_path / "none.oifits"
    write_oifits(path, simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1)))
    words = (path, "--separation", "50:400", "--null-draws", 500, "--no-limits", "--json")
    prior = ("--prior", "contrast=uniform:1e-5:0.1", "--prior", "position=separation")
    assert run("search", *words, *prior, "--companions", "0,1,2", "--out", tmp_path / "out") == 0
    result = json.loads(capsys.readouterr().out)
    posterior, evidence = result["posterior"], result["evidence"]
    assert posterior["prior"]["contrast"] == [1e-5, 0.1]
    assert "uniform in contrast" in posterior["prior"]["form"]
    limit = posterior["upper_limit"]
    assert 1e-5 < limit["contrast"] < 0.01
    integrated, chain = posterior["integrated"]["contrast"], posterior["contrast"]
    assert integrated["upper"] == pytest.approx(chain["upper"], rel=0.3)
    none = result["noise"]["posterior"]["extra_vis2"]
    assert none["lower"] <= none["median"] <= none["upper"] < 0.02
    assert 0.0 < none["probability_errors_right"] < 1.0
    second = evidence["two_companions"]
    assert second["false_alarm_probability"] > 0.0013
    assert limit["contrast"] == pytest.approx(posterior["contrast"]["upper_95"], rel=0.5)
    assert limit["contrast"] == limit["contrast_stated_prior"]
    assert evidence["companions"] == [0, 1, 2]
    assert evidence["method"] == ["quadrature", "grid", "importance"]
    assert sum(evidence["probability"]) == pytest.approx(1.0)
    assert evidence["probability"][0] > 0.9
    assert len(evidence["two_companions"]["companions"]) == 2
    assert evidence["halo"]["log_z"] < evidence["log_z"][0]
    assert sum(m["probability"] for m in result["modes"]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("field", "said"),
    [
        ("700:1500", "nearer the star, a companion fits as well or better"),
        pytest.param("250:400", "nearer the star", marks=pytest.mark.slow),
        ("60:100", "on the edge of the field that was asked for"),
        pytest.param("50:400", None, marks=pytest.mark.slow),
    ],
)
def test_a_field_that_leaves_the_companion_out_is_warned_of(
    field, said, target, tmp_path, capsys
) -> None:
    """The truth is at 133 mas."""
    words = (target, *FAST, "--separation", field, "--json", "--out", tmp_path / "out")
    assert run("search", *words) == 0
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    beyond = [w for w in warnings if "nearer the star" in w or "on the edge" in w]
    assert bool(beyond) == (said is not None)
    assert said is None or said in beyond[0]
    if field == "700:1500":
        assert float(beyond[0].split("near ")[1].split(" mas")[0]) == pytest.approx(133.1, abs=15)


@pytest.mark.slow
def test_noise_alone_is_no_reason_to_look_elsewhere(tmp_path, capsys) -> None:
    path = tmp_path / "none.oifits"
    for seed in range(5):
        write_oifits(
            path, simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(seed)), overwrite=True
        )
        words = (path, *FAST, "--separation", "300:400", "--json", "--overwrite")
        assert run("search", *words, "--out", tmp_path / "out") == 0
        warnings = json.loads(capsys.readouterr().out)["warnings"]
        assert not any("the field" in w for w in warnings)

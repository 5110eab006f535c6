"""The commands calibrate, audit and export as a script uses them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commands import run
from helpers import named_star

from amibayes.calibration import calibrate
from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.oifits import read_oifits, write_oifits

HOLES = np.random.default_rng(5).uniform(-3, 3, (5, 2))


def star(rng: np.random.Generator, name: str) -> Observables:
    sheet = point_source(
        HOLES, [4.3e-6, 4.8e-6], [1e-7] * 2, vis2_error=0.01, closure_error_rad=0.01
    )
    return named_star(sheet, name, rng)


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, rng = tmp_path_factory.mktemp("originals"), np.random.default_rng(20201211)
    paths = [folder / f"{name}.oifits" for name in ("target", "c1", "c2", "c3")]
    for path in paths:
        write_oifits(path, star(rng, path.stem.upper()))
    return paths


@pytest.fixture
def files(originals: list[Path], tmp_path: Path) -> list[str]:
    """A target and three calibrators."""
    return [shutil.copy(path, tmp_path) for path in originals]


def test_calibrate_equals_the_function(files: list[str], tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "out"
    assert run("calibrate", files[0], "--cal", *files[1:], "--out", str(out), "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    found = read_oifits(out / "calibrated.oifits")
    parts = [read_oifits(path) for path in files]
    expected = calibrate(parts[0], parts[1:], rng=np.random.default_rng(1))
    np.testing.assert_array_equal(found.data, expected.observables.data)
    np.testing.assert_array_equal(
        found.covariance.dense(), np.asarray(expected.observables.covariance.dense())
    )
    calibration = printed["calibration"]
    assert calibration["method"] == "hierarchical"
    assert [c["path"] for c in calibration["calibrators"]] == files[1:]
    assert all(c["kept"] for c in calibration["calibrators"])
    assert calibration["tau"]["vis2"] == expected.tau_vis2
    assert calibration["tau"]["closure_phase_deg"] == expected.tau_closure_phase_deg
    assert [i["role"] for i in printed["inputs"]] == ["target"] + ["calibrator"] * 3
    assert printed["data"]["n_vis2"] == 20


def test_calibrate_gives_the_same_bytes_again(
    files: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    for name in ("a", "b"):
        assert (
            run(
                "calibrate", files[0], "--cal", *files[1:], "--out", str(tmp_path / name), "--quiet"
            )
            == 0
        )
    a, b = (tmp_path / name / "calibrated.oifits" for name in ("a", "b"))
    assert a.read_bytes() == b.read_bytes()


def test_calibrate_options(files: list[str], tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    table = tmp_path / "diameters.ecsv"
    columns = ["C1", "c2.oifits", "c3"], [10.0, 20.0, 0.0], [1.0, 2.0, 0.0]
    Table(columns, names=["name", "diameter_mas", "error_mas"]).write(table)
    for number, diameters in enumerate(("10:1,20:2,0", str(table))):
        out = tmp_path / f"out{number}"
        words = [
            "--calibrator-diameters",
            diameters,
            "--calibration",
            "weighted",
            "--bin-channels",
            "2",
        ]
        words += ["--flag", "station=H5", "--merge-epochs", "1", "--time-window", "2"]
        assert run("calibrate", files[0], "--cal", *files[1:], "--out", str(out), *words) == 0
    assert "method      weighted" in capsys.readouterr().out
    first, second = (read_oifits(tmp_path / f"out{i}" / "calibrated.oifits") for i in range(2))
    np.testing.assert_array_equal(first.data, second.data)
    assert first.n_vis2 == 6
    plain = tmp_path / "plain"
    run("calibrate", files[0], "--cal", *files[1:], "--out", str(plain), *words[2:], "--quiet")
    assert (read_oifits(plain / "calibrated.oifits").only(["vis2"]).data > first.data[:6]).all()


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["T"], 2, "--cal"),
        (["T", "--cal", "T"], 2, "is given twice"),
        (["T", "--cal", "C", "C"], 2, "is given twice"),
        (["T", "--cal", "none.fits"], 3, "does not exist"),
        (["T", "--cal", "C", "--calibration", "hierarchical"], 3, "one calibrator"),
        (["T", "--cal", "C", "--calibrator-diameters", "1,2"], 2, "2 diameters for 1"),
        (["T", "--cal", "C", "--calibrator-diameters", "big"], 2, "neither a table nor a list"),
        (["T", "--cal", "C", "--calibrator-diameters", "C"], 3, "no table of diameters"),
        (["T", "--cal", "C", "--flag", "vis3>1"], 2, "is not understood"),
        (["T", "--cal", "C", "--average-polarisations"], 2, "no two polarisations"),
        (["T", "--cal", "C", "--charge-levels", "1,x"], 2, "no list of numbers"),
        (["T", "--cal", "C", "--insname", "OTHER"], 3, "no INSNAME"),
        (["T", "--cal", "C", "--clip", "0"], 2, "not a positive number"),
        (["T", "--cal", "C", "--calibraton", "weighted"], 2, "did you mean --calibration?"),
    ],
)
def test_calibrate_bad_input(
    words: list[str],
    status: int,
    message: str,
    files: list[str],
    tmp_path: Path,
    capsys,  # type: ignore[no-untyped-def]
) -> None:
    names = {"T": files[0], "C": files[1]}
    out = tmp_path / "out"
    assert run("calibrate", *(names.get(w, w) for w in words), "--out", str(out)) == status
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    assert not (out / "calibrated.oifits").exists()


def test_nothing_is_overwritten(files: list[str], tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "out"
    words = ["calibrate", files[0], "--cal", files[1], "--out", str(out), "--quiet"]
    assert run(*words) == 0
    before = (out / "calibrated.oifits").read_bytes()
    assert run(*words, "--calibration", "weighted") == 2
    assert "is there already" in capsys.readouterr().err
    assert (out / "calibrated.oifits").read_bytes() == before
    assert run(*words, "--overwrite") == 0


def test_audit(files: list[str], tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "out"
    assert run("audit", *files, "--out", str(out)) == 0
    assert capsys.readouterr().out.count("nothing found") == 4
    content = json.loads((out / "audit.json").read_text())
    assert content["n_findings"] == 0
    with fits.open(files[0], mode="update") as hdus:
        hdus["OI_VIS2"].data["VIS2DATA"][2, 1] = np.nan
        hdus["OI_VIS2"].data["VIS2DATA"][0, 0] = 2.0
    words = ["audit", files[0], "--fix", "--json", "--overwrite", "--out", str(out)]
    assert run(*words) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "audit.json").read_text())
    (entry,) = printed["files"]
    assert [f["code"] for f in entry["findings"]] == ["unusable-unflagged", "vis2-above-one"]
    assert set(entry["findings"][0]) == {
        "severity",
        "code",
        "where",
        "what",
        "why",
        "remedy",
        "certain",
    }
    assert entry["fixed"] == ["unusable-unflagged"]
    assert run("audit", entry["copy"], "--out", str(tmp_path / "again")) == 1
    assert "V² more than 5σ above 1" in capsys.readouterr().out


def test_audit_says_at_most_twenty_lines(data: Path, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    files = sorted((data / "oifits").glob("*fits"), key=lambda p: p.stat().st_size)
    paths = [str(p) for p in files[:8]]
    assert run("audit", *paths, "--out", str(tmp_path / "out")) == 1
    assert len(capsys.readouterr().out.splitlines()) <= 20


def test_audit_of_many_files_names_each_and_its_errors(
    files: list[str], tmp_path: Path, capsys
) -> None:  # type: ignore[no-untyped-def]
    """A summary cut at its end named the first files alone, whatever was wrong with the others."""
    copies = [tmp_path / f"copy{k}.oifits" for k in range(12)]
    for k, copy in enumerate(copies):
        with fits.open(files[0]) as hdus:
            hdus["OI_ARRAY"].header["FRAME"] = "GEOCENTRIC"
            hdus["OI_VIS2"].header.pop("DATE-OBS", None)
            hdus["OI_VIS2"].columns["UCOORD"].unit = "METERS"
            if k == 11:
                hdus["OI_VIS2"].data["VIS2DATA"][2, 1] = np.nan
            hdus.writeto(copy)
    assert run("audit", *map(str, copies), "--out", str(tmp_path / "out")) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 20
    assert all(any(line.startswith(f"{copy}: ") for line in lines) for copy in copies)
    last = next(k for k, line in enumerate(lines) if line.startswith(f"{copies[-1]}: "))
    assert "(1 error)" in lines[last]
    assert lines[last + 1].startswith("  error   ")
    assert lines[-2].startswith("and ")


def test_unreadable_is_three_and_one_line(data: Path, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "empty.fits").touch()
    (tmp_path / "text.fits").write_text("no FITS")
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "image.fits")
    bad = [tmp_path / n for n in ("empty.fits", "text.fits", "image.fits", "none.fits", ".")]
    bad.append(data / "oifits" / "corrupted" / "truncated.fits")
    for path in bad:
        for command in (["audit", str(path)], ["export", str(path), "--to", "mira"]):
            assert run(*command, "--out", str(tmp_path / "out")) == 3
            captured = capsys.readouterr()
            assert len(captured.err.strip().splitlines()) == 1
            assert str(path) in captured.err
            assert captured.out == ""
    midi = str(data / "oifits" / "midi_ngc5128.oifits")
    assert run("audit", midi, "--out", str(tmp_path / "m")) == 1
    assert run("export", midi, "--to", "mira", "--out", str(tmp_path / "m")) == 3


@pytest.mark.parametrize("program", ["irbis", "squeeze", "mira"])
def test_export(program: str, files: list[str], tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "out"
    assert run("export", *files[:2], "--to", program, "--out", str(out), "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["path"] == str(out / f"{program}.oifits")
    assert f"{program}." in printed["command"]
    assert read_oifits(printed["path"]).n_vis2 == 40
    assert (out / "irbis.sof").exists() == (program == "irbis")
    assert run("export", *files[:2], "--to", program, "--out", str(out)) == 2
    assert "is there already" in capsys.readouterr().err
    assert run("export", files[0], "--to", "nothing") == 2

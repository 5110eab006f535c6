"""Several files from the command line: order, repeated data, bad files, what is said."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commands import run
from epochs import F430M, F480M, MJD, epoch, noisy
from helpers import niriss

from amibayes.calibration import calibrate
from amibayes.data.joining import in_order, refuse_twice, unused
from amibayes.data.observables import join
from amibayes.detection.verdict import Verdict
from amibayes.errors import DataError, UsageError
from amibayes.oifits import read_oifits, write_oifits
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.report_types import SearchReport
from amibayes.pipeline.search import search_companion
from amibayes.report import result_json, summary
from amibayes.report.words import measured
from amibayes.support.atomic_files import to_json

FAST = ("--separation", "80:250", "--no-posterior", "--no-limits", "--null-draws", "1000")


def found(paths: list[Path], cals: Sequence[Path] = (), **options: object) -> SearchReport:
    """The main job without pictures."""
    quick = {"posterior": False, "limits": False, "null_draws": 1000}
    return search_companion(
        [str(p) for p in paths],
        [str(p) for p in cals],
        SearchOptions(separation_mas=(80.0, 250.0), **(quick | options)),  # type: ignore[arg-type]
    )


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().split("\n")) == 1, captured.err
    return captured.err


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    """Two filters, and a second epoch of one of them to which the companion has moved."""
    rng = np.random.default_rng(41)
    sheets = [
        noisy(epoch(F430M, MJD[0]), [120.0, -90.0, 0.01], rng),
        noisy(epoch(F480M, MJD[0], turn_deg=15.0), [120.0, -90.0, 0.02], rng),
        noisy(epoch(F480M, MJD[2], turn_deg=40.0), [147.0, -106.0, 0.02], rng),
    ]
    paths = [tmp_path / f"{name}.oifits" for name in ("f430m", "f480m", "later")]
    for path, sheet in zip(paths, sheets, strict=True):
        write_oifits(path, sheet)
    return paths


@pytest.mark.slow
def test_joint_fit_is_in_the_result_whatever_the_order_of_files(files, tmp_path, capsys) -> None:
    assert run("search", *files, *FAST, "--motion", "--json", "--out", tmp_path / "0") == 0
    results = [json.loads(capsys.readouterr().out)]
    paths = [files[i] for i in (2, 0, 1)]
    results.append(json.loads(to_json(result_json(found(paths, motion=True)))))
    assert [r["path"] for r in results[0]["residuals"]] == [str(p) for p in files]
    assert [r["path"] for r in results[1]["residuals"]] == [str(p) for p in paths]
    for part in ("fit", "significance", "modes", "data", "warnings"):
        assert results[0][part] == results[1][part], part
    fit = results[0]["fit"]
    assert fit["contrast_kind"] == "per-filter"
    assert [c["band"] for c in fit["contrasts"]] == ["NIRISS_4.29um", "NIRISS_4.82um"]
    assert fit["contrasts"][0]["contrast"] == fit["contrast"]
    for entry, truth in zip(fit["contrasts"], (0.01, 0.02), strict=True):
        assert abs(entry["contrast"] - truth) < 5 * entry["errors"]["contrast"]
    years = (MJD[2] - MJD[0]) / 365.25
    for name, shift in (("east", 27.0), ("north", -16.0)):
        error = fit["errors"][f"{name}_rate_mas_yr"]
        assert abs(fit[f"{name}_rate_mas_yr"] - shift / years) < 5 * error
    assert MJD[0] < fit["reference_mjd"] < MJD[2]
    assert results[0]["significance"]["detected"] is None or results[0]["significance"]["detected"]
    assert (tmp_path / "0" / "files.png").stat().st_size > 1000
    page = (tmp_path / "0" / "report.html").read_text(encoding="utf-8")
    wanted = [
        "Contrasts of the bands, each has its own",
        "NIRISS\u00a04.82\u00a0µm",
        "Linear motion",
        "mas/yr",
    ]
    wanted += ["Reduced χ² of each file", *(path.name for path in files)]
    for words in wanted:
        assert words in page, words
    for entry in fit["contrasts"]:
        assert measured(entry["contrast"], entry["errors"]["contrast"]) in page
    assert all(0.2 < r["chi2r_vis2"] < 3.0 for r in results[0]["residuals"])
    assert any("not integrated directly" in w for w in results[0]["warnings"])


@pytest.mark.parametrize(
    ("many", "method"),
    [((2, 2), "hierarchical"), pytest.param((3, 1), "hierarchical", marks=pytest.mark.slow)],
)
def test_each_filter_has_its_calibrators(many, method, files, tmp_path) -> None:
    """Files of one name in two folders; a filter's calibrators say nothing of the other's."""
    rng = np.random.default_rng(43)
    cals = []
    for folder, band, count in zip(("blue", "red"), (F430M, F480M), many, strict=True):
        (tmp_path / folder).mkdir()
        for k in range(count):
            cals.append(tmp_path / folder / f"cal{k}.oifits")
            write_oifits(cals[-1], noisy(epoch(band, MJD[0]), [0.0, 0.0, 0.0], rng))
    report = found(files[:2], cals, null_draws=500)
    assert report.calibration is not None
    assert report.calibration.method == method
    assert [use.kept for use in report.calibration.calibrators] == [True] * 4
    for (value, error), truth in zip(report.result.contrasts.values(), (0.01, 0.02), strict=True):
        assert abs(value - truth) < 5 * error


def test_one_calibrator_of_each_filter_tells_no_scatter(files, tmp_path) -> None:
    rng = np.random.default_rng(43)
    targets = [read_oifits(path) for path in files[:2]]
    cals = [noisy(epoch(band, MJD[0]), [0.0, 0.0, 0.0], rng) for band in (F430M, F480M)]
    assert calibrate(targets, cals).method == "weighted"
    with pytest.raises(DataError, match="no baseline has more"):
        calibrate(targets, cals, method="hierarchical")


def test_a_free_slope_and_disc_of_the_companion_are_told(files, tmp_path) -> None:
    """Contrasts of 1 and 2 % at 4.29 and 4.82 µm: a slope of ln 2 / ln (4.82 / 4.29) = 5.9."""
    options = {"contrast": "tied", "contrast_slope": "free", "companion_diameter": "free"}
    lines = summary(found(files[:2], null_draws=0, **options), tmp_path)
    (slope,) = [line.split() for line in lines if line.startswith("slope")]
    assert abs(float(slope[1]) - 5.9) < 4.0 * float(slope[3])
    assert any(line.startswith("disc ") and " companion" in line for line in lines)


def test_tied_contrast_and_summary(files, tmp_path) -> None:
    tied = found(files[:2], contrast="tied", file_noise=False)
    assert any(
        "one contrast for NIRISS_4.29um, NIRISS_4.82um" in x for x in summary(tied, tmp_path)
    )
    moving = found(files[1:], motion=True, null_draws=0, posterior=True)
    rejected = replace(moving, verdict=Verdict("model rejected", "", 0.0))
    for start in ("motion      E ", "posterior ", "chain "):
        assert any(line.startswith(start) for line in summary(moving, tmp_path)), start
        assert not any(line.startswith(start) for line in summary(rejected, tmp_path)), start
    result = result_json(tied)
    assert result["fit"]["contrast_kind"] == "tied"
    assert {c["contrast"] for c in result["fit"]["contrasts"]} == {result["fit"]["contrast"]}
    lines = summary(found(files[:2]), tmp_path)
    assert len(lines) <= 20
    assert any("2 fitted together" in line for line in lines)
    assert any("NIRISS_4.82um 0.0" in line and "--contrast tied" in line for line in lines)


@pytest.mark.slow
def test_whole_joint_job_with_posterior_evidence_and_limits(files, tmp_path, capsys) -> None:
    words = (*files[:2], "--separation", "100:250", "--null-draws", "3000", "--json")
    assert run("search", *words, "--companions", "0,1,2", "--out", tmp_path / "a") == 0
    result = json.loads(capsys.readouterr().out)
    posterior = result["posterior"]
    assert posterior["converged"]
    second = posterior["contrast[NIRISS_4.82um]"]
    assert second["lower_95"] < 0.02 < second["upper_95"]
    assert "2 bands, independently" in posterior["prior"]["form"]
    assert posterior["mode_method"] == "laplace"
    assert result["evidence"]["method"] == ["quadrature", "importance", "importance"]
    assert result["evidence"]["probability"][0] < 1e-6
    assert result["limits"]["companion"] == "the same contrast in every band, at rest"
    assert any(x is not None for x in result["limits"]["delta_mag"])


def test_noise_of_each_file_is_in_the_result(files) -> None:
    with fits.open(files[1], mode="update") as hdus:
        for hdu in hdus:
            if hdu.name == "OI_VIS2":
                hdu.data["VIS2ERR"] /= 5.0
    data = read_oifits(files[1])
    assert np.median(data.errors[0]) == pytest.approx(0.001, rel=0.01)
    result = result_json(found(files[:2]))
    entries = {Path(f["path"]).name: f for f in result["noise"]["files"]}
    assert entries["f430m.oifits"]["extra_vis2"] == 0.0
    assert 0.002 < entries["f480m.oifits"]["extra_vis2"] < 0.01
    assert any("f480m.oifits was added" in w for w in result["warnings"])


def test_the_same_data_under_two_names_are_refused(files, tmp_path, capsys) -> None:
    copy = tmp_path / "copy.oifits"
    copy.write_bytes(files[0].read_bytes())
    assert run("search", files[0], files[1], copy, *FAST, "--out", tmp_path / "a") == 2
    line = one_line(capsys)
    assert "copy.oifits" in line
    assert "f430m.oifits" in line
    again = tmp_path / "again.oifits"
    write_oifits(again, read_oifits(files[0]))
    assert run("search", files[0], again, *FAST, "--out", tmp_path / "a") == 2
    assert "holds the data of" in one_line(capsys)


def test_data_that_stand_twice_in_part_are_said_to(files) -> None:
    first, second = (read_oifits(p) for p in files[:2])
    assert refuse_twice([first, second]) == ()
    merged = replace(
        second,
        vis2=replace(second.vis2, **{"value": np.r_[first.vis2.value[:2], second.vis2.value[2:]],
                                     "u_m": np.r_[first.vis2.u_m[:2], second.vis2.u_m[2:]],
                                     "v_m": np.r_[first.vis2.v_m[:2], second.vis2.v_m[2:]],
                                     "wavelength_m": np.r_[first.vis2.wavelength_m[:2],
                                                           second.vis2.wavelength_m[2:]]}),
    )  # fmt: skip
    (said,) = refuse_twice([first, merged])
    assert said.startswith("2 number(s) stand in the data more than once")
    with pytest.raises(UsageError, match="holds the data of"):
        refuse_twice([first, second, first])
    assert [p.source for p in in_order([second, first])] == [first.source, second.source]


@pytest.mark.parametrize("fault", ["cut", "flagged", "missing", "text"])
def test_a_bad_file_among_several_is_named_in_one_line(fault, files, tmp_path, capsys) -> None:
    bad = tmp_path / f"{fault}.oifits"
    if fault == "cut":
        bad.write_bytes(files[2].read_bytes()[:-4000])
    elif fault == "text":
        bad.write_text("no FITS at all")
    elif fault == "flagged":
        bad.write_bytes(files[2].read_bytes())
        with fits.open(bad, mode="update") as hdus:
            for hdu in hdus:
                if hdu.name in ("OI_VIS2", "OI_T3"):
                    hdu.data["FLAG"][:] = True
    assert run("search", files[0], bad, files[1], *FAST, "--out", tmp_path / "a") == 3
    line = one_line(capsys)
    assert f"{fault}.oifits" in line
    assert "f430m" not in line


def test_a_file_without_the_wanted_observables_is_named(files) -> None:
    data = read_oifits(files[0])
    (said,) = unused([data.only(("vis2",)), read_oifits(files[1])], ("cp",))
    assert "f430m.oifits holds no usable cp" in said
    assert unused([data], ("cp",)) == ()


def test_motion_options_that_make_no_sense(files, tmp_path, capsys) -> None:
    assert run("search", files[0], *FAST, "--motion", "--out", tmp_path / "a") == 2
    assert "all data are of one date" in one_line(capsys)
    assert run("search", *files, *FAST, "--fastest", "5", "--out", tmp_path / "a") == 2
    assert "--fastest: needs a motion" in one_line(capsys)
    words = ("--motion", "--fastest", "1e6")
    assert run("search", *files, *FAST, *words, "--out", tmp_path / "a") == 2
    assert "positions" in one_line(capsys)


def test_calibrator_of_another_insname_is_named() -> None:
    rng = np.random.default_rng(42)
    target = noisy(epoch(source="target"), [120.0, -90.0, 0.02], rng)
    same = noisy(epoch(source="same", mjd=60000.1), [0.0, 0.0, 0.0], rng)
    other = noisy(epoch(source="other", mjd=60000.2, insname="SAM"), [0.0, 0.0, 0.0], rng)
    found = calibrate(target, [same, other])
    (note,) = found.observables.notes
    assert note.startswith("calibrator other is of INSNAME SAM and not of NIRISS")
    assert calibrate(target, [same]).observables.notes == ()


def test_several_targets_say_which_option_chooses(tmp_path) -> None:
    rng = np.random.default_rng(43)
    path = tmp_path / "two.oifits"
    parts = [noisy(epoch(source=s), [0.0, 0.0, 0.0], rng) for s in "ab"]
    renamed = [
        replace(p, setups=(replace(p.setups[0], target=name),))
        for p, name in zip(parts, ("A", "B"), strict=True)
    ]

    write_oifits(path, join(renamed))
    with pytest.raises(DataError, match=r"several targets: A, B \(choose .* target=NAME"):
        read_oifits(path)
    assert read_oifits(path, target="B").n_vis2 == 21


def test_what_is_said_of_every_file_stands_once() -> None:
    notes = [("the header lacks NGROUPS", "1 of 10 integrations not used"), ("another",)]
    parts = [replace(niriss(), notes=(first, *more)) for first, *more in [*notes, notes[0][:1]]]
    assert join(parts).notes == (*notes[0], *notes[1])


def test_v2_in_a_file_of_its_own_leaves_the_kind_of_the_covariance_to_closure_phases() -> None:
    """V² and closure phases in two files made a "diagonal covariance" of correlated triangles."""
    sheet = niriss()
    vis2, closing = replace(sheet.only(["vis2"]), covariance_kind="diagonal"), sheet.only(["cp"])
    assert join([vis2, closing]).covariance_kind == sheet.covariance_kind == "assumed"
    alone = replace(closing, covariance_kind="diagonal")
    assert join([vis2, alone]).covariance_kind == "diagonal"
    assert join([vis2, vis2]).covariance_kind == "diagonal"

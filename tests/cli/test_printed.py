"""What the commands print: the numbers of the result, in at most twenty lines."""

from __future__ import annotations

import importlib
import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from commands import run
from helpers import error_of, niriss, simulated

from amibayes.calibration import calibrate
from amibayes.detection.false_alarm import Significance
from amibayes.detection.verdict import Verdict
from amibayes.likelihood.averaged_noise import NoisePosterior
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.oifits import read_oifits, write_oifits
from amibayes.parallel import spawn
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.prepare import prepare
from amibayes.pipeline.report_types import SearchReport, calibrator_verdicts
from amibayes.pipeline.run import Run
from amibayes.pipeline.search import search_companion
from amibayes.pipeline.vetting import vet
from amibayes.pipeline.warnings import search_warnings
from amibayes.report.limits import limits_summary
from amibayes.report.result import result_json, upper_limit
from amibayes.report.statement import statement_of
from amibayes.report.summary import summary
from amibayes.report.survey import survey_lines

FIRST, SECOND = [110.0, -75.0, 0.05], [-60.0, 140.0, 0.03]


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    """A resolved star with two companions."""
    path = tmp_path_factory.mktemp("data") / "star.oifits"
    model = BinaryModel(companions=2, diameter_mas=20.0)
    write_oifits(path, simulated(niriss(), FIRST + SECOND, np.random.default_rng(3), model))
    return path


@pytest.fixture(scope="module")
def report(path: Path) -> SearchReport:
    options = SearchOptions(
        (80.0, 200.0),
        diameter="free",
        extra_noise=False,
        null_draws=3000,
        companions=(1, 2),
        posterior=False,
        limits=False,
    )
    return search_companion([path], options=options)


def line(report: SearchReport, label: str) -> str:
    (said,) = [text for text in summary(report, Path("out")) if text.startswith(label)]
    return said


def test_two_companions_and_a_disc_are_told(report: SearchReport) -> None:
    assert report.evidence is not None
    assert report.evidence.two is not None
    theta, errors = report.result.theta, np.sqrt(np.diag(report.result.theta_covariance))
    words = line(report, "diameter").split()
    assert float(words[1]) == pytest.approx(theta[3], abs=0.1 * errors[3])
    assert float(words[3]) == pytest.approx(errors[3], rel=0.05)
    assert words[2::2] == ["+/-", "mas"]
    # The one of the two that is not the best single fit, within 10 mas of where it was put.
    first = report.result.companion
    other = min(
        (FIRST, SECOND), key=lambda c: -np.hypot(c[0] - first.east_mas, c[1] - first.north_mas)
    )
    words = line(report, "second").split()
    assert float(words[1]) == pytest.approx(np.hypot(*other[:2]), abs=10.0)
    assert float(words[6]) == pytest.approx(np.degrees(np.arctan2(*other[:2])) % 360, abs=4.0)
    gain = report.result.chi2_binary - report.evidence.two.chi2
    assert f"delta chi2 {gain:.1f} (detected; " in line(report, "second")
    assert "1: ln Z" in line(report, "evidence")
    assert repr(report.evidence).startswith("<Evidence: 1 companions ln Z ")
    assert len(summary(report, Path("out"))) <= 20


def test_a_disc_of_closure_phases_alone_is_told_as_such(report: SearchReport) -> None:
    assert "closure phases alone" not in line(report, "diameter")
    seen = report.result.likelihood
    phases = Likelihood(seen.observables.only("cp"), seen.model)
    told = replace(report, result=replace(report.result, likelihood=phases))
    assert line(told, "diameter").endswith("mas (closure phases alone hardly tell it)")


def test_a_disc_that_is_as_large_as_may_be_is_told_as_such(report: SearchReport) -> None:
    found = report.result
    theta, at = found.theta.copy(), found.likelihood.parameters.index("diameter_mas")
    theta[at] = found.likelihood.parameters[at].upper
    told = replace(report, result=replace(found, theta=theta))
    assert line(told, "diameter").endswith(
        "(the largest that is tried: every baseline resolves it)"
    )


def test_what_was_not_tested_is_written_so(report: SearchReport) -> None:
    # Two companions are there: the verdict refuses a model of one.
    assert "not stated: see the verdict; " in line(report, "companion")
    untested = replace(report, significance=None)
    assert line(untested, "companion") == (
        "companion   not tested: no false-alarm probability was asked for"
    )
    assert report.significance is not None
    few = replace(report, significance=few_draws(report.significance))
    assert line(few, "companion") == "companion   undecided: 3 null draws are too few"
    said = search_warnings(report.observables, report.result, ExtraNoise(), few.significance, None)
    assert any("3 null draws cannot measure a false-alarm probability" in text for text in said)


def few_draws(weight: Significance) -> Significance:
    return replace(weight, null=weight.null[:3], statistic=1.0)


def test_more_warnings_than_lines_are_counted(report: SearchReport) -> None:
    many = replace(report, warnings=tuple(f"doubt {k}" for k in range(30)))
    said = summary(many, Path("out"))
    assert len(said) == 20
    shown = [text for text in said if "doubt" in text]
    assert said[-2] == f"WARNING     {30 - len(shown)} more warnings in result.json"


class Amount:
    """A distribution of the extra noise whose quantiles are known."""

    def quantile(self, level: np.ndarray) -> np.ndarray:
        return 0.01 * np.asarray(level)


def test_noise_that_the_data_ask_for_is_told_and_other_is_not(report: SearchReport) -> None:
    found = {
        "vis2": NoisePosterior(0.02, Amount()),  # type: ignore[arg-type]
        "closure_phase_rad:b.fits": NoisePosterior(0.01, Amount()),  # type: ignore[arg-type]
        "vis2:a.fits": NoisePosterior(0.9, Amount()),  # type: ignore[arg-type]
    }
    said = line(replace(report, noise_posterior=found), "extra noise")
    assert "0.005 +0.003 -0.003 V2 (P(stated errors correct) = 0.02)" in said
    assert f"{np.degrees(0.005):.2g} " in said
    assert "deg closure phase of b.fits (P(stated errors correct) = 0.01)" in said
    assert "a.fits" not in said
    quiet = replace(report, noise_posterior={"vis2": NoisePosterior(0.9, Amount())})  # type: ignore[arg-type]
    assert not any(text.startswith("extra noise") for text in summary(quiet, Path("out")))


def test_a_misfit_is_warned_of_where_no_noise_was_added(report: SearchReport) -> None:
    result = replace(report.result, chi2_binary=3.0 * report.result.ndof)
    said = search_warnings(report.observables, result, ExtraNoise(), None, None)
    assert any(text.startswith("reduced chi2 is 3.0 with the companion") for text in said)
    noisy = search_warnings(report.observables, result, ExtraNoise(vis2=0.01), None, None)
    assert any("noise of 0.01 in V2" in text for text in noisy)
    assert not any(text.startswith("reduced chi2") for text in noisy)


def test_a_star_with_two_companions_rejects_the_model_of_one(report: SearchReport) -> None:
    assert report.verdict is not None
    assert report.verdict.statement == "model rejected"
    assert line(report, "verdict").startswith("verdict     MODEL REJECTED: ")
    assert "not stated" in line(report, "best fit")
    found = statement_of(json.loads(json.dumps(result_json(report))))
    assert (found.kind, found.label) == ("open", "Model rejected")
    assert "amibayes export" in found.sentences[0]


def test_other_positions_and_lost_limits_stand_in_the_statement(report: SearchReport) -> None:
    content = json.loads(json.dumps(result_json(replace(report, verdict=None))))
    mode = content["modes"][0]
    content["modes"] = [mode, *({**mode, "probability": 0.1} for _ in range(5))]
    content["limits"] = {"separation_mas": [100.0], "delta_mag": [None]}
    said = " ".join(statement_of(content).sentences)
    assert "do not rule out another position" in said
    assert "and 2 more" in said
    assert "No injected companion is recovered reliably" in said
    assert upper_limit(report) is None


def test_a_model_that_is_refused_has_no_upper_limit(report: SearchReport) -> None:
    assert report.significance is not None
    assert report.verdict is not None
    prior = SimpleNamespace(contrast_min=1e-5, contrast_max=1.0)
    tight = SimpleNamespace(upper_limit=lambda *_, **__: 0.01)
    unsure = replace(report.significance, interval=(0.2, 0.3))
    parts: dict[str, Any] = {"posterior": SimpleNamespace(prior=prior), "grid": tight}
    rejected = replace(report, significance=unsure, **parts)
    none = replace(rejected, verdict=Verdict("no companion", "", 0.5))
    assert rejected.statement == "model rejected"
    assert upper_limit(rejected) is None
    assert (upper_limit(none) or {})["contrast"] == 0.01


def test_what_speaks_against_the_evidence_is_told(report: SearchReport) -> None:
    found = report.evidence
    assert found is not None
    assert "baseline resolves" not in line(report, "evidence")
    likelier = replace(found, halo_log_z=max(found.log_z) + 4.0)
    said = line(replace(report, evidence=likelier), "evidence")
    assert f"no baseline resolves: {likelier.halo_log_z:.1f}, more likely" in said
    assert report.significance is not None
    test: Any = replace(report.significance.test, exposures=object())  # type: ignore[type-var]
    shared = replace(report, significance=replace(report.significance, test=test))
    assert "independently" not in line(shared, "evidence")
    none = replace(shared, verdict=Verdict("no companion", "", 0.5))
    assert "as if exposures erred independently" in line(none, "evidence")


def test_a_run_without_calibrators_has_no_verdicts(report: SearchReport) -> None:
    assert calibrator_verdicts(report) == []


@pytest.mark.parametrize("stars", [2, 3])
def test_dithers_of_a_calibrator_are_one_calibrator(report: SearchReport, stars: int) -> None:
    # Three are vetted, two are not; both have fewer verdicts than files.
    rng = np.random.default_rng(4)
    sheet = niriss()
    names = [f"{k}_d1_calints.fits, {k}_d2_calints.fits" for k in range(stars)]
    references = []
    for name in names:
        drawn = sheet.with_data(sheet.data + sheet.covariance.draw(rng, 1)[:, 0])
        references.append(replace(drawn, setups=(replace(drawn.setups[0], source=name),)))
    verdicts = calibrator_verdicts(
        replace(
            report,
            calibrators=tuple(file for name in names for file in name.split(", ")),
            references=tuple(references),
            calibration=calibrate([sheet], references),
            vetting=vet(references, null_draws=200, limits=False) if stars > 2 else None,
        )
    )
    assert [v["path"] for v in verdicts] == names
    assert all(v["kept"] for v in verdicts)


def test_nothing_to_read_is_refused() -> None:
    with pytest.raises(Exception, match=r"no target given \(name at least one file\)"):
        prepare([], [], SearchOptions(), np.random.default_rng(1), Run())


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("alone") / "alone.oifits"
    write_oifits(path, simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1)))
    return path


def test_limits_in_mass(alone: Path, tmp_path: Path, capsys) -> None:
    tracks = tmp_path / "tracks.ecsv"
    mass, magnitude = [1.0, 5.0, 50.0], [12.0, 8.0, 2.0]
    Table({"mass_mjup": mass, "delta_mag": magnitude}).write(tracks)
    words = ("--criterion", "candid", "--separations", 4, "--separation", "60:400")
    assert run("limits", alone, *words, "--mass-table", tracks, "--out", tmp_path / "out") == 0
    said = capsys.readouterr().out
    content = json.loads((tmp_path / "out" / "limits.json").read_text())
    curve = content["curves"][0]
    ln_mass = np.interp(-np.array(curve["delta_mag"]), [-12, -8, -2], np.log(mass))
    assert curve["mass"] == pytest.approx(np.exp(ln_mass))
    assert f"mass {min(curve['mass']):.3g} to {max(curve['mass']):.3g} M_Jup" in said
    table = Table.read(tmp_path / "out" / "limits.ecsv")
    np.testing.assert_allclose(table["mass_vis2_cp"], curve["mass"])
    content["warnings"] = [f"doubt {k}" for k in range(30)]
    content["curves"][1]["delta_mag"] = [None] * 4
    lines = limits_summary(content, tmp_path)
    assert len(lines) == 20
    assert lines[-2].endswith("more warnings in limits.json")
    assert any("no limit in this field" in text for text in lines)


@pytest.mark.slow
def test_other_data_in_a_folder_are_not_gone_on_with(path, alone, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    words = ("--separation", "80:200", "--null-draws", 0, "--no-posterior", "--no-limits")
    assert run("search", alone, *words, "--out", out, "--quiet") == 0
    before = (out / "result.json").read_bytes()
    assert run("search", path, *words, "--out", out, "--quiet", "--resume") == 2
    assert "is the result of other data" in error_of(capsys)
    assert (out / "result.json").read_bytes() == before
    assert run("search", alone, *words, "--out", out, "--quiet", "--resume") == 0
    (out / "result.json").write_text("{}")
    assert run("search", alone, *words, "--out", out, "--quiet", "--resume") == 2
    assert "is the result of other data" in error_of(capsys)


@pytest.mark.parametrize(
    ("column", "cell", "outcome"),
    [
        pytest.param("keep_all", "true", "--keep-all", marks=pytest.mark.slow),
        ("keep_all", "maybe", "column 'keep_all' holds 'maybe' (write true or false)"),
        ("smearing", "false", "--no-smearing"),
    ],
)
def test_cells_of_options_that_take_no_value(column, cell, outcome, alone, tmp_path, capsys):
    batch = tmp_path / "t.csv"
    batch.write_text(f"target,{column}\n{alone},{cell}\n")
    words = ("--null-draws", 0, "--no-posterior", "--no-limits", "--separation", "80:200")
    out = tmp_path / "out"
    status = run("search", "--batch", batch, *words, "--out", out, "--quiet")
    if outcome.startswith("--"):
        assert status == 0
        page = (out / "alone" / "report.html").read_text()
        assert outcome in page
    else:
        assert status == 2
        assert outcome in error_of(capsys)


def test_numbers_that_are_none(alone: Path, tmp_path: Path, capsys) -> None:
    for words, fault in [
        (("vet", alone, "--alpha", "2"), "2 is not below 1"),
        (("search", alone, "--diameter", "-1"), "-1 is negative or not finite"),
        (("limits", alone, "--mass-table", "t", "--primary-magnitude", "x"), "'x' is not a number"),
        (("limits", alone, "--mass-table", "t", "--primary-magnitude", "inf"), "inf is not finite"),
        (("search", alone, "--null-draws", "1.5"), "is not a whole number"),
        (("vet", alone, "--charge-levels", "1,2,3"), "--charge-levels"),
        (
            (
                "plan",
                "--floor",
                "none",
                "--filter",
                "F430M",
                "--mag",
                "6",
                "--photons",
                "1e8",
                "--separation",
                "50:99999",
            ),
            "the baselines distinguish",
        ),
    ]:
        assert run(*words, "--out", tmp_path / "out") == 2
        assert fault in error_of(capsys)


def test_audit_and_export_in_words(alone: Path, tmp_path: Path, capsys) -> None:
    assert run("export", alone, "--to", "mira", "--out", tmp_path / "e") == 0
    said = capsys.readouterr().out
    assert "next        " in said
    assert str(tmp_path / "e" / "mira.oifits") in said
    other = tmp_path / "other" / alone.name
    other.parent.mkdir()
    from astropy.io import fits

    with fits.open(alone) as hdus:
        hdus["OI_VIS2"].data["VIS2DATA"][2] = np.nan
        hdus.writeto(other)
    words = ("audit", other, "--fix", "--overwrite")
    assert run(*words, "--out", tmp_path / "a") == 1
    assert f"corrected in {tmp_path / 'a' / alone.name}" in capsys.readouterr().out
    assert run(*words, "--out", other.parent) == 2
    assert "would be written over itself" in error_of(capsys)
    twin = tmp_path / "twin" / alone.name
    twin.parent.mkdir()
    twin.write_bytes(other.read_bytes())
    assert run("audit", other, twin, "--fix", "--out", tmp_path / "b") == 2
    assert "two files have the same name" in error_of(capsys)


SCENE = """
name = "small"
[star]
magnitude = 6.0
filter = "F430M"
[instrument]
filter = "F430M"
[exposure]
n_groups = 5
n_integrations = 6
n_pixels = 48
"""


def test_images_made_and_measured_in_words(tmp_path: Path, capsys) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    assert run("simulate", tmp_path / "scene.toml", "--out", tmp_path / "images") == 0
    said = capsys.readouterr().out
    (cube,) = (tmp_path / "images").glob("*_calints.fits")
    assert f"{cube}  F430M  5 groups, 6 integrations, " in said
    words = ("extract", cube, "--out", tmp_path / "e", "--per-integration", "--overwrite")
    assert run(*words) == 0
    said = capsys.readouterr().out
    (entry,) = json.loads((tmp_path / "e" / "extract.json").read_text())["extractions"]
    assert f"integrations   {entry['n_used']} of 6 used" in said
    assert f"closure phase  σ {entry['sigma_closure_phase_deg']:.3g} deg" in said
    assert len(said.splitlines()) <= 20
    assert said.count("mask magnified") == 1  # by the geometry, not by a note again
    assert any("mask magnified" in note for note in entry["notes"])
    single = next((tmp_path / "e").glob("*_integrations.oifits"))
    assert read_oifits(single).n_vis2 == 21 * entry["n_used"]
    twin = tmp_path / "twin" / cube.name
    twin.parent.mkdir()
    twin.write_bytes(cube.read_bytes())
    assert run("extract", cube, twin, "--out", tmp_path / "f") == 2
    assert "two cubes have the same name" in error_of(capsys)
    assert not (tmp_path / "f").exists()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError("9 GB"), "not enough memory: 9 GB (ask for less)"),
        pytest.param(
            ValueError("odd\n  thing"),
            "ValueError: odd thing (a fault of amibayes",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_surprise_with_one_target_spares_the_others(
    error, said, alone, tmp_path, capsys, monkeypatch
) -> None:
    batch = tmp_path / "t.csv"
    batch.write_text(f"target,name\n{alone},bad\n{alone},good\n")
    whole = importlib.import_module("amibayes.cli.search").perform

    def perform(arguments):
        if Path(arguments.out).name == "bad":
            raise error
        return whole(arguments)

    monkeypatch.setattr("amibayes.cli.search.perform", perform)
    out = tmp_path / "out"
    words = ("--null-draws", 0, "--no-posterior", "--no-limits", "--separation", "80:200")
    assert run("search", "--batch", batch, *words, "--out", out, "--quiet") == 4
    assert said in error_of(capsys)
    summary = json.loads((out / "survey.json").read_text())
    assert [entry["status"] for entry in summary["targets"]] == ["failed", "done"]


def test_a_survey_of_many_is_told_in_twenty_lines(tmp_path: Path) -> None:
    targets = [{"name": f"s{k}", "status": "failed", "error": "gone"} for k in range(40)]
    content = {"targets": targets, "n_done": 0, "n_targets": 40, "n_failed": 40}
    lines = survey_lines(content, tmp_path)
    assert len(lines) == 20
    assert lines[0] == "targets     0 of 40 done, 40 failed"
    shown = sum(text.startswith("s") for text in lines)
    assert lines[-2].startswith(f"and {40 - shown} more in ")


def test_what_mpi_and_other_schedulers_need(alone: Path, tmp_path: Path, capsys) -> None:
    if importlib.util.find_spec("mpi4py") is None:
        assert run("search", alone, "--scheduler", "mpi", "--out", tmp_path / "out") == 4
        assert "mpi4py is missing (pip install 'amibayes[mpi]')" in error_of(capsys)
    with pytest.raises(TypeError, match="not made from a SeedSequence"):
        spawn(np.random.Generator(Unseeded()), 2)


class Unseeded(np.random.PCG64):
    """A generator that does not say how it was seeded."""

    @property
    def seed_seq(self):
        return None

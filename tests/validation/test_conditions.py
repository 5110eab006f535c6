"""Conditions write what they say, and trials take what a search writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trial_answers
from conftest import script
from poppy_stars import PoppyExposure
from trial_answers import PLAN

from amibayes import read_oifits
from amibayes.cli import main
from amibayes.detection.verdict import STATEMENTS
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.parallel import child_seeds
from amibayes.pipeline.search import search_companion
from amibayes.support.options import ALPHA
from amibayes.validation import QUICK, SimulatedTable
from amibayes.validation.trial import answer_of, options_of, run_trial

SEED = np.random.SeedSequence(4)
VLTI = SimulatedTable("vlti", 0.02, 0.5, field_mas=(1.5, 12.0))


@pytest.mark.parametrize(
    ("condition", "truth"),
    [
        (SimulatedTable(epochs=2), (150.0, -80.0, 0.1)),
        (VLTI, (5.0, 3.0, 0.1)),
        (replace(VLTI, companion_mas=1.5), (5.0, 3.0, 0.1)),
    ],
)
def test_the_formula_of_the_tables_agrees_with_the_model(
    condition: SimulatedTable, truth: tuple[float, ...], tmp_path: Path
) -> None:
    """Channels flat in wavelength against the model's, flat in 1/λ: 1 % of a light of a tenth."""
    exact = replace(condition, vis2_error=1e-7, closure_error_deg=1e-5)
    model = BinaryModel(companion_diameter_mas=condition.companion_mas)
    for path in exact.write(np.array(truth), SEED, tmp_path)[0]:
        found = Likelihood(read_oifits(path), model).difference(np.array([truth]))
        assert np.abs(found).max() < 1e-3


@pytest.mark.parametrize("common", [0.0, 0.6])
def test_errors_of_the_tables_are_as_stated_and_closures_share_baselines(common: float) -> None:
    """Variances of 3000 draws within 4.5 σ, and of whitened ones, that of a shared channel too."""
    condition = replace(VLTI, common=common)
    sheet, rng = condition._exposures(0)[0], np.random.default_rng(5)
    draws = np.array([np.concatenate(condition._noise(sheet, rng)) for _ in range(3000)])
    ratio = draws.var(axis=0) / sheet.covariance.variance
    assert np.abs(ratio - 1.0).max() < 4.5 * np.sqrt(2.0 / 3000.0)
    first, second = draws[:, 0], draws[:, 1]
    assert list(sheet.vis2.row[:2]) == [sheet.vis2.row[0]] * 2
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(common, abs=4.5 / np.sqrt(3000.0))
    if not common:
        white = sheet.covariance.whiten(draws.T)
        assert white.var() == pytest.approx(1.0, abs=4.5 * np.sqrt(2.0 / white.size))


def test_calibration_errors_of_the_tables_are_smooth_over_channels() -> None:
    """Offset and slope: of three channels the second difference is none, the variance as said."""
    condition = replace(VLTI, calibration=(0.03, 0.5))
    sheet, rng = condition._exposures(0)[0], np.random.default_rng(7)
    drawn = [condition._calibration_errors(sheet, rng) for _ in range(2000)]
    for errors, size in zip(zip(*drawn, strict=True), (0.03, np.radians(0.5)), strict=True):
        channels = np.array(errors).reshape(2000, -1, 3)
        assert np.abs(channels @ [1.0, -2.0, 1.0]).max() < 1e-9
        # Offset and slope have half of the variance each, averaged over the channels.
        assert channels.var() == pytest.approx(size**2, rel=0.05)
        assert channels.mean(axis=2).var() == pytest.approx(0.5 * size**2, rel=0.05)


def test_a_share_of_the_data_is_spoilt() -> None:
    rng = np.random.default_rng(6)
    spoilt = replace(VLTI, outliers=0.05)._spoilt(np.ones(20_000), rng)
    assert np.mean(spoilt == 10.0) == pytest.approx(0.05, abs=4.5 * np.sqrt(0.05 * 0.95 / 20_000))


def test_a_trial_takes_what_search_writes(tmp_path: Path) -> None:
    """The command on the same files, with the same options, writes what the trial takes."""
    condition = SimulatedTable()
    plan = replace(QUICK, settings=(condition,), null_draws=4000, alpha=ALPHA)
    answer = run_trial(plan, (0, "alone", SEED))
    _, of_data, of_search = child_seeds(SEED, 3)
    targets, _ = condition.write(None, of_data, tmp_path)
    seed = str(of_search.generate_state(1)[0])
    wanted = ["--separation", "50:400", "--null-draws", "4000", "--seed", seed]
    files = [str(path) for path in targets]
    rest = ["--no-posterior", "--no-limits", "--no-pictures", "--quiet", "--out", str(tmp_path)]
    assert main(["search", *files, *wanted, *rest]) == 0
    content = json.loads((tmp_path / "result.json").read_text())
    found = content["significance"]["false_alarm_probability"]
    assert answer["false_alarm_probability"] == found
    assert STATEMENTS[answer["statement"]] == content["verdict"]["statement"]


@pytest.mark.slow
def test_a_companion_in_images_of_poppy_is_measured_where_it_is(tmp_path: Path) -> None:
    """Nothing of our optics or detector: place within 4.5 σ, contrast within 4.5 σ and 2 %."""
    condition, truth = PoppyExposure(), np.array([120.0, -90.0, 0.03])
    plan = replace(QUICK, settings=(condition,), null_draws=400)
    options = options_of(plan, condition.field_mas, "bright", 1)
    files = condition.write(truth, np.random.SeedSequence(3), tmp_path)
    report = search_companion(*files, options)
    companion = report.result.companion
    place = np.array([companion.east_mas, companion.north_mas])
    assert np.hypot(*(place - truth[:2])) < 4.5 * companion.separation_error_mas
    error = np.hypot(companion.contrast_error, 0.02 * truth[2] / 4.5)
    assert companion.contrast == pytest.approx(truth[2], abs=4.5 * error)
    answer = answer_of(report, truth)
    assert answer["found"]
    assert STATEMENTS[answer["statement"]] == "companion"


def test_answers_go_on_from_a_line_that_was_cut_short(tmp_path: Path) -> None:
    answers = script("trials").answers
    path, asked = tmp_path / "a" / "answers.jsonl", []

    def trial(k: int) -> dict[str, int]:
        asked.append(k)
        return {"k": k}

    def kept(n: int) -> list[int]:
        return [answer["k"] for answer in answers(path, n, trial, "docs/validation.py")]

    assert kept(3) == [0, 1, 2]
    path.write_text(path.read_text()[:-3])
    assert kept(5) == list(range(5))
    assert asked == [0, 1, 2, 2, 3, 4]
    assert kept(2) == [0, 1]
    assert len(path.read_text().splitlines()) == 5


def test_the_table_names_the_checks_that_fail_of_a_condition() -> None:
    table = script("validation")

    def row(**spoilt: float) -> str:
        each = zip(trial_answers.answers(PLAN, 3, **spoilt), PLAN.kinds, strict=True)
        return table.row_of("one", [answer | {"kind": kind} for answer, kind in each])

    assert row().endswith("| none |")
    assert "**68% interval of separation_mas; " in row(coverage=0.8)
    assert row().count("|") == len(table.HEAD) + 1

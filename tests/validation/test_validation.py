"""The validation itself: its checks find what is wrong and pass what is right."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from trial_answers import PLAN, answers

from amibayes.cli import main
from amibayes.errors import DataError, RunError
from amibayes.plots.style import save
from amibayes.report.page import page_html, read_figure
from amibayes.report.validation import (
    PICTURES,
    validation_json,
    validation_page,
    validation_pictures,
    validation_table,
)
from amibayes.validation import QUICK, validate
from amibayes.validation.plan import RANGES, ValidationPlan
from amibayes.validation.tally import rate, tally, unequal, uniformity
from amibayes.validation.trial import run_trial


def test_a_sound_programme_passes() -> None:
    """25 checks at 1e-3 on fixed seeds; 1 of 50 runs may fail one by chance, here none does."""
    validation = tally(PLAN, 1, list(answers(PLAN)))
    assert validation.passed, [c for c in validation.checks if not c.passed]
    assert {c.n for c in validation.checks if c.group == "ranks"} == {100}
    assert len(validation.of_kind("alone")) == 400


@pytest.mark.parametrize(
    ("fault", "size", "group"),
    [
        ("alarm", 1.7, "false alarms"),
        ("contrast", 2.0, "ranks"),
        ("coverage", 0.8, "coverage"),
        ("found", 0.75, "completeness"),
        ("verdict", 0.06, "verdicts"),
        ("second", 3.0, "second companion"),
    ],
)
def test_a_fault_is_found_where_it_is(fault: str, size: float, group: str) -> None:
    validation = tally(PLAN, 1, list(answers(PLAN, 3, **{fault: size})))
    assert {c.group for c in validation.checks if not c.passed} == {group}


def test_few_trials_claim_nothing() -> None:
    plan = replace(QUICK, per_range=1, n_alone=2)
    checks = tally(plan, 1, list(answers(plan))).checks
    assert all(c.passed and np.isnan(c.measured) for c in checks)


def test_kinds_take_turns() -> None:
    kinds = QUICK.kinds
    assert {k: kinds.count(k) for k in kinds} == dict.fromkeys(RANGES, 8) | {"alone": 12}
    half = kinds[: len(kinds) // 2]
    assert half.count("faint") == 4
    assert half.count("alone") == 6


def test_unequal_chances_are_tested_exactly() -> None:
    alike = unequal("g", "n", np.arange(300) < 70, np.full(300, 0.3))
    binomial = stats.binom(300, 0.3)
    expected = 2.0 * min(binomial.cdf(70), binomial.sf(69))
    assert alike.p_value == pytest.approx(expected, rel=1e-9)
    # Every one of sixteen hits of chance 0.2 or 0.9: a product.
    chance = np.tile([0.2, 0.9], 8)
    assert unequal("g", "n", np.ones(16), chance).p_value == pytest.approx(2 * chance.prod())


def test_p_values_of_the_checks() -> None:
    x = (np.arange(50) + 0.5) / 50
    assert uniformity("g", "n", x).p_value == pytest.approx(1.0, abs=1e-6)
    assert uniformity("g", "n", 0.5 * x).p_value < 1e-10
    hits = np.arange(100) < 68
    assert rate("g", "n", hits, 0.68).p_value == pytest.approx(1.0, abs=1e-9)
    assert rate("g", "n", hits, 0.5).p_value == stats.binomtest(68, 100, 0.5).pvalue
    check = unequal("g", "n", hits, np.full(100, 0.5))
    assert check.p_value == pytest.approx(2.0 * stats.binom.sf(67, 100, 0.5))
    assert check.error == pytest.approx(0.05)


def test_mean_and_scatter_of_the_distance() -> None:
    """The exact distribution at n = 100 is within 2 % of the limit."""
    check = uniformity("g", "n", np.linspace(0.0, 1.0, 100))
    assert check.expected == pytest.approx(float(stats.kstwo.mean(100)), rel=0.02)
    assert check.error == pytest.approx(float(stats.kstwo.std(100)), rel=0.02)


@pytest.mark.slow
def test_one_star_goes_the_whole_way_and_is_held_to_its_truth() -> None:
    """A companion a hundred times brighter than the limits of these data is found where it is."""
    plan = replace(QUICK, null_draws=400)
    answer = run_trial(plan, (0, "bright", np.random.SeedSequence(2)))
    assert answer["found"]
    assert answer["expected"] > 0.99
    assert answer["false_alarm_probability"] < 0.01
    rho = np.hypot(*answer["truth"][:2])
    inner, outer = plan.settings[0].field_mas
    assert inner <= rho <= outer
    assert RANGES["bright"][0] <= answer["truth"][2] <= RANGES["bright"][1]
    # Each rank is beyond 5e-5 of either end in one of 1e4 sound runs.
    assert all(5e-5 < rank < 1.0 - 5e-5 for rank in answer["rank"])
    assert all(wide or not narrow for narrow, wide in answer["covered"])


def test_a_failure_of_the_analysis_names_the_trial(monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise DataError("holds nothing", source="star")

    monkeypatch.setattr("amibayes.validation.trial.search_companion", refuse)
    with pytest.raises(RunError, match=r"trial 3 \(alone\): star: holds nothing"):
        run_trial(QUICK, (3, "alone", np.random.SeedSequence(1)))


def test_the_page_says_what_holds_and_what_fails(tmp_path) -> None:
    sound = tally(PLAN, 1, list(answers(PLAN)))
    bad = tally(PLAN, 3, list(answers(PLAN, 3, coverage=0.8)))
    failing = [check for check in bad.checks if not check.passed]
    assert validation_table(sound)[-1] == "All 25 checks hold."
    *rows, last = validation_table(bad)[1:]
    assert [row[:52].strip() for row in rows] == [check.name for check in failing]
    assert last.startswith(f"{len(failing)} of 25 checks fail: {failing[0].name}")
    figures = {}
    for name, drawing in validation_pictures(bad).items():
        save(drawing, tmp_path / f"{name}.png")
        figures[name] = read_figure(tmp_path / f"{name}.png", name, "")
    assert set(figures) == {name for name, *_ in PICTURES.values()}
    said = page_html(validation_page(bad, figures, "out"))
    assert said.count("FAILS") == len(failing)
    assert "Failed" in said
    assert "Passed" in page_html(validation_page(sound, figures, "out"))
    content = validation_json(bad)
    assert content["passed"] is False
    assert [c["passed"] for c in content["checks"]] == [c.passed for c in bad.checks]
    known = bad.of_kind("faint")[0]
    assert content["trials"]["rank"][known] == list(bad.rank[known])
    assert content["trials"]["found"][bad.of_kind("alone")[0]] is None


def test_command_on_one_star(monkeypatch, tmp_path, capsys) -> None:
    setting = replace(QUICK.settings[0], n_integrations=12)
    one = replace(QUICK, settings=(setting,), per_range=0, n_alone=1, null_draws=400)
    monkeypatch.setattr("amibayes.validation.QUICK", one)
    out = tmp_path / "out"
    assert main(["validate", "--out", str(out), "--seed", "5"]) == 0
    said = capsys.readouterr().out
    assert said.strip().endswith(f"written to {out}")
    content = json.loads((out / "validation.json").read_text())
    assert content["trials"]["kind"] == ["alone"]
    assert (out / "validation.html").read_text().count("data:image/png") == 4
    assert not (out / "journal").exists() or not list((out / "journal").rglob("*.npz"))


@pytest.fixture
def small() -> ValidationPlan:
    setting = replace(QUICK.settings[0], n_integrations=12)
    return replace(QUICK, settings=(setting,), per_range=1, n_alone=1, null_draws=400)


@pytest.mark.slow
def test_whole_way_and_resumed(small: ValidationPlan, tmp_path) -> None:
    """A run that was stopped after two stars gives the numbers of an undisturbed one."""

    class StoppedError(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise StoppedError

    with pytest.raises(StoppedError):
        validate(small, 5, journal=tmp_path, progress=stop)
    assert len(list(tmp_path.glob("*/piece-*.npz"))) >= 1
    seen: list[int] = []
    resumed = validate(
        small, 5, journal=tmp_path, resume=True, progress=lambda done, total: seen.append(done)
    )
    whole = validate(small, 5)
    assert seen[0] >= 1
    assert resumed.kind == whole.kind
    for name in ("false_alarm_probability", "truth", "rank", "covered", "found", "expected"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name))
    bright = whole.of_kind("bright")[0]
    assert whole.found[bright] == 1.0
    assert not list(tmp_path.glob("*/piece-*.npz"))


@pytest.mark.slow
def test_command_writes_page_pictures_and_numbers(small, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("amibayes.validation.QUICK", small)
    out = tmp_path / "out"
    assert main(["validate", "--out", str(out), "--seed", "5", "--quiet"]) == 0
    content = json.loads((out / "validation.json").read_text())
    assert content["n_trials"] == 4
    assert len(content["checks"]) == 25
    assert content["trials"]["found"].count(None) == 1
    page = (out / "validation.html").read_text()
    assert page.count("data:image/png") == 4
    assert "amibayes validate --quick --seed 5" in page
    assert {p.name for p in out.iterdir()} == {
        "validation.json",
        "validation.html",
        "ranks.png",
        "coverage.png",
        "false_alarms.png",
        "completeness.png",
    }
    assert main(["validate", "--out", str(out), "--quiet"]) == 2
    assert "--overwrite" in capsys.readouterr().err

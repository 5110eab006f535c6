"""Rows and statistics of a survey from the results of its targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amibayes.report.survey import survey_lines
from amibayes.survey.completeness import Crossings, DetectionProbability
from amibayes.survey.rows import Outcome, detection_of, row_of, table_of
from amibayes.survey.together import suggested_box, survey_json
from amibayes.units import contrast_to_delta_mag, delta_mag_to_contrast

RHO = [80.0, 160.0, 240.0]


def limits(**more: object) -> dict:
    return {
        "method": "injection",
        "separation_mas": RHO,
        "delta_mag": [5.0, 6.0, None],
        "delta_mag_50": [5.5, 6.6, None],
        "completeness": 0.95,
        "false_positive_rate": 0.0013,
        "criterion_at": ["detection", "position", "position"],
    } | more


def result(p: float = 0.3, **more: object) -> dict:
    return {
        "significance": {
            "detected": p < 1e-3,
            "false_alarm_probability": p,
            "alpha": 0.0013,
        },
        "fit": {"separation_mas": 100.0, "delta_mag": 4.0, "errors": {"delta_mag": 0.1}},
        "data": {"separation_mas": [70.0, 400.0]},
        "inputs": [
            {"path": "a/t.fits", "role": "target"},
            {"path": "c.fits", "role": "calibrator"},
        ],
        "modes": [{"separation_mas": 100.0, "position_angle_deg": 10.0, "contrast": 0.1}],
    } | more


def test_a_row_has_what_the_result_has() -> None:
    row = row_of(result(limits=limits()))
    assert (row["files"], row["calibrators"]) == (["t.fits"], ["c.fits"])
    assert (row["limit_delta_mag"], row["limit_delta_mag_worst"]) == (5.5, 5.0)
    assert row["delta_mag_error"] == 0.1
    assert row["separation_error_mas"] is None
    assert "verdict" not in row
    assert row["field_mas"] == [70.0, 400.0]
    assert set(row["limits"]) <= {
        "method",
        "separation_mas",
        "delta_mag",
        "completeness",
        "false_positive_rate",
    }
    assert row_of({"significance": None})["limits"] is None


@pytest.mark.parametrize("statement", ["model rejected", "inconsistent data"])
def test_a_target_without_an_answer_counts_neither_way(statement: str, tmp_path: Path) -> None:
    """A disc or a triple is not like noise, and no companion of that place either."""
    place = {"separation_mas": 100.0, "position_angle_deg": 10.0, "delta_mag": 4.0}
    found = [
        result(p, limits=limits(), verdict={"statement": said}, fit=place)
        for p, said in [(1e-4, statement), (1e-4, "companion"), (0.4, "no companion")]
    ]
    rows = [row_of(content) for content in found]
    assert [row["detected"] for row in rows] == [None, True, False]
    outcomes = [
        Outcome(name, "done", row=row, detection=detection_of(content))
        for name, row, content in zip("abc", rows, found, strict=True)
    ]
    survey = survey_json("search", 1, outcomes, whole=True)
    assert survey["false_alarms"]["discovered"] == ["b"]
    assert (survey["false_alarms"]["n_tested"], survey["false_alarms"]["n_detected"]) == (2, 1)
    assert survey["companion_frequency"]["n_targets"] == 2
    assert survey["companion_frequency"]["n_detected"] == 1
    assert f"a  {statement}, limits" in "\n".join(survey_lines(survey, tmp_path))


def test_detection_goes_through_the_curves_where_counts_are_not_kept() -> None:
    found = detection_of({"limits": limits()})
    at = found(np.array(RHO), delta_mag_to_contrast(np.array([5.0, 5.5, 6.0, 6.6])))
    assert at[0, :2] == pytest.approx([0.95, 0.5])
    assert at[1, 2:] == pytest.approx([0.95, 0.5])
    assert not at[2].any()
    assert detection_of({"limits": limits(method="absil")}) is None
    assert detection_of({"limits": None}) is None


def test_detection_follows_the_counts_of_injections() -> None:
    contrast = np.geomspace(1e-3, 1e-1, 12) * np.ones((3, 1))
    share = 1 / (1 + np.exp(-4 * np.log(contrast / 0.01)))
    counts = (200 * share).astype(int)
    cells = {
        "separation_mas": RHO,
        "contrast": contrast.tolist(),
        "trials": np.full(contrast.shape, 200).tolist(),
        "detected": counts.tolist(),
        "located": (0 * counts).tolist(),
    }
    of_search = detection_of({"limits": limits(completeness_map=cells)})
    of_limits = detection_of(limits(completeness_map=cells))
    for found in (of_search, of_limits):
        at = found(np.array(RHO), contrast[0])
        assert np.abs(at[0] - share[0]).max() < 0.02  # there a companion counts wherever seen
        assert not at[1:].any()


def survey(n: int, rng: np.random.Generator, companions: int = 0) -> list[Outcome]:
    outcomes = []
    for k in range(n):
        p = 1e-4 if k < companions else rng.uniform(0.002, 1.0)
        rings = tuple(Crossings(float(np.log(3e-3)), 6.0) for _ in RHO)
        detection = DetectionProbability(np.array(RHO), rings)
        row = row_of(result(p, limits=limits()))
        outcomes.append(Outcome(f"s{k}", "done", row=row, detection=detection))
    return outcomes


def test_together_counts_rates_and_frequency() -> None:
    rng = np.random.default_rng(2)
    outcomes = [*survey(60, rng, companions=12), Outcome("bad", "failed", "gone")]
    content = survey_json("search", 1, outcomes, whole=True)
    alarms, frequency = content["false_alarms"], content["companion_frequency"]
    assert alarms["discovered"] == [f"s{k}" for k in range(12)]
    assert alarms["n_tested"] == 60
    assert alarms["expected_false_detections"] == pytest.approx(60 * 0.0013)
    assert content["targets"][0]["survey_wide_false_alarm"] == pytest.approx(1 - 0.9999**60)
    assert frequency["n_detected"] == 12
    low, high = frequency["interval_95"]
    assert low < 12 / 60 / frequency["mean_completeness"] < high
    faintest = contrast_to_delta_mag(3e-3)
    assert frequency["delta_mag"][1] == pytest.approx(faintest, abs=0.25)
    assert content["completeness_au"] is None
    assert (content["n_done"], content["n_failed"]) == (60, 1)
    begun = survey_json("search", 1, outcomes, whole=False)
    assert "false_alarms" not in begun
    table = table_of(content["targets"], {"seed": 1})
    assert table["false_discovery_rate"].mask.tolist() == [False] * 60 + [True]
    names = table.colnames
    assert names.index("false_discovery_rate") == names.index("false_alarm_probability") + 1


def test_false_positives_are_no_companions() -> None:
    """Of tests at 20 %, a fifth of stars without companions are detected: f is about 0."""
    outcomes = survey(60, np.random.default_rng(2), companions=12)
    for outcome in outcomes:
        outcome.row["alpha"] = 0.2
    found = survey_json("search", 1, outcomes, whole=True)["companion_frequency"]
    # A completeness p and 12 of 60: σ of f is √(0.2 · 0.8/60)/(p − 0.2), 0.08.
    assert found["interval_68"][0] < 0.08
    assert found["median"] < 0.12


def test_distances_and_masses_give_physical_units(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    (tmp_path / "m.csv").write_text("mass_mjup,absolute_mag\n100,8\n10,14\n")
    facts = {"distance_pc": 20.0, "mass_table": str(tmp_path / "m.csv"), "primary_magnitude": 4.0}
    outcomes = [
        Outcome(o.name, "done", row=o.row, facts=facts, detection=o.detection)
        for o in survey(3, rng)
    ]
    found = survey_json("search", 1, outcomes, whole=True)["completeness_au"]
    assert found["mass_unit"] == "M_Jup"
    assert found["separation_au"][0] == pytest.approx(80.0 * 20.0 / 1000.0)
    # The mass whose magnitude is that of half completeness, ln mass being linear in it.
    half = contrast_to_delta_mag(3e-3)
    mass = 100.0 * 0.1 ** ((half - 4.0) / 6.0)
    at = np.interp(np.log(mass), np.log(found["mass"]), found["mean"][10])
    assert at == pytest.approx(0.5, abs=0.05)
    without = [
        Outcome(o.name, "done", row=o.row, facts={"distance_pc": 20.0}, detection=o.detection)
        for o in outcomes
    ]
    assert "delta_mag" in survey_json("search", 1, without, whole=True)["completeness_au"]
    near = [
        Outcome(o.name, "done", row=o.row, facts={"distance_pc": pc}, detection=o.detection)
        for o, pc in zip(outcomes, (20.0, 10.0, 40.0), strict=True)
    ]
    across = survey_json("search", 1, near, whole=True)["completeness_au"]["separation_au"]
    # From 80 mas at 10 pc to 240 mas at 40 pc.
    np.testing.assert_allclose([across[0], across[-1]], [0.8, 9.6])


def test_a_survey_that_sees_nothing_counts_nothing() -> None:
    rings = (None, None, None)
    blind = Outcome(
        "x",
        "done",
        row=row_of(result(0.5, limits=limits())),
        detection=DetectionProbability(np.array(RHO), rings),
    )
    assert suggested_box([blind]) is None
    assert suggested_box([]) is None
    content = survey_json("search", 1, [blind], whole=True)
    assert content["companion_frequency"] is None


def test_an_entry_says_what_went_wrong_and_what_a_star_is() -> None:
    facts = {"distance_pc": 12.0, "mass_table": "a.csv", "unknown": 1}
    done = Outcome("a", "done", key="k", row={"files": ["t"]}, facts=facts, chosen="b (2 deg)")
    assert done.entry() == {
        "name": "a", "status": "done", "error": None, "key": "k", "distance_pc": 12.0,
        "chosen_calibrators": "b (2 deg)", "files": ["t"],
    }  # fmt: skip
    failed = Outcome("a", "failed", "no light")
    assert failed.entry() == {"name": "a", "status": "failed", "error": "no light", "key": ""}

"""Numbers of surveys as they were recorded: a change of any of them is seen.

`pytest tests/survey/test_recorded_survey.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from recorded_numbers import numbers_of
from test_rows import limits, result

from amibayes.survey.completeness import Crossings, DetectionProbability
from amibayes.survey.false_alarms import expected_quantiles, false_alarms
from amibayes.survey.frequency import Box, frequency_posterior
from amibayes.survey.rows import Outcome, detection_of, row_of
from amibayes.survey.together import suggested_box, survey_json

TOLERANCE = {"rtol": 0.0, "atol": 1e-6}


def outcomes(facts: dict[str, object] | None = None) -> list[Outcome]:
    """Twelve stars of other fields and depths, some with companions, one unmeasured."""
    rng, found = np.random.default_rng(3), []
    for k in range(12):
        rho = np.array([60.0 + 5.0 * k, 160.0, 240.0 + 10.0 * (k % 5)])
        rings = tuple(Crossings(float(np.log(m)), 5.0) for m in (4e-3, 2e-3 + 1e-4 * k, 3e-3))
        p = 1e-4 if k < 4 else float(rng.uniform(0.002, 1.0))
        row = row_of(result(p, limits=limits(delta_mag=[5.0, 6.0 + 0.1 * k, None])))
        more = {} if facts is None else facts | {"distance_pc": 10.0 + k}
        detection = DetectionProbability(rho, rings)
        found.append(Outcome(f"s{k}", "done", row=row, detection=detection, facts=more))
    return [*found, Outcome("bad", "failed", "gone"), replace(found[0], name="x", detection=None)]


def test_surveys(tmp_path: Path, num_regression) -> None:
    table = tmp_path / "m.csv"
    table.write_text("mass_mjup,absolute_mag\n100,8\n30,10\n10,14\n")
    masses = {"mass_table": str(table), "primary_magnitude": 4.0}
    numbers = {}
    for name, facts in (("seen", None), ("au", {}), ("masses", masses)):
        content = survey_json("search", 1, outcomes(facts), whole=True)
        box = suggested_box(outcomes(facts)[:12])
        assert box is not None
        more = [box.completeness(o.detection) for o in outcomes()[:12] if o.detection is not None]
        numbers |= numbers_of(
            **{
                name: {key: content[key] for key in ("n_done", "n_failed", "n_targets")},
                f"{name} alarms": content["false_alarms"],
                f"{name} completeness": content["completeness"],
                f"{name} physical": content["completeness_au"] or 0.0,
                f"{name} frequency": content["companion_frequency"],
                f"{name} rates": [
                    t.get("false_discovery_rate", np.nan) for t in content["targets"]
                ],
                f"{name} box": (box, more),
            }
        )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_laws_and_rows(num_regression) -> None:
    contrast = np.geomspace(1e-3, 1e-1, 6) * np.ones((3, 1))
    trials = np.full(contrast.shape, 40)
    found = np.array([[0, 2, 11, 30, 39, 40], [0, 0, 4, 22, 37, 40], [0, 0, 0, 0, 0, 0]])
    cells = {
        **{"separation_mas": [80.0, 160.0, 240.0], "contrast": contrast.tolist()},
        **{"trials": trials.tolist(), "detected": found.tolist(), "located": (found // 2).tolist()},
    }
    places, levels = np.array([70.0, 80.0, 130.0, 200.0, 240.0]), np.geomspace(2e-3, 5e-2, 5)
    detections = [
        detection_of(content)
        for content in (
            {"limits": limits()},
            {"limits": limits(completeness_map=cells)},
            {"limits": limits(delta_mag=[None, 7.0, None])},
        )
    ]
    row = row_of(result(0.3, limits=limits(delta_mag=[5.0, 6.0, 6.5])))
    alarms = false_alarms(np.array([0.001, 0.2, 0.01, 0.5, 0.9, 0.7]), 0.1)
    hit, p = np.arange(9) % 3 == 0, np.linspace(0.2, 0.9, 9)
    posterior = frequency_posterior(hit, p, 0.01)
    box = Box((60.0, 200.0), (1.0, 6.0))
    numbers = numbers_of(
        detections=[d(places, levels) for d in detections if d is not None],
        limits=[row[k] for k in row if k.startswith("limit_")],
        alarms=alarms,
        discovered=alarms.discovered,
        needed=alarms.draws_needed(),
        uniform=alarms.uniformity(),
        quantiles=expected_quantiles(7),
        posterior=posterior,
        interval=[posterior.interval(0.68), posterior.quantile(0.5)],
        holds=[box.holds(*at) for at in ((60.0, 1.0), (200.0, 6.0), (59.0, 2.0), (100.0, 6.1))],
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)

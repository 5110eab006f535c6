"""What a comparison of models of the sky is warned of, beside the verdict on the data."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amibayes.comparison.hypotheses import FAMILIES, hypotheses
from amibayes.comparison.verdict import candidates
from amibayes.data.point_source import point_source
from amibayes.pipeline.models import models_warnings
from amibayes.pipeline.warnings import calibrator_warnings
from amibayes.support.options import SKY_MODELS


def compared(stated: str, p_fit: float = 0.5, **log_z: float) -> Any:
    """A comparison with the evidences of models by name; a plus is written as two underscores."""
    names = {n.replace("__", "+"): z for n, z in log_z.items()} or {stated: 0.0}
    models = [
        SimpleNamespace(name=n, log_z=z, p_fit=p_fit, chi2=900.0, ndof=100)
        for n, z in names.items()
    ]
    best = max(models, key=lambda m: m.log_z)
    verdict = SimpleNamespace(statement=stated, because="the odds say so")
    return SimpleNamespace(models=models, best=best, verdict=verdict)


def of(statement: str) -> Any:
    return SimpleNamespace(statement=statement)


@pytest.mark.parametrize(
    ("name", "statement", "n"),
    [
        ("companion", "inconsistent data", 1),
        ("star", "model rejected", 1),
        ("ring", "model rejected", 1),
        ("companion", "companion", 0),
        ("crescent", "companion", 1),
        ("two", "companion", 1),
        ("ring+companion", "companion", 1),
        ("star", "companion", 1),
        ("star", "no companion", 0),
        ("ring", "no companion", 0),
        ("two", "no companion", 1),
    ],
)
def test_a_verdict_that_contradicts_the_comparison_is_warned_of(
    name: str, statement: str, n: int
) -> None:
    found = models_warnings(compared(name), of(statement))
    assert len(found) == n
    assert all(statement in line for line in found)


def test_a_model_that_does_not_fit_is_warned_of() -> None:
    (line,) = models_warnings(compared("ring", 1e-5))
    assert "ring, does not fit: chi2 is 900 for 100 degrees of freedom" in line
    # One that does not fit either is no argument against the rejection.
    assert len(models_warnings(compared("ring", 1e-5), of("model rejected"))) == 1


def test_no_kind_of_models_has_the_name_of_a_model() -> None:
    """Shares of a family's column overwrote those of the model of the same name."""
    models = hypotheses([*SKY_MODELS, "ring+companion", "disc+companion"])
    names = [name for name, _ in candidates(models)]
    assert len(set(names)) == len(names)
    assert set(FAMILIES.values()) & {m.name for m in models} <= {"star"}


@pytest.mark.parametrize(("metres", "sized", "told"), [(100.0, False, True), (100.0, True, False),
                                                       (5.0, False, False)])  # fmt: skip
def test_calibrators_that_were_taken_for_points(metres: float, sized: bool, told: bool) -> None:
    """0.3 mas at 100 m in K loses 1.1 % of V²; no mask of a telescope notices it."""
    stations = np.array([[0.0, 0.0], [metres, 0.0], [0.0, 0.3 * metres]])
    data = point_source(
        stations, np.array([2.2e-6]), 5e-8, vis2_error=0.02, closure_error_rad=0.02, mjd=60000.0
    )
    said = calibrator_warnings([data], [data], sized=sized)
    assert any("taken for points" in text for text in said) is told
    assert not any("days" in text for text in said)
    assert calibrator_warnings([data], [], sized=sized) == []
    assert calibrator_warnings([data.only(["cp"])], [data], sized=False) == []


@pytest.mark.parametrize(("days", "told"), [(0.2, False), (3.0, True)])
def test_calibrators_of_another_night_are_told(days: float, told: bool) -> None:
    target, calibrator = (
        point_source(
            np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 3.0]]), np.array([2.2e-6]), 5e-8,
            vis2_error=0.02, closure_error_rad=0.02, mjd=mjd,
        )
        for mjd in (60000.0, 60000.0 + days)
    )  # fmt: skip
    said = calibrator_warnings([target], [calibrator], sized=False)
    assert any("3.0 days from the nearest" in text for text in said) is told
    # A library of many nights tells how the instrument changes.
    assert calibrator_warnings([target], [calibrator], sized=False, drifting=True) == []

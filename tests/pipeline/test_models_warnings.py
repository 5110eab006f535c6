"""What a comparison of models of the sky is warned of, beside the verdict on the data."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from amibayes.pipeline.models import models_warnings


def compared(name: str, p_fit: float = 0.5) -> Any:
    return SimpleNamespace(best=SimpleNamespace(name=name, p_fit=p_fit, chi2=900.0, ndof=100))


@pytest.mark.parametrize(
    ("name", "statement", "n"),
    [
        ("companion", "inconsistent data", 1),
        ("star", "model rejected", 1),
        # The verdict is on a star and a companion: a ring may be what they are refused for.
        ("ring", "model rejected", 0),
        ("companion", "companion", 0),
    ],
)
def test_a_model_that_the_verdict_refuses_is_warned_of(name: str, statement: str, n: int) -> None:
    found = models_warnings(compared(name), SimpleNamespace(statement=statement))  # type: ignore[arg-type]
    assert len(found) == n
    assert all(name in line and statement in line for line in found)


def test_a_model_that_does_not_fit_is_warned_of() -> None:
    (line,) = models_warnings(compared("ring", 1e-5))
    assert "ring, does not fit: chi2 is 900 for 100 degrees of freedom" in line

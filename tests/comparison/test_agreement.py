"""What a comparison of models says in words, beside the verdict of a search."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amibayes.comparison.agreement import agreement, model_words
from amibayes.comparison.compare import ModelComparison
from amibayes.comparison.hypotheses import Hypothesis
from amibayes.comparison.limits import searchable
from amibayes.comparison.verdict import ModelVerdict
from amibayes.likelihood.chi2 import REJECTED
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.models.extended import Extended
from amibayes.support.options import SKY_MODELS

EVIDENCES = {"star": 0.0, "companion": 1.0, "two": 2.0, "ring": 3.0, "crescent": 4.0}


def compared(stated: str, p_fit: float = 0.5, log_z: dict[str, float] | None = None) -> Any:
    """A comparison that states something, of models with these evidences."""
    models = [
        SimpleNamespace(name=name, log_z=z, p_fit=p_fit, chi2=912.345, ndof=100)
        for name, z in (log_z or EVIDENCES).items()
    ]
    verdict = ModelVerdict(stated, "the odds say so", 0.99, 0.01)
    return ModelComparison(tuple(models), np.zeros(len(models)), ExtraNoise(), None, verdict)


def of(statement: str) -> Any:
    return SimpleNamespace(statement=statement)


@pytest.mark.parametrize(
    ("stated", "log_z", "words"),
    [
        ("ring", {"companion": 1.0, "ring": 10.9}, "a ring explains … than a companion: ln Z +9.9"),
        ("ring", {"companion": 1.0, "ring": 11.0}, "a ring explains … than a companion: ln Z +10"),
        ("ring", {"star": 1.0, "ring": 16.4}, "a ring explains … than the star alone: ln Z +15"),
        ("crescent", {"star": 9.0, "companion": 1.0, "crescent": 0.5},
         "a crescent explains … than a companion: ln Z -0.5"),
        ("star", {"star": 0.5, "companion": -6.0},
         "the star alone is more probable than a companion: ln Z +6.5"),
        ("two", {"two": 3.0, "star": 1.0},
         "two companions explain … than the star alone: ln Z +2.0"),
        ("halo+companion", {"companion": 1.0, "halo+companion": 5.0},
         "over-resolved light and a companion explain … than a companion: ln Z +4.0"),
        ("one or two companions", {"star": -4.0, "companion": 1.0, "two": 3.0, "ring": 9.0},
         "one or two companions explain … than the star alone: ln Z +7.0"),
        ("companions and extended light", {"ring+companion": 1.0, "disc+two": 3.0, "star": 0.0},
         "companions and extended light explain … than the star alone: ln Z +3.0"),
        ("extended light", {"disc": 6.0, "ring": 5.0, "companion": 4.0},
         "extended light explains … than a companion: ln Z +2.0"),
        ("companion", {"companion": 1.0, "ring": 0.0}, "the odds say so"),
        ("undecided", {"companion": 1.0, "ring": 0.0},
         "the comparison of models is undecided: the odds say so"),
    ],
)  # fmt: skip
def test_the_comparison_in_a_sentence(stated: str, log_z: dict[str, float], words: str) -> None:
    found = agreement(compared(stated, log_z=log_z))
    assert found.summary == words.replace("…", "the data better")
    assert found.agrees is None
    assert found.leads is (stated != "undecided")
    assert found.warning == ""


@pytest.mark.parametrize(
    ("stated", "statement", "agrees", "leads"),
    [
        ("companion", "companion", True, False),
        ("one or two companions", "companion", True, False),
        ("star", "companion", False, True),
        ("two", "companion", False, True),
        ("undecided", "companion", False, True),
        ("crescent", "companion", False, True),
        ("star", "no companion", True, False),
        ("undecided", "no companion", True, False),
        ("ring", "no companion", True, True),
        ("extended light", "no companion", True, True),
        ("two", "no companion", False, True),
        ("one or two companions", "no companion", False, True),
        ("ring", "model rejected", False, True),
        ("ring", "inconsistent data", False, False),
    ],
)
def test_who_agrees_and_what_leads(stated: str, statement: str, agrees: bool, leads: bool) -> None:
    found = agreement(compared(stated), of(statement))
    assert (found.agrees, found.leads) == (agrees, leads)
    assert found.summary == agreement(compared(stated)).summary
    assert bool(found.warning) is not agrees


def test_a_rejection_is_agreed_with_where_nothing_fits() -> None:
    for statement in ("model rejected", "inconsistent data"):
        assert agreement(compared("ring", 0.9 * REJECTED), of(statement)).agrees
        assert not agreement(compared("ring", REJECTED), of(statement)).agrees
    # Of a companion that the search does state, the fit of the rest is no matter.
    assert agreement(compared("companion", 1e-9), of("companion")).agrees


def test_words_of_a_contradiction() -> None:
    best = compared("crescent")
    summary = agreement(best).summary
    line = agreement(best, of("companion")).warning
    assert line == (
        f"the verdict is companion, but {summary}; fit and posterior are of one companion and "
        "nothing else"
    )
    pair = compared("two")
    line = agreement(pair, of("no companion")).warning
    assert line == f"the verdict is no companion, but {agreement(pair).summary}"
    line = agreement(best, of("model rejected")).warning
    assert line == (
        "the verdict, model rejected, is on a star with at most one companion; of the models of "
        "the sky that were compared crescent fits (chi2 912.3 for 100 degrees of freedom): "
        f"{summary}"
    )
    for name in ("star", "companion"):
        one = compared(name, log_z={"star": 0.0, "companion": 0.0, name: 5.0})
        assert agreement(one, of("model rejected")).warning == (
            f"{name} is the most probable of the models of the sky that were compared, but the "
            "verdict on it is: model rejected"
        )


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("star", "the star alone"),
        ("companion", "a companion"),
        ("star+companion", "a companion"),
        ("disc", "a Gaussian disc"),
        ("halo+ring+companion", "over-resolved light, a ring and a companion"),
        ("extended light", "extended light"),
        ("ring+something", "ring+something"),
    ],
)
def test_models_in_words(name: str, words: str) -> None:
    assert model_words(name) == words


def test_no_words_of_a_model_have_a_comma() -> None:
    assert all("," not in model_words(name) for name in SKY_MODELS)


RING, CRESCENT = (Extended("ring", "light", smoothed=True, crescent=c) for c in (False, True))


@pytest.mark.parametrize(
    ("name", "around", "bands", "asked"),
    [
        ("ring", (RING,), (), True),
        ("ring", (RING,), ("F380M", "F480M"), True),
        ("crescent", (CRESCENT,), (), True),
        ("crescent", (CRESCENT,), ("F380M", "F480M"), False),
        ("disc+crescent", (RING, CRESCENT), ("F380M", "F480M"), False),
        ("ring+companion", (RING,), (), False),
        ("halo", (), (), False),
        ("ring", (RING, "no extended light"), (), False),
    ],
)
def test_light_beside_which_companions_are_searched_for(
    name: str, around: tuple[Any, ...], bands: tuple[str, ...], asked: bool
) -> None:
    model = SimpleNamespace(surroundings=around, bands=bands)
    likelihood = SimpleNamespace(model=model, samples=SimpleNamespace(off_axis=None))
    fit = SimpleNamespace(model=SimpleNamespace(likelihood=likelihood), hypothesis=Hypothesis(name))
    assert searchable(SimpleNamespace(fit=fit)) is asked
    # A response off the axis that data have is as bad as contrasts of each band.
    likelihood.samples.off_axis = np.ones(3)
    lopsided = any(part is CRESCENT for part in around)
    assert searchable(SimpleNamespace(fit=fit)) is (asked and not lopsided)

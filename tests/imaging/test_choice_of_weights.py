"""The weight of the regulariser by data left out, with images and data that are numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amibayes.errors import DataError
from amibayes.imaging import choice


class Fake:
    """A problem whose images are numbers, and data whose deviance they are."""

    def path(self, term: Any, weights: Any, iterations: int = 0) -> Any:
        return iter([w * term.factor for w in weights])

    def first(self, term: Any) -> float:
        return -1.0

    def visibility(self, values: float) -> float:
        return values


def test_weights_by_data_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean of the folds, and its standard error by their scatter."""
    told: list[tuple[int, int]] = []
    parts = [("kept", 1.0), ("kept", 4.0), ("kept", 10.0)]

    def term(data: Any, samples: Any, part: Any) -> Any:
        noise = SimpleNamespace(n_independent=5)
        return SimpleNamespace(factor=2.0, noise=noise, deviance=lambda x: part * x)

    monkeypatch.setattr(choice, "WEIGHTS", (100.0, 10.0))
    monkeypatch.setattr(choice, "DataTerm", SimpleNamespace(of=term))
    monkeypatch.setattr(choice, "folds_of", lambda *_: parts)
    source = SimpleNamespace(source="a")
    args = (Fake(), source, None, np.random.default_rng(1))
    table = choice.cross_validated(*args, lambda *k: told.append(k))
    spread = np.std([1.0, 4.0, 10.0], ddof=1) / np.sqrt(3.0)
    expected = [[100.0, 10.0], [200.0, 20.0], [40.0 * spread, 4.0 * spread]]
    np.testing.assert_allclose(table, expected)
    assert told == [(1, 3), (2, 3), (3, 3)]
    parts[1:] = []
    np.testing.assert_allclose(choice.cross_validated(*args, None)[1:], [[40.0, 4.0], [0.0, 0.0]])
    parts.clear()
    with pytest.raises(DataError, match="has one baseline: nothing can be left out"):
        choice.cross_validated(*args, None)


@pytest.mark.parametrize(
    ("fits", "weight"),
    [({1000, 100, 30, 10}, 1000), ({100, 10}, 100), ({10}, 10), ({30, 10}, 30), (set(), 30)],
)
def test_the_largest_weight_that_predicts_and_fits(fits: set[int], weight: float) -> None:
    """Where no image fits, the one that predicts best."""
    noise = SimpleNamespace(n_independent=100, degrees=np.inf)
    # χ² of a hundred data has a probability of 1e-3 at 149.4.
    term = SimpleNamespace(factor=1.0, noise=noise, chi2=lambda x: 149.4 if x in fits else 149.5)
    table = np.array([[1000.0, 100.0, 30.0, 10.0], [2.0, 2.5, 1.5, 1.9], [9.0, 9.0, 1.0, 9.0]])
    assert choice.largest_that_fits(Fake(), term, table) == (weight, weight)
    # Those that predict worse by more than a standard error of the best are passed over.
    table[1, 0] = 2.51
    found = choice.largest_that_fits(Fake(), term, table)[0]
    assert found == (100 if weight == 1000 else weight)


def test_a_given_weight_begins_from_larger_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "WEIGHTS", (1000.0, 100.0, 10.0))
    term = SimpleNamespace(factor=1.0)
    for weight, start in (
        (1000.0, -1.0),
        (5000.0, -1.0),
        (99.0, 100.0),
        (100.0, 1000.0),
        (1.0, 10.0),
    ):
        assert choice.before(Fake(), term, weight) == start

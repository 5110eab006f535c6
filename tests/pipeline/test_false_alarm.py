"""More searches of noise alone where the first ones do not tell a detection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.companion_search.result import SearchResult
from amibayes.pipeline.false_alarm import MORE, false_alarm
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions
from amibayes.support.options import NULL_DRAWS

OPTIONS = SearchOptions(separation_mas=(60.0, 300.0))


@pytest.fixture(scope="module")
def lucky() -> SearchResult:
    """A star alone whose noise looks like a companion as 1.4 % of noise does."""
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(7))
    return search_field(data, OPTIONS).result


@pytest.mark.parametrize(("alpha", "times"), [(0.014, MORE), (0.03, 1), (0.007, 1)])
def test_more_are_drawn_where_the_level_is_within_the_interval(
    lucky: SearchResult, alpha: float, times: int
) -> None:
    """The interval of 10 000 draws is 0.0125 to 0.017."""
    found = false_alarm(lucky, replace(OPTIONS, alpha=alpha), np.random.default_rng(2))
    assert found.n_draws == times * NULL_DRAWS
    low, high = found.interval
    # Probability by 50 000 draws, and the error of the ratio of both.
    assert abs(found.probability - 0.0143) < 5.0 * np.sqrt(0.0143 / NULL_DRAWS)
    assert high - low == pytest.approx(0.0048 / np.sqrt(times), rel=0.1)
    assert found.detected == (alpha == 0.03)


def test_as_many_are_drawn_as_was_asked_for(lucky: SearchResult) -> None:
    options = replace(OPTIONS, alpha=0.014, null_draws=4000)
    assert false_alarm(lucky, options, np.random.default_rng(2)).n_draws == 4000

"""Bright companions, whose data are far from linear in the contrast."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.companion_search.search import search
from amibayes.detection.false_alarm import (
    Significance,
    beside_bright,
    bright_probability,
    significance,
)
from amibayes.detection.statistic import statistic_of
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood

FIELD = (80.0, 670.0)
DRAWS = 3000


@pytest.mark.parametrize("place", [(-415.0, 426.0), (126.0, -62.0), (-304.0, -350.0)])
def test_an_equal_binary_is_detected(place: tuple[float, float], rng) -> None:
    """Its closure phases are nearly 0 and 180°: linear templates are blind to most of them."""
    result = search(Likelihood(simulated(niriss(), (*place, 0.96), rng)), FIELD)
    assert result.chi2_binary < 1e-2 * result.chi2_single
    drawn = significance(statistic_of(result), DRAWS, rng)
    found = beside_bright(drawn, result, ExtraNoise())
    assert found.detected
    if drawn.detected:
        assert found is drawn
    else:
        assert found.bright == found.probability < 1e-6
        assert found.threshold() == drawn.threshold()


def test_noise_beside_the_errors_is_no_reason_to_deny_an_equal_binary(rng) -> None:
    """Errors that are a little too small, while the companion explains nearly all of the data."""
    result = search(Likelihood(simulated(niriss(), (6.8, -129.8, 0.9), rng)), FIELD)
    drawn = significance(statistic_of(result), DRAWS, rng)
    blind = replace(drawn, probability=0.5, interval=(0.48, 0.52), tail=None)
    added = ExtraNoise(vis2=0.001)
    assert blind.detected is False
    assert beside_bright(blind, result, added).detected
    # A twentieth of the squared residuals, that noise is taken for, is another matter.
    worse = replace(result, chi2_binary=0.05 * result.chi2_single)
    assert beside_bright(blind, worse, added) is blind
    assert beside_bright(blind, worse, ExtraNoise()).detected


def test_noise_of_any_size_never_looks_like_a_bright_companion(rng) -> None:
    """Of stars whose data scatter up to hundreds of times as much as their errors say."""
    sheet = niriss()
    for size in np.geomspace(1.0, 300.0, 12):
        noise = size * sheet.covariance.draw(rng, 1)[:, 0]
        data = sheet.with_data(sheet.data + noise)
        result = search(Likelihood(data), FIELD)
        bound = bright_probability(result, statistic_of(result))
        assert bound is None or bound > 1e-2


@pytest.mark.parametrize(
    ("bound", "p", "stated"),
    [(None, 0.3, None), (0.2, 0.3, None), (0.15, 0.3, None), (0.1, 0.3, 0.2), (0.0, 0.3, 1e-10)],
)
def test_the_smaller_of_two_probabilities_counts_twice(
    bound: float | None, p: float, stated: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested = Significance(1.0, np.arange(10_000.0), p, (0.2, 0.4), None, 0.0013)
    monkeypatch.setattr("amibayes.detection.false_alarm.bright_probability", lambda *_: bound)
    partly, nearly = (SimpleNamespace(chi2_single=1.0, chi2_binary=left) for left in (0.2, 0.001))
    found = beside_bright(tested, partly, ExtraNoise())  # type: ignore[arg-type]
    for noise in (ExtraNoise(vis2=0.01), ExtraNoise(closure_phase_rad=0.01)):
        # Beside noise that was added the companion has to explain more.
        assert beside_bright(tested, partly, noise) is tested  # type: ignore[arg-type]
        beside = beside_bright(tested, nearly, noise)  # type: ignore[arg-type]
        assert beside.probability == found.probability
    if stated is None:
        assert found is tested
    else:
        assert (found.probability, found.bright) == (stated, stated)
        assert found.interval == (0.0, stated)


@pytest.mark.parametrize(
    ("upper", "draws", "detected", "words"),
    [
        (1e-4, 10_000, True, "True"),
        (2e-3, 10_000, False, "False"),
        (1e-4, 100, None, "cannot be told below 0.0013 with so few draws"),
    ],
)
def test_what_is_shown_of_a_probability(
    upper: float, draws: int, detected: bool | None, words: str
) -> None:
    null = np.arange(float(draws))
    tested = Significance(draws - 3.0, null, 1e-5, (0.0, upper), None, 0.0013)
    assert tested.detected is detected
    assert (tested.n_draws, tested.n_above) == (draws, 3)
    assert tested.parametric == pytest.approx(4.0 / (draws + 1.0))
    shown = dict(tested.rows())
    assert shown["detected"] == words
    assert shown["null draws"] == f"{draws}, 3 of them as large"
    assert shown["extrapolated"] == "no"
    assert shown["statistic"] == f"{draws - 3.0:.4g}"
    assert "Pareto" in dict(replace(tested, tail=object()).rows())["extrapolated"]  # type: ignore[arg-type]


@pytest.mark.parametrize(("p", "stated"), [(None, 0.01), (0.005, 0.01), (0.01, 0.01), (0.2, 0.2)])
def test_the_larger_probability_of_two_checks_is_stated(p: float | None, stated: float) -> None:
    tested = Significance(1.0, np.arange(100.0), 0.01, (0.0, 0.02), None, 0.0013)
    check = SimpleNamespace(
        probability=p, interval=None if p is None else (p / 2, 2 * p), tail=None
    )
    found = tested.beside(check)  # type: ignore[arg-type]
    assert found.probability == stated
    assert found.randomised is check
    assert found.interval == ((0.0, 0.02) if stated == 0.01 else (0.1, 0.4))

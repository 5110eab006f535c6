"""Limits of companions beside a disc."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import niriss, simulated
from scenes import disc, observed

from amibayes.cli import main
from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.optimise import fit_single
from amibayes.companion_search.search import search
from amibayes.comparison.compare import compare_sky_models
from amibayes.comparison.hypotheses import Hypothesis
from amibayes.comparison.limits import limits_beside
from amibayes.detection.statistic import statistic_of
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.oifits import write_oifits
from amibayes.posterior.priors import Prior

FIELD = (94.0, 300.0)
DISC = [0.03, 220.0, 0.6, 30.0]


def with_light(name: str, shape: list[float], companion: float) -> Likelihood:
    """A star with light around it and a companion at 134 mas."""
    model = BinaryModel(1, surroundings=Hypothesis(name).model(BinaryModel()).surroundings)
    theta = [120.0, -60.0, companion, *shape]
    return Likelihood(simulated(niriss(), theta, np.random.default_rng(1), model))


def with_disc(companion: float) -> Likelihood:
    return with_light("disc", DISC, companion)


def test_single_fit_finds_the_disc() -> None:
    base = with_disc(0.0)
    around = Hypothesis("disc").model(base.model)
    theta, chi2 = fit_single(base.with_model(replace(around, companions=1)))
    np.testing.assert_allclose(theta[:2], DISC[:2], rtol=0.2)
    assert chi2 < 36.0 + 5.0 * np.sqrt(72.0)


def test_a_companion_beside_a_disc_is_found_where_it_is() -> None:
    base = with_disc(0.01)
    around = replace(Hypothesis("disc").model(base.model), companions=1)
    found = search(base.with_model(around), FIELD)
    assert found.companion.east_mas == pytest.approx(
        120.0, abs=5.0 * found.companion.east_error_mas
    )
    assert found.companion.contrast == pytest.approx(0.01, abs=5.0 * found.companion.contrast_error)


def test_a_known_fit_is_a_starting_point() -> None:
    """With the star's disc free as well the search keeps the fit that the comparison found."""
    base = with_disc(0.0).with_model(BinaryModel(1, "free"))
    around = replace(Hypothesis("disc").model(base.model), companions=1)
    found = search(base.with_model(around), FIELD, single=np.array([0.0, *DISC]))
    assert found.chi2_single < 36.0 + 5.0 * np.sqrt(72.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shape"),
    [("disc", DISC), ("crescent", [0.05, 220.0, 0.7, 40.0, 0.2, 0.9, 250.0])],
)
def test_limit_beside(name: str, shape: list[float]) -> None:
    """No deeper than without the disc, and not shallower by more than it makes it."""
    base = with_light(name, shape, 0.0)
    found = compare_sky_models(
        search(base, FIELD),
        Prior(*FIELD, contrast_min=1e-4),
        np.random.default_rng(2),
        models=["star", "companion", name],
        confusion_draws=0,
    )
    beside = limits_beside(
        found, base, FIELD, np.random.default_rng(3), alpha=0.01, null_draws=2000
    )
    assert beside.model == name
    star = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1))
    alone = limits_beside_nothing(star)
    assert np.nanmedian(beside.limit.delta_mag) < np.nanmedian(alone) + 0.1
    assert np.nanmedian(beside.limit.delta_mag) > np.nanmedian(alone) - 1.5


def limits_beside_nothing(star) -> np.ndarray:
    from amibayes.detection.false_alarm import significance
    from amibayes.detection.statistic import statistic_of
    from amibayes.limits.completeness import detection_limit

    result = search(Likelihood(star), FIELD)
    rng = np.random.default_rng(4)
    tested = significance(statistic_of(result, stated_errors=True), 2000, rng, 0.01)
    return detection_limit(result, tested, rng).delta_mag


@pytest.mark.slow
def test_limits_command_gives_the_limit_beside_a_stated_disc(tmp_path: Path) -> None:
    """A disc hides companions of a star alone; with the disc in the model they are seen."""
    path = tmp_path / "disc.oifits"
    write_oifits(path, observed(niriss(0.003, 0.1), disc(), np.random.default_rng(3)))
    words = ["--models", "star,disc", "--separation", "94:350", "--criterion", "candid"]
    words += ["--null-draws", "3000", "--separations", "4", "--quiet"]
    assert main(["limits", str(path), "--out", str(tmp_path / "out"), *words]) == 0
    content = json.loads((tmp_path / "out" / "limits.json").read_text())
    assert content["model_verdict"]["statement"] == "disc"
    assert content["limits_beside"]["model"] == "disc"
    alone, beside = (
        np.nanmedian(np.array(c["delta_mag"], dtype=float))
        for c in (content, content["limits_beside"])
    )
    assert beside > alone + 0.5


@pytest.mark.slow
def test_companions_beside_a_disc_are_recovered_at_the_stated_rate() -> None:
    """Companions of the stated contrasts, injected into new data of the disc and searched for.

    The disc is fitted anew with every data set, along with the search, as it would be by the
    command; nothing is linearised. 32 of each: a rate of 0.95 gives 25 or fewer, and one of 0.5
    gives 4 or fewer or 28 or more, with a probability below 1e-4.
    """
    base = with_disc(0.0)
    found = compare_sky_models(
        search(base, FIELD),
        Prior(*FIELD, contrast_min=1e-4),
        np.random.default_rng(2),
        models=["star", "companion", "disc"],
        confusion_draws=0,
    )
    beside = limits_beside(
        found, base, FIELD, np.random.default_rng(3), alpha=0.01, null_draws=2000
    )
    k = len(beside.limit.separation_mas) // 2
    place, reach = beside.limit.separation_mas[k], 0.5 * resolution_mas(base)
    threshold, disc_theta = beside.significance.threshold(), found.best.theta
    around = replace(found.best.fit.hypothesis.model(base.model), companions=1)
    rng = np.random.default_rng(6)

    def recovered(contrast: float) -> bool:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        east, north = place * np.sin(angle), place * np.cos(angle)
        data = simulated(niriss(), [east, north, contrast, *disc_theta], rng, around)
        result = search(Likelihood(data, around), FIELD)
        test = statistic_of(result, stated_errors=True)
        c = result.companion
        near = np.hypot(c.east_mas - east, c.north_mas - north) < reach
        return bool(test.evaluate(test.observed[:, None])[0] > threshold and near)

    whole = sum(recovered(beside.limit.contrast[k]) for _ in range(32))
    half = sum(recovered(beside.limit.contrast_50[k]) for _ in range(32))
    assert whole > 25
    assert 4 < half < 28

"""Targets of a survey that share what they have in common have the numbers that each has alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.calibration import calibrate
from amibayes.companion_search.grid import make_grid
from amibayes.detection.statistic import BankStatistic, make_statistic
from amibayes.detection.treatments import LATTICE, FreeScale
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.oifits import write_oifits
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.search import search_companion
from amibayes.report import result_json
from amibayes.support.shared_results import SharedResults, sharing

KNOWN = SearchOptions(
    separation_mas=(60.0, 250.0),
    null_draws=4000,
    posterior=False,
    limits=False,
    extra_noise=False,
    diameter=0.0,
)


def written(path: Path, seed: int, contrast: float = 0.0) -> Path:
    write_oifits(path, simulated(niriss(), [110.0, -75.0, contrast], np.random.default_rng(seed)))
    return path


def numbers(target: Path, calibrators: list[Path], options: SearchOptions) -> dict[str, object]:
    content = result_json(search_companion([target], calibrators, options), "key")
    assert content.pop("timing_s")
    return content


def test_targets_of_equal_errors_share_null_draws_with_the_same_numbers(tmp_path: Path) -> None:
    targets = [written(tmp_path / f"t{k}.oifits", k, 0.01 * (k == 1)) for k in range(3)]
    alone = [numbers(target, [], KNOWN) for target in targets]
    for order in ([0, 1, 2], [2, 1, 0]):
        results = SharedResults()
        with sharing(results):
            together = {k: numbers(targets[k], [], KNOWN) for k in order}
        assert [together[k] for k in range(3)] == alone
        assert results.found >= 2
    other = replace(KNOWN, seed=2)
    with sharing(results):
        before = results.made
        assert numbers(targets[0], [], other) != alone[0]
        assert results.made > before


def test_the_scatter_between_calibrators_is_shared_with_the_same_numbers() -> None:
    calibrators = [simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(k)) for k in range(3)]
    targets = [
        simulated(niriss(), [110.0, -75.0, 0.01], np.random.default_rng(9 + k)) for k in (0, 1)
    ]
    results = SharedResults()

    def run(target: int) -> tuple[object, ...]:
        rng = np.random.default_rng(5)
        found = calibrate(targets[target], calibrators, rng=rng)
        return found.observables.data, found.tau, rng.random(3)

    alone = [run(k) for k in (0, 1)]
    with sharing(results):
        for k in (1, 0):
            for mine, expected in zip(run(k), alone[k], strict=True):
                np.testing.assert_array_equal(mine, expected)
    assert (results.made, results.found) == (1, 1)


@pytest.mark.slow
def test_calibrators_are_vetted_once_with_the_same_numbers(tmp_path: Path) -> None:
    calibrators = [written(tmp_path / f"c{k}.oifits", 20 + k) for k in range(3)]
    targets = [written(tmp_path / f"t{k}.oifits", k) for k in range(2)]
    options = replace(KNOWN, extra_noise=True)
    alone = [numbers(target, calibrators, options) for target in targets]
    results = SharedResults()
    with sharing(results):
        assert [numbers(target, calibrators, options) for target in targets] == alone
    assert results.found >= 2


def free_scale() -> tuple[BankStatistic, FreeScale]:
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(4))
    grid = make_grid(60.0, 250.0, 25.0)
    test = make_statistic(Likelihood(data, BinaryModel(1, 0.0)), grid, np.empty(0))
    assert isinstance(test.treatment, FreeScale)
    return test, test.treatment


def drawn(test: BankStatistic, scale: np.ndarray) -> np.ndarray:
    """Null draws at a scale of each datum, not rounded, with common random numbers."""
    exact = replace(test, treatment=replace(test.treatment, scale=scale))
    return np.sort(exact.simulated(20_000, np.random.default_rng(1)).statistic)


def test_a_common_scale_drops_out_of_null_draws() -> None:
    test, treatment = free_scale()
    one, seven = (drawn(test, factor * treatment.scale) for factor in (1.0, 7.0))
    np.testing.assert_allclose(seven, one, rtol=1e-3, atol=1e-4)
    larger = replace(treatment, scale=7.0 * treatment.scale)
    np.testing.assert_allclose(larger.of_nulls.scale, treatment.of_nulls.scale, rtol=1e-12)


def test_rounded_scales_change_probabilities_by_no_more_than_themselves() -> None:
    """The worst of the lattice, with common random numbers: half a step in one group."""
    test, treatment = free_scale()
    second = treatment.groups.label == 1
    worst = np.where(second, np.exp(0.5 * LATTICE), 1.0) * treatment.scale
    exact, rounded = drawn(test, treatment.scale), drawn(test, worst)
    for alpha in (0.2, 0.05, 0.01):
        threshold = np.quantile(exact, 1.0 - alpha)
        change = np.log((rounded > threshold).mean() / alpha)
        assert abs(change) < LATTICE + 4.0 * np.sqrt(0.05 / (alpha * len(exact)))


def test_scales_within_a_step_have_one_null_distribution() -> None:
    _, treatment = free_scale()
    second = treatment.groups.label == 1
    middle = replace(treatment, scale=np.where(second, np.exp(3.0 * LATTICE), 1.0))
    near = replace(treatment, scale=middle.scale * np.where(second, 1.02, 1.0))
    far = replace(treatment, scale=middle.scale * np.where(second, 1.03, 1.0))
    np.testing.assert_array_equal(near.of_nulls.scale, middle.of_nulls.scale)
    assert not np.array_equal(far.of_nulls.scale, middle.of_nulls.scale)
    floored = replace(near, least=1.0, scale=7.0 * near.scale).of_nulls.scale
    np.testing.assert_allclose(floored / (7.0 * near.scale), 1.0, atol=0.5 * LATTICE + 1e-9)

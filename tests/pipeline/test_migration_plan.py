"""The bias that a plan states, against extracted images, and the error of fitted ramps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amibayes.extraction import extract
from amibayes.extraction.options import ExtractOptions
from amibayes.instrument import ChargeMigration, load_instrument
from amibayes.pipeline.migration_plan import (
    best_groups,
    coefficient_error,
    expect_migration,
    light_of,
    vis2_change,
)
from amibayes.ramps.transfer import SIDES, gains
from amibayes.scene.sources import Scene
from amibayes.simulation import PRESETS, Exposure, simulate
from amibayes.simulation.budget import PlanOptions, make_plan

NIRISS = load_instrument("niriss", "F480M")
PAPER = PRESETS["paper"]
PLAN = make_plan(NIRISS, magnitude=4.0, photons=3e8, options=PlanOptions(peak_limit_e=40e3))


def test_bias_is_that_of_extracted_images() -> None:
    moving = replace(PAPER, boundary_shift_x=3.6e-7, boundary_shift_y=3.6e-7)
    exposure = Exposure(PLAN.n_groups, 8, jitter_rad=0.0, dither_rad=0.0)
    rate = PLAN.count_rate_e_s
    rng = np.random.default_rng(1)
    cube = simulate(Scene(), NIRISS, exposure, rng, detector=moving, count_rate_e_s=rate)
    left_in, free = (
        extract(cube, options=ExtractOptions(charge_migration=m, geometry="stated")).data[:21]
        for m in ("off", 3.6e-7)
    )
    expected = 3.6e-7 * vis2_change(PLAN, PAPER)
    np.testing.assert_allclose(left_in - free, expected, atol=0.1 * np.abs(expected).max())


def test_expectation_says_what_is_left() -> None:
    found = expect_migration(PLAN, PAPER, 1e-3)
    assert found is not None
    known = NIRISS.charge_migration
    assert known is not None
    assert found.slopes / found.left_in == pytest.approx(known.error / known.per_e)
    assert found.ramps is not None
    assert found.ramps < found.slopes
    assert (
        expect_migration(
            replace(PLAN, instrument=replace(NIRISS, charge_migration=None)), PAPER, 1.0
        )
        is None
    )
    few = replace(PLAN, n_groups=2)
    assert coefficient_error(few, PAPER) is None
    more = coefficient_error(replace(PLAN, n_integrations=4 * PLAN.n_integrations), PAPER)
    assert found.error_per_e is not None
    assert more is not None
    # Half, but for the prior of linearity, which more integrations do not narrow.
    assert 0.5 <= more / found.error_per_e < 0.6


def test_fewer_groups_where_the_bias_rules() -> None:
    known = ChargeMigration(3.6e-7, 1.2e-7)
    assert best_groups(PLAN, known, 0.0, 1e-3) == PLAN.n_groups
    assert best_groups(PLAN, known, 1e6, 1e-3) == 2
    between = best_groups(PLAN, known, 1e4, 1e-3)
    assert 2 <= between < PLAN.n_groups


def test_charge_in_the_plan_is_conserved() -> None:
    light = light_of(PLAN)
    moved = gains(SIDES, light, light)
    assert np.abs(moved.sum(axis=(1, 2))).max() < 1e-9 * np.abs(moved).sum()

"""Stacked completeness: against the single targets' own numbers and drawn companions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import special

from amibayes.limits.mass_table import MassTable
from amibayes.survey.completeness import Crossings, DetectionProbability, from_counts, stack
from amibayes.survey.rows import Outcome
from amibayes.survey.together import statistics
from amibayes.units import delta_mag_to_contrast


def target(rng: np.random.Generator) -> DetectionProbability:
    rho = np.linspace(rng.uniform(40, 80), rng.uniform(300, 500), 8)
    middle = np.log(delta_mag_to_contrast(rng.uniform(5.0, 7.0, 8)))
    return DetectionProbability(rho, tuple(Crossings(m, 6.0) for m in middle))


def test_the_mean_is_the_share_of_drawn_companions_that_are_found() -> None:
    rng = np.random.default_rng(2)
    targets = [target(rng) for _ in range(5)]
    rho, mag = np.array([60.0, 120.0, 350.0, 600.0]), np.array([4.0, 5.5, 6.5])
    found = stack(targets, rho, mag)
    n = 20000
    star = rng.integers(5, size=n)
    for i, r in enumerate(rho):
        for j, m in enumerate(mag):
            each = np.array([t(np.array([r]), delta_mag_to_contrast([m]))[0, 0] for t in targets])
            share = float((rng.uniform(size=n) < each[star]).mean())
            assert abs(found.mean[i, j] - share) < 4.5 * np.sqrt(0.25 / n)
    inside = [sum(t.separation_mas[0] <= r <= t.separation_mas[-1] for t in targets) for r in rho]
    assert found.covering.tolist() == inside
    assert (found.mean[3] == 0).all()


def test_a_probability_is_interpolated_between_rings() -> None:
    low, high = Crossings(-9.0, 5.0), Crossings(-11.0, 5.0)
    one = DetectionProbability(np.array([100.0, 200.0, 300.0]), (low, high, None))
    x = np.array([-10.5, -9.5])
    found = one(np.array([99.0, 100.0, 125.0, 200.0, 250.0, 300.0]), np.exp(x))
    near, far = special.expit(5 * (x + 9)), special.expit(5 * (x + 11))
    expected = [0 * x, near, 0.75 * near + 0.25 * far, far, 0.5 * far, 0 * x]
    assert found == pytest.approx(np.array(expected))


def test_a_fit_of_counts_follows_the_truth() -> None:
    rng = np.random.default_rng(7)
    rho = np.array([80.0, 200.0])
    contrast = np.geomspace(5e-4, 2e-2, 14) * np.ones((2, 1))
    truth = special.expit(4.0 * np.log(contrast / 3e-3))
    trials = np.full(contrast.shape, 400)
    trials[0, 3] = 0
    fitted = from_counts(rho, contrast, trials, rng.binomial(trials, truth))
    found = fitted(rho, contrast[0])
    assert np.abs(found - truth).max() < 5 * np.sqrt(0.25 / 400)
    assert from_counts(rho, contrast, trials, 0 * trials)(rho, contrast[0]).max() == 0


def test_au_and_masses_are_of_each_target_by_itself() -> None:
    rng = np.random.default_rng(9)
    targets = [target(rng) for _ in range(3)]
    distance = [20.0, 50.0, 140.0]
    tables = [
        MassTable(np.array([2.0, 5.0, 8.0]) + shift, np.array([200.0, 60.0, 10.0]), "M_Jup")
        for shift in (0.0, 0.5, 1.0)
    ]
    au, mass = np.array([4.0, 15.0]), np.array([5.0, 30.0, 100.0, 900.0])
    found = stack(targets, au, mass, distance_pc=distance, masses=tables)
    for i, a in enumerate(au):
        for j, m in enumerate(mass):
            each = []
            for one, d, table in zip(targets, distance, tables, strict=True):
                rho = a / d * 1000.0  # mas: an astronomical unit at a parsec is an arcsecond
                mag = table.delta_mag[0] if m > 200 else table.delta_mag_at(np.array([m]))[0]
                known = m >= 10
                contrast = delta_mag_to_contrast([mag])
                each.append(one(np.array([rho]), contrast)[0, 0] if known else 0.0)
            assert found.mean[i, j] == pytest.approx(np.mean(each))


@pytest.mark.parametrize("n", [1, 3])
def test_masses_have_the_unit_of_their_tables(n: int, tmp_path: Path) -> None:
    """And reach from the least of all tables to the largest, of one target as of several."""
    rng, outcomes = np.random.default_rng(4), []
    for k in range(n):
        table = tmp_path / f"{k}.csv"
        table.write_text(f"mass_mjup,absolute_mag\n{100 + k},8\n30,10\n{10 - k},14\n")
        facts = {"mass_table": str(table), "primary_magnitude": 4.0, "distance_pc": 10.0}
        found = target(rng)
        row = {"limit_delta_mag_best": 6.0}
        outcomes.append(Outcome(f"s{k}", "done", row=row, detection=found, facts=facts))
    found = statistics(outcomes)[1]["completeness_au"]
    assert found["mass_unit"] == "M_Jup"
    assert (found["mass"][0], found["mass"][-1]) == pytest.approx((11.0 - n, 99.0 + n))


@pytest.mark.parametrize(("second", "unit"), [("mass_msun", "M_Jup"), ("mass", None)])
def test_tables_of_several_units_are_brought_to_one(
    second: str, unit: str | None, tmp_path: Path
) -> None:
    """Where one has no known unit, targets share magnitudes and no masses."""
    rng, outcomes, scale = np.random.default_rng(4), [], {"mass_msun": 1047.57}
    for k, name in enumerate(("mass_mjup", second)):
        rows = [f"{m / scale.get(name, 1.0)},{mag}" for m, mag in ((100, 8), (30, 10), (10, 14))]
        table = tmp_path / f"{k}.csv"
        table.write_text("\n".join([f"{name},absolute_mag", *rows]))
        facts = {"mass_table": str(table), "primary_magnitude": 4.0, "distance_pc": 10.0}
        row = {"limit_delta_mag_best": 6.0}
        outcomes.append(Outcome(name, "done", row=row, detection=target(rng), facts=facts))
    found = statistics(outcomes)[1]["completeness_au"]
    assert found.get("mass_unit") == unit
    if unit is None:
        assert "mass" not in found
    else:
        assert (found["mass"][0], found["mass"][-1]) == pytest.approx((10.0, 100.0), rel=1e-5)

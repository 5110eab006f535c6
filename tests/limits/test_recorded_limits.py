"""Numbers of limits as they were recorded: a change of any of them is seen, and asked about.

`pytest tests/limits/test_recorded_limits.py --force-regen` records them anew.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import niriss, simulated
from recorded_numbers import numbers_of

from amibayes.companion_search.search import search
from amibayes.detection.false_alarm import significance
from amibayes.detection.statistic import statistic_of
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.aliases import ambiguous, nearer_alias
from amibayes.limits.analytic import analytic_limit
from amibayes.limits.completeness import detection_limit
from amibayes.limits.injection import recover
from amibayes.limits.logistic import fit_logistic
from amibayes.limits.mass_table import read_mass_table
from amibayes.limits.pooled import quantiles
from amibayes.limits.rings import make_rings
from amibayes.models.binary import BinaryModel


@pytest.mark.parametrize("contrast", [0.0, 0.02])
def test_limits_are_those_recorded(contrast: float, num_regression) -> None:
    """Around a single star and beside a companion, by injection and by closed criteria."""
    data = simulated(niriss(), [150.0, 90.0, contrast], np.random.default_rng(1))
    result = search(Likelihood(data), (50.0, 400.0))
    rng = np.random.default_rng(2)
    weight = significance(statistic_of(result), 3000, rng, alpha=0.01)
    limit = detection_limit(result, weight, rng, separation_mas=[100.0, 220.0, 390.0], trials=60)
    numbers = {
        "contrast": limit.contrast,
        "contrast_50": limit.contrast_50,
        "log_error": limit.log_error,
        "log_error_50": limit.log_error_50,
        "spread": limit.spread.ravel(),
        "by_detection": limit.by_detection.astype(float),
        "ambiguous": limit.ambiguous,
        "located": limit.located.ravel().astype(float),
        "detected": limit.detected.ravel().astype(float),
        "level": limit.level.ravel(),
        "threshold": np.array([limit.threshold]),
    }
    for method in ("absil", "candid", "posterior"):
        closed = analytic_limit(result, method, n_separations=4, remove=contrast > 0.0)
        numbers[method] = closed.contrast
        numbers[f"{method}_spread"] = closed.spread.ravel()
    num_regression.check(numbers, default_tolerance={"rtol": 1e-4, "atol": 1e-9})


def test_parts_of_limits_are_those_recorded(tmp_path: Path, num_regression) -> None:
    """Criteria of a resolved star, recoveries, rings, fits of counts and tables of masses."""
    star = BinaryModel(diameter_mas="free")
    data = simulated(niriss(), [150.0, -80.0, 0.02, 30.0], np.random.default_rng(1), star)
    result = search(Likelihood(data, star), (100.0, 220.0), check=False)
    test = statistic_of(result, stated_errors=True)
    weight = significance(test, 2000, np.random.default_rng(2), alpha=0.01)
    rng = np.random.default_rng(3)
    noise = ExtraNoise(vis2=0.01)
    limit = detection_limit(
        result, weight, rng, separation_mas=[120.0, 200.0], trials=24, noise=noise
    )
    bright = [[150.0, -80.0, 0.3], [-90.0, 120.0, 0.004], [60.0, 100.0, 0.001]] * 4
    found = recover(test, np.array(bright), weight.threshold(), np.random.default_rng(4))
    level, tried = np.geomspace(1e-3, 1e-1, 7), np.full(7, 40.0)
    law = fit_logistic(np.log(level), np.array([0.0, 1, 9, 21, 35, 39, 40]), tried)
    table = tmp_path / "masses.csv"
    table.write_text("mass_mjup,absolute_mag\n100,8\n30,10\n10,14\n")
    masses = read_mass_table(table, 4.0)
    rings = make_rings(result, 3, most_angles=20)
    low, high = limit.jeffreys()
    values = np.array([[3.0, 1.0, np.inf], [2.0, 5.0, 4.0]])
    closed = [
        analytic_limit(result, method, separation_mas=[110.0, 190.0], sigmas=sigmas)
        for method, sigmas in (("closure-phase", 3.0), ("posterior", 2.0), ("candid", 40.0))
    ]
    nearer = nearer_alias(test.bank, 180.0, rings.places)
    numbers = numbers_of(
        limit={name: getattr(limit, name) for name in ("contrast", "log_error", "critical")},
        columns=limit.columns(),
        share=limit.share,
        interval=(limit.false_positive_interval, low, high),
        probability=[limit.probability(r, c) for r in (130.0, 200.0) for c in (1e-3, 2e-3, 8e-3)],
        recovered=found,
        law=law,
        seen=law(np.linspace(-9.0, 0.0, 9)),
        crossing=[law.crossing(p) for p in (0.5, 0.95)],
        masses=masses,
        mass_at=(masses.mass_at(np.array([3.0, 5.0, 9.5])), masses.delta_mag_at(np.array([20.0]))),
        rings=rings,
        quantiles=quantiles(values, np.array([0.2, 0.5, 0.8, 0.95])),
        closed=[(one.contrast_at, one.delta_mag, one.spread) for one in closed],
        aliases=(nearer, ambiguous(nearer, np.full(len(nearer), 40.0))),
    )
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-4})

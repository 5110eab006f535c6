"""Errors of an extraction against simulated exposures: pulls, efficiency, coverage."""

from __future__ import annotations

import numpy as np
import pytest

from amibayes.calibration import calibrate
from amibayes.cube import Cube
from amibayes.extraction import ExtractOptions, extract_all
from amibayes.extraction.shrinkage import lag_one, shrunk_covariance
from amibayes.instrument import load_instrument
from amibayes.scene import Scene
from amibayes.simulation import Detector, Exposure, simulate
from amibayes.units import FloatArray


def exposure(photons: float, n: int, seed: int) -> Cube:
    groups = 14
    rate = photons / n / (groups * 0.07544)
    detector = Detector(flat_error=0.0, full_well_e=1e9)
    rng = np.random.default_rng(seed)
    instrument = load_instrument("niriss", "F430M")
    return simulate(
        Scene(), instrument, Exposure(groups, n), rng, detector=detector, count_rate_e_s=rate
    )


def wishart_data(n: int, rng: np.random.Generator, p: int = 36) -> tuple[FloatArray, FloatArray]:
    """Deviations of n draws from their mean, and the error of that mean, true covariance 1."""
    draws = rng.standard_normal((n, p))
    return draws - draws.mean(axis=0), draws.mean(axis=0)


@pytest.mark.parametrize("n", [20, 50, 200])
@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_intervals_cover(n: int, scale: float) -> None:
    rng = np.random.default_rng(1000 * n)
    weights = rng.standard_normal(36)
    trials, inside = 300, 0
    for _ in range(trials):
        deviation, mean = wishart_data(n, rng)
        found = shrunk_covariance(deviation, np.eye(36) / scale, np.eye(36), 21)
        sigma = np.sqrt(weights @ found.matrix @ weights / n)
        inside += abs(weights @ mean) < sigma
    # 4.2 binomial standard deviations (0.027) of 68.3 %.
    assert inside / trials == pytest.approx(0.683, abs=0.113)


def test_generalised_least_squares_covers_at_few_integrations() -> None:
    """An amplitude fitted with the inverse covariance, where plug-in errors cover 19 %."""
    rng = np.random.default_rng(7)
    template = rng.standard_normal(36)
    trials, inside = 300, 0
    for _ in range(trials):
        deviation, mean = wishart_data(20, rng)
        matrix = shrunk_covariance(deviation, np.eye(36), np.eye(36), 21).matrix / 20
        weight = np.linalg.solve(matrix, template)
        inside += abs(weight @ mean) < np.sqrt(weight @ template)
    assert inside / trials == pytest.approx(0.683, abs=0.113)


def test_scatter_wins_where_the_physics_is_wrong() -> None:
    rng = np.random.default_rng(3)
    root = np.eye(36) + 0.5 * rng.standard_normal((36, 36)) / 6.0
    draws = rng.standard_normal((2000, 36)) @ root.T
    found = shrunk_covariance(draws - draws.mean(axis=0), np.eye(36), np.eye(36), 21)
    assert found.prior_freedom < 1000.0
    # Relative errors of a sample covariance of 2000: 3 % on the diagonal.
    np.testing.assert_allclose(np.diag(found.matrix), np.diag(root @ root.T), rtol=0.15)


def test_correlation_in_time_is_found_and_paid_for() -> None:
    rng = np.random.default_rng(4)
    noise = rng.standard_normal((401, 36))
    drifting = noise[1:] + noise[:-1]  # lag one: 0.5; variance of the mean 4/n, not 2/n
    deviation = drifting - drifting.mean(axis=0)
    found = shrunk_covariance(deviation, 2.0 * np.eye(36), np.eye(36), 21)
    assert found.correlation == pytest.approx(0.5, abs=0.05)
    assert found.block > 1
    assert np.diag(found.matrix).mean() == pytest.approx(4.0, rel=0.2)
    quiet = shrunk_covariance(noise - noise.mean(axis=0), np.eye(36), np.eye(36), 21)
    assert quiet.block == 1
    assert abs(lag_one(noise.T)) < 4.5 / np.sqrt(noise.size)


@pytest.mark.slow
@pytest.mark.parametrize("photons", [1e6, 1e7, 1e8])
@pytest.mark.parametrize("method", ["fringes", "matched"])
def test_calibrated_pulls(photons: float, method: str) -> None:
    pulls, scatter = [], []
    options = ExtractOptions(method=method)  # type: ignore[arg-type]
    for seed in range(12):
        found = [extract_all(exposure(photons, 20, 100 * seed + k), options)[0] for k in (0, 1)]
        calibrated = calibrate(found[0].observables, [found[1].observables]).observables
        ideal = np.concatenate([np.ones(21), np.zeros(35)])
        pulls.append(calibrated.covariance.whiten(calibrated.data - ideal))
        physical = np.sqrt(np.diag(found[0].physical) / 20)
        raw = np.concatenate([found[0].average.vis2, found[0].average.closure_phase])
        scatter.append((raw - ideal) / physical)
    # 12 × 36 pulls: standard deviation known to 3.4 %, mean to 0.05; the ratio V²/V² at
    # 1e6 photons is skewed.
    assert np.std(pulls) == pytest.approx(1.0, abs=0.17)
    assert abs(np.mean(pulls)) < 0.2
    assert np.sqrt(np.mean(np.var(scatter, axis=0, ddof=1))) == pytest.approx(1.0, abs=0.2)

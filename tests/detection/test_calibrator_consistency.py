"""Calibrators that agree give uniform probabilities, one that is a binary is named."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import stats

from amibayes.calibration import calibrate
from amibayes.calibration.leave_one_out import leave_out
from amibayes.calibration.matching import keys_of
from amibayes.calibration.scatter_likelihood import population_of
from amibayes.calibration.scatter_posterior import ScatterGrid, sample_tau
from amibayes.calibration.transfer import transfer_of
from amibayes.companion_search.optimise import refine
from amibayes.data.observables import Observables
from amibayes.detection.calibrator_consistency import OTHERS, compare_calibrators
from amibayes.detection.verdict import _apart
from amibayes.likelihood.extra_noise import ExtraNoise, add_noise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.parameters import Box
from amibayes.pipeline.warnings import consistency_warnings

TRUTH = (150.0, -80.0, 0.02)
POINT = (0.0, 0.0, 0.0)
BOX = Box(50.0, 400.0, 188.0)


def star(rng, theta, name: str, scatter: float, errors: float = 1.0) -> Observables:
    """One observation, with scatter beyond the stated errors, which are ``errors`` of the true."""
    sheet = niriss()
    noisy = add_noise(sheet, ExtraNoise(0.005 * scatter, np.radians(0.3 * scatter)))
    data = simulated(noisy, list(theta), rng)
    stated = niriss(0.005 * errors, 0.3 * errors).covariance
    setups = tuple(replace(s, source=f"/data/{name}.fits") for s in sheet.setups)
    return replace(data, covariance=stated, setups=setups)


def compared(
    rng, n: int, *, scatter: float = 0.0, errors: float = 1.0, bad=POINT, draws: int = 199
):
    """Comparison of n calibrators of which the first is ``bad``, by name."""
    target = star(rng, TRUTH, "target", scatter, errors)
    stars = [star(rng, POINT if k else bad, f"cal{k}", scatter, errors) for k in range(n)]
    calibrated = calibrate(target, stars, method="weighted", clip=None).observables
    likelihood = Likelihood(calibrated)
    theta = np.array(refine(likelihood, np.array(TRUTH), BOX, 0.0).theta)
    result = SimpleNamespace(likelihood=likelihood, theta=theta)
    pairs = [(s, (0.0, 0.0)) for s in stars]
    return compare_calibrators(result, pairs, rng, draws)


def uniform(p: np.ndarray, independent: int) -> bool:
    """Whether probabilities may be uniform, of which so many are independent."""
    few = int((p < 0.1).sum() * independent / p.size)
    distance = stats.kstest(p, "uniform").statistic
    far = stats.kstwo.sf(distance, independent)
    return bool(far > 1e-4 and stats.binomtest(few, independent, 0.1).pvalue > 1e-4)


def test_probability_is_uniform_where_two_calibrators_agree(rng) -> None:
    """15 pairs whose errors are understated twofold: the scale of the errors drops out."""
    p = np.array([compared(rng, 2, errors=0.5)[0].p for _ in range(15)])
    assert uniform(p, 15)


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.parametrize("scatter", [0.0, 2.0])
def test_probability_is_uniform_where_calibrators_agree(rng, n: int, scatter: float) -> None:
    """50 sets of 2, 3 and 5, with and without scatter that the errors do not hold."""
    p = np.array([[c.p for c in compared(rng, n, scatter=scatter)] for _ in range(50)])
    assert uniform(p.ravel(), 50)


def test_a_calibrator_with_a_companion_is_named(rng) -> None:
    """4.2 mag, errors of 0.3° and 0.5 %: the other two do not disagree with each other's mean."""
    found = compared(rng, 3, bad=(120.0, 60.0, 0.02), draws=999)
    assert found[0].parts == ("cal0.fits", OTHERS)
    assert found[0].p == 1e-3
    assert found[0].delta_chi2 > 50.0
    assert all(one.p > 0.01 for one in found[1:])
    assert "calibrated with cal0.fits and with the other calibrators" in _apart(
        found[0], moves=False
    )
    (warning,) = consistency_warnings(found)
    assert "cal0.fits" in warning
    assert not consistency_warnings(found[1:])


def test_one_calibrator_is_compared_with_nothing(rng) -> None:
    assert compared(rng, 1) == ()


def test_noise_of_the_target_is_not_in_the_comparison(rng) -> None:
    """Another observation of the target changes only where the templates are taken."""
    stars = [star(rng, POINT, f"cal{k}", 0.0) for k in range(3)]
    gains = []
    for _ in range(2):
        target = star(rng, TRUTH, "target", 0.0)
        calibrated = calibrate(target, stars, method="weighted", clip=None).observables
        result = SimpleNamespace(likelihood=Likelihood(calibrated), theta=np.array(TRUTH))
        pairs = [(s, (0.0, 0.0)) for s in stars]
        gains.append([c.delta_chi2 for c in compare_calibrators(result, pairs, rng, 10)])
    np.testing.assert_allclose(np.sort(gains[0]), np.sort(gains[1]), rtol=0.05)


def test_gain_is_that_of_dense_algebra(rng) -> None:
    """Two calibrators: generalised least squares of their difference, all in one matrix."""
    stars = [star(rng, POINT, f"cal{k}", 0.0) for k in range(2)]
    target = star(rng, TRUTH, "target", 0.0)
    keys = keys_of(target)
    apart = leave_out(0, [(s, (0.0, 0.0)) for s in stars], keys)
    assert apart is not None
    templates = rng.standard_normal((4, len(keys)))
    templates[:, 21:] = np.linalg.solve(*_closing(stars[0], templates[:, 21:]))
    made = apart.against(templates, np.array([3]))
    score = made.score(apart.measured)[0]
    gain = score @ np.linalg.solve(made.covariance, score)
    seen = [transfer_of(s, keys, (0.0, 0.0)) for s in stars]
    weight = np.linalg.pinv(sum(t.covariance.toarray() for t in seen), rcond=1e-9)
    change = seen[0].value - seen[1].value

    def explained(some: np.ndarray) -> float:
        moment = some @ weight @ change
        return float(moment @ np.linalg.solve(some @ weight @ some.T, moment))

    assert gain == pytest.approx(explained(templates) - explained(templates[3:]), rel=1e-8)
    whole = made.whole(apart.measured)[0]
    assert whole == pytest.approx(change @ weight @ change, rel=1e-8)


def _closing(data: Observables, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The identity, and what baselines can make of some closure phases."""
    span = np.linalg.svd(data.covariance.dense()[21:, 21:])[0][:, :15]
    return np.eye(len(phases)), phases @ span @ span.T


def test_scatter_on_a_grid_is_that_of_the_chain(rng) -> None:
    stars = [star(rng, POINT, f"cal{k}", 2.0) for k in range(3)]
    keys = keys_of(stars[0])
    seen = [transfer_of(s, keys, (0.0, 0.0)) for s in stars]
    population = population_of(seen, keys, seen[0].seen)
    grid = ScatterGrid.of(population)
    tau, weight = grid.posterior
    chain = sample_tau(grid, rng)
    np.testing.assert_allclose(weight @ tau, chain.mean(axis=0), rtol=0.05)
    spread = np.sqrt(weight @ tau**2 - (weight @ tau) ** 2)
    np.testing.assert_allclose(spread, chain.std(axis=0), rtol=0.15)

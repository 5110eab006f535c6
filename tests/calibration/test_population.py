"""Calibrators as a drifting population: against populations that were simulated."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from drifting_visits import Drift, visits
from helpers import niriss
from scipy.sparse import csr_array

from amibayes.calibration import calibrate
from amibayes.calibration.matching import keys_of
from amibayes.calibration.population import components, inflation, population_response, predict
from amibayes.calibration.transfer import Transfer
from amibayes.data.point_source import point_source
from amibayes.errors import DataError

Q = 20


def population(
    n: int, rng: np.random.Generator, sizes: tuple[float, ...] = (4.0, 2.5), scatter: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Independent draws (n, Q) with unit errors, and their true components."""
    modes = np.linalg.qr(rng.standard_normal((Q, len(sizes))))[0]
    amplitude = rng.standard_normal((n, len(sizes))) * sizes
    noise = np.sqrt(1.0 + scatter**2) * rng.standard_normal((n, Q))
    return 2.0 + amplitude @ modes.T + noise, modes


def test_components_of_a_large_population_are_the_truth() -> None:
    data, modes = population(4000, np.random.default_rng(1))
    found = components(data, np.ones(len(data)))
    assert found.modes.shape == (Q, 2)
    assert np.abs(np.diagonal(found.modes.T @ modes)) == pytest.approx([1.0, 1.0], abs=0.01)
    assert found.variance == pytest.approx([16.0, 6.25], rel=5 * np.sqrt(2 / 4000))
    assert found.scatter == pytest.approx(0.25, abs=5 * 1.25 * np.sqrt(2 / (4000 * Q)))


def test_variances_of_small_libraries_are_not_those_of_the_noise() -> None:
    rng = np.random.default_rng(2)
    draws = [components(population(25, rng)[0], np.ones(25)) for _ in range(200)]
    first = np.array([d.variance[0] for d in draws if len(d.variance)])
    assert len(first) > 195
    assert abs(first.mean() - 16.0) < 4 * first.std() / np.sqrt(len(first)) + 0.8
    scatter = np.array([d.scatter for d in draws])
    assert abs(scatter.mean() - 0.25) < 0.1


def test_noise_alone_has_no_components() -> None:
    rng = np.random.default_rng(3)
    n_modes = [
        components(rng.standard_normal((30, Q)), np.ones(30)).modes.shape[1] for _ in range(100)
    ]
    assert np.mean(n_modes) < 0.1


def test_a_prediction_is_as_good_as_it_states_and_better_nearer_in_time() -> None:
    """Dates of one Ornstein-Uhlenbeck process: χ² of the truth, and errors against the mean's."""
    rng = np.random.default_rng(4)
    chi2, near, far = [], [], []
    for _ in range(60):
        days = np.sort(rng.uniform(0.0, 300.0, 40))
        at = days[20] + 1.0
        dates = np.append(days, [at, 2000.0])
        matrix = np.exp(-np.abs(dates[:, None] - dates) / 25.0) + 1e-9 * np.eye(len(dates))
        amplitude = 4.0 * np.linalg.cholesky(matrix) @ rng.standard_normal(len(dates))
        mode = np.linalg.qr(rng.standard_normal((Q, 1)))[0][:, 0]
        truth = amplitude[:, None] * mode
        data = truth[:40] + rng.standard_normal((40, Q))
        found = components(data, np.ones(40))
        for k, store in ((40, near), (41, far)):
            made = predict(found, data, np.ones(40), days, float(dates[k]))
            error = truth[k] - made.mean
            store.append(float(error @ mode))
            along = float(mode @ made.covariance @ mode)
            chi2.append(store[-1] ** 2 / along)
    assert 0.6 < np.mean(chi2) < 1.6
    assert np.std(near) < 0.5 * np.std(far)


def test_inflation_is_one_where_the_population_is_as_modelled() -> None:
    rng = np.random.default_rng(5)
    data, _ = population(40, rng)
    days = np.arange(40.0)
    assert inflation(data, np.ones(40), days)[0] < 1.35
    heavy = data + 3.0 * rng.standard_t(1.5, data.shape)
    assert inflation(heavy, np.ones(40), days)[0] > 1.5


def test_a_target_is_freed_of_the_drift_by_a_library() -> None:
    """Residuals of point sources, and their χ², beside the mean of the three nearest stars of a
    week before."""
    rng = np.random.default_rng(6)
    ours, theirs, chi2 = [], [], []
    for _ in range(4):
        mjd = np.concatenate([60000.0 + np.sort(rng.uniform(0.0, 120.0, 30)), [60060.0]])
        stars = visits(Drift(), mjd, rng)
        target, library = stars[-1], stars[:-1]
        out = calibrate(target, library, method="population").observables
        perfect = np.repeat([1.0, 0.0], [out.n_vis2, out.n_closure_phases])
        residual = out.data - perfect
        whitened = out.covariance.whiten(residual[:, None])
        chi2.append(float((whitened**2).sum()) / out.n_independent)
        ours.append(float(np.mean(residual**2)))
        before = np.argsort([abs(o.vis2.mjd[0] - 60053.0) for o in library])[:3]
        mean = np.mean([library[k].data for k in before], axis=0)
        n = out.n_vis2
        nearest = np.concatenate([target.data[:n] / mean[:n], target.data[n:] - mean[n:]])
        theirs.append(float(np.mean((nearest - perfect) ** 2)))
    assert np.mean(ours) < 0.7 * np.mean(theirs)
    assert 0.6 < np.mean(chi2) < 1.4


@pytest.mark.parametrize("moved", ["vis2", "closure"])
def test_scatter_of_one_kind_of_data_is_none_of_the_other(moved: str) -> None:
    """Coherence that is lost scatters V² by five errors, and closure phases not at all; or pistons
    these. 20 stars tell a variance of 15 numbers and more to 8 %."""
    rng = np.random.default_rng(3)
    star = niriss()
    keys = keys_of(star)
    size = np.repeat([5.0, 0.0] if moved == "vis2" else [0.0, 5.0], [21, 35])
    errors, scatter = star.covariance.draw(rng, 20).T, star.covariance.draw(rng, 20).T * size
    covariance = csr_array(star.covariance.sparse)
    transfers = [
        Transfer(np.repeat([0.9, 0.0], [21, 35]) + one, covariance, np.ones(56, bool))
        for one in errors + scatter
    ]
    found = population_response(transfers, keys, np.arange(20.0), 10.5)
    variance = found.covariance.diagonal() / star.covariance.variance
    of_vis2, of_closure = variance[:21].mean(), variance[21:].mean()
    wide, narrow = (of_vis2, of_closure) if moved == "vis2" else (of_closure, of_vis2)
    assert 0.6 < wide / (25.0 * 21.0 / 20.0) < 1.5
    assert narrow < 0.6


def test_a_member_with_a_companion_is_named() -> None:
    """One of twelve with 3 % at 130 mas: it makes the errors of all larger."""
    mjd = 60000.0 + 7.0 * np.arange(13)
    for companions, told in (({3: [80.0, 100.0, 0.03]}, ["star3.oifits"]), (None, [])):
        *library, target = visits(Drift(), mjd, np.random.default_rng(4), companions)
        out = calibrate(target, library, method="population").observables
        assert [n.split()[1] for n in out.notes if "not what the others predict" in n] == told


def test_a_small_library_is_refused() -> None:
    stars = visits(Drift(), 60000.0 + np.arange(5.0), np.random.default_rng(1))
    with pytest.raises(DataError, match="a population takes 6"):
        calibrate(stars[0], stars[1:], method="population")


def test_likelihoods_beyond_the_range_of_numbers_predict_as_well() -> None:
    """300 stars that are all alike but for tiny noise: likelihoods differ by e to the 1000."""
    rng = np.random.default_rng(9)
    mode = np.linalg.qr(rng.standard_normal((Q, 1)))[0][:, 0]
    days = np.linspace(0.0, 3.0, 300)
    amplitude = 5.0 * np.cos(days / 3.0)
    noise = np.full(300, 1e-8)
    data = amplitude[:, None] * mode + 1e-4 * rng.standard_normal((300, Q))
    made = predict(components(data, noise), data, noise, days, 1.5)
    assert np.isfinite(made.mean).all()
    assert made.mean @ mode == pytest.approx(5.0 * np.cos(0.5), abs=1e-2)


def test_medians_of_covariances_that_are_none_are_mended() -> None:
    """Each of three kinds of calibrators is sound; the median of their entries is not."""
    rng = np.random.default_rng(3)
    keys = keys_of(
        point_source(
            [(0.0, 0.0), (3.0, 1.0), (-1.0, 4.0)], [4e-6], [1e-7], vis2_error=0.1,
            closure_error_rad=0.1,
        ).only(["vis2"])
    )  # fmt: skip
    kinds = []
    for one, two, three in ((0.9, 0.9, 0.8), (0.9, 0.0, 0.0), (0.0, 0.9, 0.0)):
        kinds.append(np.array([[1.0, one, two], [one, 1.0, three], [two, three, 1.0]]))
    assert all(np.linalg.eigvalsh(k)[0] > 0.0 for k in kinds)
    assert np.linalg.eigvalsh(np.median(kinds, axis=0))[0] < -0.1
    transfers = [
        Transfer(0.8 + 0.01 * rng.normal(size=3), csr_array(1e-4 * kinds[k % 3]), np.ones(3, bool))
        for k in range(9)
    ]
    found = population_response(transfers, keys, np.arange(9.0), 4.2)
    assert np.linalg.eigvalsh(found.covariance.toarray())[0] > 0.0
    assert found.value == pytest.approx(0.8, abs=0.05)


def test_members_see_what_most_of_a_library_see() -> None:
    """A baseline that few see is none of theirs, whether they see it or not."""
    seen = np.ones((6, 3), dtype=bool)
    seen[:2, 1] = False
    seen[:, 2] = np.arange(6) == 3
    transfers = [SimpleNamespace(seen=one) for one in seen]
    with pytest.raises(DataError, match=r"^4 calibrators of the library"):
        population_response(transfers, None, np.zeros(6), 0.0)  # type: ignore[arg-type]

"""Laws of χ², of t distributions and of restricted likelihoods against their definitions."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss
from scipy import stats
from scipy.special import gammaln, log_ndtr, logsumexp

from amibayes.data.observables import join
from amibayes.likelihood.chi2 import (
    candid_n_sigma,
    chi2_of_part,
    chi2_survival,
    deviance,
    log_chi2_survival,
    log_peak,
    restricted_loss,
    touched,
)


@pytest.mark.parametrize("dof", [2, 8, 30, 200, 600])
def test_tails_of_even_degrees_are_finite_sums(dof: int) -> None:
    """Q(a, z) = e⁻ᶻ Σ zᵏ/k!, k < a (Abramowitz & Stegun 26.4.21), as far out as is asked."""
    x = np.array([0.1, 20.0, 900.0, 1500.0, 2500.0, 1e4, 1e6])
    k, z = np.arange(dof // 2), 0.5 * x[:, None]
    expected = -z[:, 0] + logsumexp(k * np.log(z) - gammaln(k + 1.0), axis=1)
    np.testing.assert_allclose(log_chi2_survival(x, dof), expected, rtol=1e-9, atol=1e-12)
    assert log_chi2_survival(2500.0, dof) == pytest.approx(expected[4])


def test_tail_of_one_degree_is_that_of_a_normal_deviate() -> None:
    x = np.array([0.3, 9.0, 900.0, 2500.0, 1e5])
    expected = np.log(2.0) + log_ndtr(-np.sqrt(x))
    np.testing.assert_allclose(log_chi2_survival(x, 1.0), expected, rtol=1e-9)


def test_candids_sigma_of_known_probabilities() -> None:
    """Two-sided: of one degree nσ is √x."""
    ratio = np.array([4.0, 25.0, 900.0, 4e4])
    np.testing.assert_allclose(candid_n_sigma(3.0 * ratio, 3.0, 1.0), np.sqrt(ratio), rtol=1e-9)
    expected = stats.norm.isf(0.5 * stats.chi2.sf(30.0 * 50.0 / 40.0, 30.0))
    assert candid_n_sigma(50.0, 40.0, 30.0) == pytest.approx(expected)
    assert candid_n_sigma(1e-9, 40.0, 30.0) == 0.0
    assert candid_n_sigma(50.0, 0.0, 30.0) > 1e3


@pytest.mark.parametrize(("n", "degrees"), [(1, 5.0), (4, 12.0), (30, 40.0)])
def test_t_distributed_data(n: int, degrees: float) -> None:
    """Of unit covariance: the scale matrix is (ν − 2)/ν."""
    law = stats.multivariate_t(shape=(degrees - 2.0) / degrees * np.eye(n), df=degrees)
    x = np.random.default_rng(1).standard_normal((6, n))
    at, peak = law.logpdf(x), float(law.logpdf(np.zeros(n)))
    assert log_peak(n, degrees) == pytest.approx(peak)
    found = deviance((x**2).sum(axis=1), n, degrees)
    np.testing.assert_allclose(found, -2.0 * (at - peak))
    assert log_peak(n, np.inf) == pytest.approx(n * stats.norm.logpdf(0.0))
    assert list(deviance(np.array([3.0, 4.0]), n, np.inf)) == [3.0, 4.0]


def test_a_chi2_as_large_by_chance() -> None:
    assert chi2_survival(30.0, 20.0) == pytest.approx(stats.chi2.sf(30.0, 20))
    # One datum of unit variance is a t deviate of variance ν/(ν − 2), scaled to 1.
    x, degrees = 2.3, 9.0
    expected = 2.0 * stats.t.sf(x * np.sqrt(degrees / (degrees - 2.0)), degrees)
    assert chi2_survival(x**2, 1.0, degrees) == pytest.approx(expected)
    # Hotelling: the sum of squares of n normal deviates over a common χ²_ν.
    rng, n = np.random.default_rng(2), 5
    scale = rng.chisquare(degrees, 40_000) / (degrees - 2.0)
    drawn = rng.chisquare(n, 40_000) / scale
    share = float((drawn > 10.0).mean())
    assert chi2_survival(10.0, n, degrees) == pytest.approx(share, abs=0.01)


def test_chi2_of_a_part_is_that_of_its_own_covariance() -> None:
    """Whether or not its errors are shared with other data."""
    data = join([niriss(), replace(niriss(0.01), covariance=niriss(0.01).covariance)])
    dense = data.covariance.dense()
    difference = np.random.default_rng(3).standard_normal(len(data.data)) * 0.01
    n2 = data.n_vis2
    for at in (np.arange(4, 20), np.arange(n2, n2 + 12), np.array([0, 3, n2, n2 + 1, n2 + 40])):
        part = dense[np.ix_(at, at)]
        chi2, rank = chi2_of_part(data.covariance, at, difference)
        assert rank == np.linalg.matrix_rank(part, hermitian=True)
        inverse = np.linalg.pinv(part, rcond=1e-10, hermitian=True)
        assert chi2 == pytest.approx(difference[at] @ inverse @ difference[at], rel=1e-6)


@pytest.mark.parametrize(
    ("at", "inside", "beyond"),
    [
        ([0], [1, 0, 0], [0, 1, 1]),
        ([1], [0, 1, 0], [1, 1, 1]),
        ([1, 2], [0, 1, 1], [1, 0, 0]),
        ([0, 1, 2], [1, 1, 1], [0, 0, 0]),
    ],
)
def test_what_data_touch(at: list[int], inside: list[int], beyond: list[int]) -> None:
    """Two data with opposite weights in a combination do touch it."""
    whitening = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, 0.0, 2.0]])
    covariance = SimpleNamespace(size=3, whitening=whitening)
    mask = np.isin(np.arange(3), at)
    for some in (np.array(at), mask):
        own, others = touched(covariance, some)
        assert (own.tolist(), others.tolist()) == (
            [bool(x) for x in inside],
            [bool(x) for x in beyond],
        )


@pytest.mark.parametrize("n_zero", [0, 1])
def test_restricted_likelihood(n_zero: int) -> None:
    """(n − k) ln(χ²/(n − k)) + ln|C| + ln|XᵀX| of a least-squares fit (Patterson & Thompson)."""
    rng, n = np.random.default_rng(4), 20
    slopes = rng.standard_normal((n, 3)) * [1.0, 100.0, 1e-3]
    residual = rng.standard_normal(n)
    left = np.linalg.lstsq(slopes, residual, rcond=None)[1][0]
    expected = 17.0 * np.log(left / 17.0) + 5.0 + np.linalg.slogdet(slopes.T @ slopes)[1]
    columns = np.column_stack([residual, slopes, np.zeros((n, n_zero))])
    assert restricted_loss(columns.T @ columns, n, 5.0) == pytest.approx(expected)
    # As many parameters as data leave nothing.
    few = columns[:3]
    assert restricted_loss(few.T @ few, 3, 5.0) == 0.0


def test_a_parameter_told_twice_counts_once() -> None:
    rng, n = np.random.default_rng(5), 12
    slope, residual = rng.standard_normal((2, n))
    twice = np.column_stack([residual, slope, slope])
    once = np.column_stack([residual, slope])
    difference = restricted_loss(twice.T @ twice, n, 0.0) - restricted_loss(once.T @ once, n, 0.0)
    # Of standardised slopes, the two of which have eigenvalues 2 and 0, and norms of each.
    assert difference == pytest.approx(np.log(2.0) + np.log(slope @ slope))

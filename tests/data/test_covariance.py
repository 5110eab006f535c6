"""Closures, covariances and observables against dense algebra and counting."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.sparse import csr_array

from amibayes.data.closure import (
    assumed_covariance,
    baseline_variances,
    closure_matrix,
    kernel_basis,
)
from amibayes.data.covariance import (
    Block,
    BlockCovariance,
    Covariance,
    covariance_from_matrix,
    dense_covariance,
    diagonal_covariance,
    stack_covariances,
)
from amibayes.errors import DataError


def triangles(n: int) -> np.ndarray:
    return np.array(list(combinations(range(n), 3)))


@pytest.mark.parametrize("n", [3, 4, 5, 6, 7])
def test_closure_rank_and_equal_errors(n: int) -> None:
    matrix, baselines = closure_matrix(triangles(n))
    assert len(baselines) == n * (n - 1) // 2
    assert kernel_basis(matrix).shape[1] == (n - 1) * (n - 2) // 2
    np.testing.assert_allclose(baseline_variances(matrix, np.full(len(matrix), 3.0)), 1.0)


def test_seven_stations_have_singular_values_root_seven() -> None:
    singular = np.linalg.svd(closure_matrix(triangles(7))[0], compute_uv=False)
    np.testing.assert_allclose(singular[:15], np.sqrt(7.0))
    np.testing.assert_allclose(singular[15:], 0.0, atol=1e-12)


def test_closure_matrix_reproduces_closures_of_any_station_order(rng: np.random.Generator) -> None:
    station_phase = rng.normal(size=7)
    shuffled = np.array([rng.permutation(t) for t in triangles(7)])
    matrix, baselines = closure_matrix(shuffled)
    pistons = station_phase[baselines[:, 0]] - station_phase[baselines[:, 1]]
    np.testing.assert_allclose(matrix @ pistons, 0.0, atol=1e-12)
    assert (np.abs(matrix).sum(axis=1) == 3).all()


@pytest.mark.parametrize("n", [4, 5, 7])
def test_baseline_variances_reproduce_errors_they_can(n: int, rng: np.random.Generator) -> None:
    matrix, baselines = closure_matrix(triangles(n))
    truth = rng.uniform(0.5, 2.0, (len(baselines), 6))
    found = baseline_variances(matrix, np.abs(matrix) @ truth)
    np.testing.assert_allclose(np.abs(matrix) @ found, np.abs(matrix) @ truth, rtol=1e-3)
    assert (found > 0).all()


def test_uneven_errors_keep_every_combination_finite() -> None:
    matrix, _ = closure_matrix(triangles(4))
    covariance = assumed_covariance(matrix, np.array([[100.0], [1.0], [1.0], [1.0]]))[0]
    basis = kernel_basis(matrix)
    assert np.linalg.eigvalsh(basis.T @ covariance @ basis).min() > 0.1


def test_shared_baseline_correlates_by_a_third() -> None:
    matrix, _ = closure_matrix(triangles(7))
    covariance = assumed_covariance(matrix, np.ones((35, 1)))[0]
    off = covariance[~np.eye(35, dtype=bool)]
    assert set(np.round(np.abs(off), 6)) == {0.0, 0.333333}
    np.testing.assert_allclose(np.diag(covariance), 1.0)


def random_matrix(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, 2 * n))
    return root @ root.T / n


def some_covariances(rng: np.random.Generator) -> list[Covariance]:
    blocks = [Block(np.array([0, 2]), random_matrix(rng, 2)), Block(np.array([1]), np.eye(1))]
    blocks += [Block(np.array([3, 5]), random_matrix(rng, 2)), Block(np.array([4]), 2 * np.eye(1))]
    dense = dense_covariance(random_matrix(rng, 5))
    diagonal = diagonal_covariance(rng.uniform(1, 2, 4))
    return [diagonal, BlockCovariance(6, blocks), dense, stack_covariances([diagonal, dense])]


@pytest.mark.parametrize("which", range(4))
def test_protocol_against_dense_algebra(which: int, rng: np.random.Generator) -> None:
    covariance = some_covariances(rng)[which]
    matrix = covariance.dense()
    x = rng.normal(size=(covariance.size, 3))
    assert isinstance(covariance, Covariance)
    np.testing.assert_allclose(np.diag(matrix), covariance.variance)
    np.testing.assert_allclose(covariance.solve(x), np.linalg.solve(matrix, x), rtol=1e-9)
    np.testing.assert_allclose(covariance.logdet(), np.linalg.slogdet(matrix)[1])
    white = covariance.whiten(x)
    np.testing.assert_allclose(white.T @ white, x.T @ np.linalg.solve(matrix, x), rtol=1e-9)
    np.testing.assert_allclose(covariance.whiten(x[:, 0]), white[:, 0])
    keep = np.array([3, 1, 2])
    np.testing.assert_allclose(covariance.select(keep).dense(), matrix[np.ix_(keep, keep)])
    again = covariance_from_matrix(matrix)
    np.testing.assert_allclose(again.dense(), matrix)


@pytest.mark.parametrize("which", range(4))
def test_draws_have_the_covariance(which: int, rng: np.random.Generator) -> None:
    covariance = some_covariances(rng)[which]
    n = 20_000
    white = covariance.whiten(covariance.draw(rng, n))
    sample = white @ white.T / n
    # The entries scatter by sqrt(2/n) (diagonal) and sqrt(1/n); at most 36 are looked at,
    # and 6 sigma leaves a false failure of 1e-7.
    assert np.abs(sample - np.eye(len(sample))).max() < 6 * np.sqrt(2 / n)


def test_kernel_basis_makes_a_singular_covariance_usable(rng: np.random.Generator) -> None:
    matrix, _ = closure_matrix(triangles(7))
    full = assumed_covariance(matrix, np.full((35, 1), 0.04))[0]
    covariance = dense_covariance(full, kernel_basis(matrix))
    assert covariance.rank == 15
    signal = matrix @ rng.normal(size=21)
    expected = signal @ np.linalg.pinv(full, rcond=1e-9) @ signal
    np.testing.assert_allclose((covariance.whiten(signal) ** 2).sum(), expected)
    fewer = covariance.select(np.arange(10))
    assert fewer.rank == np.linalg.matrix_rank(matrix[:10])


def test_bad_covariances_are_refused() -> None:
    with pytest.raises(DataError, match="zero, negative or not finite"):
        diagonal_covariance(np.array([1.0, 0.0]))
    with pytest.raises(DataError, match="positive definite"):
        dense_covariance(np.array([[1.0, 2.0], [2.0, 1.0]]))
    with pytest.raises(ValueError, match="tile"):
        BlockCovariance(3, [Block(np.array([0, 1]), np.eye(2))])


def test_sum_with_a_sparse_covariance_and_selection_are_those_of_the_matrices(
    rng: np.random.Generator,
) -> None:
    """Blocks of several shapes, with and without basis, in any order."""
    matrix, _ = closure_matrix(np.array(list(combinations(range(4), 3))))
    basis = kernel_basis(matrix)
    places = np.split(rng.permutation(20), [4, 8, 12, 14, 16, 17, 18, 19])
    bases = [basis, basis, basis, *[None] * 6]
    blocks = []
    for place, b in zip(places, bases, strict=True):
        inner = random_matrix(rng, len(place) if b is None else b.shape[1])
        blocks.append(Block(place, inner if b is None else b @ inner @ b.T, b))
    covariance = BlockCovariance(20, blocks)
    dense = covariance.dense()
    np.testing.assert_allclose(covariance.variance, np.diag(dense))
    added = np.zeros((20, 20))
    for place, b in zip(places, bases, strict=True):
        added[np.ix_(place, place)] = np.eye(len(place)) if b is None else matrix @ matrix.T / 3
    found = covariance.plus(csr_array(0.5 * added))
    np.testing.assert_allclose(found.dense(), dense + 0.5 * added, atol=1e-14)
    assert found.rank == covariance.rank == 3 * 3 + 8
    y = rng.normal(size=20)
    size, along = covariance.against(csr_array(added), y)
    grown = 1.0 + 0.5 * size
    assert (along**2 / grown).sum() == pytest.approx((found.whiten(y) ** 2).sum(), rel=1e-9)
    assert np.log(grown).sum() == pytest.approx(found.logdet() - covariance.logdet(), rel=1e-9)
    keep = rng.permutation(20)[:13]
    chosen = covariance.select(keep)
    np.testing.assert_allclose(chosen.dense(), dense[np.ix_(keep, keep)], atol=1e-14)
    x = rng.normal(size=(20, 2))
    np.testing.assert_allclose(
        found.solve(x)[np.concatenate(places[3:])],
        np.linalg.pinv(dense + 0.5 * added, rcond=1e-10)[np.concatenate(places[3:])] @ x,
        atol=1e-8,
    )


def test_basis_of_closures_does_not_turn_with_the_last_digits() -> None:
    """All singular values of the closures of an array are equal: their vectors are any."""
    matrix = closure_matrix(triangles(7))[0]
    basis = kernel_basis(matrix)
    np.testing.assert_allclose(basis.T @ basis, np.eye(15), atol=1e-14)
    np.testing.assert_allclose(basis @ (basis.T @ matrix), matrix, atol=1e-13)
    shaken = matrix * (1.0 + 1e-12 * np.random.default_rng(1).standard_normal(matrix.shape))
    np.testing.assert_allclose(kernel_basis(shaken), basis, atol=1e-10)

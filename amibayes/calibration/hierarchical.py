"""Calibrators as draws from one population: random effects with a scatter per observable type.

The target is one more draw of the population. The response of the instrument is integrated out
exactly (`amibayes.calibration.scatter_likelihood`); the scatter between calibrators has a
half-normal prior and is sampled (`amibayes.calibration.scatter_posterior`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from amibayes.calibration.matching import Keys
from amibayes.calibration.scatter_likelihood import AT_ONCE, Group, Population, population_of
from amibayes.calibration.scatter_posterior import ScatterGrid, sample_tau
from amibayes.calibration.transfer import Transfer
from amibayes.calibration.weighted import TransferFunction, shared_changes
from amibayes.support.shared_results import shared
from amibayes.units import FloatArray


def _posterior_of(
    population: Population, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Draws of the scatter, its nodes and their weights.

    Targets of a survey share them where their calibrators are the same: the target's own data are
    no part of the population.
    """

    def made() -> tuple[tuple[FloatArray, FloatArray, FloatArray], Any]:
        grid = ScatterGrid.of(population)
        return (sample_tau(grid, rng), *grid.posterior), rng.bit_generator.state

    found, after = shared(made, "scatter between calibrators", population, rng.bit_generator.state)
    rng.bit_generator.state = after
    return found


def hierarchical_response(
    transfers: Sequence[Transfer],
    keys: Keys,
    rng: np.random.Generator,
    covariate: FloatArray | None = None,
) -> TransferFunction:
    """Response of the instrument for the target: moments of its posterior predictive density.

    Parameters
    ----------
    covariate : (n_calibrators,) float array, optional
        See `population_of`.
    """
    known = np.asarray(np.array([t.seen for t in transfers]).any(axis=0))
    population = population_of(transfers, keys, known, covariate)
    draws, tau, weight = _posterior_of(population, rng)
    value, covariance = predictive(population, tau, weight, len(keys))

    def combine(changes: FloatArray) -> FloatArray:
        # The mean is linear in what the calibrators see, at any scatter between them.
        moved = [replace(t, value=own) for t, own in zip(transfers, changes, strict=True)]
        return predictive(population_of(moved, keys, known, covariate), tau, weight, len(keys))[0]

    shared = shared_changes(transfers, combine)
    return TransferFunction(value, covariance, known, draws, shared=shared)


def predictive(
    population: Population, tau: FloatArray, weight: FloatArray, n_keys: int
) -> tuple[FloatArray, csr_array]:
    """Mean and covariance of the target's response.

    Parameters
    ----------
    population : Population
    tau, weight : (m, 2) and (m,) float arrays
        Scatters between calibrators and their posterior: moments by a sum over the grid do not
        depend on a seed, as those of a chain would by 5 %.
    n_keys : int
    """
    value = np.zeros(n_keys)
    rows, columns, values = [np.empty(0, np.intp)], [np.empty(0, np.intp)], [np.empty(0)]
    for group in population.groups:
        mean, covariance = _moments(group, tau, weight)
        for i, keys in enumerate(group.keys):
            value[keys] = group.basis[i] @ mean[i]
            rows.append(np.repeat(keys, len(keys)))
            columns.append(np.tile(keys, len(keys)))
            values.append((group.basis[i] @ covariance[i] @ group.basis[i].T).ravel())
    places = np.concatenate(rows), np.concatenate(columns)
    return value, coo_array((np.concatenate(values), places), shape=(n_keys, n_keys)).tocsr()


def _moments(group: Group, tau: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (g, r) and covariance (g, r, r) of the target's parameters over scatters."""
    r = group.noise.shape[-1]
    square = weight @ tau**2
    second = square[0] * group.target_scatter[0] + square[1] * group.target_scatter[1]
    near = group.response(tau[[weight.argmax()]])[0][0, :, :r]
    first = np.zeros_like(near)
    n_parts = 1 + int(len(tau) * group.noise.size / AT_ONCE)
    for some, share in zip(
        np.array_split(tau, n_parts), np.array_split(weight, n_parts), strict=True
    ):
        mean, covariance = group.response(some)
        off = mean[..., :r] - near
        first += np.einsum("n,ngp->gp", share, off)
        second += np.einsum("n,ngpq->gpq", share, covariance[..., :r, :r])
        second += np.einsum("n,ngp,ngq->gpq", share, off, off)
    return near + first, second - first[:, :, None] * first[:, None, :]

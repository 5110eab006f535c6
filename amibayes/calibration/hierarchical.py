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
from amibayes.calibration.scatter_posterior import sample_tau
from amibayes.calibration.transfer import Transfer
from amibayes.calibration.weighted import TransferFunction, shared_changes
from amibayes.support.shared_results import shared
from amibayes.units import FloatArray

MAX_DRAWS = 256
"""Of the scatter, over which the moments of the response are averaged."""


def _tau_of(population: Population, rng: np.random.Generator) -> FloatArray:
    """Draws of `sample_tau`, which targets of a survey share where their calibrators are the same.

    The target's own data are no part of the population.
    """

    def drawn() -> tuple[FloatArray, Any]:
        return sample_tau(population, rng), rng.bit_generator.state

    tau, after = shared(drawn, "scatter between calibrators", population, rng.bit_generator.state)
    rng.bit_generator.state = after
    return tau


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
    tau = _tau_of(population, rng)
    value, covariance = predictive(population, tau, len(keys))

    def combine(changes: FloatArray) -> FloatArray:
        # The mean is linear in what the calibrators see, at any scatter between them.
        moved = [replace(t, value=own) for t, own in zip(transfers, changes, strict=True)]
        return predictive(population_of(moved, keys, known, covariate), tau, len(keys))[0]

    shared = shared_changes(transfers, combine)
    return TransferFunction(value, covariance, known, tau, shared=shared)


def predictive(
    population: Population, tau: FloatArray, n_keys: int
) -> tuple[FloatArray, csr_array]:
    """Mean and covariance of the target's response over draws of τ."""
    value = np.zeros(n_keys)
    rows, columns, values = [np.empty(0, np.intp)], [np.empty(0, np.intp)], [np.empty(0)]
    for group in population.groups:
        mean, covariance = _moments(group, np.nan_to_num(_thinned(tau, group)))
        for i, keys in enumerate(group.keys):
            value[keys] = group.basis[i] @ mean[i]
            rows.append(np.repeat(keys, len(keys)))
            columns.append(np.tile(keys, len(keys)))
            values.append((group.basis[i] @ covariance[i] @ group.basis[i].T).ravel())
    places = np.concatenate(rows), np.concatenate(columns)
    return value, coo_array((np.concatenate(values), places), shape=(n_keys, n_keys)).tocsr()


def _thinned(tau: FloatArray, group: Group) -> FloatArray:
    """Evenly chosen draws, as many as the size of the components allows."""
    size = group.noise.size
    n = int(np.clip(min(1e9 / (size * group.noise.shape[-1]), AT_ONCE / size), 32, MAX_DRAWS))
    return np.asarray(tau[np.linspace(0, len(tau) - 1, min(n, len(tau))).astype(int)])


def _moments(group: Group, tau: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (g, r) and covariance (g, r, r) of the target's parameters over draws of τ."""
    r = group.noise.shape[-1]
    mean, covariance = group.response(tau)
    mean, covariance = mean[..., :r], covariance[..., :r, :r]
    square = (tau**2).mean(axis=0)
    own = square[0] * group.target_scatter[0] + square[1] * group.target_scatter[1]
    centre = mean.mean(axis=0)
    spread = np.einsum("ngp,ngq->gpq", mean - centre, mean - centre) / len(tau)
    return centre, covariance.mean(axis=0) + own + spread

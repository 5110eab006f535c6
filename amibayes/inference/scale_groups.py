"""Data whose errors may be wrong by a factor of their own: each kind of each file.

A statistic that is free of one scale of all errors is not free of two: where closure phases
scatter less than stated and V² do not, noise of the V² alone passes for twice as significant as
it is. Each group of data is therefore weighed by its own scatter about the fit without a
companion, in the data and in every null set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from amibayes.inference.positive import best_positive
from amibayes.observables import IntArray, Observables
from amibayes.units import FloatArray

FEWEST = 8
"""Independent data from which on a kind of data of one file has a scale of its own."""

MOST_UNEQUAL = 100.0
"""Variances of groups, in units of the mean, are not told apart beyond this and its inverse."""


@dataclass(frozen=True, eq=False)
class ScaleGroups:
    """Which independent data share a scale of their errors.

    Parameters
    ----------
    label : (n_data,) int array
        Group of each whitened datum.
    share : float
        Degrees of freedom per datum: less than 1 where nuisance parameters took some.
    """

    label: IntArray
    share: float

    @property
    def several(self) -> bool:
        """Whether there is more than one."""
        return bool(self.label.max(initial=0) > 0)

    def sums(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Sums over the groups, (n_groups, …), of values of the data (n_data, …)."""
        member = self.label == np.arange(self.label.max(initial=0) + 1)[:, None]
        return np.asarray(member.astype(values.dtype) @ values)

    def variances(self, data: FloatArray) -> FloatArray:
        """Mean squares of whitened data (n_data, n), (n_groups, n), within what is believed."""
        count = self.share * self.sums(np.ones(len(data)))[:, None]
        square = self.sums(data**2)
        mean = np.where(square.sum(axis=0) > 0.0, square.sum(axis=0) / count.sum(), 1.0)
        return np.asarray(np.clip(square / count, mean / MOST_UNEQUAL, mean * MOST_UNEQUAL))


def scale_groups(data: Observables, n_nuisance: int) -> ScaleGroups:
    """Group the whitened data by file and kind.

    Parameters
    ----------
    data : Observables
        Unflagged. Kinds and files whose errors are correlated share a scale, as does all
        where the covariance was estimated: its scale was measured.
    n_nuisance : int
        Parameters of the fit without a companion.
    """
    whitening = data.covariance.whitening
    share = max(1.0 - n_nuisance / max(whitening.shape[0], 1), 1e-6)
    if data.freedom is not None:
        return ScaleGroups(np.zeros(whitening.shape[0], dtype=np.intp), share)
    sources = np.unique([s.source for s in data.setups], return_inverse=True)[1]
    setup = np.concatenate([data.vis2.setup, data.closure_phase.setup])
    kind = np.arange(len(setup)) >= data.n_vis2
    of_datum = 2 * sources[setup] + kind
    label = _connected(whitening, of_datum)
    count = np.bincount(label)
    # Too few to tell their own scatter: they go with all else that is too few.
    label = np.where(count[label] < FEWEST, len(count), label)
    return ScaleGroups(np.unique(label, return_inverse=True)[1], share)


def _connected(whitening: csr_array, of_datum: IntArray) -> IntArray:
    """Label of each row, the same for all whose data have labels in common."""
    n = int(of_datum.max()) + 1
    used = coo_array(whitening)
    rows, columns = used.coords
    edges = coo_array(
        (np.ones(len(rows)), (n + rows, of_datum[columns])), shape=(n + whitening.shape[0],) * 2
    )
    return np.asarray(connected_components(edges, directed=False)[1][n:], dtype=np.intp)


def weighted_gain(
    groups: ScaleGroups,
    units: NDArray[np.floating],
    match: Sequence[NDArray[np.floating]],
    weight: NDArray[np.floating],
) -> FloatArray:
    """Gain in weighted χ² of the best contrasts, none below zero, (n, m).

    Parameters
    ----------
    groups : ScaleGroups
    units : (n_bands, n_data, m) float array
        Templates of unit norm.
    match : sequence of (n, m) arrays
        Products of weighted data with each band's templates.
    weight : (n_groups, n) array
    """
    products = {
        (a, b): weight.T @ groups.sums(units[a] * units[b]).astype(weight.dtype)
        for b in range(len(units))
        for a in range(b + 1)
    }
    length = [np.sqrt(np.maximum(products[b, b], 1e-12)) for b in range(len(units))]
    shared = {(a, b): s / (length[a] * length[b]) for (a, b), s in products.items() if a < b}
    return best_positive([m / s for m, s in zip(match, length, strict=True)], shared)[1]

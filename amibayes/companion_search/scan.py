"""What a scan of one data set over the template bank found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from amibayes.data.observables import Observables
from amibayes.likelihood.channel_rows import ChannelRows
from amibayes.units import FloatArray, IntArray

SWEEPS = 8
"""Rounds over the bands in which the contrasts of bands that are coupled find their best."""


def best_positive(
    match: Sequence[NDArray[Any]] | NDArray[Any], shared: Mapping[tuple[int, int], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Non-negative least squares on templates of unit norm, by coordinate descent.

    Parameters
    ----------
    match : (n_bands, …, m) array
        Products of the templates with data.
    shared : mapping of (a, b) to (…, m) array
        Products of the templates of two bands, where these are coupled.

    Returns
    -------
    contrasts : (n_bands, …, m) array
        In units of their errors.
    gain : (…, m) array
        In χ².
    """
    coupled: dict[int, list[tuple[int, FloatArray]]] = {b: [] for b in range(len(match))}
    for (a, b), s in shared.items():
        s = s.astype(match[0].dtype)
        coupled[a].append((b, s))
        coupled[b].append((a, s))
    best = [np.maximum(m, 0.0) if not coupled[b] else 0.0 * m for b, m in enumerate(match)]
    for _ in range(SWEEPS if shared else 0):
        for b in [b for b in coupled if coupled[b]]:
            best[b] = np.maximum(match[b] - sum(s * best[a] for a, s in coupled[b]), 0.0)
    gain = sum(
        x * (2.0 * m - x - sum(s * best[a] for a, s in coupled[b]))
        for b, (x, m) in enumerate(zip(best, match, strict=True))
    )
    return np.asarray(best), np.asarray(gain)


MIN_DATA = 8
"""Independent data from which on a kind of data of one file has a scale of its own."""


MAX_UNEQUAL = 100.0
"""Variances of groups, in units of the mean, are not told apart beyond this and its inverse."""


NO_SCATTER = 1e-30
"""Variance, in units of the stated one, of data that are all as the model: phases that were set to
0, say. Single precision holds one over it."""


@dataclass(frozen=True, eq=False)
class ScaleGroups:
    """Which independent data share a scale of their errors.

    Parameters
    ----------
    label : (n_data,) int array
        Group of each whitened datum.
    share : float
        Degrees of freedom per datum: less than 1 where nuisance parameters took some.
    count : (n_groups,) float array, optional
        Data of every group, where a row stands for several.
    """

    label: IntArray
    share: float
    count: FloatArray | None = None

    @property
    def degrees(self) -> FloatArray:
        """Degrees of freedom of every group, (n_groups,)."""
        count = np.bincount(self.label) if self.count is None else self.count
        return np.asarray(self.share * count)

    @property
    def several(self) -> bool:
        """Whether there is more than one."""
        return bool(self.label.max(initial=0) > 0)

    def sums(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Sums over the groups, (n_groups, …), of values of the data (n_data, …)."""
        member = self.label == np.arange(self.label.max(initial=0) + 1)[:, None]
        return np.asarray(member.astype(values.dtype) @ values)

    def variances(self, data: FloatArray) -> FloatArray:
        """Mean squares of whitened data (n_rows, n), (n_groups, n), within `MAX_UNEQUAL`."""
        count = self.degrees[:, None]
        square = self.sums(data**2)
        mean = np.where(square.sum(axis=0) > 0.0, square.sum(axis=0) / count.sum(), 1.0)
        return np.asarray(np.clip(square / count, mean / MAX_UNEQUAL, mean * MAX_UNEQUAL))


def scale_groups(
    data: Observables, n_nuisance: int, rows: ChannelRows | None = None
) -> ScaleGroups:
    """Group the whitened data by file and kind.

    Parameters
    ----------
    data : Observables
        Unflagged. Kinds and files whose errors are correlated share a scale, as does all
        where the covariance was estimated: its scale was measured.
    n_nuisance : int
        Parameters of the fit without a companion.
    rows : ChannelRows, optional
        Those of errors that are smooth over the channels: where there are enough of a level they
        have a scale of their own, so that the statistic does not depend on how large these errors
        are.
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
    if rows is not None:
        split = label + (label.max() + 1) * rows.level
        enough = np.bincount(split)[split] >= MIN_DATA
        label = np.unique(np.where(enough, split, label), return_inverse=True)[1]
    count = np.bincount(label)
    # Too few to tell their own scatter: they go with all else that is too few.
    label = np.where(count[label] < MIN_DATA, len(count), label)
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


@dataclass(frozen=True, eq=False)
class GroupWeights:
    """Weights (n_groups, n) of the groups of data in n data sets."""

    groups: ScaleGroups
    weight: NDArray[np.floating]

    def sums(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Weighted sums (n, m) over the data of values (n_data, m)."""
        return self.of_sums(self.groups.sums(values))

    def of(self, part: IntArray | slice) -> GroupWeights:
        """Weights of some of the data sets."""
        return GroupWeights(self.groups, self.weight[:, part])

    def of_sums(self, sums: NDArray[np.floating]) -> FloatArray:
        """Weighted sums (n, m) of the sums over the groups, (n_groups, m)."""
        return np.asarray(self.weight.T @ sums.astype(self.weight.dtype))


def weighted_gain(
    weights: GroupWeights,
    units: NDArray[np.floating],
    match: Sequence[NDArray[np.floating]],
) -> FloatArray:
    """Gain in weighted χ² of the best contrasts, none below zero, (n, m).

    Parameters
    ----------
    weights : GroupWeights
        Of n data sets.
    units : (n_bands, n_data, m) float array
        Templates of unit norm.
    match : sequence of (n, m) arrays
        Products of weighted data with each band's templates.
    """
    products = {
        (a, b): weights.sums(units[a] * units[b]) for b in range(len(units)) for a in range(b + 1)
    }
    length = [np.sqrt(np.maximum(products[b, b], 1e-12)) for b in range(len(units))]
    shared = {(a, b): s / (length[a] * length[b]) for (a, b), s in products.items() if a < b}
    return best_positive([m / s for m, s in zip(match, length, strict=True)], shared)[1]


class RunningMaximum:
    """Largest score of many data sets over positions that come part by part.

    Attributes
    ----------
    score : (n,) float32 array
        0 where none was above.
    position : (n,) int array
    """

    def __init__(self, n: int) -> None:
        self.score = np.zeros(n, dtype=np.float32)
        self.position = np.zeros(n, dtype=np.intp)

    def update(
        self,
        score: NDArray[np.floating],
        position: IntArray,
        which: IntArray | slice = slice(None),
    ) -> None:
        """Take the largest scores (n,) of some positions, and where they are, into account.

        Of all data sets, or of n of them.
        """
        better = score > self.score[which]
        at = np.arange(len(self.score))[which][better]
        self.score[at], self.position[at] = score[better], position[better]


@dataclass(frozen=True, eq=False)
class ScanResult:
    """What a scan of one data set found at every position.

    Parameters
    ----------
    contrast, sigma : (n_positions,) float array
        Best contrast, the same in every band and at rest, and its error.
    gain : (n_positions,) float array
        Largest gain in χ², for positive contrasts.
    tail : (n_positions, width − 2) float array
        Contrasts and rates that gain so much.
    n_contrasts : int
    """

    contrast: FloatArray
    sigma: FloatArray
    gain: FloatArray
    tail: FloatArray
    n_contrasts: int = 1

    @property
    def contrasts(self) -> FloatArray:
        """Contrasts of the largest gain, (n_positions, n_contrasts)."""
        return self.tail[:, : self.n_contrasts]

    def bounded(self, at: IntArray) -> FloatArray:
        """Contrasts, cut off at 0 and 1, and rates at some positions."""
        tail = self.tail[at]
        tail[:, : self.n_contrasts] = np.clip(tail[:, : self.n_contrasts], 0.0, 1.0)
        return tail

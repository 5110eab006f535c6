"""Whitened data in the order of their channels, and turned so that a common error is one row."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from amibayes.data.observables import Observables
from amibayes.data.setup import rows_of_exposures
from amibayes.likelihood.smooth_basis import SmoothBasis, smooth_basis
from amibayes.units import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class ChannelLayout:
    """Which whitened rows are the channels of one baseline, or triangles, of one exposure.

    Those of both polarisations: they have the calibrator and the atmosphere in common. Arrays are
    sorted by group, by polarisation and by channel within a group.

    Parameters
    ----------
    order : (rank,) int array
        Where each stands in the whitened data.
    group : (rank,) int array
        Numbered from 0.
    gap : (rank,) float array
        Channels since the one before in its group; infinite for the first one, and `APART` for the
        first one of another polarisation.
    weight : (rank,) float array
        Shape of the common error in units of the errors, of unit mean square in each group.
    unit : (rank,) float array
        Root mean square of that shape in its group, before: V² (or a radian) in errors.
    amplitude : (rank,) float array
        Root mean square in the group of the change by a coherent error of the visibility, in
        errors.
    datum, place : (rank,) int array
        First of the data that a row is made of, and which of the combinations of these it is.
    stated : (rank,) bool array
        Rows whose data are of several channels or kinds: their correlations are stated.
    vis2 : (rank,) bool array
        Rows of V².
    source : (rank,) int array
        File that a row comes from, an index into ``names``.
    names : tuple of str
    """

    order: IntArray
    group: IntArray
    gap: FloatArray
    weight: FloatArray
    unit: FloatArray
    amplitude: FloatArray
    datum: IntArray
    place: IntArray
    stated: BoolArray
    vis2: BoolArray
    source: IntArray
    names: tuple[str, ...]

    @property
    def starts(self) -> BoolArray:
        """First rows of the groups, (rank,)."""
        return np.isinf(self.gap)

    @cached_property
    def count(self) -> IntArray:
        """Number of rows of each group."""
        return np.bincount(self.group)

    @property
    def any(self) -> bool:
        """Whether there is a group of several channels."""
        return bool(len(self.count) and self.count.max() > 1)

    def changes(self, which: tuple[bool, bool]) -> FloatArray:
        """Errors that change across the channels of each group, (n, rank): slope, and curves.

        Orthonormal; 0 where a group has none.
        """
        rows, n = self._plain, len(self.order)
        place = np.arange(n) - np.flatnonzero(self.starts)[self.group]
        wanted = [level for level, one in zip((SLOPE, CURVE), which, strict=True) if one]
        level = rows.level[self.order]
        turn = csr_array(rows.rotation[self.order][:, self.order])
        found = [
            turn.T @ ((level == own) & (place == k)).astype(float)
            for own in wanted
            for k in np.unique(place[level == own])
        ]
        return np.array(found).reshape(-1, n)

    @cached_property
    def _plain(self) -> ChannelRows:
        """Rows of channels that share nothing."""
        n = np.zeros(len(self.order))
        return self.turned(n, n, np.zeros((2, len(n))), np.zeros((3, len(n))))

    @cached_property
    def _bases(self) -> list[tuple[IntArray, SmoothBasis]]:
        """Where groups of several rows are, (n_groups, n), and bases of these: groups alike as one.

        Kept, since they are asked for with every share that is tried.
        """
        spectra = np.flatnonzero(self.starts | (self.gap == APART))
        lengths = np.diff(spectra, append=len(self.order))
        alike: dict[tuple[int, ...], list[int]] = {}
        for _, own in groupby(range(len(spectra)), lambda k: self.group[spectra[k]]):
            parts = list(own)
            alike.setdefault(tuple(lengths[parts].tolist()), []).append(int(spectra[parts[0]]))
        places = {
            own: np.array(firsts)[:, None] + np.arange(sum(own))
            for own, firsts in alike.items()
            if sum(own) > 1
        }
        return [(at, smooth_basis(self.weight[at], own)) for own, at in places.items()]

    def sums(self, values: FloatArray) -> FloatArray:
        """Sums of (rank, …) over the groups, (n_groups, …)."""
        at = np.flatnonzero(self.starts)
        return np.asarray(np.add.reduceat(values, at, axis=0))

    def innovations(self, values: FloatArray, neighbour: FloatArray) -> FloatArray:
        """Differences of sorted rows (rank, …) to what their neighbour predicts, of unit variance.

        (x_i − φ^Δ x_{i−1})/√(1 − φ^{2Δ}) of a correlation φ^Δ between channels Δ apart.
        """
        back = self._back(neighbour)
        before = np.roll(values, 1, axis=0)
        shape = (-1,) + (1,) * (values.ndim - 1)
        scale = np.sqrt(1.0 - back**2).reshape(shape)
        return np.asarray((values - back.reshape(shape) * before) / scale)

    def _back(self, neighbour: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.where(
                self.starts, 0.0, np.power(neighbour, np.where(self.starts, 1, self.gap))
            )

    def turned(
        self, common: FloatArray, neighbour: FloatArray, further: FloatArray, smooth: FloatArray
    ) -> ChannelRows:
        """Rows for shares ρ, correlations φ (rank,) and variances of further errors (2, rank).

        Of these the first is common to the channels and the second changes across them, in units
        of the errors; ``smooth`` (3, rank) are those of offset, slope and curves that no floor has.
        All are sorted likewise.
        """
        n = len(self.order)
        variance, level, added = np.ones(n), np.zeros(n, dtype=np.intp), further.sum(axis=0)
        # A floor says that exposures are too few to tell: no errors then shrink by a fit. Nor
        # do they where smooth errors are beside them, and not a share of them.
        beside = added + smooth.sum(axis=0) > 0.0
        single = np.flatnonzero(self.count[self.group] == 1)
        rows, columns, values = [single], [single], [np.ones(len(single))]
        for at, basis in self._bases:
            first, count = at[:, 0], at.shape[1]
            rows.append(at[:, basis.row].ravel())
            columns.append(at[:, basis.column].ravel())
            values.append(basis.value.ravel())
            # Differences of neighbours are never trusted more than independent channels are:
            # what makes neighbours alike (overlap on the detector) blurs the signal there too.
            rest = np.maximum(basis.variance(neighbour[first]), 1.0)
            rest *= 1.0 - common[first, None]
            variance[at] = np.where(beside[first, None], np.maximum(rest, 1.0), rest)
            variance[first] += common[first] * count
            added[at] = further[1, first, None] * basis.slope_share
            added[first] += further[0, first] * count
            if basis.slope:
                level[at[:, :2]] = OFFSET, SLOPE
                level[at[:, basis.curves]] = CURVE
        variance += added
        for own, size in zip((OFFSET, SLOPE, CURVE), smooth, strict=True):
            here = (level == own).astype(float)
            number = np.maximum(self.sums(here), 1.0)
            variance += here * size * (self.count / number)[self.group]
        places = tuple(self.order[np.concatenate(p)] for p in (rows, columns))
        return ChannelRows(
            csr_array((np.concatenate(values), places), shape=(n, n)),
            self._unsorted(np.sqrt(variance)),
            self._unsorted(level),
            self._unsorted(added),
        )

    def _unsorted(self, values: NDArray[Any]) -> NDArray[Any]:
        out = np.empty_like(values)
        out[self.order] = values
        return out


@dataclass(frozen=True, eq=False)
class ChannelRows:
    """Whitened data turned to rows that are independent where their channels are not.

    Parameters
    ----------
    rotation : (rank, rank) sparse array
        Orthonormal; the first row of each group is along its common error.
    sigma : (rank,) float array
        Standard deviation of the rows.
    level : (rank,) int array
        `OFFSET` of rows along an error that is common to the channels, `SLOPE` of those along one
        that changes evenly across them, `CURVE` of curves over all of them, 0 of all others.
    floor : (rank,) float array
        Variance by further errors.
    apart : ChannelRows, optional
        The rows as they were before those that exposures share were turned.
    """

    rotation: csr_array
    sigma: FloatArray
    level: IntArray
    floor: FloatArray
    apart: ChannelRows | None = None

    @property
    def growing(self) -> FloatArray:
        """Share of the variance (rank,) that grows with the size of the errors: no floor does."""
        apart = self.apart or self
        own = 1.0 - apart.floor / apart.sigma**2
        if self.apart is None:
            return own
        return np.asarray(csr_array(self.rotation @ apart.rotation.T).power(2) @ own)

    def part(self, inside: BoolArray) -> ChannelRows:
        """Those of some of the whitened data (rank,), which share nothing with the others."""
        return ChannelRows(
            csr_array(self.rotation[inside][:, inside]),
            self.sigma[inside],
            self.level[inside],
            self.floor[inside],
            None if self.apart is None else self.apart.part(inside),
        )


OFFSET, SLOPE, CURVE = 1, 2, 3

APART = 1e9
"""Channels between those of two polarisations: no noise of neighbours reaches so far."""


def independent_rows(n: int) -> ChannelRows:
    """Whitened data (n,) as they are."""
    one = np.ones(n)
    unit = csr_array((one, (np.arange(n), np.arange(n))), shape=(n, n))
    return ChannelRows(unit, one, np.zeros(n, dtype=np.intp), np.zeros(n))


def channel_layout(data: Observables) -> ChannelLayout:
    """Find the rows that are channels of one exposure, in data whitened by their covariance.

    Parameters
    ----------
    data : Observables
        Unflagged, in independent channels. Data that a block correlates across channels, or
        across kinds, already have their correlations stated: they are groups of one.
    """
    group, weight, first, place, stated = _labelled(data)
    setup, channel = (
        np.concatenate([getattr(m, name) for m in (data.vis2, data.closure_phase)])[first]
        for name in ("setup", "channel")
    )
    order = np.lexsort((channel, setup, group))
    group, channel, weight, first = group[order], channel[order], weight[order], first[order]
    setup = setup[order]
    begins = np.append(True, np.diff(group) != 0)[: len(group)]
    group = np.cumsum(begins) - 1
    gap = np.where(np.diff(setup, prepend=-1) == 0, np.diff(channel, prepend=0), APART)
    gap = np.where(begins, np.inf, gap)
    count = np.maximum(np.bincount(group), 1)
    mean = np.bincount(group, weight**2) / count
    slope = np.bincount(group, _amplitudes(data)[first] ** 2) / count
    names = tuple(sorted({s.source for s in data.setups}))
    of_setup = np.array([names.index(s.source) for s in data.setups], dtype=np.intp)
    return ChannelLayout(
        order,
        group,
        gap,
        weight / np.sqrt(mean[group]),
        np.sqrt(mean[group]),
        np.sqrt(slope[group]),
        first,
        place[order],
        stated[order],
        first < data.n_vis2,
        of_setup[setup],
        names,
    )


def _amplitudes(data: Observables) -> FloatArray:
    """Change by a coherent error of the visibility, in units of the errors, (n_data,).

    Without a fit: 2|V| of V², not below its noise; 0 of closure phases.
    """
    sigma = np.sqrt(data.covariance.variance)
    n = data.n_vis2
    vis2, closure = data.vis2.coherent_slope, data.closure_phase.coherent_slope
    if vis2 is None:
        vis2 = 2.0 * np.sqrt(np.maximum(_pattern(data), sigma[:n]))
    if closure is None:
        closure = np.zeros(data.n_closure_phases)
    return np.asarray(np.concatenate([vis2, closure]) / sigma)


def _pattern(data: Observables) -> FloatArray:
    """V² as a fit expects them, (n_vis2,): the measured ones have noise of their own."""
    expected = data.vis2.expected
    return np.abs(data.vis2.value if expected is None else expected)


def _labelled(data: Observables) -> tuple[IntArray, FloatArray, IntArray, IntArray, BoolArray]:
    """Group of each whitened row, shape of its common error, first datum, combination, stated."""
    n_vis2 = data.n_vis2
    tables = data.vis2, data.closure_phase
    row = np.concatenate([rows_of_exposures(data.setups, m) for m in tables])
    channel = np.concatenate([m.channel for m in tables])
    sigma = np.sqrt(data.covariance.variance)
    # The pattern of a gain is V² itself, not below its noise; that of an offset is flat.
    shape = np.ones(len(sigma))
    shape[:n_vis2] = np.maximum(_pattern(data), sigma[:n_vis2])
    vis2, strength = np.arange(len(sigma)) < n_vis2, np.log(shape / sigma)
    kinds = vis2.astype(np.intp)
    groups, firsts, weights = [np.empty(0, np.intp)], [np.empty(0, np.intp)], [np.empty(0)]
    places, stated = [np.empty(0, np.intp)], [np.empty(0, bool)]
    used = 0
    for stack in data.covariance.stacks:
        inside, rank = stack.index, stack.shape[1]
        key = np.concatenate([kinds[inside[:, :1]], row[inside]], axis=1)
        same = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1, 1)
        alike = (channel[inside] == channel[inside[:, :1]]) & (vis2[inside] == vis2[inside[:, :1]])
        # Rows of one exposure and kind, one of each channel; of a block of several, each alone.
        own = np.arange(len(inside) * rank).reshape(-1, rank)
        shared = same * rank + np.arange(rank)
        label = np.where(alike.all(axis=1)[:, None], shared, own + own.size)
        groups.append(used + label.ravel())
        used += 2 * own.size
        firsts.append(np.repeat(inside[:, 0], rank))
        weights.append(np.repeat(np.exp(strength[inside].mean(axis=1)), rank))
        places.append(np.tile(np.arange(rank), len(inside)))
        stated.append(np.repeat(~alike.all(axis=1), rank))
    return (
        np.concatenate(groups), np.concatenate(weights), np.concatenate(firsts),
        np.concatenate(places), np.concatenate(stated),
    )  # fmt: skip

"""Errors that exposures which follow each other share: a transfer function that drifts.

Gains of baselines and offsets of closure phases change over minutes to hours. Exposures of
one night then err alike, as light of a companion does. Of what is common to the channels of an
exposure, a share κ of the variance is correlated by exp(−Δt/τ) between exposures of the same
baseline (or combination of triangles). κ and τ have a posterior by restricted likelihood; a
covariance has its mean over that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from amibayes.data.closure import canonical
from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.setup import without_polarisation
from amibayes.likelihood.channel_rows import ChannelLayout, ChannelRows
from amibayes.likelihood.chi2 import restricted_loss
from amibayes.units import FloatArray, IntArray

HOURS = np.array([0.25, 0.5, 1.0, 2.0, 4.0, 8.0])
"""Nodes of τ: from the time between exposures to a night."""

SHARES = np.linspace(0.0, 0.95, 20)
"""Nodes of κ."""

PRIOR_INDEPENDENT = 0.5
"""Prior probability of κ = 0: even odds, as for extra noise. The rest is uniform."""

NIGHT_HOURS = 12.0
"""Exposures farther apart than this begin another series."""

LONGEST = 256
"""Exposures of a series: of more, each part by itself."""


@dataclass(frozen=True, eq=False)
class Series:
    """Exposures of one baseline, or combination of triangles, in one night.

    Parameters
    ----------
    rows : (n,) int array
        What is common to the channels of each, among whitened data.
    hours : (n,) float array
    source : str
        File that they come from.
    vis2 : bool
        Of V², or of closure phases.
    """

    rows: IntArray
    hours: FloatArray
    source: str
    vis2: bool

    def correlation(self, share: FloatArray, tau: FloatArray) -> FloatArray:
        """Correlations (..., n, n) of exposures for κ and τ (...), hours."""
        share, tau = share[..., None, None], tau[..., None, None]
        apart = np.abs(self.hours[:, None] - self.hours)
        return np.asarray(share * np.exp(-apart / tau) + (1.0 - share) * np.eye(len(self.rows)))

    def mean_correlation(self, lasting: Sequence[float]) -> FloatArray:
        """Its mean over a posterior; see `Drift.lasting`."""
        whole = self.correlation(np.ones(len(HOURS)), HOURS)
        return np.tensordot(lasting, whole, 1) + (1.0 - sum(lasting)) * np.eye(len(self.rows))


@dataclass(frozen=True, eq=False)
class Drift:
    """Posterior of what exposures of one kind of observable share.

    Parameters
    ----------
    mass : (n_hours, n_shares) float array
        Of the nodes `HOURS` and `SHARES`.
    """

    mass: FloatArray

    @property
    def share(self) -> tuple[float, float]:
        """Mean and standard deviation of κ."""
        weight = self.mass.sum(axis=0)
        mean = float(weight @ SHARES)
        return mean, float(np.sqrt(weight @ (SHARES - mean) ** 2))

    @property
    def hours(self) -> float:
        """Median of τ where something is shared."""
        some = np.cumsum(self.mass[:, 1:].sum(axis=1))
        return float(HOURS[np.searchsorted(some, 0.5 * some[-1])])

    @property
    def lasting(self) -> tuple[float, ...]:
        """Mean share of the variance that lasts for each of `HOURS`."""
        return tuple((self.mass @ SHARES).tolist())

    def nodes(self, n: int) -> FloatArray:
        """κ and τ of equal probability, (2, n), from the least κ to the largest."""
        order = np.argsort(np.tile(SHARES, len(HOURS)), kind="stable")
        cumulative = np.cumsum(self.mass.ravel()[order])
        at = order[np.searchsorted(cumulative, (np.arange(n) + 0.5) / n * cumulative[-1])]
        return np.array([SHARES[at % len(SHARES)], HOURS[at // len(SHARES)]])


def series_of(data: Observables, layout: ChannelLayout) -> tuple[Series, ...]:
    """Exposures of the same baselines or triangles, of unflagged data.

    None of data whose covariance was estimated from scatter, or states correlations of channels.
    """
    if data.freedom is not None:
        return ()
    setup, mjd = (
        np.concatenate([getattr(m, name) for m in (data.vis2, data.closure_phase)])
        for name in ("setup", "mjd")
    )
    at = layout.starts & ~layout.stated & np.isfinite(mjd[layout.datum])
    names = _names(data, layout.datum[at])
    of: dict[tuple[object, ...], list[tuple[float, int]]] = {}
    rows_of_data = zip(layout.order[at], layout.datum[at], names, layout.place[at], strict=True)
    for row, datum, name, place in rows_of_data:
        own, vis2 = data.setups[setup[datum]], bool(datum < data.n_vis2)
        key = own.source, vis2, without_polarisation(own.insname), name, int(place)
        of.setdefault(key, []).append((24.0 * float(mjd[datum]), int(row)))
    found = []
    for (source, kind, *_), members in of.items():
        hours, rows = map(np.array, zip(*sorted(members), strict=True))
        cuts = np.flatnonzero(np.diff(hours) > NIGHT_HOURS) + 1
        for part in np.split(np.arange(len(rows)), cuts):
            found += [
                Series(rows[few], hours[few], str(source), bool(kind))
                for few in np.array_split(part, 1 + len(part) // LONGEST)
                if len(few) > 1
            ]
    return tuple(found)


def _names(data: Observables, which: IntArray) -> list[tuple[object, ...]]:
    """What some data are of, whatever the order of rows and stations in a file.

    Triangles that share baselines are one: their combinations do not depend on the order, nor on
    the sense of each. One that stands alone changes its sign with its sense.
    """
    n, closure = data.n_vis2, data.closure_phase
    together = data.covariance_kind == "assumed"
    of_set = np.empty(len(closure), dtype=np.intp)
    numbers: dict[frozenset[tuple[object, ...]], int] = {}
    for entries in closure.sets if together else ():
        # A number for its triangles, which are hundreds where holes are many.
        triangles = frozenset(_named(data, closure, i) for i in entries.tolist())
        of_set[entries] = numbers.setdefault(triangles, len(numbers))

    def name(k: int) -> tuple[object, ...]:
        if k < n:
            return _named(data, data.vis2, k)
        if together:
            return (int(of_set[k - n]),)
        sign = canonical(closure.stations[k - n : k - n + 1])[1]
        return (*_named(data, closure, k - n), int(sign[0]))

    return [name(k) for k in which.tolist()]


def _named(data: Observables, table: Measurements, k: int) -> tuple[object, ...]:
    """Names of the stations of a row, in order."""
    own = data.setups[table.setup[k]].stations
    return tuple(sorted(own[i] for i in table.stations[k]))


@dataclass(frozen=True, eq=False)
class _Node:
    """What exposures that share noise of one τ are independent in.

    Parameters
    ----------
    stacks : list of (rows (m, n), vectors (m, n, n))
        Eigenvectors of exp(−Δt/τ) of series that are as long as each other.
    precision : (n_shares, n_rows) float array
        Inverse variances along them, of all stacks, for `SHARES`.
    logdet : (n_shares,) float array
        Of the covariances.
    """

    stacks: list[tuple[IntArray, FloatArray]]
    precision: FloatArray
    logdet: FloatArray

    def along(self, white: FloatArray) -> FloatArray:
        """Whitened data (n_independent, n) along the eigenvectors, (n_rows, n)."""
        turned = [vectors.swapaxes(1, 2) @ white[rows] for rows, vectors in self.stacks]
        return np.concatenate([part.reshape(-1, white.shape[1]) for part in turned])


@dataclass(frozen=True, eq=False)
class SeriesAxes:
    """Eigenvalues and eigenvectors of exp(−Δt/τ) of some series, at every node of τ.

    Parameters
    ----------
    nodes : tuple of _Node
        One of each of `HOURS`.
    """

    nodes: tuple[_Node, ...]

    @classmethod
    def of(cls, series: Sequence[Series]) -> SeriesAxes:
        """Find them; of at least one series."""
        lengths = sorted({len(one.rows) for one in series})
        alike = [[one for one in series if len(one.rows) == n] for n in lengths]
        rows = [np.array([one.rows for one in few]) for few in alike]
        hours = [np.array([one.hours for one in few]) for few in alike]
        apart = [np.abs(when[:, :, None] - when[:, None]) for when in hours]
        nodes = []
        for tau in HOURS:
            values, vectors = zip(*(np.linalg.eigh(np.exp(-dt / tau)) for dt in apart), strict=True)
            size = np.concatenate([one.ravel() for one in values])
            variance = 1.0 + SHARES[:, None] * (size - 1.0)
            stacks = list(zip(rows, vectors, strict=True))
            nodes.append(_Node(stacks, 1.0 / variance, np.log(variance).sum(axis=1)))
        return cls(tuple(nodes))


@dataclass(frozen=True, eq=False)
class SeriesStack:
    """Series as long as each other.

    Parameters
    ----------
    rows : (m, n) int array
    lasting : (n_hours, m, n, n) float array
        Covariance of their rows where these share all that lasts for each of `HOURS`.
    apart : (m, n, n) float array
        The same where they share nothing.
    """

    rows: IntArray
    lasting: FloatArray
    apart: FloatArray

    @classmethod
    def of(cls, series: Sequence[Series], sizes: FloatArray) -> SeriesStack:
        """Of standard deviations of rows, (n_sizes, n_rows), of equal probability."""
        rows = np.array([one.rows for one in series])
        own = sizes[:, rows]
        square = np.einsum("kmi,kmj->mij", own, own) / len(sizes)
        every = np.array([one.correlation(np.ones(len(HOURS)), HOURS) for one in series])
        return cls(rows, every.swapaxes(0, 1) * square, square * np.eye(rows.shape[1]))

    def covariance(self, lasting: Sequence[float]) -> FloatArray:
        """Mean covariances (m, n, n) over a posterior; see `Drift.lasting`."""
        return np.tensordot(lasting, self.lasting, 1) + (1.0 - sum(lasting)) * self.apart


def drift_of(axes: SeriesAxes, both: FloatArray) -> Drift:
    """Posterior of κ and τ by restricted likelihood.

    Parameters
    ----------
    axes : SeriesAxes
    both : (n_independent, 1 + n_dim) float array
        Whitened residual of a fit, and slopes of its parameters.
    """
    along = [node.along(both) for node in axes.nodes]
    product = [
        (own.T * node.precision[:, None]) @ own for own, node in zip(along, axes.nodes, strict=True)
    ]
    logdet = np.array([node.logdet for node in axes.nodes])
    loss = restricted_loss(np.array(product), len(along[0]), logdet)
    prior = np.full(len(SHARES), (1.0 - PRIOR_INDEPENDENT) / (len(SHARES) - 1))
    prior[0] = PRIOR_INDEPENDENT
    mass = np.exp(-0.5 * (loss - loss.min())) * prior
    return Drift(mass / mass.sum())


@dataclass(frozen=True, eq=False)
class Axes:
    """Eigenvalues (n,) and eigenvectors (n, n) of the covariance of some rows."""

    rows: IntArray
    values: FloatArray
    vectors: FloatArray


def turned_rows(
    rows: ChannelRows, correlated: Sequence[tuple[Series, FloatArray]]
) -> tuple[ChannelRows, list[Axes]]:
    """Turn rows that exposures share to independent ones.

    Parameters
    ----------
    rows : ChannelRows
    correlated : sequence of (Series, (n, n) float array)
        Exposures, and the correlation of what is common to the channels of each.

    Returns
    -------
    ChannelRows
    list of Axes
        Of the covariance of each series.
    """
    if not correlated:
        return rows, []
    sigma, axes = np.array(rows.sigma), []
    for one, correlation in correlated:
        own = rows.sigma[one.rows]
        values, vectors = np.linalg.eigh(correlation * np.outer(own, own))
        axes.append(Axes(one.rows, values, vectors))
        sigma[one.rows] = np.sqrt(values)
    turn = _placed([(a.rows, a.vectors.T) for a in axes], len(sigma))
    turned = csr_array(turn @ rows.rotation)
    return replace(rows, rotation=turned, sigma=sigma, apart=rows.apart or rows), axes


def _placed(blocks: Sequence[tuple[IntArray, FloatArray]], n: int) -> csr_array:
    """A matrix (n, n) with blocks at some rows, and 1 on the rest of its diagonal."""
    rest = np.setdiff1d(np.arange(n), np.concatenate([rows for rows, _ in blocks]))
    row = np.concatenate([rest, *(np.repeat(rows, len(rows)) for rows, _ in blocks)])
    column = np.concatenate([rest, *(np.tile(rows, len(rows)) for rows, _ in blocks)])
    value = np.concatenate([np.ones(len(rest)), *(block.ravel() for _, block in blocks)])
    return csr_array((value, (row, column)), shape=(n, n))

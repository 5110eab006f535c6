"""Errors that the channels of one exposure share, as calibration and detector leave them.

The transfer function errs in all channels of an exposure at once: a gain of V² for each
baseline, an offset of the closure phases for each triangle, by way of the baselines that the
triangles share. Neighbouring channels share more: their light overlaps on the detector, and
the atmosphere's errors are smooth in wavelength. In data whitened by their own errors, the
channels of one baseline (or of one combination of triangles) of one exposure then have the
covariance

    (1 − ρ) φ^|i−j| + ρ w_i w_j,

w the shape of the gain or offset in units of the errors (of unit mean square), ρ the share of
the variance that is common to all, φ the correlation of neighbours in the rest. ρ and φ are
fitted with that covariance. For the data it is made diagonal by a rotation with w as its first
axis, a slope of w across the channels as its second, and details of ever shorter ranges of
channels as the others (multiwavelets): exact for φ = 0, and close for others. It has n log n
entries, so that thousands of channels cost no more than a few passes over the data, where an
inverse would cost n³.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from amibayes.data.blocks import Block, BlockCovariance, orthonormal
from amibayes.data.covariance import Covariance, multiplied
from amibayes.data.observables import Observables
from amibayes.data.systematics import Systematics
from amibayes.likelihood.channel_rows import APART, ChannelLayout, ChannelRows, channel_layout
from amibayes.likelihood.chi2 import restricted_loss, touched
from amibayes.likelihood.exposure_rows import series_of, turned_rows
from amibayes.likelihood.noise import GaussianNoise, NoiseModel, noise_of
from amibayes.units import FloatArray, IntArray

COMMON = 0.99 * np.linspace(0.0, 1.0, 34)
"""Nodes of ρ: steps of 0.03, finer than what a hundred exposures can tell."""

NEIGHBOUR = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95])
"""Nodes of φ."""


@dataclass(frozen=True)
class Correlation:
    """What channels of an exposure share of the noise of one kind of observable.

    Parameters
    ----------
    common : float
        ρ, the share of the variance that is common to all channels.
    neighbour : float
        φ, the correlation of neighbouring channels in the rest.
    value, error : float
        Correlation of neighbouring channels in all, ρ + (1 − ρ)φ, and its standard
        deviation; NaN where no exposure has two channels.
    offset, slope : float
        Variance of what the floor has in common to all channels, and in changes across them, in
        units of the floor's: more than 1 where residuals show more.
    lasting : tuple of float
        Share of what is common to the channels that exposures which follow each other have in
        common too, for each of `amibayes.likelihood.exposure_rows.HOURS`; empty where no
        baseline was observed twice in a night.
    smooth : (float, float, float)
        Variance of errors that are common to the channels, change evenly across them, and by a
        curve, in units of the errors: what residuals show beyond ρ and φ, where no floor has them.
    """

    common: float = 0.0
    neighbour: float = 0.0
    value: float = 0.0
    error: float = float("nan")
    offset: float = 1.0
    slope: float = 1.0
    lasting: tuple[float, ...] = ()
    smooth: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def any(self) -> bool:
        """Whether anything is shared, by channels or by exposures."""
        return self.value + sum(self.smooth) + sum(self.lasting) > 0.0


@dataclass(frozen=True)
class ChannelShare:
    """The correlations of one file, or of all where files are not told apart."""

    vis2: Correlation = Correlation()
    closure_phase: Correlation = Correlation()
    source: str = ""


def share_of(shares: Sequence[ChannelShare], source: str) -> ChannelShare:
    """The correlations of one file: its own, or those of all."""
    by_file = {s.source: s for s in shares}
    return by_file.get(source) or by_file.get("") or ChannelShare()


class ChannelCovariance:
    """A covariance with correlations between the channels of each exposure.

    Parameters
    ----------
    base : BlockCovariance
        Of channels that are independent.
    rows : ChannelRows
        Of ``base``.
    """

    def __init__(self, base: BlockCovariance, rows: ChannelRows) -> None:
        self.base, self.rows = base, rows

    @property
    def size(self) -> int:
        """Length of the data vector."""
        return self.base.size

    @property
    def rank(self) -> int:
        """Number of independent combinations."""
        return self.base.rank

    @cached_property
    def _turn(self) -> csr_array:
        """What is done to data that the base has whitened, (rank, rank)."""
        return csr_array(diags_array(1.0 / self.rows.sigma) @ self.rows.rotation)

    @cached_property
    def whitening(self) -> csr_array:
        """The sparse matrix W, (rank, size), with W C Wᵀ = 1."""
        return csr_array(self._turn @ self.base.whitening)

    @cached_property
    def factors(self) -> tuple[csr_array, ...]:
        """Sparse matrices whose product is the whitening, the first applied last.

        Two where they hold fewer numbers than their product: that mixes the triangles of every
        channel with those of all others.
        """
        base = self.base.whitening
        product = int(np.diff(base.indptr)[self._turn.indices].sum())
        if self._turn.nnz + base.nnz < product:
            return self._turn, base
        return (self.whitening,)

    @cached_property
    def _colouring(self) -> Any:
        turned = self.rows.rotation.T @ diags_array(self.rows.sigma)
        return self.base.colouring @ turned

    @property
    def variance(self) -> FloatArray:
        """Diagonal of the matrix, (size,)."""
        return np.asarray(csr_array(self._colouring).power(2).sum(axis=1)).ravel()

    def whiten(self, x: FloatArray) -> FloatArray:
        """Independent, unit-variance combinations, (rank, …)."""
        if self.base.has_large_blocks:
            return np.asarray(self._turn @ self.base.whiten(x))
        return multiplied(self.factors, x)

    def solve(self, x: FloatArray) -> FloatArray:
        """(Pseudo-)inverse of the covariance times x, (size, …)."""
        return multiplied(self._unwhitening, multiplied(self.factors, x))

    @cached_property
    def _unwhitening(self) -> tuple[csr_array, ...]:
        return tuple(csr_array(factor.T) for factor in reversed(self.factors))

    def logdet(self) -> float:
        """Logarithm of the determinant of the covariance of the independent combinations."""
        return self.base.logdet() + 2.0 * float(np.log(self.rows.sigma).sum())

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Noise vectors, (size, n)."""
        return np.asarray(self._colouring @ rng.standard_normal((self.rank, n)))

    def dense(self) -> FloatArray:
        """The full matrix, (size, size)."""
        colour = csr_array(self._colouring)
        return np.asarray((colour @ colour.T).toarray())

    @cached_property
    def symmetric(self) -> csr_array:
        """Rows (size, rank) of the symmetric whitening; see `Covariance.symmetric`."""
        return csr_array(self.base.symmetric @ self.rows.rotation.T)

    def select(self, keep: IntArray) -> Covariance:
        """Covariance of the entries ``keep``, in that order."""
        inside, beyond = touched(self.base, keep)
        links = abs(self.rows.rotation[inside]) @ (~inside).astype(float)
        if (np.diff(keep) > 0).all() and not ((inside & beyond).any() or links.any()):
            # They share no noise with others: what is turned for all is turned for them alone.
            return ChannelCovariance(self.base.select(keep), self.rows.part(inside))
        colour = csr_array(csr_array(self._colouring)[keep])
        shared = csr_array(abs(colour) @ abs(colour).T)
        count, label = connected_components(shared, directed=False)
        order = np.argsort(label, kind="stable")
        blocks = np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
        return BlockCovariance(len(keep), [_block(colour, at) for at in blocks])


def _block(colouring: csr_array, at: IntArray) -> Block:
    """The entries ``at`` of a covariance A Aᵀ that share no noise with the others."""
    rows = csr_array(colouring[at])
    dense = csr_array(rows[:, np.unique(rows.indices)]).toarray()
    return Block(at, dense @ dense.T, orthonormal(dense))


def channel_rows(
    layout: ChannelLayout, shares: Sequence[ChannelShare], floors: Sequence[Systematics] = ()
) -> ChannelRows:
    """Rows of channels that are correlated as the shares and floors of their files say."""
    common, neighbour = np.zeros(len(layout.order)), np.zeros(len(layout.order))
    growth, smooth = np.ones((2, len(layout.order))), np.zeros((3, len(layout.order)))
    for k, name in enumerate(layout.names):
        share = share_of(shares, name)
        for kind, found in ((layout.vis2, share.vis2), (~layout.vis2, share.closure_phase)):
            here = (layout.source == k) & kind
            common[here], neighbour[here] = found.common, found.neighbour
            growth[:, here] = np.array([[found.offset], [found.slope]])
            smooth[:, here] = np.array(found.smooth)[:, None]
    # Half of it is common to all channels, half changes: calibrations err in either way.
    further = 0.5 * growth * floor_of_rows(layout, floors)
    return layout.turned(common, neighbour, further, smooth)


def floor_of_rows(layout: ChannelLayout, floors: Sequence[Systematics]) -> FloatArray:
    """Variance by the floors of every row, in its errors, (rank,), sorted as the layout."""
    out = np.zeros(len(layout.order))
    for floor in floors:
        here = layout.source == layout.names.index(floor.source)
        gain = np.where(layout.vis2, floor.vis2, floor.closure_phase_rad) * layout.unit
        coherent = floor.visibility * layout.amplitude
        # Closure phases of bright fringes have their floor from the same coherent errors.
        both = np.where(layout.vis2, gain**2 + coherent**2, np.maximum(gain, coherent) ** 2)
        out[here] = both[here]
    return out


def noise_with_channels(
    data: Observables, shares: Sequence[ChannelShare], floors: Sequence[Systematics] = ()
) -> NoiseModel:
    """The noise of unflagged data whose channels share some of it.

    A covariance that was estimated from scatter holds what channels share already.
    """
    if not (shares or floors) or data.freedom is not None:
        return noise_of(data)
    layout = channel_layout(data)
    lasting = any(sum(c.lasting) > 0.0 for s in shares for c in (s.vis2, s.closure_phase))
    if not (layout.any or floors or lasting):
        return noise_of(data)
    return noise_with_rows(data, noise_rows(data, layout, shares, floors), floor=bool(floors))


def noise_with_rows(data: Observables, rows: ChannelRows | None, *, floor: bool) -> GaussianNoise:
    """The noise of unflagged data that are turned to known rows; ``floor`` as `GaussianNoise`'s."""
    stated = data.covariance
    covariance = stated if rows is None else ChannelCovariance(stated, rows)
    return GaussianNoise(covariance, rows=rows, floor=floor)


def noise_rows(
    data: Observables,
    layout: ChannelLayout,
    shares: Sequence[ChannelShare],
    floors: Sequence[Systematics] = (),
) -> ChannelRows:
    """Independent rows of channels and exposures that share what their files' shares say."""
    rows, correlated = channel_rows(layout, shares, floors), []
    if any(share.vis2.lasting or share.closure_phase.lasting for share in shares):
        for one in series_of(data, layout):
            share = share_of(shares, one.source)
            lasting = (share.vis2 if one.vis2 else share.closure_phase).lasting
            if sum(lasting) > 0.0:
                correlated.append((one, one.mean_correlation(lasting)))
    return turned_rows(rows, correlated)[0] if correlated else rows


def correlation_of(
    layout: ChannelLayout,
    residual: FloatArray,
    jacobian: FloatArray,
    floors: Sequence[Systematics] = (),
    *,
    changing: tuple[bool, bool] = (False, False),
) -> Correlation:
    """Find ρ and φ by restricted likelihood under a uniform prior: their posterior means.

    Parameters
    ----------
    layout : ChannelLayout
        Of data of one kind.
    residual : (rank,) float array
        Of a fit, whitened by independent channels.
    jacobian : (rank, n_dim) float array
        Of its parameters, likewise: they take their share of what is common.
    floors : sequence of Systematics
        What is common for certain.
    changing : (bool, bool)
        Whether exposures have errors that change across channels, of any size: evenly, by a curve.

    Notes
    -----
    The size of the errors is free: only the ratio of common and other variance counts. Means
    and not the most likely values: few exposures tell little, and then half of what could be
    common is taken to be so.
    """
    if not layout.any:
        return Correlation()
    both = np.column_stack([residual, jacobian])[layout.order]
    further = floor_of_rows(layout, floors)
    changes = layout.changes(changing)
    loss = np.array([_losses(layout, both, further, changes, phi) for phi in NEIGHBOUR])
    mass = np.exp(-0.5 * (loss - loss.min())) * _widths(NEIGHBOUR)[:, None]
    mass /= mass.sum()
    value = COMMON + (1.0 - COMMON) * NEIGHBOUR[:, None]
    mean = float((mass * value).sum())
    error = float(np.sqrt((mass * (value - mean) ** 2).sum()))
    common = float(mass.sum(axis=0) @ COMMON)
    return Correlation(common, max((mean - common) / (1.0 - common), 0.0), mean, error)


def _widths(nodes: FloatArray) -> FloatArray:
    """Ranges that unevenly spaced nodes stand for."""
    edges = np.concatenate([nodes[:1], 0.5 * (nodes[1:] + nodes[:-1]), nodes[-1:]])
    return np.diff(edges)


def _losses(
    layout: ChannelLayout, both: FloatArray, further: FloatArray, changes: FloatArray, phi: float
) -> FloatArray:
    """−2 ln of the restricted likelihood at every node of ρ, the scale of errors at its best.

    ``both`` (rank, 1 + n_dim) has residual and slopes of the fit, sorted as the layout; of each of
    the ``changes`` (n, rank) every group may have any amount.
    """
    neighbour = np.full(len(both), phi)
    units: list[FloatArray] = []
    extents = [np.empty(0)]

    def level(values: FloatArray) -> FloatArray:
        """Innovations of values (rank, n) without the changes so far."""
        steps = layout.innovations(values, neighbour)
        for unit in units:
            steps = steps - unit[:, None] * layout.sums(unit[:, None] * steps)[layout.group]
        return steps

    for change in changes:
        across = level(change[:, None])[:, 0]
        extent = layout.sums(across**2)
        units.append(across / np.sqrt(np.where(extent > 0.0, extent, 1.0))[layout.group])
        extents.append(extent[extent > 0.0])
    steps, weight = level(both), level(layout.weight[:, None])[:, 0]
    length = layout.sums(weight**2)
    along = layout.sums(steps * weight[:, None]) / np.sqrt(length)[:, None]
    several = layout.count > 1
    single_row = ~several[layout.group]
    alone = steps[single_row] / np.sqrt(1.0 + further[single_row])[:, None]
    # Half of the floor is a slope, of several channels; the fit of ρ and φ leaves that out.
    sloped = layout.sums((layout.gap < APART).astype(float)) > 0.0
    sure = (np.where(sloped, 0.5, 1.0) * further[layout.starts])[several]
    along, length = along[several], length[several]
    whole = steps[several[layout.group]]
    rest, single = whole.T @ whole - along.T @ along, alone.T @ alone
    free = np.log(np.concatenate(extents))
    n_rest = len(whole) - len(along) - len(free)
    back = layout._back(neighbour)
    log_step = float(np.log1p(-(back**2)).sum())
    each = COMMON[:, None]
    variance = 1.0 - each + (each + sure) * length
    weighted = along.T / variance[:, None] @ along
    product = rest / (1.0 - each[:, None]) + single + weighted
    logdet = log_step + n_rest * np.log1p(-COMMON) + np.log(variance).sum(axis=1) + free.sum()
    return restricted_loss(product, len(both) - len(free), logdet)

"""What exposures share of the noise in a test of no companion.

Null sets of exposures that err independently give a companion too often where a transfer
function drifts (`amibayes.likelihood.exposure_rows`). What a test takes for the drift is what the
residuals of the fit without a companion show: the best companion has taken a part of it. The mean
of the covariance over its posterior weights the data, and null sets are drawn with values
of the posterior: few exposures tell little, and then it is as wide as the prior.

So is the size of calibration errors, which a table has of an instrument on a good night
(`amibayes.data.systematics`): the gains of a few baselines hardly tell what they are that night.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import ndtri

from amibayes.companion_search.reduction import Roots
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.observables import Observables
from amibayes.data.systematics import MIN_EXPOSURES
from amibayes.likelihood.channel_noise import noise_with_rows
from amibayes.likelihood.channel_rows import (
    ChannelLayout,
    ChannelRows,
    channel_layout,
    independent_rows,
)
from amibayes.likelihood.exposure_rows import (
    Axes,
    Drift,
    Series,
    SeriesAxes,
    SeriesStack,
    drift_of,
    series_of,
    turned_rows,
)
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise import GaussianNoise
from amibayes.likelihood.noise_fit import MIN_ROWS
from amibayes.support.evenly import evenly
from amibayes.units import FloatArray

DRAWN, DRAWN_OF_FLOORS = 32, 128
"""Pairs of κ and τ that null sets are drawn with, of equal probability; and with sizes of floors,
whose largest ones make the smallest false-alarm probabilities."""

FLOOR_SPREAD = 0.5
"""Standard deviation of ln of a floor's size: published ones of an instrument differ by factors
of three to five (PIONIER, 3 to 15 % of V²), which is what two of these are to either side."""

FEW_ROWS = 16
"""Rows of one diagonal root: matrices of all rows of many files would fill the memory."""

KNOWN = 0.1
"""Standard deviation of ln of a size below which null sets are drawn with it as it is: thresholds
would move by some hundredths. Two hundred gains tell their size as well."""


@dataclass(frozen=True, eq=False)
class ExposureNoise:
    """Noise that exposures and channels share, and how well it is known.

    Parameters
    ----------
    vis2, closure_phase : Drift or None
        None where no baseline was observed twice in a night.
    noise : GaussianNoise
        With the mean of the covariance over the posterior.
    roots : tuple of Roots
        Of the covariance, whitened by that mean, for values of κ and τ and sizes of floors of
        equal probability.
    """

    vis2: Drift | None
    closure_phase: Drift | None
    noise: GaussianNoise
    roots: tuple[Roots, ...]

    def shared(self, normals: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Let exposures share what they may, of independent unit normals (n_rows, n)."""
        which = rng.integers(len(self.roots), size=normals.shape[1])
        order = np.argsort(which, kind="stable")
        drawn = normals[:, order]
        ends = np.cumsum(np.bincount(which, minlength=len(self.roots)))
        for roots, part in zip(self.roots, np.split(drawn, ends[:-1], axis=1), strict=True):
            for rows, root in roots:
                part[rows] = root @ part[rows]
        out = np.empty_like(drawn)
        out[:, order] = drawn
        return out

    def of_bank(self, bank: TemplateBank) -> ExposureNoise:
        """The same for the rows of a bank."""
        if bank.reduction is None:
            return self
        return replace(self, roots=bank.reduction.roots(self.roots))


def exposure_noise(
    likelihood: Likelihood, single: FloatArray, *, beside: FloatArray | None = None
) -> ExposureNoise | None:
    """Find what exposures share, and how large floors are, from a fit without a companion.

    None where no baseline was observed twice in a night and no calibration errors are known, and
    where the covariance was estimated from scatter.

    Parameters
    ----------
    likelihood : Likelihood
    single : (n_nuisance,) float array
        The fit.
    beside : (n_dim,) float array, optional
        The fit with a companion, in its place: what is left beside one that is known.
    """
    exposures = exposures_of(likelihood)
    if exposures is None:
        return None
    fit = (single_likelihood(likelihood), single) if beside is None else (likelihood, beside)
    drifts = exposures.drifts(*fit)
    turned, axes, each = exposures.turned(*drifts)
    return ExposureNoise(*drifts, exposures.noise_of(turned), exposures.roots(axes, each))


def exposures_of(likelihood: Likelihood) -> Exposures | None:
    """Rows that exposures may share; None as in `exposure_noise`."""
    data = likelihood.observables.unflagged()
    layout, rows = channel_layout(data), likelihood.noise.rows
    if rows is None and layout.any:
        return None  # no row of the whitened data is common to the channels
    rows = independent_rows(len(layout.order)) if rows is None else rows.apart or rows
    series, floor = series_of(data, layout), likelihood.noise.floor
    if not (series or floor):
        return None
    # Long series have large matrices, of which so many would fill the memory.
    many = floor and all(len(one.rows) < MIN_EXPOSURES for one in series)
    sizes = _sizes(rows, layout, DRAWN_OF_FLOORS if many else DRAWN)
    if not (series or np.ptp(sizes, axis=0).any()):
        return None
    return Exposures(data, rows, series, floor, sizes)


@dataclass(frozen=True, eq=False)
class Exposures:
    """Rows of data that exposures may share, and what is known of their size.

    Parameters
    ----------
    data : Observables
        Without what is flagged.
    rows : ChannelRows
        As they are where exposures err independently.
    series : tuple of Series
    floor : bool
        Whether calibration errors are known.
    sizes : (n, rank) float array
        Standard deviations of rows, of equal probability.
    """

    data: Observables
    rows: ChannelRows
    series: tuple[Series, ...]
    floor: bool
    sizes: FloatArray

    @cached_property
    def _mean(self) -> FloatArray:
        """Standard deviations (rank,) of the mean covariance."""
        return np.asarray(np.sqrt((self.sizes**2).mean(axis=0)))

    def noise_of(self, rows: ChannelRows) -> GaussianNoise:
        """Noise whose rows are turned."""
        return noise_with_rows(self.data, rows, floor=self.floor)

    def drifts(
        self, likelihood: Likelihood, theta: FloatArray
    ) -> tuple[Drift | None, Drift | None]:
        """What exposures share of V² and of closure phases, by the residuals of a fit."""
        fit = likelihood.with_noise(self.noise_of(self.rows))
        return self.drifts_in(np.column_stack([fit.residuals(theta)[:, 0], fit.jacobian(theta)]))

    def drifts_in(self, both: FloatArray) -> tuple[Drift | None, Drift | None]:
        """The same of data that are whitened as independent exposures; see `drift_of`."""
        vis2, closure = (None if axes is None else drift_of(axes, both) for axes in self._axes)
        return vis2, closure

    def whitened(self, drifts: tuple[Drift | None, Drift | None], white: FloatArray) -> FloatArray:
        """Whiten data (n_rows, n) by the mean covariance, given as those of `drifts_in` are.

        The mean of exposures is over the posterior itself, not over its nodes.
        """
        out = white / np.sqrt(self._variance)[:, None]
        for kind, stack in self._stacks:
            drift = drifts[0 if kind else 1]
            if drift is not None:
                covariance = stack.covariance(drift.lasting)
                out[stack.rows] = np.linalg.solve(np.linalg.cholesky(covariance), white[stack.rows])
        return out

    @cached_property
    def _variance(self) -> FloatArray:
        """Mean variances (rank,) of rows in units of those of independent exposures."""
        return np.asarray((self._mean / self.rows.sigma) ** 2)

    @cached_property
    def _stacks(self) -> list[tuple[bool, SeriesStack]]:
        """Series as long as each other, of V² and of closure phases."""
        relative = self.sizes / self.rows.sigma
        alike: dict[tuple[bool, int], list[Series]] = {}
        for one in self.series:
            alike.setdefault((one.vis2, len(one.rows)), []).append(one)
        return [(kind, SeriesStack.of(few, relative)) for (kind, _), few in alike.items()]

    @cached_property
    def _axes(self) -> list[SeriesAxes | None]:
        """Of V² and of closure phases."""
        of_kinds = [[one for one in self.series if one.vis2 == kind] for kind in (True, False)]
        return [SeriesAxes.of(own) if own else None for own in of_kinds]

    def turned(
        self, vis2: Drift | None, closure: Drift | None
    ) -> tuple[ChannelRows, list[Axes], list[FloatArray]]:
        """Rows turned by the mean of their covariance.

        And the axes of each series, and its covariances (n, len, len) for values of κ and τ and
        sizes of equal probability.
        """
        # The kinds' shares do not depend on each other: those of closure phases come in another
        # order.
        n = len(self.sizes)
        order = {True: np.arange(n), False: np.argsort(evenly(n))}
        nodes = {
            kind: drift.nodes(n)[:, order[kind]]
            for kind, drift in ((True, vis2), (False, closure))
            if drift is not None
        }
        mean, each, means = self._mean, [], []
        for one in self.series:
            own = self.sizes[:, one.rows]
            each.append(one.correlation(*nodes[one.vis2]) * own[:, :, None] * own[:, None])
            means.append(each[-1].mean(axis=0) / np.outer(mean[one.rows], mean[one.rows]))
        correlated = list(zip(self.series, means, strict=True))
        return *turned_rows(replace(self.rows, sigma=mean), correlated), each

    def roots(self, axes: Sequence[Axes], each: Sequence[FloatArray]) -> tuple[Roots, ...]:
        """Roots of the covariances of rows turned to axes, whitened by their mean."""
        alone = np.ptp(self.sizes, axis=0) > 0.0
        blocks = []
        for axis, covariance in zip(axes, each, strict=True):
            turn = axis.vectors / np.sqrt(axis.values)
            found = np.linalg.cholesky(turn.T @ covariance @ turn)
            blocks.append([(axis.rows, root) for root in found])
            alone[axis.rows] = False
        few = np.arange(FEW_ROWS, np.count_nonzero(alone), FEW_ROWS)
        for at in np.split(np.flatnonzero(alone), few):
            if len(at):
                blocks.append([(at, np.diag(own)) for own in self.sizes[:, at] / self._mean[at]])
        return tuple(zip(*blocks, strict=True))


def _sizes(rows: ChannelRows, layout: ChannelLayout, n: int) -> FloatArray:
    """Standard deviations of rows (n, rank), for floors of sizes of equal probability.

    Offsets and slopes of V² and of closure phases of each file have a size of their own. m of them
    that are larger than the table says are found so (`amibayes.likelihood.noise_fit`) where ln of
    their size is off by √(2/m).
    """
    variance = np.tile(rows.sigma**2, (n, 1))
    group = np.empty((2, len(layout.order)), dtype=np.intp)
    group[:, layout.order] = layout.source, layout.vis2
    of_floor = np.where(rows.floor > 0.0, rows.level, 0)
    middle = ndtri((np.arange(n) + 0.5) / n)
    for seed, key in enumerate(np.unique(np.array([*group, of_floor])[:, of_floor > 0], axis=1).T):
        here = np.flatnonzero((np.array([*group, of_floor]) == key[:, None]).all(axis=0))
        share = rows.floor[here] / rows.sigma[here] ** 2
        told = 0.5 * (share**2).mean() * max(len(here) - MIN_ROWS, 0)
        spread = 1.0 / np.sqrt(FLOOR_SPREAD**-2 + told)
        if spread < KNOWN:
            continue
        # Sizes do not depend on each other: each comes in an order of its own.
        size = np.random.default_rng(seed).permutation(np.exp(spread * middle))
        variance[:, here] += (size**2 - 1.0)[:, None] * rows.floor[here]
    return np.sqrt(variance)

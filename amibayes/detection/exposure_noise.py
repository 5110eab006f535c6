"""Errors that exposures which follow each other share: a transfer function that drifts.

Gains of baselines and offsets of closure phases change over minutes to hours. Exposures of
one night then err alike, as light of a companion does, and noise that is drawn independently for
each exposure gives a companion too often. How much they share is told by the residuals of the
best fit: of what is common to the channels of an exposure, a share κ of the variance is
correlated by exp(−Δt/τ) between exposures of the same baseline (or combination of triangles).
κ and τ have a posterior by restricted likelihood, and null sets are drawn with values from it:
few exposures tell little, and then it is as wide as the prior.

The statistic that is searched for stays the same: its null distribution alone changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from amibayes.companion_search.reduction import Roots
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.observables import Observables
from amibayes.likelihood.channel_noise import ChannelCovariance, linear_fit
from amibayes.likelihood.channel_rows import (
    ChannelLayout,
    ChannelRows,
    channel_layout,
    independent_rows,
)
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise import GaussianNoise
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

DRAWN = 32
"""Pairs of κ and τ that null sets are drawn with, of equal probability."""


@dataclass(frozen=True, eq=False)
class Series:
    """Exposures of one baseline, or combination of triangles, in one night.

    Parameters
    ----------
    rows : (n,) int array
        What is common to the channels of each, among whitened data.
    hours : (n,) float array
    """

    rows: IntArray
    hours: FloatArray


@dataclass(frozen=True, eq=False)
class Drift:
    """Posterior of what exposures of one kind of observable share.

    Parameters
    ----------
    series : tuple of Series
    mass : (n_hours, n_shares) float array
        Of the nodes `HOURS` and `SHARES`.
    """

    series: tuple[Series, ...]
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

    def nodes(self, n: int) -> list[tuple[float, float]]:
        """κ and τ of equal probability, n pairs, from the least κ to the largest."""
        order = np.argsort(np.tile(SHARES, len(HOURS)), kind="stable")
        cumulative = np.cumsum(self.mass.ravel()[order])
        at = order[np.searchsorted(cumulative, (np.arange(n) + 0.5) / n * cumulative[-1])]
        return [(float(SHARES[k % len(SHARES)]), float(HOURS[k // len(SHARES)])) for k in at]


@dataclass(frozen=True, eq=False)
class ExposureNoise:
    """Noise that exposures share, and how well it is known.

    Parameters
    ----------
    vis2, closure_phase : Drift or None
        None where no baseline was observed twice in a night.
    noise : GaussianNoise
        With the mean of the covariance over the posterior.
    roots : tuple of Roots
        Of the covariance, whitened by that mean, for values of κ and τ of equal probability.
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
        return replace(self, roots=tuple(map(bank.reduction.roots, self.roots)))


def exposure_noise(likelihood: Likelihood, single: FloatArray) -> ExposureNoise | None:
    """Find what exposures share, from the residuals of a fit without a companion.

    None where no baseline was observed twice in a night, and where the covariance was estimated
    from scatter.

    Parameters
    ----------
    likelihood : Likelihood
    single : (n_nuisance,) float array
        The fit.
    """
    data, star = likelihood.observables.unflagged(), single_likelihood(likelihood)
    if data.freedom is not None:
        return None
    layout, rows = channel_layout(data), likelihood.noise.rows
    if layout.any and rows is None:
        return None  # no row of the whitened data is common to the channels
    both = np.column_stack([star.residuals(single)[:, 0], star.jacobian(single)])
    of_kinds = [series_of(data, layout, vis2=vis2) for vis2 in (True, False)]
    vis2, closure = (drift_of(series, both) if series else None for series in of_kinds)
    known = [drift for drift in (vis2, closure) if drift is not None]
    if not known:
        return None
    turned, roots = _turned(rows or independent_rows(len(both)), known)
    covariance = ChannelCovariance(data.covariance, turned)
    noise = GaussianNoise(covariance, rows=turned, floor=likelihood.noise.floor)
    return ExposureNoise(vis2, closure, noise, roots)


def series_of(data: Observables, layout: ChannelLayout, *, vis2: bool) -> tuple[Series, ...]:
    """Exposures of the same baselines or triangles, of unflagged data of one kind."""
    setup, mjd = (
        np.concatenate([getattr(m, name) for m in (data.vis2, data.closure_phase)])
        for name in ("setup", "mjd")
    )
    stations = [*data.vis2.stations.tolist(), *data.closure_phase.stations.tolist()]
    at = layout.starts & (layout.vis2 == vis2) & ~layout.stated
    of: dict[tuple[object, ...], list[tuple[float, int]]] = {}
    for row, datum, place in zip(layout.order[at], layout.datum[at], layout.place[at], strict=True):
        own = data.setups[setup[datum]]
        names = [own.stations[k] for k in stations[datum]]
        key = own.source, own.insname, *(sorted(names) if vis2 else names), int(place)
        of.setdefault(key, []).append((24.0 * float(mjd[datum]), int(row)))
    found = []
    for members in of.values():
        hours, rows = map(np.array, zip(*sorted(members), strict=True))
        cuts = np.flatnonzero(np.diff(hours) > NIGHT_HOURS) + 1
        for part in np.split(np.arange(len(rows)), cuts):
            found += [
                Series(rows[few], hours[few])
                for few in np.array_split(part, 1 + len(part) // LONGEST)
                if len(few) > 1
            ]
    return tuple(found)


def drift_of(series: Sequence[Series], both: FloatArray) -> Drift:
    """Posterior of κ and τ by restricted likelihood.

    Parameters
    ----------
    series : sequence of Series
        At least one.
    both : (n_independent, 1 + n_dim) float array
        Whitened residual of a fit, and slopes of its parameters.
    """
    n = sum(len(one.rows) for one in series)
    loss = np.empty((len(HOURS), len(SHARES)))
    for i, tau in enumerate(HOURS):
        size, along = _along_axes(series, both, tau)
        for k, share in enumerate(SHARES):
            variance = 1.0 + share * (size - 1.0)
            chi2, n_fitted, information = linear_fit((along / variance[:, None]).T @ along)
            if n == n_fitted:  # the fit passes through all data: they say nothing of their noise
                loss[i, k] = 0.0
                continue
            left = n - n_fitted
            logdet = float(np.log(variance).sum())
            loss[i, k] = left * np.log(max(chi2, 1e-300) / left) + logdet + information
    prior = np.full(len(SHARES), (1.0 - PRIOR_INDEPENDENT) / (len(SHARES) - 1))
    prior[0] = PRIOR_INDEPENDENT
    mass = np.exp(-0.5 * (loss - loss.min())) * prior
    return Drift(tuple(series), mass / mass.sum())


def _along_axes(
    series: Sequence[Series], both: FloatArray, tau: float
) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (n,) of exp(−Δt/τ), and data (n, …) along its eigenvectors."""
    parts = [(np.linalg.eigh(_kernel(one, tau)), both[one.rows]) for one in series]
    return (
        np.concatenate([values for (values, _), _ in parts]),
        np.concatenate([vectors.T @ own for (_, vectors), own in parts]),
    )


def _kernel(one: Series, tau: float) -> FloatArray:
    return np.asarray(np.exp(-np.abs(one.hours[:, None] - one.hours) / tau))


def _turned(rows: ChannelRows, drifts: Sequence[Drift]) -> tuple[ChannelRows, tuple[Roots, ...]]:
    """Rows of which those that exposures share are turned to independent ones.

    By the mean of their covariance over the posterior; and roots of the covariance of these new
    rows, for κ and τ of equal probability.
    """
    turns: list[tuple[IntArray, FloatArray]] = []
    blocks: list[list[tuple[IntArray, FloatArray]]] = [[] for _ in range(DRAWN)]
    sigma = np.array(rows.sigma)
    for first, drift in enumerate(drifts):
        nodes = drift.nodes(DRAWN)
        # The kinds' shares do not depend on each other: the second kind's come in another order.
        order = np.argsort(np.arange(DRAWN) * GOLDEN % 1.0) if first else np.arange(DRAWN)
        for one in drift.series:
            own = rows.sigma[one.rows]
            each = np.array([_correlation(one, *nodes[k]) for k in order]) * np.outer(own, own)
            values, vectors = np.linalg.eigh(each.mean(axis=0))
            turns.append((one.rows, vectors.T))
            sigma[one.rows] = np.sqrt(values)
            whitened = vectors.T @ each @ vectors / np.sqrt(np.outer(values, values))
            for block, root in zip(blocks, np.linalg.cholesky(whitened), strict=True):
                block.append((one.rows, root))
    rotation = csr_array(_placed(turns, len(sigma)) @ rows.rotation)
    made = replace(rows, rotation=rotation, sigma=sigma)
    return made, tuple(map(tuple, blocks))


GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def _correlation(one: Series, share: float, tau: float) -> FloatArray:
    return share * _kernel(one, tau) + (1.0 - share) * np.eye(len(one.rows))


def _placed(blocks: Sequence[tuple[IntArray, FloatArray]], n: int) -> csr_array:
    """A matrix (n, n) with blocks at some rows, and 1 on the rest of its diagonal."""
    rest = np.setdiff1d(np.arange(n), np.concatenate([rows for rows, _ in blocks]))
    row = np.concatenate([rest, *(np.repeat(rows, len(rows)) for rows, _ in blocks)])
    column = np.concatenate([rest, *(np.tile(rows, len(rows)) for rows, _ in blocks)])
    value = np.concatenate([np.ones(len(rest)), *(block.ravel() for _, block in blocks)])
    return csr_array((value, (row, column)), shape=(n, n))

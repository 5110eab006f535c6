"""What exposures share of the noise in a test of no companion.

Null sets of exposures that err independently give a companion too often where a transfer
function drifts (`amibayes.likelihood.exposure_rows`). What a test takes for the drift is what the
residuals of the fit without a companion show: the best companion has taken a part of it. The mean
of the covariance over its posterior weights the data, and null sets are drawn with values
of the posterior: few exposures tell little, and then it is as wide as the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.reduction import Roots
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.likelihood.channel_noise import ChannelCovariance
from amibayes.likelihood.channel_rows import ChannelRows, channel_layout, independent_rows
from amibayes.likelihood.exposure_rows import Drift, Series, drift_of, series_of, turned_rows
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise import GaussianNoise
from amibayes.support.evenly import evenly
from amibayes.units import FloatArray

DRAWN = 32
"""Pairs of κ and τ that null sets are drawn with, of equal probability."""


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
        return replace(self, roots=bank.reduction.roots(self.roots))


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
    data = likelihood.observables.unflagged()
    layout, rows = channel_layout(data), likelihood.noise.rows
    if rows is None and layout.any:
        return None  # no row of the whitened data is common to the channels
    rows = independent_rows(len(layout.order)) if rows is None else rows.apart or rows
    series = series_of(data, layout)
    if not series:
        return None
    floor = likelihood.noise.floor
    alone = GaussianNoise(ChannelCovariance(data.covariance, rows), rows=rows, floor=floor)
    star = single_likelihood(likelihood.with_noise(alone))
    both = np.column_stack([star.residuals(single)[:, 0], star.jacobian(single)])
    of_kinds = [[one for one in series if one.vis2 == kind] for kind in (True, False)]
    vis2, closure = (drift_of(own, both) if own else None for own in of_kinds)
    turned, roots = _turned(rows, series, vis2, closure)
    covariance = ChannelCovariance(data.covariance, turned)
    return ExposureNoise(vis2, closure, GaussianNoise(covariance, rows=turned, floor=floor), roots)


def _turned(
    rows: ChannelRows, series: Sequence[Series], vis2: Drift | None, closure: Drift | None
) -> tuple[ChannelRows, tuple[Roots, ...]]:
    """Rows turned by the mean of their covariance, and roots of the covariance of new rows.

    These for κ and τ of equal probability.
    """
    # The kinds' shares do not depend on each other: those of closure phases come in another order.
    mixed = np.argsort(evenly(DRAWN))
    nodes = {
        kind: [drift.nodes(DRAWN)[k] for k in (np.arange(DRAWN) if kind else mixed)]
        for kind, drift in ((True, vis2), (False, closure))
        if drift is not None
    }
    each = [np.array([one.correlation(*node) for node in nodes[one.vis2]]) for one in series]
    means = [correlation.mean(axis=0) for correlation in each]
    turned, axes = turned_rows(rows, list(zip(series, means, strict=True)))
    blocks = []
    for axis, correlation in zip(axes, each, strict=True):
        own = rows.sigma[axis.rows]
        turn = axis.vectors / np.sqrt(axis.values)
        covariance = turn.T @ (correlation * np.outer(own, own)) @ turn
        blocks.append([(axis.rows, root) for root in np.linalg.cholesky(covariance)])
    return turned, tuple(zip(*blocks, strict=True))

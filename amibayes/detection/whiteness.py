"""Whether residuals of neighbouring spectral channels are independent, as errors alone say."""

from __future__ import annotations

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.data.measurements import Measurements
from amibayes.likelihood.student import symmetric_whitening
from amibayes.units import IntArray

NOTABLE, SURE = 0.2, 5.0
"""Correlation between channels that matters, and its size in chance errors.

A correlation of 0.2 makes the variance of a sum over ten channels nearly three times as large.
"""


def channel_correlation(result: SearchResult) -> tuple[float, int]:
    """Correlation of the residuals of a fit between neighbouring channels of a row.

    Residuals are whitened symmetrically, so that correlations which the covariance has in it
    do not count.

    Returns
    -------
    correlation : float
        0 where there is one channel.
    n_pairs : int
        Pairs of data it rests on; by chance it scatters by 1/√n_pairs.
    """
    data, noise = result.likelihood.observables, result.likelihood.noise
    # What the noise model knows of the correlation of channels is taken out by the whitening:
    # what is left shows between neighbours.
    white = result.likelihood.residuals(result.theta)
    residuals = symmetric_whitening(data, noise.covariance).residuals(white)[:, 0]
    vis2, closure = _neighbours(data.vis2), _neighbours(data.closure_phase) + data.n_vis2
    first, second = residuals[np.concatenate([vis2, closure], axis=1)]
    norm = float(np.sqrt((first @ first) * (second @ second)))
    return (float(first @ second) / norm if norm else 0.0), len(first)


def correlated(result: SearchResult) -> float | None:
    """Correlation between channels beyond the model of the noise; None where it does not matter."""
    correlation, n_pairs = channel_correlation(result)
    if correlation < NOTABLE or correlation * np.sqrt(n_pairs) < SURE:
        return None
    return correlation


def _neighbours(data: Measurements) -> IntArray:
    """Pairs (2, n) of entries of one row in neighbouring channels."""
    order = np.lexsort((data.channel, data.row, data.setup))
    step = np.diff(np.stack([data.setup, data.row, data.channel])[:, order], axis=1)
    beside = np.flatnonzero((step[0] == 0) & (step[1] == 0) & (step[2] == 1))
    return np.stack([order[beside], order[beside + 1]])

"""Null data of which half of the variance is common to the channels of an exposure."""

from __future__ import annotations

import numpy as np

from amibayes.companion_search.grid import make_grid
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.detection.statistic import make_statistic
from amibayes.likelihood.channel_noise import ChannelShare, Correlation, noise_with_channels
from amibayes.likelihood.extra_noise import with_noise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise_fit import fit_noise

STATIONS = np.array([[0.0, 0.0], [30.0, 10.0], [-20.0, 45.0], [60.0, -30.0]])
CHANNELS = np.linspace(1.55e-6, 1.75e-6, 6)


def pionier(exposures: int = 4, covariance: str = "assumed") -> Observables:
    """Four telescopes, six channels, exposures while the sky turns."""
    parts = []
    for k in range(exposures):
        c, s = np.cos(0.2 * k), np.sin(0.2 * k)
        parts.append(
            point_source(
                STATIONS @ np.array([[c, s], [-s, c]]),
                CHANNELS,
                0.04e-6,
                vis2_error=0.02,
                closure_error_rad=np.radians(1.0),
                covariance=covariance,
                mjd=60000.0 + 0.02 * k,
            )
        )
    return join(parts)


def with_draw(data: Observables, draw: np.ndarray) -> Observables:
    return data.with_data(data.data + draw)


def share(vis2: float, closure: float, neighbour: float = 0.0) -> ChannelShare:
    found = [Correlation(c, neighbour, c + (1 - c) * neighbour) for c in (vis2, closure)]
    return ChannelShare(*found)


def probabilities(n: int, draws: int, seed: int) -> np.ndarray:
    """False-alarm probabilities of null data with half of the variance common to channels.

    Each data set has null draws of its own, with its own noise, fitted as a search does it: at
    the best companion, gains in proportion to the V² that it predicts.
    """
    rng = np.random.default_rng(seed)
    sheet = pionier(8)
    noise = noise_with_channels(sheet, [share(0.5, 0.5)]).draw(n, rng)
    grid, out = make_grid(3.0, 12.0, 1.0), []
    for draw in noise.T:
        stated = Likelihood(with_draw(sheet, draw)).expecting(np.array([10.0, 5.0, 0.0]))
        (best,) = make_statistic(stated, grid, np.empty(0)).strongest
        stated = stated.expecting(best)
        likelihood = with_noise(stated, fit_noise(stated, best))
        statistic = make_statistic(likelihood, grid, np.empty(0))
        null = statistic.draw_null(draws, rng)
        out.append((1 + (null >= statistic.value).sum()) / (draws + 1.0))
    return np.array(out)

"""Evidences of many data sets that were simulated alike, from draws that all of them share.

The posteriors of such data sets lie near each other. Draws from one mixture, fitted to the mean
of the posteriors, serve them all: what models predict is worked out once for each draw, and no
data set has fewer draws that count than if it had its share of them for itself (a posterior's
density is at most m times that of the mean of m).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.comparison.mixture import PriorDraws, first_mixture, weighted
from amibayes.comparison.unit_cube import CubeModel
from amibayes.units import FloatArray

PER_ROUND = 0.25
"""Draws of each adaptation, in units of those that count: they only place the mixture."""


@dataclass(frozen=True)
class PooledEffort:
    """How many draws the evidences of a group of data sets are worth.

    Parameters
    ----------
    prior : int
        Draws from the prior.
    draws : int
        Draws from the mixture that count.
    centres : int
        Distributions in the mixture.
    rounds : int
        Adaptations of the mixture.
    """

    prior: int = 2048
    draws: int = 4096
    centres: int = 16
    rounds: int = 4


def pooled_evidences(
    model: CubeModel,
    data: FloatArray,
    cube: FloatArray,
    chi2: FloatArray,
    rng: np.random.Generator,
    prior: PriorDraws,
    effort: PooledEffort,
) -> tuple[FloatArray, FloatArray]:
    """Measure the evidences of data sets that were simulated alike.

    Parameters
    ----------
    model : CubeModel
        With at least one parameter.
    data : (n_data, m) float array
    cube, chi2 : (m, k, n_dim), (m, k) float array
        Fits of each.
    rng : numpy.random.Generator
    prior : PriorDraws
        Of the same model.
    effort : PooledEffort

    Returns
    -------
    log_z, error : (m,) float array
    """
    best = chi2.min(axis=1)
    at_prior = model.log_prob_of_many(prior.predicted, data, best)

    def log_prob(points: FloatArray) -> FloatArray:
        return model.log_prob_of_many(model.predict(points), data, best)

    mixture = first = first_mixture(model, cube, chi2, effort.centres)
    for _ in range(effort.rounds):
        few = int(PER_ROUND * effort.draws)
        drawn = weighted(mixture.beside(first), prior, at_prior, log_prob, few, rng)
        mixture = mixture.adapted(drawn)
    return weighted(mixture.beside(first), prior, at_prior, log_prob, effort.draws, rng).log_z

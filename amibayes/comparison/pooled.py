"""Evidences of many data sets that were simulated alike, from draws that all of them share.

The posteriors of such data sets lie near each other. Draws from one mixture, fitted to the mean
of the posteriors, serve them all: what models predict is worked out once for each draw, and no
data set has fewer draws that count than if it had its share of them for itself (a posterior's
density is at most m times that of the mean of m).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.comparison.integral import (
    LEAST_SHARE,
    MODE_LIMIT,
    Mixture,
    PriorDraws,
    laplace_shapes,
    log_density,
    off_edges,
    tempered,
)
from amibayes.comparison.unit_cube import CubeModel
from amibayes.likelihood.quadrature import log_sum
from amibayes.units import FloatArray

SAME, CANDIDATES = 0.02, 32
"""Fits nearer than this in every dimension of the cube are one, and so many may be drawn around."""

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
    mixture = _mixture(model, cube, chi2, effort.centres)
    for _ in range(effort.rounds):
        drawn = _inside(mixture.draw(int(PER_ROUND * effort.draws), rng))
        every = np.concatenate([prior.cube, drawn])
        values = np.concatenate(
            [at_prior, model.log_prob_of_many(model.predict(drawn), data, best)]
        )
        density = log_density(mixture, every, len(prior.cube) / len(every))
        weights = [tempered(column, model.n_dim) for column in (values.T - density)]
        mixture = mixture.adapted(every, np.mean(weights, axis=0))
    drawn = _inside(mixture.draw(effort.draws, rng))
    every = np.concatenate([prior.cube, drawn])
    values = np.concatenate([at_prior, model.log_prob_of_many(model.predict(drawn), data, best)])
    n = len(prior.cube) + effort.draws
    return _evidence(values - log_density(mixture, every, len(prior.cube) / n)[:, None], n)


def _evidence(log_weight: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """ln Z and its error (m,) of weights (n_inside, m); draws outside the cube count as 0."""
    log_z = log_sum(log_weight) - np.log(n)
    square = (np.exp(log_weight - log_z) ** 2).sum(axis=0) / n
    return log_z, np.sqrt(np.maximum(square - 1.0, 0.0) / n)


def _inside(cube: FloatArray) -> FloatArray:
    return cube[((cube >= 0.0) & (cube <= 1.0)).all(axis=1)]


def _mixture(model: CubeModel, cube: FloatArray, chi2: FloatArray, centres: int) -> Mixture:
    """t distributions at fits that lie outside each other's 1σ, the best of each data set first."""
    merit = (chi2 - chi2.min(axis=1, keepdims=True)).ravel()
    fits = cube.reshape(-1, model.n_dim)
    order = np.argsort(merit, kind="stable")
    kept: list[int] = []
    for i in order[merit[order] <= MODE_LIMIT]:
        if len(kept) == CANDIDATES:
            break
        if not kept or np.abs(model.apart(fits[i], fits[kept])).max(axis=1).min() >= SAME:
            kept.append(int(i))
    centre, worth = fits[kept], np.exp(-0.25 * merit[kept])
    shapes = laplace_shapes(model, centre)
    chosen: list[int] = []
    belongs = np.full(len(centre), -1)
    for i in range(len(centre)):
        if belongs[i] < 0 and len(chosen) < centres:
            near = _squares(model, centre, centre[i], shapes[i]) < model.n_dim
            belongs[near & (belongs < 0)] = i
            chosen.append(i)
    share = np.array([worth[belongs == i].sum() for i in chosen]) + LEAST_SHARE
    moved = off_edges(model, centre[chosen], shapes[chosen])
    return Mixture(model, moved, shapes[chosen], share / share.sum())


def _squares(
    model: CubeModel, cube: FloatArray, centre: FloatArray, triangle: FloatArray
) -> FloatArray:
    """Squares of the distances of points from a fit, in units of that fit's errors, (n,)."""
    white = np.linalg.solve(triangle, model.apart(cube, centre).T)
    return np.asarray((white**2).sum(axis=0))

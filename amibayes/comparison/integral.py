"""Evidence and posterior by adaptive importance sampling on the unit cube.

Draws come from the prior and from t distributions around the best fits (`Mixture`); the last ones
alone count, and their scatter is the error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.comparison.mixture import PriorDraws, first_mixture, laplace_shapes, weighted
from amibayes.comparison.unit_cube import CubeModel
from amibayes.posterior.sampler import Draws
from amibayes.units import FloatArray

GOOD_ERROR, REPEATS = 0.15, 3
"""Error of ln Z below which no more draws are made: odds change by 3 at ln Z 1; and how often
twice as many draws may be made for it."""


@dataclass(frozen=True)
class Effort:
    """How many draws an evidence is worth.

    Parameters
    ----------
    prior : int
        Draws from the prior.
    modes : int
        Draws around the best fits that count; each adaptation takes half as many.
    repeats : int
        How often the mixture is fitted again, and drawn from twice as much, where the error is
        large.
    centres : int
        Best fits that are drawn around.
    rounds : int
        Adaptations of the mixture before the draws that count.
    """

    prior: int = 8192
    modes: int = 4096
    repeats: int = REPEATS
    centres: int = 12
    rounds: int = 7


def log_z_laplace(model: CubeModel, data: FloatArray, cube: FloatArray, chi2: FloatArray) -> float:
    """ln Z of a Gaussian at the best fit, half of it in every dimension that is at an edge."""
    first = int(np.argmin(chi2))
    best = cube[first]
    edges = ((best <= 0.0) | (best >= 1.0)) & ~model.turning
    triangle = laplace_shapes(model, best[None], model.inflation(chi2[[first]]))[0]
    volume = np.log(np.diag(triangle)).sum() + 0.5 * len(best) * np.log(2.0 * np.pi)
    at_best = model.log_prob(best[None], data)[0]
    return float(at_best + min(volume - np.log(2.0) * edges.sum() + model.log_names, 0.0))


def integrate(
    model: CubeModel,
    data: FloatArray,
    cube: FloatArray,
    chi2: FloatArray,
    rng: np.random.Generator,
    *,
    prior: PriorDraws | None = None,
    effort: Effort | None = None,
) -> Draws:
    """Measure the evidence of a model, and draw from its posterior.

    Parameters
    ----------
    model : CubeModel
    data : (n_data,) float array
    cube, chi2 : (n, n_dim), (n,) float array
        Fits of the data.
    rng : numpy.random.Generator
    prior : PriorDraws, optional
        Of the same model.
    effort : Effort, optional

    Returns
    -------
    Draws
        Parameter sets with their weights; ``log_z`` and ``log_z_error`` in its diagnostics.
    """
    effort = effort or Effort()
    if model.n_dim == 0:
        value = model.log_prob(np.zeros((1, 0)), data)
        return Draws(np.zeros((1, 0)), value, np.ones(1), {"log_z": value[0], "log_z_error": 0.0})
    known = prior or PriorDraws.of(model, effort.prior, rng)
    at_prior = model.log_prob_of(known.predicted, data)[:, None]

    def log_prob(points: FloatArray) -> FloatArray:
        return model.log_prob(points, data)[:, None]

    mixture = first = first_mixture(model, cube[None], chi2[None], effort.centres)
    for _ in range(effort.rounds):
        drawn = weighted(mixture.beside(first), known, at_prior, log_prob, effort.modes // 2, rng)
        mixture = mixture.adapted(drawn)
    for k in range(1 + effort.repeats):
        n = effort.modes * 2**k
        drawn = weighted(mixture.beside(first), known, at_prior, log_prob, n, rng)
        (log_z,), (error,) = drawn.log_z
        if error < GOOD_ERROR:
            break
        # What was drawn places the mixture better; the draws that count are then new ones.
        mixture = mixture.adapted(drawn)
    weight = np.exp(drawn.log_weight[:, 0] - log_z) / drawn.n
    evidence = {"log_z": float(log_z), "log_z_error": float(error)}
    return Draws(model.theta(drawn.cube), drawn.log_prob[:, 0], weight, evidence)

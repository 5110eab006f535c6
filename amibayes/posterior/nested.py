"""Nested sampling with dynesty (Skilling 2006; Speagle 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.posterior.sampler import Draws, LogProb, ModelPrior
from amibayes.support.optional import optional_package

LIVE_POINTS = 500
"""ln Z is then known to some 0.15, less than what one number of the prior changes."""


@dataclass(frozen=True)
class NestedSampler:
    """Nested sampling by random walks (extra ``amibayes[evidence]``).

    Parameters
    ----------
    live_points : int
    """

    live_points: int = LIVE_POINTS

    def sample(self, log_prob: LogProb, prior: ModelPrior, rng: np.random.Generator) -> Draws:
        """Sample the posterior and measure its evidence.

        Raises
        ------
        UsageError
            Where dynesty is not installed.
        """
        dynesty = optional_package("dynesty", "nested sampling needs dynesty", "evidence")
        sampler = dynesty.NestedSampler(
            lambda theta: float(log_prob(theta[None])[0]),
            lambda cube: prior.from_cube(cube[None])[0],
            prior.n_dim,
            nlive=self.live_points,
            sample="rwalk",
            rstate=rng,
        )
        sampler.run_nested(print_progress=False)
        found = sampler.results
        evidence = {"log_z": float(found.logz[-1]), "log_z_error": float(found.logzerr[-1])}
        weights = found.importance_weights()
        return Draws(found.samples, found.logl, weights / weights.sum(), evidence)

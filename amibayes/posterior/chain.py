"""A sampler by emcee: an ensemble of walkers, stopped on the autocorrelation time.

Sampled in (east, north, ln contrast, nuisance…), whose prior is flat. The chain is written
whole after every segment, with the state of the random generator, so that a killed run
goes on from there and ends with the same samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import emcee
import numpy as np

from amibayes.errors import DataError
from amibayes.posterior.chain_file import load_chain, save_chain
from amibayes.posterior.laplace import physical, sampled
from amibayes.posterior.modes import Region
from amibayes.posterior.sampler import Draws, LogProb, ModelPrior
from amibayes.support import request
from amibayes.support.ensemble_moves import IndependenceMove, along_others
from amibayes.units import FloatArray

N_WALKERS = 32
"""Some ten times the number of parameters: moves take their directions from the others."""

SEGMENT = 500
"""Steps between two checks of the length of the chain, and between two writes of it."""

MAX_STEPS = 30_000
"""Steps after which a chain is given up: a minute or two."""

ENOUGH = 50.0
"""Autocorrelation times a chain must be long (Foreman-Mackey et al. 2013)."""

GOOD_RHAT = 1.02
"""Means of parts of the chain then differ by a fifth of the posterior's width at most."""

N_TRIALS = 20_000
"""Draws of the prior among which walkers without a start find one: half a second."""


@dataclass(frozen=True, eq=False)
class EnsembleSampler:
    """Goodman & Weare's walkers (emcee).

    Parameters
    ----------
    start : (n_walkers, n_dim) float array, optional
        Where the walkers start, contrast as its logarithm; unless given, at draws of the
        prior that the likelihood prefers.
    region : Region, optional
        Part of the field that is sampled; all of it unless given.
    proposal : IndependenceMove, optional
        Proposals that do not start from where a walker is (`emcee.moves.MHMove`).
    path : path, optional
        HDF5 file of the chain, readable by `emcee.backends.HDFBackend`.
    resume : bool
        Go on from ``path`` if it holds the chain of the same data, prior and seed.
    max_steps : int
        Steps after which a chain that has not converged is given up (and said to be so).
    progress : callable, optional
        Called with (steps done, steps expected).
    """

    start: FloatArray | None = None
    region: Region | None = None
    proposal: IndependenceMove | None = None
    path: str | Path | None = None
    resume: bool = False
    max_steps: int = MAX_STEPS
    progress: Callable[[int, int], None] | None = None

    def sample(self, log_prob: LogProb, prior: ModelPrior, rng: np.random.Generator) -> Draws:
        """Sample the posterior: the second two thirds of the chain, thinned."""
        chain = self.run(log_prob, prior, rng)
        burn, thin = burn_in(chain), thinning(chain)
        x = chain.get_chain(discard=burn, thin=thin, flat=True)
        posterior = chain.get_log_prob(discard=burn, thin=thin, flat=True)
        diagnostics = {
            "autocorrelation_time": longest(times(chain)),
            "split_rhat": float(split_rhat(chain).max()),
            "acceptance": float(np.mean(chain.acceptance_fraction)),
            "converged": float(long_enough(chain)),
        }
        value, even = posterior - prior.prior.log_density(x), np.full(len(x), 1.0 / len(x))
        return Draws(physical(x, prior.parameters), value, even, diagnostics)

    def run(
        self, log_prob: LogProb, prior: ModelPrior, rng: np.random.Generator
    ) -> emcee.EnsembleSampler:
        """Give the chain itself, burn-in included."""
        start = self._drawn(log_prob, prior, rng) if self.start is None else self.start
        seed = int(rng.integers(2**32))
        posterior = self._log_posterior(log_prob, prior)
        # All of data, covariance, noise and model are in the values at the start.
        places, independent = self._places(), self.proposal is not None
        digest = request.digest(
            start, posterior(start), prior.prior, seed, places, independent, emcee.__version__
        )
        backend = load_chain(self.path, digest) if self.path and self.resume else None
        sampler = emcee.EnsembleSampler(
            *start.shape, posterior, vectorize=True, moves=self._moves(), backend=backend
        )
        state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
        while not long_enough(sampler) and sampler.iteration < self.max_steps:
            sampler.run_mcmc(state if sampler.iteration == 0 else None, SEGMENT)
            if self.path:
                save_chain(sampler, self.path, digest)
            if self.progress:
                # Walkers that have not moved have no times.
                expected = int(min(ENOUGH * longest(times(sampler)), self.max_steps))
                self.progress(sampler.iteration, max(expected, sampler.iteration))
        return sampler

    def _drawn(self, log_prob: LogProb, prior: ModelPrior, rng: np.random.Generator) -> FloatArray:
        """Walkers at prior draws, taken without replacement with the likelihood as weight."""
        theta = prior.draw(N_TRIALS, rng)
        x = sampled(theta, prior.parameters)
        inside = np.isfinite(self._log_posterior(log_prob, prior)(x))
        if inside.sum() < N_WALKERS:
            raise DataError("the likelihood is finite almost nowhere in the prior")
        # The largest of ln w + Gumbel noise are such a sample (Efraimidis & Spirakis 2006).
        key = np.where(inside, log_prob(theta) + rng.gumbel(size=N_TRIALS), -np.inf)
        return np.asarray(x[np.argsort(key)[-N_WALKERS:]])

    def _places(self) -> FloatArray | None:
        return None if self.region is None else self.region.places

    def _moves(self) -> list[tuple[emcee.moves.Move, float]]:
        """Moves and how often each is made."""
        along = along_others()
        if self.proposal is None:
            return along
        half = [(move, 0.5 * share) for move, share in along]
        return [*half, (emcee.moves.MHMove(self.proposal), 0.5)]

    def _log_posterior(
        self, log_prob: LogProb, prior: ModelPrior
    ) -> Callable[[FloatArray], FloatArray]:
        place = prior.parameters.place()

        def log_posterior(x: FloatArray) -> FloatArray:
            density = prior.prior.log_density(x)
            if self.region is not None:
                density = np.where(self.region.holds(*x[:, place].T), density, -np.inf)
            inside = np.isfinite(density)
            if inside.any():
                density[inside] += log_prob(physical(x[inside], prior.parameters))
            return density

        return log_posterior


def burn_in(sampler: emcee.EnsembleSampler) -> int:
    """Steps that are thrown away: a third."""
    return int(sampler.iteration // 3)


def thinning(sampler: emcee.EnsembleSampler) -> int:
    """Steps between two samples: half an autocorrelation time loses hardly anything."""
    time = longest(times(sampler))
    return max(1, int(0.5 * time)) if np.isfinite(time) else 1


def times(sampler: emcee.EnsembleSampler) -> FloatArray:
    """Integrated autocorrelation times of the second two thirds of the chain, steps, (n_dim,).

    NaN where a walker did not move.
    """
    chain = sampler.get_chain()[burn_in(sampler) :]
    with np.errstate(invalid="ignore"):
        return np.asarray(emcee.autocorr.integrated_time(chain, tol=0))


def longest(times: FloatArray) -> float:
    """Longest of the times that are known, or infinity."""
    return float(np.nanmax(times)) if np.isfinite(times).any() else np.inf


def long_enough(sampler: emcee.EnsembleSampler) -> bool:
    """Whether the chain is longer than `ENOUGH` times and its parts agree."""
    if sampler.iteration < 2 * SEGMENT:
        return False
    kept = sampler.iteration - burn_in(sampler)
    return bool(kept > ENOUGH * longest(times(sampler)) and split_rhat(sampler).max() < GOOD_RHAT)


def split_rhat(sampler: emcee.EnsembleSampler) -> FloatArray:
    """Split-R̂ of the parameters, every walker's second two thirds cut in two, (n_dim,).

    Infinite where no walker moved.
    """
    chain = sampler.get_chain()[burn_in(sampler) :]
    half = len(chain) // 2
    halves = np.concatenate([chain[:half], chain[half : 2 * half]], axis=1)
    within = halves.var(axis=0, ddof=1).mean(axis=0)
    between = halves.mean(axis=0).var(axis=0, ddof=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.sqrt((half - 1) / half + between / within)
    return np.where(within > 0.0, found, np.inf)

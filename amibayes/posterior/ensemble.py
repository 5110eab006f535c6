"""The posterior of a search by emcee: walkers start on its modes; samples and their quality."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import emcee
import numpy as np
from astropy.table import QTable

from amibayes.companion_search.result import SearchResult
from amibayes.data.tables import UNITS, pretty, quantity_table
from amibayes.errors import DataError
from amibayes.posterior.chain import (
    MAX_STEPS,
    N_WALKERS,
    EnsembleSampler,
    burn_in,
    long_enough,
    longest,
    split_rhat,
    thinning,
    times,
)
from amibayes.posterior.derived import DERIVED, derived, interval
from amibayes.posterior.grid import GridPosterior
from amibayes.posterior.independence import independence_move_within, mode_mixture
from amibayes.posterior.laplace import gaussian_of, log_masses, physical
from amibayes.posterior.modes import Region, elsewhere, mode_probabilities, modes_to_sample
from amibayes.posterior.polynomial import PolynomialLogProb, polynomial_log_prob
from amibayes.posterior.priors import Prior
from amibayes.posterior.sampler import ModelPrior
from amibayes.support.arguments import checks_arguments, one_of
from amibayes.support.ensemble_moves import IndependenceMove, independence_move
from amibayes.support.labelled import labelled
from amibayes.support.notebook import html_table
from amibayes.support.optional import optional_package
from amibayes.units import (
    FloatArray,
)

START_WIDTH = 0.05
"""Longest scatter of the walkers' start, in units of the field."""


Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Samples of the posterior and how far they can be trusted.

    Parameters
    ----------
    names : tuple of str
        Names of the columns.
    samples : (n, n_dim) float array
        Thinned, burn-in removed; contrast as a flux ratio.
    log_prob : (n,) float array
    chain : (n_steps, n_walkers, n_dim) float array
        All of it, burn-in included.
    chain_log_prob : (n_steps, n_walkers) float array
    autocorrelation_time : float
        Longest of the parameters', in steps.
    n_steps, n_burn : int
        Steps of each walker, and those thrown away.
    split_rhat : float
        Largest split-R̂ (Gelman et al. 2013) of the parameters over the walkers.
    acceptance : float
        Mean fraction of accepted proposals.
    converged : bool
        Longer than 50 autocorrelation times and split-R̂ below 1.02.
    prior : Prior
    mode_probability : (n_modes,) float array
        Probability of each mode of the search among the modes, in their order.
    mode_method : {"grid", "laplace"}
    elsewhere : float
        Probability farther than λ/2B from every mode; NaN without a grid posterior.
    times, rhats : (n_dim,) float array
        Autocorrelation time (steps) and split-R̂ of each parameter.
    """

    names: tuple[str, ...]
    samples: FloatArray
    log_prob: FloatArray
    chain: FloatArray
    chain_log_prob: FloatArray
    autocorrelation_time: float
    n_steps: int
    n_burn: int
    n_walkers: int
    split_rhat: float
    acceptance: float
    converged: bool
    prior: Prior
    mode_probability: FloatArray
    mode_method: str
    elsewhere: float
    times: FloatArray
    rhats: FloatArray

    @property
    def n_effective(self) -> int:
        """Number of independent samples, n_walkers · n_steps / autocorrelation time."""
        return int(self.n_walkers * (self.n_steps - self.n_burn) / self.autocorrelation_time)

    def column(self, name: str) -> FloatArray:
        """Samples of a parameter, or of separation_mas, position_angle_deg or delta_mag."""
        one_of("Posterior.column", "name", name, (*self.names, *DERIVED))
        if name in self.names:
            return self.samples[:, self.names.index(name)]
        return derived(name, *(self.column(n) for n in ("east_mas", "north_mas", "contrast")))

    def interval(self, name: str, level: float = 0.68) -> tuple[float, float, float]:
        """(median, lower, upper) of a quantity.

        Position angles are cut opposite their mean; the median lies in [0, 360) and the
        limits on both sides of it.
        """
        return interval(name, self.column(name), level)

    def to_table(self) -> QTable:
        """All samples as an astropy table with units, with separation, angle and Δmag."""
        columns = {name: self.column(name) for name in (*self.names, *DERIVED)}
        return quantity_table(columns | {"log_prob": self.log_prob}, UNITS)

    def to_xarray(self) -> Any:
        """The chain, burn-in removed, as labelled arrays (extra ``xarray``).

        Returns
        -------
        xarray.Dataset
            Of (chain, draw), a walker being a chain, which ArviZ takes too: every parameter,
            separation, position angle and magnitude difference, and ``log_prob``.
        """
        kept = replace(self, samples=self.chain[self.n_burn :].reshape(-1, len(self.names)))
        shape = (-1, self.n_walkers)
        columns = {n: kept.column(n).reshape(shape).T for n in (*self.names, *DERIVED)}
        columns["log_prob"] = self.chain_log_prob[self.n_burn :].T
        facts = {"converged": int(self.converged), "split_rhat": self.split_rhat}
        return labelled(
            {name: (("chain", "draw"), values) for name, values in columns.items()},
            {"chain": np.arange(self.n_walkers), "draw": np.arange(self.n_burn, self.n_steps)},
            facts | {"autocorrelation_time": self.autocorrelation_time},
        )

    def _repr_html_(self) -> str:
        """Show medians and intervals in a notebook."""
        rows = []
        for name in (*DERIVED, *self.names):
            median, low, high = self.interval(name)
            _, low95, high95 = self.interval(name, 0.95)
            rows.append((pretty(name), *(f"{x:.5g}" for x in (median, low, high, low95, high95))))
        header = ("", "median", "16 %", "84 %", "2.5 %", "97.5 %")
        return html_table(repr(self).strip("<>"), header, rows)

    def convergence(self) -> dict[str, dict[str, float]]:
        """How far each parameter can be trusted: autocorrelation time, split-R̂, samples."""
        kept = self.n_walkers * (self.n_steps - self.n_burn)
        each = zip(self.names, self.times, self.rhats, strict=True)
        return {
            name: {
                "autocorrelation_time": float(time),
                "split_rhat": float(rhat),
                "n_effective": float(kept / time),
            }
            for name, time, rhat in each
        }

    def to_inference_data(self) -> Any:
        """Give the chain, burn-in removed, to ArviZ (extra ``amibayes[arviz]``).

        Returns
        -------
        arviz.InferenceData, or xarray.DataTree from ArviZ 1.0 on
            Walkers are chains; ``lp`` is the log-posterior.

        Raises
        ------
        UsageError
            Where ArviZ is not installed.
        """
        arviz = optional_package("arviz", "InferenceData needs ArviZ", "arviz")
        kept = self.chain[self.n_burn :].swapaxes(0, 1)
        groups: dict[str, Any] = {
            "posterior": {name: kept[..., k] for k, name in enumerate(self.names)},
            "sample_stats": {"lp": self.chain_log_prob[self.n_burn :].T},
        }
        # Version 1 takes one dictionary of groups and returns an xarray.DataTree; from 1.3 on it
        # calls that InferenceData too.
        old = int(arviz.__version__.split(".")[0]) < 1
        return arviz.from_dict(**groups) if old else arviz.from_dict(groups)

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT converged"
        return f"<Posterior: {len(self.samples)} samples of {', '.join(self.names)}; {state}>"


@checks_arguments
def sample(
    result: SearchResult,
    prior: Prior,
    rng: np.random.Generator,
    *,
    path: str | Path | None = None,
    resume: bool = False,
    grid: GridPosterior | None = None,
    max_steps: int = MAX_STEPS,
    progress: Progress | None = None,
) -> Posterior:
    """Sample the posterior of a search's model.

    Parameters
    ----------
    result : SearchResult
        Its modes are where the walkers start, in proportion to their Laplace weights; a
        strong one keeps them in its `Region`.
    prior : Prior
    rng : numpy.random.Generator
    path : path, optional
        HDF5 file of the chain, readable by `emcee.backends.HDFBackend`.
    resume : bool
        Go on from ``path`` if it holds the chain of the same data, prior and seed.
    grid : GridPosterior, optional
        Of the same likelihood and prior: gives the modes' probabilities, and the
        `IndependenceProposal`. Without it that is a `mode_mixture`.
    max_steps : int
        Steps after which a chain that has not converged is given up (and said to be so).
    progress : callable, optional
        Called with (steps done, steps expected).
    """
    region, parameters = Region.of(result), result.likelihood.parameters
    start = _start(result, prior, region, rng)
    everything, quick = ModelPrior(prior, parameters), None
    proposal: IndependenceMove | None = None
    if grid is not None:
        proposal = independence_move_within(grid, region)
    elif (quick := _quick(result, everything, rng)) is not None:
        proposal = independence_move(quick.around)
    else:
        proposal = independence_move(
            mode_mixture(result.likelihood, modes_to_sample(result), prior, rng)
        )
    walkers = EnsembleSampler(start, region, proposal, path, resume, max_steps, progress)
    chain = walkers.run(quick or result.likelihood.log_prob, everything, rng)
    return _posterior(chain, result, prior, grid)


MANY_SAMPLES = 500
"""Points of the (u, v) plane from which on a polynomial costs less than the likelihood."""


def _quick(
    result: SearchResult, prior: ModelPrior, rng: np.random.Generator
) -> PolynomialLogProb | None:
    """ln L of one strong mode of many data as a polynomial, where it is one."""
    likelihood, modes = result.likelihood, modes_to_sample(result)
    if len(likelihood.samples) < MANY_SAMPLES or len(modes) > 1:
        return None
    centre, scatter = gaussian_of(likelihood, np.array(modes[0].theta), prior.prior, START_WIDTH)
    return polynomial_log_prob(likelihood.log_prob, prior, centre, scatter, rng)


def _start(
    result: SearchResult, prior: Prior, region: Region, rng: np.random.Generator
) -> FloatArray:
    """Walkers (n, n_dim) around the modes, each by its own covariance, inside the prior."""
    chosen, likelihood = modes_to_sample(result), result.likelihood
    # A weak mode's errors reach past the prior's edges; a walker needs only a fair start.
    fits = [gaussian_of(likelihood, np.array(m.theta), prior, START_WIDTH) for m in chosen]
    log_weight = log_masses(likelihood, chosen, prior)
    weight = np.exp(log_weight - log_weight.max())
    place = likelihood.parameters.place()
    n_dim, n_trials = len(fits[0][0]), 100 * N_WALKERS
    which = rng.choice(len(fits), size=n_trials, p=weight / weight.sum())
    centre = np.array([c for c, _ in fits])[which]
    scatter = np.array([s for _, s in fits])[which]
    trial = centre + np.einsum("nij,nj->ni", scatter, rng.standard_normal((n_trials, n_dim)))
    inside = trial[np.isfinite(prior.log_density(trial)) & region.holds(*trial[:, place].T)]
    if len(inside) < N_WALKERS:
        raise DataError("the best fit lies outside the prior", source=likelihood.observables.source)
    return np.asarray(inside[:N_WALKERS])


def _posterior(
    sampler: emcee.EnsembleSampler,
    result: SearchResult,
    prior: Prior,
    grid: GridPosterior | None,
) -> Posterior:
    parameters, each = result.likelihood.parameters, times(sampler)
    burn, thin = burn_in(sampler), thinning(sampler)
    return Posterior(
        names=parameters.names,
        samples=physical(sampler.get_chain(discard=burn, thin=thin, flat=True), parameters),
        log_prob=sampler.get_log_prob(discard=burn, thin=thin, flat=True),
        chain=physical(sampler.get_chain(), parameters),
        chain_log_prob=sampler.get_log_prob(),
        autocorrelation_time=longest(each),
        n_steps=sampler.iteration,
        n_burn=burn,
        n_walkers=sampler.nwalkers,
        split_rhat=float(split_rhat(sampler).max()),
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        converged=long_enough(sampler),
        prior=prior,
        mode_probability=mode_probabilities(result, prior, grid),
        mode_method="laplace" if grid is None else "grid",
        elsewhere=float("nan") if grid is None else elsewhere(result, grid),
        times=each,
        rhats=split_rhat(sampler),
    )

"""The posterior by emcee: started on the modes, stopped on the autocorrelation time.

Sampled in (east, north, ln contrast, nuisance…), whose prior is flat. The chain is written
whole after every segment, with the state of the random generator, so that a killed run
goes on from there and ends with the same samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import emcee
import numpy as np
from astropy.table import QTable

from amibayes.companion_search.result import Mode, SearchResult
from amibayes.companion_search.search import resolution_mas
from amibayes.data.tables import UNITS, html_table, pretty, quantity_table
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.posterior.chain_file import load_chain, save_chain
from amibayes.posterior.grid import GridPosterior
from amibayes.posterior.laplace import gaussian_of, log_masses, physical
from amibayes.posterior.priors import Prior
from amibayes.support import request
from amibayes.support.ensemble_moves import along_others
from amibayes.units import (
    BoolArray,
    FloatArray,
    IntArray,
    contrast_to_delta_mag,
    position_angle_deg,
    separation,
)

STRONG = 30.0
"""Δχ² above which a mode is an island in the sea of noise."""


def modes_to_sample(result: SearchResult) -> tuple[Mode, ...]:
    """Choose the modes that one chain explores.

    Where there are strong ones it is that of the reported one: a mean over positions apart
    is no position. Weak ones are joined by the sea of noise around them.
    """
    strong = result.modes[0].delta_chi2 > STRONG
    return result.modes[:1] if strong else result.modes


@dataclass(frozen=True, eq=False)
class Region:
    """Where a chain is at home: nearer to the reported mode than to any that it leaves out.

    Parameters
    ----------
    places : (n, 2) float array
        East and north of the modes, mas, the reported one first; it alone where the chain
        explores all of the field.
    """

    places: FloatArray

    @classmethod
    def of(cls, result: SearchResult) -> Region:
        """Region of the chain of a search's result."""
        reported, *others = (mode.place for mode in result.modes)
        if modes_to_sample(result) == result.modes:
            others = []
        least = 0.5 * resolution_mas(result.likelihood)  # nearer ones are of the same position
        apart = [place for place in others if math.dist(place, reported) > least]
        return cls(np.array([reported, *apart]))

    def holds(self, east: FloatArray, north: FloatArray) -> BoolArray:
        """Whether positions (n,) are in it."""
        away = np.hypot(east[:, None] - self.places[:, 0], north[:, None] - self.places[:, 1])
        return np.asarray(away.argmin(axis=1) == 0)


@dataclass(frozen=True, eq=False)
class IndependenceProposal:
    """Proposals for `emcee.moves.MHMove` from a grid posterior.

    Every box of a cell in contrast is filled evenly in ln contrast, every cell evenly in
    area; nuisance parameters are drawn by themselves.
    """

    grid: GridPosterior

    def __call__(
        self, walkers: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose places (n, n_dim) for walkers (n, n_dim), and ln q(old)/q(new), (n,)."""
        places, log_density = self.draw(len(walkers), random)
        return places, self.log_density(walkers) - log_density

    def draw(self, n: int, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        """Draw (n, n_dim) of (east, north, ln contrast, nuisance…), and their ln q, (n,)."""
        cells, nuisance = self.grid.cells, self.grid.nuisance
        flat = np.searchsorted(self._cumulated, random.random_sample(n), side="right")
        cell, box = np.divmod(flat, self.grid.contrast_probability.shape[1])
        node = np.searchsorted(self._nodes_cumulated, random.random_sample(n), side="right")
        out, around, up = random.random_sample((3, n))
        inner, outer = cells.inner[cell] ** 2, cells.outer[cell] ** 2
        rho = np.sqrt(inner + out * (outer - inner))
        angle = cells.first[cell] + around * (cells.last[cell] - cells.first[cell])
        low, high = (np.log(self.grid.contrast_edges[cell, box + k]) for k in (0, 1))
        size = nuisance.high[node] - nuisance.low[node]
        further = nuisance.low[node] + random.random_sample(size.shape) * size
        parameters = self.grid.parameters
        places = np.empty((n, len(parameters)))
        places[:, parameters.place()] = np.stack([rho * np.sin(angle), rho * np.cos(angle)]).T
        places[:, parameters.contrasts[0]] = low + up * (high - low)
        places[:, parameters.nuisance] = further
        return places, self._log_density(cell, box, node)

    def log_density(self, places: FloatArray) -> FloatArray:
        """Logarithm of q at (n, n_dim) places; −inf where the grid holds nothing."""
        cells, nuisance = self.grid.cells, self.grid.nuisance
        parameters = self.grid.parameters
        east, north = places[:, parameters.place()].T
        ln_contrast = places[:, parameters.contrasts[0]]
        rho, angle = np.hypot(east, north)[:, None], np.arctan2(east, north)[:, None] % (2 * np.pi)
        across = (cells.first <= angle) & (angle < cells.last)
        in_cell = across & (cells.inner <= rho) & (rho < cells.outer)
        cell = in_cell.argmax(axis=1)
        edges = np.log(self.grid.contrast_edges[cell])
        in_box = (edges[:, :-1] <= ln_contrast[:, None]) & (ln_contrast[:, None] < edges[:, 1:])
        box = in_box.argmax(axis=1)
        value = places[:, None, parameters.nuisance]
        in_node = np.all((nuisance.low <= value) & (value < nuisance.high), axis=2)
        node = in_node.argmax(axis=1)
        inside = np.any(in_cell, axis=1) & np.any(in_box, axis=1) & np.any(in_node, axis=1)
        return np.where(inside, self._log_density(cell, box, node), -np.inf)

    def _log_density(self, cell: IntArray, box: IntArray, node: IntArray) -> FloatArray:
        grid, cells, nuisance = self.grid, self.grid.cells, self.grid.nuisance
        width = cells.last[cell] - cells.first[cell]
        area = 0.5 * (cells.outer[cell] ** 2 - cells.inner[cell] ** 2) * width
        depth = np.log(grid.contrast_edges[cell, box + 1] / grid.contrast_edges[cell, box])
        volume = np.prod(nuisance.high[node] - nuisance.low[node], axis=1)
        share = grid.contrast_probability[cell, box] * grid.nuisance_probability[node]
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(share / (area * depth * volume)))

    @cached_property
    def _cumulated(self) -> FloatArray:
        """Of all boxes, cell by cell."""
        return _cumulated(self.grid.contrast_probability.ravel())

    @cached_property
    def _nodes_cumulated(self) -> FloatArray:
        return _cumulated(self.grid.nuisance_probability)


def _cumulated(probability: FloatArray) -> FloatArray:
    """Sums up to 1, the last of which no draw from [0, 1) reaches."""
    total = np.cumsum(probability)
    return np.asarray(total / total[-1])


N_WALKERS = 32


SEGMENT = 500


MAX_STEPS = 30_000


ENOUGH = 50.0
"""Autocorrelation times a chain must be long (Foreman-Mackey et al. 2013)."""


GOOD_RHAT = 1.02


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
        if name == "separation_mas":
            return separation(self.column("east_mas"), self.column("north_mas"))
        if name == "position_angle_deg":
            return position_angle_deg(self.column("east_mas"), self.column("north_mas"))
        if name == "delta_mag":
            return contrast_to_delta_mag(self.column("contrast"))
        return self.samples[:, self.names.index(name)]

    def interval(self, name: str, level: float = 0.68) -> tuple[float, float, float]:
        """(median, lower, upper) of a quantity.

        Position angles are cut opposite their mean; the median lies in [0, 360) and the
        limits on both sides of it.
        """
        values, cut = self.column(name), 0.0
        if name == "position_angle_deg":
            cut = float(np.angle(np.exp(1j * np.radians(values)).mean(), deg=True)) - 180.0
            values = (values - cut) % 360.0
        low, mid, high = np.quantile(values, [0.5 - level / 2, 0.5, 0.5 + level / 2]) + cut
        turn = 360.0 * (mid // 360.0) if name == "position_angle_deg" else 0.0
        return float(mid - turn), float(low - turn), float(high - turn)

    def to_table(self) -> QTable:
        """All samples as an astropy table with units, with separation, angle and Δmag."""
        derived = ("separation_mas", "position_angle_deg", "delta_mag")
        columns = {name: self.column(name) for name in (*self.names, *derived)}
        return quantity_table(columns | {"log_prob": self.log_prob}, UNITS)

    def _repr_html_(self) -> str:
        """Show medians and intervals in a notebook."""
        rows = []
        for name in ("separation_mas", "position_angle_deg", "delta_mag", *self.names):
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
        try:
            import arviz
        except ImportError as error:
            raise UsageError(
                "InferenceData needs ArviZ", remedy="pip install 'amibayes[arviz]'"
            ) from error
        kept = self.chain[self.n_burn :].swapaxes(0, 1)
        groups: dict[str, Any] = {
            "posterior": {name: kept[..., k] for k, name in enumerate(self.names)},
            "sample_stats": {"lp": self.chain_log_prob[self.n_burn :].T},
        }
        # Version 1 takes one dictionary of groups and returns an xarray.DataTree.
        old = hasattr(arviz, "InferenceData")
        return arviz.from_dict(**groups) if old else arviz.from_dict(groups)

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT converged"
        return f"<Posterior: {len(self.samples)} samples of {', '.join(self.names)}; {state}>"


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
        `IndependenceProposal`.
    max_steps : int
        Steps after which a chain that has not converged is given up (and said to be so).
    progress : callable, optional
        Called with (steps done, steps expected).
    """
    likelihood, region = result.likelihood, Region.of(result)
    start = _start(result, prior, region, rng)
    seed = int(rng.integers(2**32))
    log_prob = _log_posterior(likelihood, prior, region)
    # All of data, covariance, noise and model are in the values at the start.
    digest = request.digest(
        start, log_prob(start), prior, seed, region.places, grid is not None, emcee.__version__
    )
    backend = load_chain(path, digest) if path and resume else None
    sampler = emcee.EnsembleSampler(
        len(start),
        start.shape[1],
        log_prob,
        vectorize=True,
        moves=_moves(grid, region),
        backend=backend,
    )
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    while not (done := _long_enough(sampler)) and sampler.iteration < max_steps:
        sampler.run_mcmc(state if sampler.iteration == 0 else None, SEGMENT)
        if path:
            save_chain(sampler, path, digest)
        if progress:
            progress(sampler.iteration, int(ENOUGH * _time(sampler)))
    return _posterior(sampler, result, prior, grid, done)


def _moves(grid: GridPosterior | None, region: Region) -> list[tuple[emcee.moves.Move, float]]:
    """Moves and how often each is made."""
    along = along_others()
    if grid is None:
        return along
    inside = region.holds(*grid.cells.position)
    if not grid.probability[inside].any():  # too improbable for cells of its own
        return along
    leaps = IndependenceProposal(grid.within(inside))
    return [*((move, 0.5 * share) for move, share in along), (emcee.moves.MHMove(leaps), 0.5)]


def _log_posterior(
    likelihood: Likelihood, prior: Prior, region: Region
) -> Callable[[FloatArray], FloatArray]:
    parameters = likelihood.parameters
    place = parameters.place()

    def log_posterior(x: FloatArray) -> FloatArray:
        density = np.where(region.holds(*x[:, place].T), prior.log_density(x), -np.inf)
        inside = np.isfinite(density)
        if inside.any():
            density[inside] += likelihood.log_prob(physical(x[inside], parameters))
        return density

    return log_posterior


def mode_probabilities(
    result: SearchResult, prior: Prior, grid: GridPosterior | None = None
) -> FloatArray:
    """Probability of each mode among the modes, (n_modes,).

    By the grid posterior within λ/2B of each mode, where there is one; else by Laplace's
    approximation.
    """
    if grid is not None:
        mass = mode_masses(result, grid)
        if mass.sum() > 0.0:
            return np.asarray(mass / mass.sum())
    log_mass = log_masses(result.likelihood, result.modes, prior)
    weight = np.exp(log_mass - log_mass.max())
    return np.asarray(weight / weight.sum())


def mode_masses(result: SearchResult, grid: GridPosterior) -> FloatArray:
    """Posterior probability within λ/2B of each mode; what is missing to 1 is elsewhere."""
    places = np.array([m.place for m in result.modes])
    return grid.mass_near(places, 0.5 * resolution_mas(result.likelihood))


def _elsewhere(result: SearchResult, grid: GridPosterior) -> float:
    return max(1.0 - float(mode_masses(result, grid).sum()), 0.0)


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


def _times(sampler: emcee.EnsembleSampler) -> FloatArray:
    """Integrated autocorrelation times of the second two thirds of the chain, steps, (n_dim,)."""
    chain = sampler.get_chain()[sampler.iteration // 3 :]
    return np.asarray(emcee.autocorr.integrated_time(chain, tol=0))


def _longest(times: FloatArray) -> float:
    return float(np.nanmax(times)) if np.isfinite(times).any() else np.inf


def _time(sampler: emcee.EnsembleSampler) -> float:
    return _longest(_times(sampler))


def _long_enough(sampler: emcee.EnsembleSampler) -> bool:
    if sampler.iteration < 2 * SEGMENT:
        return False
    kept = sampler.iteration - sampler.iteration // 3
    return bool(kept > ENOUGH * _time(sampler) and _split_rhat(sampler).max() < GOOD_RHAT)


def _split_rhat(sampler: emcee.EnsembleSampler) -> FloatArray:
    """Split-R̂ of the parameters, every walker's second two thirds cut in two, (n_dim,)."""
    chain = sampler.get_chain()[sampler.iteration // 3 :]
    half = len(chain) // 2
    halves = np.concatenate([chain[:half], chain[half : 2 * half]], axis=1)
    within = halves.var(axis=0, ddof=1).mean(axis=0)
    between = halves.mean(axis=0).var(axis=0, ddof=1)
    return np.asarray(np.sqrt(((half - 1) / half * within + between) / within))


def _posterior(
    sampler: emcee.EnsembleSampler,
    result: SearchResult,
    prior: Prior,
    grid: GridPosterior | None,
    converged: bool,
) -> Posterior:
    times = _times(sampler)
    time, parameters = _longest(times), result.likelihood.parameters
    burn = sampler.iteration // 3
    thin = max(1, int(0.5 * time)) if np.isfinite(time) else 1
    return Posterior(
        names=parameters.names,
        samples=physical(sampler.get_chain(discard=burn, thin=thin, flat=True), parameters),
        log_prob=sampler.get_log_prob(discard=burn, thin=thin, flat=True),
        chain=physical(sampler.get_chain(), parameters),
        chain_log_prob=sampler.get_log_prob(),
        autocorrelation_time=time,
        n_steps=sampler.iteration,
        n_burn=burn,
        n_walkers=sampler.nwalkers,
        split_rhat=float(_split_rhat(sampler).max()),
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        converged=converged,
        prior=prior,
        mode_probability=mode_probabilities(result, prior, grid),
        mode_method="laplace" if grid is None else "grid",
        elsewhere=float("nan") if grid is None else _elsewhere(result, grid),
        times=times,
        rhats=_split_rhat(sampler),
    )

"""Draws that do not start from where a walker is: of a grid posterior, or of the modes.

They lead a chain from mode to mode, and weighted by the posterior they are a sampler and an
evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from amibayes.companion_search.result import Mode
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.posterior.grid import GridPosterior
from amibayes.posterior.laplace import HeavyTailed, gaussian_of, log_masses, physical, sampled
from amibayes.posterior.modes import Region
from amibayes.posterior.nuisance import StarAlone, star_alone
from amibayes.posterior.polynomial import Around
from amibayes.posterior.priors import Prior
from amibayes.posterior.sampler import Draws, LogProb, ModelPrior, log_mean
from amibayes.support.ensemble_moves import Proposal
from amibayes.units import FloatArray, IntArray

N_DRAWS = 20_000
"""ln Z is then known to a per cent, where the grid is as fine as it is by default."""


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


def independence_move_within(grid: GridPosterior, region: Region) -> IndependenceProposal | None:
    """Proposals inside a region; None where it is too improbable for cells of its own."""
    inside = region.holds(*grid.cells.position)
    if not grid.probability[inside].any():
        return None
    return IndependenceProposal(grid.within(inside))


class Unnoticed:
    """A companion as the prior has it, beside the star as the data then have it.

    Companions too faint for the data, most of the prior of the contrast, have this posterior: the
    star's own, moved by one Gauss–Newton step for what the companion does to the data.

    Parameters
    ----------
    likelihood : Likelihood
        With one companion.
    prior : Prior
    alone : StarAlone
        Of the same likelihood and prior.
    """

    def __init__(self, likelihood: Likelihood, prior: Prior, alone: StarAlone) -> None:
        self.prior, self.parameters = prior, likelihood.parameters
        values, vectors = np.linalg.eigh(alone.covariance)
        self.star = HeavyTailed(alone.mean, vectors * np.sqrt(np.clip(values, 1e-20, None)))
        self._some = _of_some_data(likelihood)
        single = single_likelihood(self._some)
        self._step = np.linalg.pinv(single.jacobian(alone.mean)) if len(alone.mean) else None
        self._without = single.residuals(alone.mean)

    def draw(self, rng: np.random.Generator | np.random.RandomState, n: int) -> FloatArray:
        """Draws (n, n_dim)."""
        x = sampled(self.prior.draw(rng, n), self.parameters)
        x[:, self.parameters.nuisance] = self.star.draw(rng, n) + self.moved(x)
        return x

    def log_density(self, x: FloatArray) -> FloatArray:
        """ln of the density at x (n, n_dim), (n,)."""
        companion = replace(self.prior, nuisance=(), half_cauchy=())
        density = companion.log_density(x[:, self.parameters.companion()])
        inside = np.isfinite(density)
        if inside.any():
            some = x[inside]
            star = some[:, self.parameters.nuisance] - self.moved(some)
            density[inside] += self.star.log_density(star)
        return np.asarray(density)

    def moved(self, x: FloatArray) -> FloatArray:
        """What companions at x (n, n_dim) do to the nuisance parameters, (n, n_nuisance)."""
        theta = physical(x, self.parameters)
        if self._step is None:
            return theta[:, self.parameters.nuisance]
        theta[:, self.parameters.nuisance] = self.star.centre
        found = [self._some.residuals(part) for part in self._some.in_parts(theta)]
        return np.asarray((self._step @ (np.hstack(found) - self._without)).T)


SOME_DATA = 400
"""Data that tell how companions move the star: whatever is found, the density is that of the draws,
and this step of them all costs as much as the likelihood."""


def _of_some_data(likelihood: Likelihood) -> Likelihood:
    """The likelihood of `SOME_DATA` of the data with their stated errors, if there are more."""
    data = likelihood.observables.unflagged()
    n = data.n_vis2 + data.n_closure_phases
    if n <= SOME_DATA:
        return likelihood
    kept = np.random.default_rng(0).permutation(n) < SOME_DATA
    return Likelihood(data.select(kept[: data.n_vis2], kept[data.n_vis2 :]), likelihood.model)


@dataclass(frozen=True, eq=False)
class Mixture:
    """Proposals in given shares.

    Parameters
    ----------
    parts : tuple of Proposal
    share : (n_parts,) float array
    """

    parts: tuple[Proposal, ...]
    share: FloatArray

    def draw(self, rng: np.random.Generator | np.random.RandomState, n: int) -> FloatArray:
        """Draws (n, n_dim)."""
        counts = rng.multinomial(n, self.share)
        drawn = [p.draw(rng, int(m)) for p, m in zip(self.parts, counts, strict=True)]
        return np.asarray(rng.permutation(np.concatenate(drawn)))

    def log_density(self, x: FloatArray) -> FloatArray:
        """ln of the density at x (n, n_dim), (n,)."""
        parts = [p.log_density(x) for p in self.parts]
        return np.asarray(logsumexp(parts, axis=0, b=self.share[:, None]))


NEGLIGIBLE = 50.0
"""ln of the mass, below that of the best mode, with which a companion that is not noticed is left
out: its e⁻⁵⁰ of the draws would cost as much as all others."""

WORTH = 0.05
"""Share of the draws from which on a mode's own proposal is looked for."""


def mode_mixture(
    likelihood: Likelihood, modes: Sequence[Mode], prior: Prior, rng: np.random.Generator
) -> Mixture:
    """t distributions like the posterior at each mode, and a companion that is not noticed.

    Parameters
    ----------
    likelihood : Likelihood
    modes : sequence of Mode
        Of its model.
    prior : Prior
    rng : numpy.random.Generator
    """
    log_mass = log_masses(likelihood, modes, prior)
    unnoticed: list[Proposal] = []
    if likelihood.model.companions == 1:
        alone = star_alone(likelihood, prior)
        if alone.log_z > log_mass.max() - NEGLIGIBLE:
            unnoticed.append(Unnoticed(likelihood, prior, alone))
            log_mass = np.append(log_mass, alone.log_z)
    # What holds less keeps a share: its Gaussian may be too narrow.
    share = np.exp(0.5 * (log_mass - log_mass.max())) + 1e-3
    share /= share.sum()
    around = Around(likelihood.log_prob, ModelPrior(prior, likelihood.parameters), rng)
    fits = [gaussian_of(likelihood, np.array(m.theta), prior) for m in modes]
    # Laplace's covariance is of one noise and knows no tails: draws from it alone miss some.
    found = [
        (around.heavy_tailed(*fit) if s > WORTH else None) or HeavyTailed(*fit)
        for fit, s in zip(fits, share, strict=False)
    ]
    return Mixture((*found, *unnoticed), share)


@dataclass(frozen=True, eq=False)
class GridSampler:
    """Draws of a grid posterior, weighted by likelihood times prior over their own density.

    Parameters
    ----------
    grid : GridPosterior
        Of the same likelihood and prior.
    n_draws : int
    """

    grid: GridPosterior
    n_draws: int = N_DRAWS

    def sample(self, log_prob: LogProb, prior: ModelPrior, rng: np.random.Generator) -> Draws:
        """Sample the posterior of one companion and measure its evidence."""
        random = np.random.RandomState(int(rng.integers(2**32)))
        x, log_density = IndependenceProposal(self.grid).draw(self.n_draws, random)
        samples = physical(x, prior.parameters)
        value = log_prob(samples)
        log_weight = value + prior.prior.log_density(x) - log_density
        log_z, error = log_mean(log_weight, self.n_draws)
        weights = np.exp(log_weight - log_z) / self.n_draws
        evidence = {"log_z": float(log_z), "log_z_error": float(error)}
        return Draws(samples, value, weights, evidence)


def _cumulated(probability: FloatArray) -> FloatArray:
    """Sums up to 1, the last of which no draw from [0, 1) reaches."""
    total = np.cumsum(probability)
    return np.asarray(total / total[-1])

"""Draws out of a grid posterior: proposals that lead a chain from mode to mode, and a sampler."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.posterior.grid import GridPosterior
from amibayes.posterior.laplace import physical
from amibayes.posterior.modes import Region
from amibayes.posterior.sampler import Draws, LogProb, ModelPrior, log_mean
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


def leaps_within(grid: GridPosterior, region: Region) -> IndependenceProposal | None:
    """Proposals inside a region; None where it is too improbable for cells of its own."""
    inside = region.holds(*grid.cells.position)
    if not grid.probability[inside].any():
        return None
    return IndependenceProposal(grid.within(inside))


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

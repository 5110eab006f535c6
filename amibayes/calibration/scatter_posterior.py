"""Posterior of the scatter between calibrators: on a grid, and sampled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import emcee
import numpy as np

from amibayes.calibration.scatter_likelihood import Population
from amibayes.errors import RunError
from amibayes.support.ensemble_moves import independence_move
from amibayes.units import FloatArray, IntArray

LOWEST, HIGHEST = 0.01, 3.0
"""Scatters between calibrators in units of the scale of their prior, 5 times the median error: a
twentieth of an error changes nothing, three scales have a prior of 1 %."""

FURTHER = 10.0
"""By which the highest is multiplied while the posterior goes on there."""

NODES = 16
"""Of the scatter of each kind; set twice, the second time where the first found its posterior."""

NEGLIGIBLE = 1e-4
"""Part of the highest posterior below which a scatter does not count."""

FROM_PRIOR = 0.05
"""Share of proposals that are draws of the prior, which reaches where the grid does not."""

N_WALKERS = 20
CHECK_EVERY = 100
MAX_STEPS = 8000


@dataclass(frozen=True, eq=False)
class ScatterGrid:
    """The posterior on a grid, of scatters in units of their prior's scale, to draw from.

    Parameters
    ----------
    population : Population
    present : (d,) int array
        Kinds that there are: 0 for V², 1 for closure phase.
    axes : list of (m,) float array
        Nodes of each kind.
    weight : (m, ...) float array
        Probability of each cell.
    """

    population: Population
    present: IntArray
    axes: list[FloatArray]
    weight: FloatArray

    @classmethod
    def of(cls, population: Population) -> ScatterGrid:
        """Lay the grid where the posterior is, by one that covers the prior.

        The prior's tail is no bound: of errors that are far too small the data tell a scatter of
        many scales.
        """
        present = np.flatnonzero(np.isfinite(population.prior_scale))
        ends = [(LOWEST, HIGHEST)] * len(present)
        while True:
            found = cls.over(population, present, ends)
            spans = found._spans()
            if all(last < NODES - 1 for _, last in spans):
                break
            ends = [
                (low, FURTHER * high if last == NODES - 1 else high)
                for (low, high), (_, last) in zip(ends, spans, strict=True)
            ]
        ends = [
            (axis[max(first - 1, 0)], axis[last + 1])
            for axis, (first, last) in zip(found.axes, spans, strict=True)
        ]
        return cls.over(population, present, ends)

    @classmethod
    def over(
        cls, population: Population, present: IntArray, ends: list[tuple[float, float]]
    ) -> ScatterGrid:
        """Lay the grid between ends of each axis."""
        axes = [np.geomspace(*end, NODES) for end in ends]
        found = cls(population, present, axes, np.ones([NODES] * len(present)))
        # Equal steps of the logarithm: the density is per unit of the scatter itself.
        log_p = found.log_prob(found.nodes) + np.log(found.nodes).sum(axis=1)
        weight = np.exp(log_p - log_p.max()).reshape(found.weight.shape)
        return replace(found, weight=weight / weight.sum())

    def _spans(self) -> list[tuple[int, int]]:
        """First and last node of each axis that count."""
        counts = self.weight > NEGLIGIBLE * self.weight.max()
        used = [np.unique(at) for at in np.nonzero(counts)]
        return [(int(at[0]), int(at[-1])) for at in used]

    @property
    def posterior(self) -> tuple[FloatArray, FloatArray]:
        """Scatters between calibrators (m, 2) and their posterior (m,), for moments.

        Nodes that do not count are left out; a kind that is absent has scatter 0.
        """
        tau, weight = np.zeros((self.weight.size, 2)), self.weight.ravel()
        tau[:, self.present] = self.nodes * self.scale
        used = weight > NEGLIGIBLE * weight.max()
        return tau[used], weight[used] / weight[used].sum()

    @property
    def scale(self) -> FloatArray:
        """Of the prior of each kind, (d,)."""
        return np.asarray(self.population.prior_scale[self.present])

    @property
    def nodes(self) -> FloatArray:
        """All nodes, (m, d)."""
        grid = np.meshgrid(*self.axes, indexing="ij")
        return np.stack(grid, axis=-1).reshape(-1, len(self.axes))

    def log_prob(self, relative: FloatArray) -> FloatArray:
        """Logarithm of the posterior density of scatters (n, d), (n,)."""
        tau = np.zeros((len(relative), 2))
        tau[:, self.present] = relative * self.scale
        return self.population.log_prob(tau)

    def draw(self, rng: np.random.Generator | np.random.RandomState, n: int) -> FloatArray:
        """Scatters (n, d): even within cells, a few from the prior."""
        cell = rng.choice(self.weight.size, n, p=self.weight.ravel())
        place = np.unravel_index(cell, self.weight.shape)
        part = rng.random((n, len(self.axes)))
        drawn = [
            edge[at] + share * np.diff(edge)[at]
            for edge, at, share in zip(self._edges(), place, part.T, strict=True)
        ]
        from_prior = rng.random(n) < FROM_PRIOR
        prior = np.abs(rng.standard_normal((n, len(self.axes))))
        return np.where(from_prior[:, None], prior, np.stack(drawn, axis=1))

    def log_density(self, relative: FloatArray) -> FloatArray:
        """Logarithm of the density of draws at scatters (n, d), (n,)."""
        place, inside, volume = [], np.ones(len(relative), dtype=bool), 1.0
        for edge, value in zip(self._edges(), relative.T, strict=True):
            at = np.searchsorted(edge, value, side="right") - 1
            inside &= (at >= 0) & (at < len(edge) - 1)
            at = np.clip(at, 0, len(edge) - 2)
            place.append(at)
            volume = volume * np.diff(edge)[at]
        cells = np.where(inside, self.weight[tuple(place)] / volume, 0.0)
        prior = np.prod(np.sqrt(2.0 / np.pi) * np.exp(-0.5 * relative**2), axis=1)
        return np.asarray(np.log((1.0 - FROM_PRIOR) * cells + FROM_PRIOR * prior))

    def _edges(self) -> list[FloatArray]:
        """Ends of the cells (m + 1,) of each kind; the first begins at no scatter."""
        between = [np.sqrt(axis[1:] * axis[:-1]) for axis in self.axes]
        return [
            np.concatenate([[0.0], inner, [axis[-1] ** 2 / inner[-1]]])
            for axis, inner in zip(self.axes, between, strict=True)
        ]


def sample_tau(grid: ScatterGrid, rng: np.random.Generator) -> FloatArray:
    """Draw τ from its posterior with emcee, (n, 2); NaN for a kind that is absent.

    Proposals come out of the posterior on a grid: a walker forgets its place in a step or two.

    Raises
    ------
    RunError
        Where the chain is shorter than 50 autocorrelation times.
    """
    # emcee wants the state of numpy's older generator; it is seeded from ours.
    older = np.random.RandomState(np.random.MT19937(rng.integers(2**63)))
    start = grid.draw(older, N_WALKERS)
    sampler = emcee.EnsembleSampler(
        *start.shape,
        grid.log_prob,
        vectorize=True,
        moves=emcee.moves.MHMove(independence_move(grid)),
    )
    state = emcee.State(start, random_state=older.get_state())
    time = np.inf
    while sampler.iteration < MAX_STEPS and not 50 * time < sampler.iteration:
        state = sampler.run_mcmc(state, CHECK_EVERY, skip_initial_state_check=True)
        time = float(np.max(sampler.get_autocorr_time(quiet=True, tol=0)))
    if not 50 * time < sampler.iteration:
        raise RunError("the scatter between calibrators could not be sampled")
    chain = sampler.get_chain(discard=int(5 * time) + 1, flat=True)
    tau = np.full((len(chain), 2), np.nan)
    tau[:, grid.present] = chain * grid.scale
    return tau


__all__ = ["ScatterGrid", "sample_tau"]

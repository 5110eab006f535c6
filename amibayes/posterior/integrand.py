"""What a grid posterior adds up: the likelihood at cells, over contrast and nuisance.

The contrast is integrated over boxes that follow the likelihood in every cell, each with
its exact prior probability; nuisance parameters over Gauss–Legendre nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.optimise import fit_single, refine
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.parameters import Box
from amibayes.posterior.contrast_profile import profile
from amibayes.posterior.nuisance import Nuisance, given_rest, log_evidence_none, nuisance_nodes
from amibayes.posterior.priors import Prior
from amibayes.units import MAS, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a polar lattice: ranges of separation (mas) and position angle (radians)."""

    inner: FloatArray
    outer: FloatArray
    first: FloatArray
    last: FloatArray

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: Any) -> Cells:
        return Cells(self.inner[index], self.outer[index], self.first[index], self.last[index])

    @property
    def centre(self) -> tuple[FloatArray, FloatArray]:
        """Separation (the mean over the cell's area) and position angle, (n,) each."""
        a, b = self.inner, self.outer
        rho = 2.0 / 3.0 * (a * a + a * b + b * b) / (a + b)
        return rho, 0.5 * (self.first + self.last)

    @property
    def position(self) -> tuple[FloatArray, FloatArray]:
        """East and north of the centres, mas, (n,) each."""
        rho, angle = self.centre
        return rho * np.sin(angle), rho * np.cos(angle)

    @property
    def size(self) -> FloatArray:
        """Longer side, mas, (n,)."""
        across = self.outer * (self.last - self.first)
        return np.maximum(self.outer - self.inner, across)

    def halved(self) -> Cells:
        """Four cells for each one, halved in separation and in angle."""
        rho, angle = 0.5 * (self.inner + self.outer), 0.5 * (self.first + self.last)
        return Cells(
            np.concatenate([self.inner, rho, self.inner, rho]),
            np.concatenate([rho, self.outer, rho, self.outer]),
            np.concatenate([self.first, self.first, angle, angle]),
            np.concatenate([angle, angle, self.last, self.last]),
        )

    @staticmethod
    def join(one: Cells, other: Cells) -> Cells:
        """Cells of both."""
        names = ("inner", "outer", "first", "last")
        return Cells(*(np.concatenate([getattr(one, n), getattr(other, n)]) for n in names))


def polar_cells(inner_mas: float, outer_mas: float, step_mas: float) -> Cells:
    """Tile an annulus with cells of about a step in both directions."""
    n_rings = max(1, int(np.ceil((outer_mas - inner_mas) / step_mas)))
    edges = np.linspace(inner_mas, outer_mas, n_rings + 1)
    counts = np.maximum(6, np.ceil(2.0 * np.pi * edges[1:] / step_mas)).astype(int)
    ring = np.repeat(np.arange(n_rings), counts)
    place = np.arange(len(ring)) - np.repeat(np.cumsum(counts) - counts, counts)
    width = 2.0 * np.pi / counts[ring]
    return Cells(edges[ring], edges[ring + 1], place * width, (place + 1) * width)


CELLS_PER_FRINGE = 8
"""Cells per λ/B_max to begin with."""


CONTRAST_REACH = 7.0
"""Errors of the contrast, to both sides of its best value, that are integrated finely."""


FAINT_BOXES, FINE_BOXES, MORE_BOXES = 8, 40, 24
"""Boxes in contrast: below the fine range, in it, and more of them with nuisance parameters."""


CERTAIN = 30.0
"""Gain of ln L by a companion beyond which what fits without one has no share."""


BRIGHT = (0.1, 0.2, 0.4, 0.8)
"""Contrasts tried beside the best one of the linear theory."""


BATCH = 1_500_000
"""Model values (samples × parameter sets) held at once."""


@dataclass(frozen=True, eq=False)
class Shares:
    """What cells hold of the evidence.

    Parameters
    ----------
    edges : (n, n_boxes + 1) float array
        Boxes of the contrast.
    log_scale : (n,) float array
        Logarithm of the unit of the following two.
    by_contrast : (n, n_boxes) float array
    by_nuisance : (n, n_nodes) float array
    peak : (n,) float array
        Best log-likelihood.
    """

    edges: FloatArray
    log_scale: FloatArray
    by_contrast: FloatArray
    by_nuisance: FloatArray
    peak: FloatArray

    @property
    def log_mass(self) -> FloatArray:
        """Logarithm of each cell's share of the evidence, (n,)."""
        with np.errstate(divide="ignore"):
            return np.asarray(self.log_scale + np.log(self.by_contrast.sum(axis=1)))

    def __getitem__(self, index: Any) -> Shares:
        return Shares(*(getattr(self, f.name)[index] for f in fields(self)))

    @staticmethod
    def join(several: Sequence[Shares]) -> Shares:
        """Cells of all."""
        columns = ([getattr(s, f.name) for s in several] for f in fields(Shares))
        return Shares(*(np.concatenate(c) for c in columns))


class Integrand:
    """Likelihood times prior, integrated over contrast and nuisance, in batches of cells.

    Parameters
    ----------
    likelihood : Likelihood
        With a model of one companion.
    prior : Prior
    """

    def __init__(self, likelihood: Likelihood, prior: Prior) -> None:
        self.likelihood, self.prior = likelihood, prior
        self.fringe_mas = float(1.0 / likelihood.samples.frequency.max() / MAS)
        self.single, self.deviance_single = fit_single(likelihood)
        lattice = self.fringe_mas / CELLS_PER_FRINGE
        self.grid = make_grid(prior.inner_mas, prior.outer_mas, lattice)
        self._scan()
        alone = single_likelihood(likelihood)
        self.best_none = float(alone.log_prob(self.single[None])[0])
        self.nuisance = self._nuisance()
        self.n_boxes = FAINT_BOXES + FINE_BOXES + MORE_BOXES * bool(len(self.single))
        self.log_z_none = log_evidence_none(likelihood, prior, self.single)
        without, left = alone.chi2(self.single[None])[0], likelihood.chi2(self._best[None])[0]
        self.most = max(float((without - left) / likelihood.noise.inflation(left)), 0.0)

    def _scan(self) -> None:
        """Best contrast and gain in χ² of the linear theory over a lattice of the field."""
        if not len(self.grid):
            self.gain, self.contrast = np.zeros(0), np.zeros(0)
            return
        bank = TemplateBank(self.likelihood, self.grid, self.single)
        residuals = single_likelihood(self.likelihood).residuals(self.single)[:, 0]
        self.contrast, sigma = bank.scan(residuals)
        self.gain = np.where(self.contrast > 0, (self.contrast / sigma) ** 2, 0.0)

    def start(self) -> Cells:
        """Cells of the field, without those that the linear theory rules out by far."""
        p = self.prior
        cells = polar_cells(p.inner_mas, p.outer_mas, self.fringe_mas / CELLS_PER_FRINGE)
        if not len(self.grid) or self.contrast[self.gain.argmax()] > BRIGHT[0]:
            return cells
        image = np.nan_to_num(self.grid.image(self.gain), nan=0.0)
        around = maximum_filter(image, 3)
        half = self.grid.half_width
        east, north = (
            np.clip(np.rint(x / self.grid.step_mas).astype(int) + half, 0, 2 * half)
            for x in cells.position
        )
        best = self.gain.max()
        return cells[around[north, east] > 0.4 * best - 60.0]

    def _nuisance(self) -> Nuisance:
        """Nodes over what the fits with a companion, and if it counts without, allow."""
        if not len(self.single):
            return nuisance_nodes(self.prior, np.empty((1, 0)), np.empty((0, 0)))
        best = self._best
        columns = self.likelihood.parameters.nuisance
        errors = self.likelihood.errors(best)
        marginal = errors[np.ix_(columns, columns)]
        gain = float(self.likelihood.log_prob(best[None])[0]) - self.best_none
        centres = [best[columns]] if gain > CERTAIN else [self.single, best[columns]]
        narrow = given_rest(errors, columns)
        return nuisance_nodes(self.prior, np.array(centres), marginal, at_companion=narrow)

    @cached_property
    def _best(self) -> FloatArray:
        """A fit with a companion, from the best position of the linear scan."""
        if not len(self.grid):
            return np.concatenate([[self.prior.outer_mas, 0.0, 0.0], self.single])
        k = int(self.gain.argmax())
        place = [self.grid.east_mas[k], self.grid.north_mas[k], np.clip(self.contrast[k], 0, 1)]
        box = Box(self.prior.inner_mas, self.prior.outer_mas, self.fringe_mas)
        seed = np.concatenate([place, self.single])
        return np.array(refine(self.likelihood, seed, box, self.deviance_single).theta)

    def log_prob(self, sites: FloatArray, contrast: FloatArray) -> FloatArray:
        """Log-likelihood (n, k) at sites (n, 2 + n_nuisance), each with k contrasts (n, k)."""
        return self.likelihood.log_prob(self._thetas(sites, contrast)).reshape(contrast.shape)

    def _log_prob_at_best_noise(self, sites: FloatArray, contrast: FloatArray) -> FloatArray:
        """The same for one covariance, that of the search: a parabola at small contrast."""
        chi2 = self.likelihood.chi2(self._thetas(sites, contrast))
        return np.asarray(-0.5 * chi2).reshape(contrast.shape)

    def _thetas(self, sites: FloatArray, contrast: FloatArray) -> FloatArray:
        n, k = contrast.shape
        theta = np.empty((n, k, sites.shape[1] + 1))
        bright = self.likelihood.parameters.contrasts
        theta[:, :, np.delete(np.arange(theta.shape[2]), bright)] = sites[:, None]
        theta[:, :, bright[0]] = contrast
        return theta.reshape(n * k, -1)

    def _best_contrast(self, sites: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Most likely contrast (below zero where it is) and its error at sites, (n,) each."""
        n, most = len(sites), self.prior.contrast_max
        bright = [c for c in BRIGHT if c < most]
        trial = np.broadcast_to([0.0, 1e-3, 2e-3, *bright], (n, 3 + len(bright)))
        value = self._log_prob_at_best_noise(sites, trial)
        best, sigma = _parabola(np.full(n, 1e-3), np.full(n, 1e-3), value[:, :3], np.full(n, 1.0))
        if bright:
            top = value[:, 3:].argmax(axis=1)
            brighter = np.clip(best, 0.0, most)[:, None]
            exceeds = (
                value[np.arange(n), 3 + top] > self._log_prob_at_best_noise(sites, brighter)[:, 0]
            )
            best = np.where(exceeds, np.array(bright)[top], best)
        for _ in range(2):
            middle = np.clip(best, sigma, np.maximum(most, sigma))
            points = middle[:, None] + sigma[:, None] * np.array([-1.0, 0.0, 1.0])
            value = self._log_prob_at_best_noise(sites, points)
            best, sigma = _parabola(middle, sigma, value, sigma)
        return best, sigma

    def boxes(self, cells: Cells) -> tuple[FloatArray, FloatArray]:
        """Boxes of the contrast (n, n_boxes + 1), and log-likelihood (n, n_nodes, n_boxes)."""
        outer = self._best_contrast(_sites(cells, self.nuisance.outer))
        edges = self._edges(*(x.reshape(len(cells), -1) for x in outer))
        contrast, n_nodes = self._inside(edges), len(self.nuisance.value)
        sites = _sites(cells, self.nuisance.value)

        def at(rows: IntArray, wanted: FloatArray) -> FloatArray:
            return self.log_prob(sites[rows], wanted)

        everywhere = np.arange(len(sites))
        faint = at(everywhere, np.repeat(contrast[:, :FAINT_BOXES], n_nodes, axis=0))
        low, high = edges[:, FAINT_BOXES], edges[:, -1]
        fine = profile(at, low, high, contrast[:, FAINT_BOXES:], n_nodes)
        faint = faint.reshape(len(cells), n_nodes, FAINT_BOXES)
        return edges, np.concatenate([faint, fine], axis=2)

    def _edges(self, best: FloatArray, sigma: FloatArray) -> FloatArray:
        """Boxes: logarithmic below the fine range, even in it; (n, n_nodes) → (n, n_boxes + 1)."""
        p, small = self.prior, sigma.min(axis=1)
        low = np.maximum((best - CONTRAST_REACH * sigma).min(axis=1), 0.3 * small)
        high = (np.maximum(best, 0.0) + CONTRAST_REACH * sigma).max(axis=1)
        low = np.clip(low, p.contrast_min, 0.9 * p.contrast_max)
        # Where the data want less than the prior allows, what lies above its lower end counts.
        high = np.minimum(np.maximum(high, low + CONTRAST_REACH * small), p.contrast_max)
        faint = np.geomspace(np.full(len(low), p.contrast_min), low, FAINT_BOXES + 1, axis=1)
        fine = np.linspace(low, high, self.n_boxes - FAINT_BOXES + 1, axis=1)
        return np.hstack([faint, fine[:, 1:]])

    def _inside(self, edges: FloatArray) -> FloatArray:
        """Mean contrast of every box under the prior."""
        low, high = edges[:, :-1], edges[:, 1:]
        if self.prior.contrast_form == "uniform":
            return 0.5 * (low + high)
        ratio = np.log(high / low)
        return np.where(ratio > 1e-6, (high - low) / np.where(ratio > 0, ratio, 1.0), low)

    def batches(self, cells: Cells) -> list[Cells]:
        """Cut cells into groups whose model values fit in memory."""
        each = len(self.likelihood.samples) * len(self.nuisance.value) * self.n_boxes
        at_once = max(1, BATCH // each)
        return [cells[k : k + at_once] for k in range(0, len(cells), at_once)]

    def shares(self, cells: Cells) -> Shares:
        """What cells hold."""
        return Shares.join([self._shares(batch) for batch in self.batches(cells)])

    def _shares(self, cells: Cells) -> Shares:
        p = self.prior
        edges, log_prob = self.boxes(cells)
        ring = p.ring_cdf(cells.outer) - p.ring_cdf(cells.inner)
        place = np.log(ring * (cells.last - cells.first) / (2.0 * np.pi))
        bright = np.log(np.maximum(np.diff(p.contrast_cdf(edges), axis=1), 1e-300))
        log_mass = log_prob + (place[:, None] + bright)[:, None, :]
        log_mass += self.nuisance.log_weight[:, None]
        top = log_mass.max(axis=(1, 2))
        share = np.exp(log_mass - np.where(np.isfinite(top), top, 0.0)[:, None, None])
        return Shares(edges, top, share.sum(axis=1), share.sum(axis=2), log_prob.max(axis=(1, 2)))

    def delta_chi2(self, peak: FloatArray) -> FloatArray:
        """Δχ² over no companion of cells whose best log-likelihoods are given, (n,)."""
        gain = self.likelihood.noise.delta_chi2(peak - self.best_none)
        return np.minimum(gain, max(self.most, 2.0 * float(np.max(peak - self.best_none))))


def _sites(cells: Cells, nodes: FloatArray) -> FloatArray:
    """Position and nuisance parameters, (n_cells × n_nodes, 2 + n_nuisance)."""
    place = np.repeat(np.column_stack(cells.position), len(nodes), axis=0)
    return np.hstack([place, np.tile(nodes, (len(cells), 1))])


def _parabola(
    middle: FloatArray, step: FloatArray, value: FloatArray, otherwise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Top and width of the parabolas through values (n, 3) at middle − step, middle, + step."""
    slope = 0.5 * (value[:, 2] - value[:, 0]) / step
    curvature = (2.0 * value[:, 1] - value[:, 0] - value[:, 2]) / step**2
    arched = curvature > 1e-4 / otherwise**2
    safe = np.where(arched, curvature, 1.0)
    best = np.where(arched, middle + slope / safe, middle + np.sign(slope) * step)
    return best, np.where(arched, 1.0 / np.sqrt(safe), otherwise)

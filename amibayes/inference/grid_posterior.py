"""The posterior of one companion by direct integration: no chain, no linearised model.

The field is cut into cells of a polar lattice, on which the prior of the position is a
product and the edge of the field an edge of cells. A cell is halved both ways while its
share of the posterior matters and the likelihood may change within it by more than the
midpoint rule forgives. In every cell the contrast is integrated over boxes that follow the
likelihood there, and the nuisance parameters over Gauss–Legendre nodes. Strong modes, any
number of them, and a sea of noise cost a few thousand cells alike; it is what chains, mode
weights and evidences are held against.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.special import logsumexp

from amibayes.errors import DataError
from amibayes.inference.bank import TemplateBank, make_grid
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.marginal import Marginal
from amibayes.inference.priors import Prior
from amibayes.inference.refine import Box, fit_single, refine, single_likelihood
from amibayes.units import MAS, FloatArray

CELLS_PER_FRINGE = 8
"""Cells per λ/B_max to begin with."""

FLOOR = 10.0
"""Cells whose logarithm of the mass is this far below the largest are not cut any more."""

STEP = 1.5
"""Longest side of a cell that counts, in units of the shortest error a position can have."""

CONTRAST_REACH = 7.0
"""Errors of the contrast, to both sides of its best value, that are integrated finely."""

FAINT_BOXES, FINE_BOXES, MORE_BOXES = 8, 40, 24
"""Boxes in contrast: below the fine range, in it, and more of them with nuisance parameters."""

NUISANCE_REACH, NODES_PER_SIGMA = 5.0, 1.5
FEWEST_NODES, MOST_NODES = 6, 32

BRIGHT = (0.1, 0.2, 0.4, 0.8)
"""Contrasts tried beside the best one of the linear theory."""

BATCH = 1_500_000
"""Model values (samples × parameter sets) held at once."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a polar lattice: ranges of separation (mas) and position angle (radians)."""

    inner: FloatArray
    outer: FloatArray
    first: FloatArray
    last: FloatArray

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: object) -> Cells:
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


@dataclass(frozen=True, eq=False)
class Nuisance:
    """Quadrature of the nuisance parameters.

    Parameters
    ----------
    value : (n_nodes, n_nuisance) float array
    log_weight : (n_nodes,) float array
        Logarithm of the prior probability that a node stands for.
    low, high : (n_nodes, n_nuisance) float array
        Range that it stands for.
    """

    value: FloatArray
    log_weight: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, eq=False)
class GridPosterior:
    """The posterior of one companion on cells of the field.

    Parameters
    ----------
    prior : Prior
    nuisance_names : tuple of str
    log_z : float
        Logarithm of the evidence, normalisation of the likelihood and prior included.
    log_z_none : float
        The same without a companion.
    cells : Cells
    probability : (n_cells,) float array
        Adds up to 1.
    contrast_edges : (n_cells, n_boxes + 1) float array
        Boxes of the contrast in every cell.
    contrast_probability : (n_cells, n_boxes) float array
        Share of each box; adds up to ``probability``.
    nuisance : Nuisance
    nuisance_probability : (n_nodes,) float array
    n_evaluations : int
        Number of parameter sets at which the likelihood was formed.
    """

    prior: Prior
    nuisance_names: tuple[str, ...]
    log_z: float
    log_z_none: float
    cells: Cells
    probability: FloatArray
    contrast_edges: FloatArray = field(repr=False)
    contrast_probability: FloatArray = field(repr=False)
    nuisance: Nuisance = field(repr=False)
    nuisance_probability: FloatArray = field(repr=False)
    n_evaluations: int = 0

    def __repr__(self) -> str:
        return (
            f"<GridPosterior: {len(self.cells)} cells, ln Z {self.log_z:.3f}, "
            f"{self.log_z - self.log_z_none:+.3f} against no companion>"
        )

    def marginal(self, name: str) -> Marginal:
        """Distribution of east_mas, north_mas, separation_mas, ln_contrast or a nuisance."""
        if name in ("east_mas", "north_mas"):
            return self._along(*((1, 0) if name == "east_mas" else (0, 1)))
        if name == "separation_mas":
            return Marginal(self.cells.inner, self.cells.outer, self.probability)
        if name == "ln_contrast":
            edges = np.log(self.contrast_edges)
            kept = self.contrast_probability > 0
            share = self.contrast_probability[kept]
            return Marginal(edges[:, :-1][kept], edges[:, 1:][kept], share)
        k = self.nuisance_names.index(name)
        return Marginal(
            self.nuisance.low[:, k], self.nuisance.high[:, k], self.nuisance_probability
        )

    def _along(self, east: int, north: int) -> Marginal:
        """Distribution along a direction; each cell a box of its own variance."""
        rho, angle = self.cells.centre
        x = self.cells.position[0 if east else 1]
        outward = np.abs(east * np.sin(angle) + north * np.cos(angle))
        around = np.abs(east * np.cos(angle) - north * np.sin(angle))
        deep = self.cells.outer - self.cells.inner
        wide = rho * (self.cells.last - self.cells.first)
        half = 0.5 * np.hypot(deep * outward, wide * around)
        return Marginal(x - half, x + half, self.probability)

    def cdf(self, name: str, value: float) -> float:
        """Posterior probability of a smaller value of a quantity of `marginal`."""
        return float(self.marginal(name).cdf(value))

    def interval(self, name: str, level: float = 0.68) -> tuple[float, float, float]:
        """(median, lower, upper), as `Posterior.interval` has it, of the same quantities."""
        levels = np.array([0.5, 0.5 - level / 2, 0.5 + level / 2])
        if name == "contrast":
            mid, low, high = np.exp(self.marginal("ln_contrast").quantile(levels))
        elif name == "delta_mag":
            ln_c = self.marginal("ln_contrast").quantile(levels[[0, 2, 1]])
            mid, low, high = -2.5 / np.log(10.0) * ln_c
        elif name == "position_angle_deg":
            mid, low, high = self._angles(levels)
        else:
            mid, low, high = self.marginal(name).quantile(levels)
        return float(mid), float(low), float(high)

    def _angles(self, levels: FloatArray) -> FloatArray:
        """Quantiles of the position angle, degrees, cut opposite its mean; median in [0, 360)."""
        middle = self.cells.centre[1]
        mean = np.angle((self.probability * np.exp(1j * middle)).sum())
        shift = (middle - mean + np.pi) % (2.0 * np.pi) - np.pi - middle
        across = Marginal(self.cells.first + shift, self.cells.last + shift, self.probability)
        angles = np.degrees(mean + across.quantile(levels))
        return np.asarray(angles - 360.0 * (angles[0] // 360.0))

    def upper_limit(self, level: float = 0.95, *, uniform: bool = False) -> float:
        """Contrast below which the companion is with a probability.

        Parameters
        ----------
        level : float
        uniform : bool
            As if the prior were uniform in contrast over the same range, which unlike a
            log-uniform one does not depend on its lower end.
        """
        if not uniform or self.prior.contrast_form == "uniform":
            return float(np.exp(self.marginal("ln_contrast").quantile(level)))
        low, high = self.contrast_edges[:, :-1], self.contrast_edges[:, 1:]
        mass = np.diff(self.prior.contrast_cdf(self.contrast_edges), axis=1)
        share = self.contrast_probability * (high - low) / np.where(mass > 0, mass, np.inf)
        return float(Marginal(low.ravel(), high.ravel(), share.ravel()).quantile(level))

    def mass_near(self, positions: FloatArray, radius_mas: float) -> FloatArray:
        """Probability of being within a radius of each position (n, 2) and nearest to it, (n,)."""
        east, north = self.cells.position
        away = np.hypot(east[:, None] - positions[:, 0], north[:, None] - positions[:, 1])
        nearest = away.argmin(axis=1)
        near = away.min(axis=1) <= radius_mas
        return np.bincount(nearest[near], self.probability[near], minlength=len(positions))


def grid_posterior(likelihood: Likelihood, prior: Prior, *, step: float = STEP) -> GridPosterior:
    """Integrate the posterior of one companion over the whole field.

    Parameters
    ----------
    likelihood : Likelihood
        With a model of one companion.
    prior : Prior
    step : float
        Longest side of a cell that counts, in units of the shortest error that a position
        can have there: 1/(signal-to-noise × 2π/(λ/B)). Halving it shows the error.

    Returns
    -------
    GridPosterior

    Raises
    ------
    DataError
        Where the likelihood is nowhere finite.
    """
    work = _Work(likelihood, prior)
    cells = work.start()
    log_mass, peak = work.masses(cells)
    if not np.isfinite(log_mass).any():
        raise DataError("the likelihood is finite nowhere", source=likelihood.observables.source)
    while (cut := _to_cut(cells, log_mass, peak - work.best_none, work.fringe_mas, step)).any():
        children = cells[cut].halved()
        mass, top = work.masses(children)
        cells = Cells.join(cells[~cut], children)
        log_mass = np.concatenate([log_mass[~cut], mass])
        peak = np.concatenate([peak[~cut], top])
    return work.finish(cells, log_mass)


def affordable(likelihood: Likelihood, prior: Prior, most: float = 1e8) -> bool:
    """Whether the grid posterior takes fewer model values than ``most`` (about 15 s)."""
    work = _Work(likelihood, prior)
    n_sets = len(work.start()) * len(work.nuisance.value) * (work.n_boxes + 16)
    return n_sets * len(likelihood.samples) < most


def log_evidence_none(likelihood: Likelihood, prior: Prior) -> float:
    """Logarithm of the evidence without a companion, nuisance parameters integrated."""
    work = _Work(likelihood, prior)
    return work.log_z_none


def _to_cut(
    cells: Cells, log_mass: FloatArray, log_gain: FloatArray, fringe_mas: float, step: float
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Say which cells are too large for what they hold.

    No phase of the model turns faster than 2π per λ/B_max, so that at a signal-to-noise S a
    position's error is not below (λ/B_max)/(2πS); near the star, where a template grows
    with the separation, not below ρ/2S. What a centre may miss of its cell's peak is
    bounded in the same way, by the half diagonal.
    """
    gain = 2.0 * np.maximum(log_gain, 0.5)
    rate = np.maximum(2.0 * np.pi / fringe_mas, 2.0 / cells.centre[0])
    too_large = cells.size * rate * np.sqrt(gain) > step
    missed = 0.25 * np.minimum((cells.size * rate) ** 2, 2.0) * gain.max()
    density = log_mass - 2.0 * np.log(cells.size)
    below = np.maximum(log_mass - log_mass.max(), density - density.max())
    return np.asarray(too_large & (below > -FLOOR - missed))


class _Work:
    """The likelihood and prior of one grid posterior, evaluated in batches."""

    def __init__(self, likelihood: Likelihood, prior: Prior) -> None:
        self.likelihood, self.prior = likelihood, prior
        self.fringe_mas = float(1.0 / likelihood.samples.frequency.max() / MAS)
        self.single, self.chi2_single = fit_single(likelihood)
        lattice = self.fringe_mas / CELLS_PER_FRINGE
        self.grid = make_grid(prior.inner_mas, prior.outer_mas, lattice)
        self._scan()
        self.nuisance = self._nuisance()
        self.n_boxes = FAINT_BOXES + FINE_BOXES + MORE_BOXES * bool(len(self.single))
        none = single_likelihood(likelihood).log_prob(self.nuisance.value)
        self.best_none = float(none.max())
        self.log_z_none = float(logsumexp(none + self.nuisance.log_weight))
        self.n_evaluations = 0

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
        """Nodes over the ranges that the fits with and without a companion allow."""
        if not len(self.single):
            none = np.zeros((1, 0))
            return Nuisance(none, np.zeros(1), none, none)
        axes = [self._axis(k) for k in range(len(self.single))]
        value, weight, low, high = (
            np.stack(np.meshgrid(*[a[j] for a in axes], indexing="ij"), axis=-1) for j in range(4)
        )
        n = len(axes)
        log_weight = np.log(weight).sum(axis=-1).ravel()
        return Nuisance(value.reshape(-1, n), log_weight, low.reshape(-1, n), high.reshape(-1, n))

    def _axis(self, k: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        low, high = self.prior.nuisance[k]
        centres = np.clip([self.single[k], self._best[3 + k]], low, high)
        alone = single_likelihood(self.likelihood).errors(self.single)
        joint = self.likelihood.errors(self._best)
        sigma = float(np.sqrt(max(alone[k, k], joint[3 + k, 3 + k])))
        if not 0.0 < sigma < high - low:
            sigma = high - low
        begin = max(low, centres.min() - NUISANCE_REACH * sigma)
        end = min(high, centres.max() + NUISANCE_REACH * sigma)
        wanted = int(np.ceil(NODES_PER_SIGMA * (end - begin) / sigma))
        x, w = np.polynomial.legendre.leggauss(int(np.clip(wanted, FEWEST_NODES, MOST_NODES)))
        edges = begin + 0.5 * (end - begin) * np.concatenate([[0.0], np.cumsum(w)])
        value = begin + 0.5 * (end - begin) * (1.0 + x)
        return value, 0.5 * w * (end - begin) / (high - low), edges[:-1], edges[1:]

    @property
    def _best(self) -> FloatArray:
        """A fit with a companion, from the best position of the linear scan."""
        if not len(self.grid):
            return np.concatenate([[self.prior.outer_mas, 0.0, 0.0], self.single])
        k = int(self.gain.argmax())
        place = [self.grid.east_mas[k], self.grid.north_mas[k], np.clip(self.contrast[k], 0, 1)]
        box = Box(self.prior.inner_mas, self.prior.outer_mas, self.fringe_mas)
        seed = np.concatenate([place, self.single])
        return np.array(refine(self.likelihood, seed, box, self.chi2_single).theta)

    def log_prob(self, sites: FloatArray, contrast: FloatArray) -> FloatArray:
        """Log-likelihood (n, k) at sites (n, 2 + n_nuisance), each with k contrasts (n, k)."""
        n, k = contrast.shape
        theta = np.empty((n, k, sites.shape[1] + 1))
        theta[:, :, :2] = sites[:, None, :2]
        theta[:, :, 2] = contrast
        theta[:, :, 3:] = sites[:, None, 2:]
        self.n_evaluations += n * k
        return self.likelihood.log_prob(theta.reshape(n * k, -1)).reshape(n, k)

    def _best_contrast(self, sites: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Most likely contrast (below zero where it is) and its error at sites, (n,) each."""
        n, most = len(sites), self.prior.contrast_max
        bright = [c for c in BRIGHT if c < most]
        trial = np.broadcast_to([0.0, 1e-3, 2e-3, *bright], (n, 3 + len(bright)))
        value = self.log_prob(sites, trial)
        best, sigma = _parabola(np.full(n, 1e-3), np.full(n, 1e-3), value[:, :3], np.full(n, 0.1))
        if bright:
            top = value[:, 3:].argmax(axis=1)
            brighter = np.clip(best, 0.0, most)[:, None]
            exceeds = value[np.arange(n), 3 + top] > self.log_prob(sites, brighter)[:, 0]
            best = np.where(exceeds, np.array(bright)[top], best)
        for _ in range(2):
            middle = np.clip(best, sigma, np.maximum(most, sigma))
            points = middle[:, None] + sigma[:, None] * np.array([-1.0, 0.0, 1.0])
            best, sigma = _parabola(middle, sigma, self.log_prob(sites, points), sigma)
        return best, sigma

    def boxes(self, cells: Cells) -> tuple[FloatArray, FloatArray]:
        """Boxes of the contrast (n, n_boxes + 1), and log-likelihood (n, n_nodes, n_boxes)."""
        n, nodes = len(cells), self.nuisance.value
        place = np.repeat(np.column_stack(cells.position), len(nodes), axis=0)
        sites = np.hstack([place, np.tile(nodes, (n, 1))])
        best, sigma = self._best_contrast(sites)
        edges = self._edges(*(x.reshape(n, -1) for x in (best, sigma)))
        contrast = np.repeat(self._inside(edges), len(nodes), axis=0)
        return edges, self.log_prob(sites, contrast).reshape(n, len(nodes), -1)

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

    def _batches(self, cells: Cells) -> list[Cells]:
        each = len(self.likelihood.samples) * len(self.nuisance.value) * self.n_boxes
        at_once = max(1, BATCH // each)
        return [cells[k : k + at_once] for k in range(0, len(cells), at_once)]

    def _shares(self, cells: Cells) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Boxes, logarithm of their mass (n, n_nodes, n_boxes), and best log-likelihood (n,)."""
        p = self.prior
        edges, log_prob = self.boxes(cells)
        ring = p.ring_cdf(cells.outer) - p.ring_cdf(cells.inner)
        place = np.log(ring * (cells.last - cells.first) / (2.0 * np.pi))
        bright = np.log(np.maximum(np.diff(p.contrast_cdf(edges), axis=1), 1e-300))
        log_mass = log_prob + (place[:, None] + bright)[:, None, :]
        return edges, log_mass + self.nuisance.log_weight[:, None], log_prob.max(axis=(1, 2))

    def masses(self, cells: Cells) -> tuple[FloatArray, FloatArray]:
        """Logarithm of each cell's share of the evidence, and its best log-likelihood."""
        parts = []
        for batch in self._batches(cells):
            _, log_mass, peak = self._shares(batch)
            parts.append((logsumexp(log_mass, axis=(1, 2)), peak))
        mass, peak = zip(*parts, strict=True)
        return np.concatenate(mass), np.concatenate(peak)

    def finish(self, cells: Cells, log_mass: FloatArray) -> GridPosterior:
        """Contrasts and nuisance of the cells that hold something."""
        log_z = float(logsumexp(log_mass))
        cells = cells[log_mass > log_z - 1.5 * FLOOR]
        edges, shares, nodes = [], [], np.zeros(len(self.nuisance.value))
        for batch in self._batches(cells):
            edge, log_share, _ = self._shares(batch)
            share = np.exp(log_share - log_z)
            edges.append(edge)
            shares.append(share.sum(axis=1))
            nodes += share.sum(axis=(0, 2))
        contrast = np.concatenate(shares) / sum(s.sum() for s in shares)
        return GridPosterior(
            self.prior,
            replace(self.likelihood.model, companions=0).parameters,
            log_z,
            self.log_z_none,
            cells,
            contrast.sum(axis=1),
            np.concatenate(edges),
            contrast,
            self.nuisance,
            nodes / nodes.sum(),
            self.n_evaluations,
        )


def _parabola(
    middle: FloatArray, step: FloatArray, value: FloatArray, otherwise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Top and width of the parabolas through values (n, 3) at middle − step, middle, + step."""
    slope = 0.5 * (value[:, 2] - value[:, 0]) / step
    curvature = (2.0 * value[:, 1] - value[:, 0] - value[:, 2]) / step**2
    arched = curvature > 1e-2 / otherwise**2 * 1e-2
    safe = np.where(arched, curvature, 1.0)
    best = np.where(arched, middle + slope / safe, middle + np.sign(slope) * step)
    return best, np.where(arched, 1.0 / np.sqrt(safe), otherwise)

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
from scipy.special import logsumexp

from amibayes.errors import DataError
from amibayes.likelihood.combinations import combination_of, refusal
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.quadrature import Marginal
from amibayes.models.parameters import Parameters
from amibayes.posterior.integrand import Cells, Integrand, Shares
from amibayes.posterior.nuisance import Nuisance
from amibayes.posterior.priors import Prior
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import html_table
from amibayes.units import BoolArray, FloatArray

FLOOR = 10.0
"""Cells whose logarithm of the mass is this far below the largest are not cut any more."""

STEP = 1.5
"""Longest side of a cell that counts, in units of the shortest error a position can have."""


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

    @property
    def parameters(self) -> Parameters:
        """Parameters of one companion and the nuisance."""
        return self.prior.parameters(1)

    def __repr__(self) -> str:
        return (
            f"<GridPosterior: {len(self.cells)} cells, ln Z {self.log_z:.3f}, "
            f"{self.log_z - self.log_z_none:+.3f} against no companion>"
        )

    def _repr_html_(self) -> str:
        """Show medians and intervals in a notebook."""
        names = ("separation_mas", "position_angle_deg", "contrast", "delta_mag")
        each = {name: self.interval(name) for name in (*names, *self.nuisance_names)}
        rows = [(name, *(f"{x:.5g}" for x in three)) for name, three in each.items()]
        return html_table(repr(self).strip("<>"), ("", "median", "16 %", "84 %"), rows)

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

    def within(self, kept: BoolArray) -> GridPosterior:
        """The posterior given that the companion is in the cells ``kept`` (n_cells,)."""
        share = self.contrast_probability[kept]
        share = share / share.sum()
        return replace(
            self,
            cells=self.cells[kept],
            probability=share.sum(axis=1),
            contrast_edges=self.contrast_edges[kept],
            contrast_probability=share,
        )

    def mass_near(self, positions: FloatArray, radius_mas: float) -> FloatArray:
        """Probability of being within a radius of each position (n, 2) and nearest to it, (n,)."""
        east, north = self.cells.position
        away = np.hypot(east[:, None] - positions[:, 0], north[:, None] - positions[:, 1])
        nearest = away.argmin(axis=1)
        near = away.min(axis=1) <= radius_mas
        mass = np.bincount(nearest[near], self.probability[near], minlength=len(positions))
        return np.asarray(mass, dtype=float)


@checks_arguments
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
        Where the likelihood is nowhere finite, or a companion moves the star's parameters so
        much that nodes of these are too far apart.
    """
    work = Integrand(likelihood, prior)
    if not work.nuisance.close:
        raise DataError(
            "the star's parameters depend too much on the companion for a direct integral",
            source=likelihood.observables.source,
            remedy="use a chain (sample), and evidences without a grid (compare_models)",
        )
    cells = work.start()
    shares = work.shares(cells)
    if not np.isfinite(shares.log_mass).any():
        raise DataError("the likelihood is finite nowhere", source=likelihood.observables.source)
    while (cut := _to_cut(work, cells, shares, step)).any():
        children = cells[cut].halved()
        cells = Cells.join(cells[~cut], children)
        shares = Shares.join([shares[~cut], work.shares(children)])
    return _finished(work, cells, shares)


def integrable(likelihood: Likelihood) -> bool:
    """Whether the grid posterior has all of the model's dimensions."""
    shapes = likelihood.parameters.columns("shape")
    return not len(shapes) and refusal(combination_of(likelihood, method="grid posterior")) is None


POINTS = 32
"""Parameter sets per cell and node of the nuisance parameters, as measured."""


MORE_CELLS = 2000
"""Cells that the modes of a strong companion are cut into, as measured."""


def affordable(likelihood: Likelihood, prior: Prior, most: float = 3e8) -> bool:
    """Whether the grid posterior takes fewer model values than ``most`` (some ten seconds).

    Several contrasts and motion are dimensions that it does not have; and its nodes are too far
    apart for a star whose disc is any size, by what its companion is.
    """
    if not integrable(likelihood):
        return False
    work = Integrand(likelihood, prior)
    if not work.nuisance.close:
        return False
    n_sets = (len(work.start()) + MORE_CELLS) * len(work.nuisance.value) * POINTS
    return n_sets * len(likelihood.samples) < most


def _to_cut(work: Integrand, cells: Cells, shares: Shares, step: float) -> BoolArray:
    """Say which cells are too large for what they hold.

    No phase of the model turns faster than 2π per λ/B_max, so that at a signal-to-noise S a
    position's error is not below (λ/B_max)/(2πS); near the star, where a template grows
    with the separation, not below ρ/2S. What a centre may miss of its cell's peak is
    bounded in the same way, by the half diagonal.
    """
    log_mass, gain = shares.log_mass, np.maximum(work.delta_chi2(shares.peak), 1.0)
    rate = np.maximum(2.0 * np.pi / work.fringe_mas, 2.0 / cells.centre[0])
    too_large = cells.size * rate * np.sqrt(gain) > step
    missed = work.likelihood.noise.log_loss(
        0.5 * np.minimum((cells.size * rate) ** 2, 2.0) * gain.max()
    )
    density = log_mass - 2.0 * np.log(cells.size)
    below = np.maximum(log_mass - log_mass.max(), density - density.max())
    return np.asarray(too_large & (below > -FLOOR - missed))


def _finished(work: Integrand, cells: Cells, shares: Shares) -> GridPosterior:
    """Keep the cells that hold something."""
    log_z = float(logsumexp(shares.log_mass))
    kept = shares.log_mass > log_z - 1.5 * FLOOR
    shares = shares[kept]
    unit = np.exp(shares.log_scale - log_z)
    contrast = unit[:, None] * shares.by_contrast
    contrast /= contrast.sum()
    nodes = unit @ shares.by_nuisance
    return GridPosterior(
        work.prior,
        replace(work.likelihood.model, companions=0).parameters.names,
        log_z,
        work.log_z_none,
        cells[kept],
        contrast.sum(axis=1),
        shares.edges,
        contrast,
        work.nuisance,
        nodes / nodes.sum(),
    )

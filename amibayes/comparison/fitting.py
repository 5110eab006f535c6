"""Fits of many data sets from many starting points at once, by Levenberg and Marquardt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from amibayes.companion_search.descent import damped_steps
from amibayes.comparison.unit_cube import BATCH_VALUES, CubeModel
from amibayes.units import FloatArray, IntArray

STEPS = 40
"""Steps after which a fit that has not converged ends: those that do take 10 to 20."""

DAMPING, EASIER, HARDER = 1e-3, 0.2, 5.0
"""Marquardt's damping at first, and after a good and a bad step."""

LONGEST = 0.15
"""Longest step in any dimension of the cube: the basins of a bank's seeds are wider."""

CONVERGED = 1e-4
"""Gain in χ² at which a fit ends, three times in a row."""

FAINT, BRIGHT = 1e-3, 0.3
"""Fluxes of the two banks of seeds: one that the data follow linearly, one that they do not."""

BANK_VALUES, MIN_BANK, MAX_BANK = 1.2e6, 1024, 8192
"""Model values (points × shapes) of a bank, and limits of the number of its shapes."""

SEEDS = 4
"""Starting points that each bank gives of each data set."""

APART = 0.05
"""Starting points differ by so much in at least one dimension of the cube."""


def least_squares(
    model: CubeModel, cube: FloatArray, data: FloatArray, steps: int = STEPS
) -> tuple[FloatArray, FloatArray]:
    """Fit data sets from starting points, one each.

    Parameters
    ----------
    model : CubeModel
    cube : (n, n_dim) float array
    data : (n_data, n) float array
    steps : int
        No more than these.

    Returns
    -------
    cube : (n, n_dim) float array
    chi2 : (n,) float array
    """
    cube, n = model.inside(np.array(cube)), len(cube)
    if model.n_dim == 0:
        white = model.likelihood.noise.whiten(model.difference(model.predict(cube), data))
        return cube, np.asarray((white**2).sum(axis=0))
    damping, idle = np.full(n, DAMPING), np.zeros(n, dtype=int)
    chi2 = np.full(n, np.inf)
    normal = np.zeros((n, model.n_dim, model.n_dim))
    pull = np.zeros((n, model.n_dim))
    going = np.arange(n)
    chi2[going], normal[going], pull[going] = _linearised(model, cube, data)
    for _ in range(steps):
        trial = model.inside(
            cube[going] + _steps(model, cube[going], normal[going], pull[going], damping[going])
        )
        found, matrix, vector = _linearised(model, trial, data[:, going])
        better = found < chi2[going]
        gain = chi2[going] - found
        won = going[better]
        cube[won], chi2[won] = trial[better], found[better]
        normal[won], pull[won] = matrix[better], vector[better]
        damping[going] = np.clip(damping[going] * np.where(better, EASIER, HARDER), 1e-9, 1e9)
        idle[going] = np.where(better & (gain > CONVERGED), 0, idle[going] + 1)
        going = going[idle[going] < 3]
        if not len(going):
            break
    return cube, chi2


def _linearised(
    model: CubeModel, cube: FloatArray, data: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """χ² (n,), normal matrices (n, n_dim, n_dim) and gradients (n, n_dim)."""
    values = len(cube) * (1 + model.n_dim) * len(model.likelihood.samples)
    pieces = np.array_split(np.arange(len(cube)), 1 + values // BATCH_VALUES)
    found = [_linear_piece(model, cube[k], data[:, k]) for k in pieces if len(k)]
    chi2, normal, gradient = (np.concatenate(x) for x in zip(*found, strict=True))
    return chi2, normal, gradient


def _linear_piece(
    model: CubeModel, cube: FloatArray, data: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`_linearised` of as many as are worked on together."""
    predicted, slopes = model.linear(cube)
    white = model.likelihood.noise.whiten(model.difference(predicted, data)).T
    normal = np.matmul(slopes.transpose(0, 2, 1), slopes)
    return (white**2).sum(axis=1), normal, np.einsum("nkd,nk->nd", slopes, white)


def _steps(
    model: CubeModel, cube: FloatArray, normal: FloatArray, pull: FloatArray, damping: FloatArray
) -> FloatArray:
    """Damped steps (n, n_dim); what stands at an edge and is pulled outward stays there."""
    held = ((cube <= 0.0) & (pull < 0.0)) | ((cube >= 1.0) & (pull > 0.0))
    held &= ~model.turning
    diagonal = np.where(held, 0.0, np.einsum("ndd->nd", normal))
    # A dimension that the data do not feel gets the scale of the others: it stays.
    scale = np.maximum(diagonal, 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-12)
    step = damped_steps(normal, pull, damping[:, None] * scale, held)
    longest = np.abs(step).max(axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, LONGEST / np.maximum(longest, 1e-300)))


@dataclass(frozen=True, eq=False)
class SeedBank:
    """Shapes of one source, spread evenly over its prior, and what they do to the data.

    Parameters
    ----------
    model : CubeModel
    reference : (n_dim,) float array
        Point of the cube where everything but this source is taken from.
    columns : (k,) int array
        Of the source.
    flux : int
        Which of them is its flux.
    cube : (n, n_dim) float array
        The shapes.
    without : (n_data,) float array
        Prediction with the source's least flux.
    faint : (n_independent, n) float array
        Whitened derivatives by the flux.
    bright : (n_data, n) float array
        Predictions with much of it.
    """

    model: CubeModel
    reference: FloatArray
    columns: IntArray
    flux: int
    cube: FloatArray
    without: FloatArray
    faint: FloatArray
    bright: FloatArray

    @classmethod
    def of(
        cls, model: CubeModel, reference: FloatArray, columns: IntArray, flux: int, seed: int
    ) -> SeedBank:
        """Make a bank; ``seed`` scrambles the sequence of its shapes."""
        wanted = BANK_VALUES / len(model.likelihood.samples)
        n = int(2 ** np.floor(np.log2(np.clip(wanted, MIN_BANK, MAX_BANK))))
        shapes = columns[columns != flux]
        cube = np.tile(reference, (n, 1))
        cube[:, shapes] = qmc.Sobol(len(shapes), rng=np.random.default_rng(seed)).random(n)
        dark = _with_flux(model, cube, flux, 0.0)
        # A prior may leave out what is fainter than some contrast.
        least = float(model.theta(dark[:1])[0, flux])
        faint, bright = (
            _with_flux(model, cube, flux, f) for f in (max(FAINT, 2.0 * least), BRIGHT)
        )
        without = model.predict(dark[:1])[:, 0]
        change = model.likelihood.wrapped(model.predict(faint) - without[:, None])
        amount = model.theta(faint[:1])[0, flux] - least
        linear = model.likelihood.noise.whiten(change) / amount
        return cls(model, reference, columns, flux, cube, without, linear, model.predict(bright))

    def seeds(self, data: FloatArray) -> FloatArray:
        """Starting points (m, 2 · SEEDS, n_dim) for data sets (n_data, m) that are nearly alike.

        The best of both banks, the first of each again where too few differ.
        """
        model = self.model
        white = model.likelihood.noise.whiten(model.difference(self.without[:, None], data))
        match, square = self.faint.T @ white, (self.faint**2).sum(axis=0)[:, None]
        square = np.maximum(square, 1e-300)
        amount = np.clip(match / square, 0.0, BRIGHT)
        gain = 2.0 * amount * match - amount**2 * square
        chi2 = model.chi2_of_pairs(self.bright, data)
        found = []
        for k in range(data.shape[1]):
            first = self._chosen(gain[:, k])
            bright = self._at(self._chosen(-chi2[:, k]), BRIGHT)
            found.append(np.concatenate([self._at(first, amount[first, k]), bright]))
        return np.array(found)

    def _chosen(self, merit: FloatArray) -> IntArray:
        """The best shapes that differ from each other, (SEEDS,)."""
        best = np.argpartition(-merit, 40 * SEEDS)[: 40 * SEEDS]
        best = best[np.argsort(-merit[best], kind="stable")]
        kept = [int(best[0])]
        gap = self._apart(best, best[0])
        for _ in range(SEEDS - 1):
            free = np.flatnonzero(gap > APART)
            kept.append(int(best[free[0]]) if len(free) else kept[0])
            gap = np.minimum(gap, self._apart(best, kept[-1]))
        return np.array(kept, dtype=np.intp)

    def _apart(self, index: IntArray, one: int) -> FloatArray:
        """Largest difference of shapes from one of them in any dimension, (n,)."""
        change = self.model.apart(self.cube[index], self.cube[one])
        return np.asarray(np.abs(change).max(axis=1))

    def _at(self, index: IntArray, flux: FloatArray | float) -> FloatArray:
        return _with_flux(self.model, self.cube[index], self.flux, flux)


def _with_flux(
    model: CubeModel, cube: FloatArray, column: int, flux: FloatArray | float
) -> FloatArray:
    """Points of the cube with a source as bright as this, as far as the prior allows."""
    theta = model.theta(cube)
    theta[:, column] = flux
    out = np.array(cube)
    out[:, column] = model.cube(theta)[:, column]
    return out

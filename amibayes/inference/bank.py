"""The template bank: what a faint companion at every position of a grid does to the data.

At small contrast c a companion changes the whitened data by c·t(α, δ), so that with
the residuals r of the fit without a companion the best contrast is t·r/t·t and it lowers
χ² by (t·r)²/t·t. Three facts make the grid cheap: exp(−2πi(uα + vδ)) is a product of a
factor for α and one for δ, a position and its mirror image share everything, and the
whitening is folded into one sparse matrix before any position is looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from amibayes.inference.likelihood import Likelihood
from amibayes.inference.model import disc
from amibayes.units import MAS, FloatArray

IntArray = NDArray[np.intp]

DENSE_ENOUGH = 0.15
"""Share of non-zeros above which a dense product is the faster one."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Positions on a square lattice inside an annulus, symmetric about the star.

    Parameters
    ----------
    step_mas : float
        Spacing of the lattice.
    inner_mas, outer_mas : float
        Range of separations.
    columns, rows : (n,) int array
        Lattice coordinates, east = column·step, north = row·step. The first half of the
        positions is one half plane, the second half its mirror image in the same order.
    """

    step_mas: float
    inner_mas: float
    outer_mas: float
    columns: IntArray
    rows: IntArray

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def east_mas(self) -> FloatArray:
        """East offsets, (n,)."""
        return np.asarray(self.columns * self.step_mas, dtype=float)

    @property
    def north_mas(self) -> FloatArray:
        """North offsets, (n,)."""
        return np.asarray(self.rows * self.step_mas, dtype=float)

    @property
    def half_width(self) -> int:
        """Number of lattice points from the star to the edge of the map."""
        return int(self.outer_mas / self.step_mas)

    def image(self, values: FloatArray) -> FloatArray:
        """Lay values (n,) out as a map [north, east], NaN outside the annulus."""
        n = 2 * self.half_width + 1
        out = np.full((n, n), np.nan)
        out[self.rows + self.half_width, self.columns + self.half_width] = values
        return out


def make_grid(inner_mas: float, outer_mas: float, step_mas: float) -> Grid:
    """Fill the annulus inner ≤ separation ≤ outer with a lattice (the star itself left out)."""
    n = int(outer_mas / step_mas)
    axis = np.arange(-n, n + 1)
    columns, rows = np.meshgrid(axis, axis[n:])
    radius = np.hypot(columns, rows) * step_mas
    upper = (rows > 0) | (columns > 0)
    inside = upper & (radius >= inner_mas) & (radius <= outer_mas)
    columns, rows = columns[inside], rows[inside]
    return Grid(
        step_mas,
        inner_mas,
        outer_mas,
        np.concatenate([columns, -columns]),
        np.concatenate([rows, -rows]),
    )


class TemplateBank:
    """Whitened templates of a faint companion, nuisance directions projected out.

    Parameters
    ----------
    likelihood : Likelihood
        With any model; its disc, background and smearing are used.
    grid : Grid
    nuisance : (n_nuisance,) float array
        Values of the free parameters that are not a companion's (diameter, background).
    """

    def __init__(self, likelihood: Likelihood, grid: Grid, nuisance: FloatArray) -> None:
        self.grid = grid
        self.n_data = likelihood.n_independent
        self._samples = likelihood.samples
        self._smearing = likelihood.model.smearing
        self._real, self._imaginary, self._offset = _linear_response(likelihood, nuisance)
        self.nuisance_basis = _nuisance_basis(likelihood, nuisance)

    def __len__(self) -> int:
        return len(self.grid)

    def chunks(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield positions (m,) and their templates (n_data, m), all of the grid once."""
        half = len(self.grid) // 2
        n = self.grid.half_width
        axis = np.linspace(-n, n, 2 * n + 1) * self.grid.step_mas
        east = _Phase(self._samples.u, self._samples.relative_band, axis)
        north = _Phase(self._samples.v, self._samples.relative_band, axis)
        rows, columns = self.grid.rows[:half], self.grid.columns[:half] + self.grid.half_width
        cuts = np.flatnonzero(np.diff(rows)) + 1
        for index in np.split(np.arange(half), cuts) if half else []:
            row = rows[index[:1]] + self.grid.half_width
            cosine, sine = self._waves(east, _span(columns[index]), north, _span(row))
            even = self._real @ cosine - self._offset[:, None]
            odd = self._imaginary @ sine
            both = np.concatenate([even + odd, even - odd], axis=1)
            yield np.concatenate([index, index + half]), self._project(both)

    def _waves(
        self, east: _Phase, columns: slice | IntArray, north: _Phase, row: slice | IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of 2π(uα + vδ), damped by the channel's width, (n_samples, m)."""
        ca, sa = east.cosine[:, columns], east.sine[:, columns]
        cb, sb = north.cosine[:, row], north.sine[:, row]
        if self._smearing:
            damping = _damping(east, columns, north, row)
            ca, sa = ca * damping, sa * damping
        return ca * cb - sa * sb, sa * cb + ca * sb

    def templates_at(self, east_mas: FloatArray, north_mas: FloatArray) -> FloatArray:
        """Templates (n_data, m) at any positions, on the lattice or off it."""
        turns = np.outer(self._samples.u, east_mas) + np.outer(self._samples.v, north_mas)
        angle = 2.0 * np.pi * MAS * turns
        cosine, sine = np.cos(angle), np.sin(angle)
        if self._smearing:
            damping = np.sinc(0.5 * self._samples.relative_band[:, None] * angle / np.pi)
            cosine, sine = cosine * damping, sine * damping
        even = self._real @ cosine - self._offset[:, None]
        return self._project(even + self._imaginary @ sine)

    def _project(self, templates: FloatArray) -> FloatArray:
        basis = self.nuisance_basis
        return templates - basis @ (basis.T @ templates) if basis.size else templates

    def scan(self, residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Best contrast and its error at every position, from whitened residuals (n_data,).

        Returns
        -------
        contrast, sigma : (n_positions,) float array
            t·r/t·t and 1/√(t·t).
        """
        projected = self._project(residuals[:, None])[:, 0]
        match, norm = np.empty(len(self)), np.empty(len(self))
        for index, templates in self.chunks():
            norm[index] = np.einsum("dm,dm->m", templates, templates)
            match[index] = projected @ templates
        return match / norm, 1.0 / np.sqrt(norm)


class _Phase:
    """Phase factors along one axis of the lattice, (n_samples, n_axis) each."""

    def __init__(self, frequency: FloatArray, relative_band: FloatArray, axis: FloatArray) -> None:
        angle = 2.0 * np.pi * MAS * np.outer(frequency, axis)
        self.half = 0.5 * relative_band[:, None] * angle
        self.cosine, self.sine = np.cos(angle), np.sin(angle)
        self.half_cosine, self.half_sine = np.cos(self.half), np.sin(self.half)


def _span(places: IntArray) -> slice | IntArray:
    """A slice where the places are neighbours (no copy), the places themselves elsewhere."""
    first, last = int(places[0]), int(places[-1])
    return slice(first, last + 1) if last - first + 1 == len(places) else places


def _damping(
    east: _Phase, columns: slice | IntArray, north: _Phase, row: slice | IntArray
) -> FloatArray:
    """sin(x)/x of half the phase change across the channel."""
    x = east.half[:, columns] + north.half[:, row]
    sine = east.half_sine[:, columns] * north.half_cosine[:, row]
    sine += east.half_cosine[:, columns] * north.half_sine[:, row]
    return np.asarray(np.divide(sine, x, out=np.ones_like(x), where=np.abs(x) > 1e-6))


def _linear_response(
    likelihood: Likelihood, nuisance: FloatArray
) -> tuple[csr_array | FloatArray, csr_array | FloatArray, FloatArray]:
    """Matrices A, B and offset a with template = A·Re(E) + B·Im(−E) − a.

    With V₀ = D/(1 + f) real, dV/dc = (E − V₀)/(1 + f), hence dV² = 2V₀ Re dV and
    dφ = Im dV / V₀.
    """
    single = likelihood.model.__class__(
        0, likelihood.model.diameter_mas, likelihood.model.background, likelihood.model.smearing
    )
    _, diameter, background = single.split(np.atleast_2d(nuisance))
    scale = 1.0 / (1.0 + float(background[0]))
    primary = disc(likelihood.samples, diameter)[:, 0] * scale
    whitening = likelihood.observables.covariance.whitening
    n2 = likelihood.samples.squares.shape[0]
    by_vis2, by_closure = whitening[:, :n2], whitening[:, n2:]
    real = by_vis2 @ likelihood.samples.squares.multiply(2.0 * scale * primary)
    imaginary = by_closure @ likelihood.samples.legs.multiply(-scale / primary)
    offset = np.asarray(real @ primary)
    return _fastest(real), _fastest(imaginary), offset


def _fastest(matrix: csr_array) -> csr_array | FloatArray:
    matrix = csr_array(matrix)
    dense = matrix.nnz > DENSE_ENOUGH * matrix.shape[0] * matrix.shape[1]
    return matrix.toarray() if dense else matrix


def _nuisance_basis(likelihood: Likelihood, nuisance: FloatArray) -> FloatArray:
    """Orthonormal directions (n_data, k) in which the nuisance parameters move the data."""
    model = likelihood.model
    single = model.__class__(0, model.diameter_mas, model.background, model.smearing)
    if not single.parameters:
        return np.empty((likelihood.n_independent, 0))
    return np.asarray(np.linalg.qr(likelihood.with_model(single).jacobian(nuisance))[0])

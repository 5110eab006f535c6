"""The template bank: what a faint companion at every position of a grid does to the data.

At small contrast c a companion changes the whitened data by c·t(α, δ), so that with
the residuals r of the fit without a companion the best contrast is t·r/t·t and it lowers
χ² by (t·r)²/t·t. Three facts make the grid cheap: exp(−2πi(uα + vδ)) is a product of a
factor for α and one for δ, a position and its mirror image share everything, and the
whitening is folded into one sparse matrix before any position is looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amibayes.companion_search.scan import GroupWeights, RunningMaximum, ScanResult
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.linear_response import linear_response, nuisance_directions
from amibayes.models.uv_points import UVPoints
from amibayes.units import MAS, FloatArray, IntArray

WIDTH = 128
"""Most positions that are worked on at once: what fits a processor's cache."""


NUDGE = 1e-7
"""Radians; keeps sin(x)/x away from 0/0 at a relative cost below 1e-8."""


class LatticePhasors:
    """Cosine and sine of 2π(uα + vδ) over rows of the lattice, damped by the channel's width.

    Sums of angles become products of factors made once per axis. The half angles are moved
    off zero by `NUDGE`, so that sin(x)/x needs no special case.

    Parameters
    ----------
    samples : UVPoints
    axis : (n,) float array
        Coordinates of the lattice along east and along north, mas.
    smearing : bool
    turn : (n_samples,) float array, optional
        Angle added to every position's, such as that of a motion since a date.
    """

    def __init__(
        self,
        samples: UVPoints,
        axis: FloatArray,
        smearing: bool,
        turn: FloatArray | None = None,
    ) -> None:
        self._smearing = smearing
        angles = [2.0 * np.pi * MAS * np.outer(f, axis) for f in (samples.u, samples.v)]
        if turn is not None:
            angles[1] += turn[:, None]
        self._east, self._north = [(np.cos(a), np.sin(a)) for a in angles]
        half = [0.5 * samples.relative_band[:, None] * a for a in angles]
        half[1] += NUDGE
        self._half_east, self._half_north = [(h, np.cos(h), np.sin(h)) for h in half]
        self._work = np.empty((4, len(samples) * min(WIDTH, len(axis))))

    def __call__(self, columns: slice, row: int) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine, (n_samples, n_columns) each; overwritten by the next call."""
        width = columns.stop - columns.start
        shape = (4, len(self._half_east[0]), width)
        cosine, sine, damping, spare = self._work[:, : shape[1] * width].reshape(shape)
        (ca, sa), (cb, sb) = self._east, self._north
        _cosine_of_sum(ca[:, columns], sa[:, columns], cb[:, [row]], sb[:, [row]], cosine, spare)
        _sine_of_sum(ca[:, columns], sa[:, columns], cb[:, [row]], sb[:, [row]], sine, spare)
        if self._smearing:
            (xa, ca, sa), (xb, cb, sb) = self._half_east, self._half_north
            _sine_of_sum(ca[:, columns], sa[:, columns], cb[:, [row]], sb[:, [row]], damping, spare)
            np.add(xa[:, columns], xb[:, [row]], out=spare)
            damping /= spare
            cosine *= damping
            sine *= damping
        return cosine, sine


def _cosine_of_sum(
    ca: FloatArray,
    sa: FloatArray,
    cb: FloatArray,
    sb: FloatArray,
    out: FloatArray,
    spare: FloatArray,
) -> None:
    np.multiply(ca, cb, out=out)
    np.multiply(sa, sb, out=spare)
    out -= spare


def _sine_of_sum(
    ca: FloatArray,
    sa: FloatArray,
    cb: FloatArray,
    sb: FloatArray,
    out: FloatArray,
    spare: FloatArray,
) -> None:
    np.multiply(sa, cb, out=out)
    np.multiply(ca, sb, out=spare)
    out += spare


MatchedFilter = Callable[[FloatArray], tuple[FloatArray, float]]


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
    beside : (n_dim,) float array, optional
        Parameters of the likelihood's model whose companion is there already: what it and the
        nuisance parameters can do is projected out.
    """

    def __init__(
        self,
        likelihood: Likelihood,
        grid: Grid,
        nuisance: FloatArray,
        *,
        beside: FloatArray | None = None,
    ) -> None:
        self.grid = grid
        self.n_data = likelihood.n_independent
        self.n_contrasts = likelihood.model.n_contrasts
        self._samples = likelihood.samples
        self._smearing = likelihood.model.smearing
        self._even, self._odd, self._primary = linear_response(likelihood, nuisance)
        self._offset = np.asarray(self._even.matrix @ self._primary)
        both = np.intersect1d(self._even.rows, self._odd.rows, return_indices=True)
        self._even_shared, self._odd_shared = both[1:]
        if beside is None:
            self.nuisance_basis = nuisance_directions(likelihood, nuisance)
        else:
            self.nuisance_basis = np.asarray(np.linalg.qr(likelihood.jacobian(beside))[0])

    joint = False
    """Whether contrasts of bands, or rates, are free."""

    def __len__(self) -> int:
        return len(self.grid)

    @property
    def n_nuisance(self) -> int:
        """Number of nuisance directions."""
        return int(self.nuisance_basis.shape[1])

    @property
    def symmetric(self) -> bool:
        """Whether a position and its opposite predict the same: without closure phases."""
        return not len(self._odd.rows)

    def project(self, data: FloatArray) -> FloatArray:
        """Take the nuisance directions out of whitened data (n_data, …)."""
        basis = self.nuisance_basis
        return data - basis @ (basis.T @ data) if basis.size else data

    def scan(self, residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Best contrast and its error at every position, from whitened residuals (n_data,).

        Returns
        -------
        contrast, sigma : (n_positions,) float array
            t·r/t·t and 1/√(t·t), t the template without its nuisance part.
        """
        data = self.project(residuals)
        match, norm = np.empty(len(self)), np.empty(len(self))
        for index, even, odd in self._halves():
            match[index] = _both(data[self._even.rows] @ even, data[self._odd.rows] @ odd)
            norm[index] = self._norm(even, odd)
        return match / norm, 1.0 / np.sqrt(norm)

    def survey(self, residuals: FloatArray) -> ScanResult:
        """Scan whitened residuals (n_data,): contrasts and the largest gain everywhere."""
        contrast, sigma = self.scan(residuals)
        gain = np.where(contrast > 0, (contrast / sigma) ** 2, 0.0)
        return ScanResult(contrast, sigma, gain, contrast[:, None])

    def largest_gain(
        self, data: NDArray[np.float32], weights: GroupWeights | None = None
    ) -> tuple[FloatArray, IntArray]:
        """Search many data sets: largest gain in χ² over the bank, for positive contrast.

        Parameters
        ----------
        data : (n_data, n) float32 array
            Whitened, nuisance directions taken out, times their weights.
        weights : GroupWeights, optional
            Of the groups of data, where they are not 1.

        Returns
        -------
        gain : (n,) float array
        position : (n,) int array
            Where on the grid.
        """
        highest = RunningMaximum(data.shape[1])
        data_even = np.ascontiguousarray(data[self._even.rows].T)
        data_odd = np.ascontiguousarray(data[self._odd.rows].T)
        for index, even, odd in self._halves():
            scale = self._inverse_length(even, odd, weights)
            a, b = data_even @ even.astype(np.float32), data_odd @ odd.astype(np.float32)
            for half, match in zip(np.split(np.arange(len(index)), 2), (a + b, a - b), strict=True):
                match *= scale[..., half]
                highest.update(index[half], match)
        return np.asarray(highest.score, dtype=float) ** 2, highest.position

    def _inverse_length(
        self, even: FloatArray, odd: FloatArray, weights: GroupWeights | None
    ) -> NDArray[np.float32]:
        """1/√(t·t) of templates, (2m,), or with weights of each data set, (n, 2m)."""
        if weights is None:
            return np.asarray(1.0 / np.sqrt(self._norm(even, odd)), dtype=np.float32)
        return np.asarray(1.0 / np.sqrt(weights.sums(self._both_laid_out(even, odd) ** 2)))

    def _laid_out(self, even: FloatArray, odd: FloatArray) -> FloatArray:
        """Templates (n_data, m) of their two parts, nuisance directions taken out."""
        templates = np.zeros((self.n_data, even.shape[1]))
        templates[self._even.rows] = even
        templates[self._odd.rows] += odd
        return self.project(templates)

    def _both_laid_out(self, even: FloatArray, odd: FloatArray) -> FloatArray:
        """Templates (n_data, 2m) of positions and, after them, of their mirror images."""
        return np.hstack([self._laid_out(even, odd), self._laid_out(even, -odd)])

    def matched_filter(self, residuals: FloatArray) -> MatchedFilter:
        """Make a function (east, north in mas) → (best contrast, gain in χ²), off the lattice.

        Contrasts below zero gain nothing.
        """
        data = self.project(residuals)
        data_even, data_odd = data[self._even.rows], data[self._odd.rows]

        def best(position: FloatArray) -> tuple[FloatArray, float]:
            even, odd = self._parts_at(position[:1], position[1:])
            match = float(data_even @ even[:, 0] + data_odd @ odd[:, 0])
            norm = float(self._norm(even, odd)[0])
            return np.array([match / norm]), max(match, 0.0) ** 2 / norm

        return best

    def scan_at(
        self, residuals: FloatArray, east_mas: FloatArray, north_mas: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As `scan`, at any positions (m,), on the lattice or off it."""
        data = self.project(residuals)
        even, odd = self._parts_at(east_mas, north_mas)
        match = data[self._even.rows] @ even + data[self._odd.rows] @ odd
        norm = self._norm(even, odd)[: len(east_mas)]
        return match / norm, 1.0 / np.sqrt(norm)

    def templates_at(self, east_mas: FloatArray, north_mas: FloatArray) -> FloatArray:
        """Templates of unit norm (n_data, m) at any positions, on the lattice or off it."""
        even, odd = self._parts_at(east_mas, north_mas)
        templates = self._laid_out(even, odd)
        return np.asarray(templates / np.linalg.norm(templates, axis=0))

    def _parts_at(
        self, east_mas: FloatArray, north_mas: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        u, v = 2.0 * np.pi * MAS * self._samples.u, 2.0 * np.pi * MAS * self._samples.v
        angle = np.outer(u, east_mas) + np.outer(v, north_mas)
        cosine, sine = np.cos(angle), np.sin(angle)
        if self._smearing:
            damping = np.sinc((0.5 / np.pi) * self._samples.relative_band[:, None] * angle)
            cosine *= damping
            sine *= damping
        self._let_through(cosine, sine, east_mas, north_mas)
        return self._even.matrix @ cosine - self._offset[:, None], self._odd.matrix @ sine

    def _let_through(
        self, cosine: FloatArray, sine: FloatArray, east_mas: FloatArray, north_mas: FloatArray
    ) -> None:
        """Apply the extraction's response to light off the axis, in place.

        dV/dc = ρE − ρ_F V₀ instead of E − V₀: the flux's part goes with the cosine.
        """
        if self._samples.off_axis is None:
            return
        fringe, flux = self._samples.off_axis.at((east_mas, north_mas))
        turned = (cosine - 1j * sine) * fringe
        cosine[...] = turned.real - (flux - 1.0) * self._primary[:, None]
        sine[...] = -turned.imag

    def chunks(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield positions (m,) and their templates of unit norm (n_data, m), all of the grid."""
        for index, even, odd in self._halves():
            yield index, self._both_laid_out(even, odd) / np.sqrt(self._norm(even, odd))

    def by_band(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield positions (m,) and templates of unit norm of each band (n_bands, n_data, m)."""
        for index, templates in self.chunks():
            yield index, templates[None]

    def _halves(self) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Yield positions and their mirror images (2m,) with the parts that they share.

        The template is even + odd at a position and even − odd opposite the star; only the
        data that a part touches are kept, (n_rows, m).
        """
        half = len(self.grid) // 2
        for index, cosine, sine in self._half_plane():
            even = self._even.matrix @ cosine - self._offset[:, None]
            yield np.concatenate([index, index + half]), even, self._odd.matrix @ sine

    def _half_plane(
        self, drift: tuple[FloatArray, FloatArray] | None = None
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Yield positions (m,) of one half plane with cosine and sine, (n_samples, m) each.

        ``drift`` is how far east and north, mas, the companion has moved at each sample.
        """
        half, n = len(self.grid) // 2, self.grid.half_width
        axis = np.linspace(-n, n, 2 * n + 1) * self.grid.step_mas
        u, v = self._samples.u, self._samples.v
        turn = None if drift is None else 2.0 * np.pi * MAS * (u * drift[0] + v * drift[1])
        waves = LatticePhasors(self._samples, axis, self._smearing, turn)
        columns, rows = self.grid.columns[:half] + n, self.grid.rows[:half] + n
        breaks = (np.diff(rows) != 0) | (np.diff(columns) != 1) | (columns[1:] % WIDTH == 0)
        for index in np.split(np.arange(half), np.flatnonzero(breaks) + 1) if half else []:
            span = slice(int(columns[index[0]]), int(columns[index[-1]]) + 1)
            cosine, sine = waves(span, int(rows[index[0]]))
            east, north = self.grid.east_mas[index], self.grid.north_mas[index]
            if drift is not None:
                east, north = east + drift[0][:, None], north + drift[1][:, None]
            self._let_through(cosine, sine, east, north)
            yield index, cosine, sine

    def _norm(self, even: FloatArray, odd: FloatArray) -> FloatArray:
        """t·t at positions and their mirror images, (2m,), without the nuisance part."""
        norm = np.einsum("dm,dm->m", even, even) + np.einsum("dm,dm->m", odd, odd)
        i, j = self._even_shared, self._odd_shared
        cross = 2.0 * np.einsum("dm,dm->m", even[i], odd[j]) if len(i) else 0.0 * norm
        both = _both(norm, cross)
        if self.nuisance_basis.size:
            basis = self.nuisance_basis
            along = _both(basis[self._even.rows].T @ even, basis[self._odd.rows].T @ odd)
            both -= (along**2).sum(axis=0)
        return both


def _both(even: FloatArray, odd: FloatArray) -> FloatArray:
    """Values at positions and at their mirror images, one after the other."""
    return np.concatenate([even + odd, even - odd], axis=-1)

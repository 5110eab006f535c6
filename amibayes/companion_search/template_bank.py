"""The template bank: what a faint companion at every position of a grid does to the data.

At small contrast c a companion changes the whitened data by c·t(α, δ), so that with
the residuals r of the fit without a companion the best contrast is t·r/t·t and it lowers
χ² by (t·r)²/t·t. Where bands have contrasts of their own there is one template of each, and
the gain is that of the best contrasts, none below zero; where a companion moves, rates are
tried on a lattice and the largest gain counts. Data and null draws have the same statistic.

Three facts make the grid cheap: a position and its mirror image share everything, whitening is
one sparse matrix, and templates of the whole field span few numbers (`reduction.reduction_of`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from itertools import repeat
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from amibayes.companion_search.grid import Grid, trial_rates
from amibayes.companion_search.matched_filter import (
    CompanionFringes,
    MatchedFilter,
    dense_filter,
    few,
    positive,
)
from amibayes.companion_search.reduction import Reduction, reduction_of
from amibayes.companion_search.scan import GroupWeights, RunningMaximum, ScanResult
from amibayes.companion_search.templates import (
    COARSE_GAIN,
    MANY_ROWS,
    BandTemplates,
    CoarseTemplates,
    DataRows,
    MirroredTemplates,
    Templates,
)
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.linear_response import common_rows, linear_response, nuisance_directions
from amibayes.units import FloatArray, IntArray, SingleArray

NUMBERS_KEPT, KEPT_SINGLE = 12_000_000, 64_000_000
"""Numbers of templates that are kept in memory, 96 MB: those of one half plane tell the other. And
in single precision, 256 MB: many telescopes have large fields, whose templates take a minute."""


class TemplateBank:
    """Whitened templates of a faint companion, nuisance directions projected out.

    Parameters
    ----------
    likelihood : Likelihood
        With any model: its disc, background and smearing are used, and whether bands have
        contrasts of their own or companions move.
    grid : Grid
        Of places, at the reference date where companions move.
    nuisance : (n_nuisance,) float array
        Values of the free parameters that are not a companion's (diameter, background).
    beside : (n_dim,) float array, optional
        Parameters of the likelihood's model whose companion is there already: what it and the
        nuisance parameters can do is projected out.

    Notes
    -----
    `scan`, `scan_at`, `templates_at` and `matches` are those of a companion at rest, alike in
    every band; `survey`, `largest_gain`, `matched_filter` and `by_band` those of the model.
    """

    def __init__(
        self,
        likelihood: Likelihood,
        grid: Grid,
        nuisance: FloatArray,
        *,
        beside: FloatArray | None = None,
    ) -> None:
        model, samples = likelihood.model, likelihood.samples
        self.grid = grid
        self._kept: list[tuple[IntArray, FloatArray, MirroredTemplates]] | None = None
        self._coarse: CoarseTemplates | None = None
        self.n_data = self.n_rows = likelihood.n_independent
        self.reduction: Reduction | None = None
        self.n_contrasts = model.n_contrasts
        self.rates_mas_yr = trial_rates(likelihood)
        self._samples, self._moves = samples, model.moves
        self._bands = [samples.band[:, None] == b for b in range(model.n_contrasts)]
        self._years = samples.years(model.reference_mjd) if model.moves else np.zeros(len(samples))
        response = linear_response(likelihood, nuisance)
        self._even, self._odd, self._primary = response.even, response.odd, response.star
        self._fringes = CompanionFringes.of(samples, response, smearing=model.smearing)
        self._offset = response.offset
        self._shared = common_rows(self._even, self._odd)
        if beside is None:
            self.nuisance_basis = nuisance_directions(likelihood, nuisance)
        else:
            self.nuisance_basis = np.asarray(np.linalg.qr(likelihood.jacobian(beside))[0])

    def __len__(self) -> int:
        return len(self.grid)

    def on(self, grid: Grid) -> Self:
        """Make the same of other places."""
        new = copy.copy(self)
        new.grid, new._kept, new._coarse = grid, None, None
        return new

    @property
    def joint(self) -> bool:
        """Whether contrasts of bands, or rates, are free."""
        return self.n_contrasts > 1 or self._moves

    @property
    def work(self) -> float:
        """Products that the search of one data set takes."""
        return float(len(self)) * self.n_rows * self.n_contrasts * len(self.rates_mas_yr)

    @property
    def work_of_many(self) -> float:
        """The same of each of many data sets, which coarse templates show most places for."""
        return self.work / (COARSE_GAIN if self._coarse_first else 1.0)

    @property
    def n_nuisance(self) -> int:
        """Number of nuisance directions."""
        return int(self.nuisance_basis.shape[1])

    @property
    def symmetric(self) -> bool:
        """Whether a position and its opposite predict the same: without closure phases."""
        return not len(self._odd.rows)

    def reduced(self, label: IntArray) -> Self:
        """Make the same in the combinations of the data that templates span, where these are few.

        ``label`` (n_data,) are groups of data that are not combined with each other.
        """
        half = len(self.grid) // 2
        if self.joint or not half:
            return self
        east, north = self.grid.east_mas[:half], self.grid.north_mas[:half]

        def templates(index: IntArray) -> FloatArray:
            cosine, sine = self._fringes.at(east[index], north[index])
            out = np.zeros((2, self.n_data, len(index)))
            out[0, self._even.rows] = self._even.times(cosine) - self._offset[:, None]
            out[1, self._odd.rows] = self._odd.times(sine)
            return np.hstack(list(out))

        found = reduction_of(templates, half, self.nuisance_basis, label)
        if found is None:
            return self
        new = self.on(self.grid)
        new.reduction, new.n_rows = found, len(found.label)
        new._even, new._offset = found.of_part(self._even, self._offset, self.n_data)
        new._odd, _ = found.of_part(self._odd, np.zeros(len(self._odd.rows)), self.n_data)
        new.nuisance_basis = found.combined(self.nuisance_basis)
        new._shared = common_rows(new._even, new._odd)
        return new

    def reduce(self, white: FloatArray) -> FloatArray:
        """Whitened data (n_data, …) as the bank takes them, (n_rows, …)."""
        return white if self.reduction is None else self.reduction(white)

    def normals(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Data sets of unit normal deviates, (n_rows, n), in single precision as products are."""
        if self.reduction is not None:
            return self.reduction.normals(n, rng)
        return rng.standard_normal((self.n_rows, n), dtype=np.float32).astype(float)

    def added(self, noise: FloatArray, signal: FloatArray) -> FloatArray:
        """Data sets of noise and of a signal each, (n_rows, n)."""
        return noise + signal if self.reduction is None else self.reduction.added(noise, signal)

    def project(self, data: FloatArray) -> FloatArray:
        """Take the nuisance directions out of whitened data (n_rows, …)."""
        basis = self.nuisance_basis
        return data - basis @ (basis.T @ data) if basis.size else data

    def scan(self, residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Best contrast and its error at every position, from whitened residuals (n_data,).

        Returns
        -------
        contrast, sigma : (n_positions,) float array
            t·r/t·t and 1/√(t·t), t the template without its nuisance part.
        """
        rows = self._rows(self.project(residuals)[:, None])
        contrast, sigma = np.empty((2, len(self)))
        for index, _, templates in self._at_rest():
            sigma[index] = templates.sigma[0]
            contrast[index] = templates.match(rows)[0][0] * templates.sigma[0]
        return contrast, sigma

    def survey(self, residuals: FloatArray) -> ScanResult:
        """Scan whitened residuals (n_data,): contrasts, rates and the largest gain everywhere."""
        contrast, sigma = self.scan(residuals)
        if not self.joint:
            gain = np.where(contrast > 0, (contrast / sigma) ** 2, 0.0)
            return ScanResult(contrast, sigma, gain, contrast[:, None])
        rows, n = self._rows(self.project(residuals)[:, None]), self.n_contrasts
        gain, tail = np.zeros(len(self)), np.zeros((len(self), n + 2 * self._moves))
        for index, rate, templates in self.pieces():
            units, found = templates.best([m[0] for m in templates.match(rows)])
            better = found > gain[index]
            at = index[better]
            gain[at] = found[better]
            tail[at, :n] = (units * templates.sigma)[:, better].T
            if self._moves:
                tail[at, n:] = rate[better]
        return ScanResult(contrast, sigma, gain, tail, n)

    def gains(self, residuals: FloatArray) -> FloatArray:
        """Largest gain in χ² of whitened residuals (n_data,) everywhere, for positive contrasts."""
        return self.survey(residuals).gain

    def largest_gain(
        self, data: SingleArray, weights: GroupWeights | None = None
    ) -> tuple[FloatArray, IntArray]:
        """Search many data sets: largest gain in χ² over the bank, for positive contrasts.

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
        highest, rows = RunningMaximum(data.shape[1]), self._rows(data)
        for (index, _, templates), some in zip(
            self.pieces(), self._promising(rows, weights), strict=False
        ):
            gain, top = templates.highest(rows, weights, some)
            highest.update(gain, index[top], some)
        return np.asarray(highest.score, dtype=float), highest.position

    def _promising(
        self, rows: DataRows, weights: GroupWeights | None
    ) -> Iterator[IntArray | slice]:
        """Yield, for every piece, which data sets may have their largest gain in it."""
        if not self._coarse_first:
            return repeat(slice(None))
        if self._coarse is None:
            pieces = [(index, templates) for index, _, templates in self._at_rest()]
            self._coarse = CoarseTemplates.of(pieces, self.grid)
        return self._coarse.promising(rows, weights)

    def matched_filter(self, residuals: FloatArray) -> MatchedFilter:
        """Make a function (east, north in mas) → (contrasts and rates, gain), off the lattice.

        Contrasts below zero gain nothing.
        """
        data = self.project(residuals)
        if not self.joint and few(self.n_rows, len(self._samples)):
            response = self._even, self._odd, self._offset
            return dense_filter(*response, self.nuisance_basis, data, self._fringes.of_one())
        rows = self._rows(data[:, None])

        def best(position: FloatArray) -> tuple[FloatArray, float]:
            templates = self._at(position)
            match = [m[0] for m in templates.match(rows)]
            if not self.joint:
                return positive(float(match[0][0]), float(templates.sigma[0, 0]))
            units, gain = templates.best(match)
            top = int(gain.argmax())
            rate = self.rates_mas_yr[top] if self._moves else np.empty(0)
            return np.concatenate([(units * templates.sigma)[:, top], rate]), float(gain[top])

        return best

    def scan_at(
        self, residuals: FloatArray, east_mas: FloatArray, north_mas: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As `scan`, at any positions (m,), on the lattice or off it."""
        rows = self._rows(self.project(residuals)[:, None])
        templates, m = self._mirrored(*self._fringes.at(east_mas, north_mas)), len(east_mas)
        sigma = templates.sigma[0, :m]
        return templates.match(rows)[0][0, :m] * sigma, sigma

    def templates_at(self, east_mas: FloatArray, north_mas: FloatArray) -> FloatArray:
        """Templates of unit norm (n_data, m) at any positions, on the lattice or off it."""
        templates = self._mirrored(*self._fringes.at(east_mas, north_mas)).laid_out()
        return np.asarray(templates / np.linalg.norm(templates, axis=0))

    def match_at(self, own: FloatArray, east_mas: FloatArray, north_mas: FloatArray) -> FloatArray:
        """Products of data (n_data, m), each with its one of `templates_at`, (m,)."""
        return self._mirrored(*self._fringes.at(east_mas, north_mas)).match_each(own)

    def matches(
        self, data: FloatArray | SingleArray, within_mas: float = np.inf
    ) -> Iterator[tuple[IntArray, NDArray[Any]]]:
        """Yield positions (m,) and products of data with their templates of unit norm, (n, m).

        Data (n_data, n) are without nuisance directions. Positions farther out may be left out.
        """
        rows, separation = self._rows(data), np.hypot(*self.grid.places)
        for index, _, templates in self._at_rest():
            if separation[index].min() <= within_mas:
                yield index, templates.match(rows)[0]

    def by_band(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield positions (m,) and templates of unit norm of each band (n_bands, n_data, m)."""
        for index, _, templates in self.pieces():
            yield index, templates.unit

    def _rows(self, data: FloatArray | SingleArray) -> DataRows:
        """Data sets (n_data, n) as rows."""
        # Rows one after the other, since some of them are picked out.
        rows = np.ascontiguousarray(data.T)
        even, odd = (rows.take(part.rows, axis=1) for part in (self._even, self._odd))
        return DataRows(rows, even, odd)

    def pieces(self) -> Iterator[tuple[IntArray, FloatArray, Templates]]:
        """Yield positions (2m,), rates (2m, 2) and their templates in all bands."""
        if not self.joint:
            yield from self._at_rest()
            return
        for rate in self.rates_mas_yr:
            drift = (self._years * rate[0], self._years * rate[1]) if self._moves else None
            for index, cosine, sine in self._half_plane(drift):
                # The mirror image of a moving place moves the other way.
                rates = np.repeat([rate, -rate], len(index), axis=0)
                both = np.concatenate([index, index + len(self.grid) // 2])
                yield both, rates, self._in_bands(cosine, sine, mirrored=True)

    @property
    def _coarse_first(self) -> bool:
        """Whether products with the data are most of the work, and templates are kept."""
        return not self.joint and self.n_rows >= MANY_ROWS and self._n_numbers <= KEPT_SINGLE

    @property
    def _n_numbers(self) -> int:
        """Numbers of the templates of one half plane."""
        return len(self) // 2 * self.n_rows

    def _at_rest(self) -> Iterator[tuple[IntArray, FloatArray, MirroredTemplates]]:
        """Yield the same of companions at rest, alike in every band; made once where they fit."""
        if self._kept is None and self._n_numbers <= KEPT_SINGLE:
            self._kept = list(self._made())
        yield from self._made() if self._kept is None else self._kept

    def __getstate__(self) -> dict[str, Any]:
        """Leave to every process to make its own templates."""
        return self.__dict__ | {"_kept": None, "_coarse": None}

    def _made(self) -> Iterator[tuple[IntArray, FloatArray, MirroredTemplates]]:
        half, still = len(self.grid) // 2, np.zeros((1, 2))
        for index, cosine, sine in self._half_plane():
            templates = self._mirrored(cosine, sine)
            both = np.concatenate([index, index + half])
            yield both, still, templates.single() if self._n_numbers > NUMBERS_KEPT else templates

    def _at(self, position: FloatArray) -> Templates:
        """Templates of one place at all rates."""
        if not self.joint:
            return self._mirrored(*self._fringes.at(position[:1], position[1:]))
        moved = position[:, None, None] + self.rates_mas_yr.T[:, None] * self._years[:, None]
        return self._in_bands(*self._fringes.at(*moved), mirrored=False)

    def _half_plane(
        self, drift: tuple[FloatArray, FloatArray] | None = None
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Yield positions (m,) of one half plane with cosine and sine, (n_samples, m) each.

        ``drift`` is how far east and north, mas, the companion has moved at each sample.
        """
        places = self.grid.places
        for index in self.grid.half_plane(len(self._samples), tiles=self._coarse_first):
            east, north = places[:, index]
            if drift is not None:
                east, north = east + drift[0][:, None], north + drift[1][:, None]
            yield index, *self._fringes.at(east, north)

    def _mirrored(self, cosine: FloatArray, sine: FloatArray) -> MirroredTemplates:
        """Templates of one contrast at places and at their mirror images."""
        even = self._even.times(cosine) - self._offset[:, None]
        odd = self._odd.times(sine)
        rows = self._even.rows, self._odd.rows
        return MirroredTemplates.of(even, odd, rows, self._shared, self.nuisance_basis)

    def _in_bands(self, cosine: FloatArray, sine: FloatArray, *, mirrored: bool) -> BandTemplates:
        """Templates of each band at places and, with ``mirrored``, at their mirror images."""
        signs = np.array([1.0, -1.0] if mirrored else [1.0])
        out = np.zeros((len(self._bands), self.n_rows, len(signs) * cosine.shape[1]))
        change = cosine - self._primary[:, None]
        for template, here in zip(out, self._bands, strict=True):
            even = self._even.times(np.where(here, change, 0.0))
            odd = self._odd.times(np.where(here, sine, 0.0))
            template[self._even.rows] = np.tile(even, len(signs))
            template[self._odd.rows] += np.hstack([sign * odd for sign in signs])
        return BandTemplates.beside(out, self.nuisance_basis)

"""The template bank of a joint fit: a contrast per band, and a place that moves.

A companion then changes the whitened data by Σ_b c_b·t_b(α, δ, rate), one template per
band, nuisance directions projected out. The gain in χ² at a place is that of the best
contrasts, none below zero. Where bands share neither noise nor nuisance parameters it is
the sum of the gains of each band by itself. Rates are tried on a lattice, the largest gain
counts. The statistic of the data and of null draws is the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.companion_search.scan import (
    GroupWeights,
    RunningMaximum,
    ScanResult,
    best_positive,
    weighted_gain,
)
from amibayes.companion_search.template_bank import Grid, MatchedFilter, TemplateBank
from amibayes.likelihood.likelihood import Likelihood
from amibayes.units import MAS, FloatArray, IntArray

RATE_STEPS_PER_FRINGE = 4
"""Steps in rate per λ/B_max of the place at the date farthest from the reference date."""

UNCOUPLED = 1e-6
"""Correlation of templates below which bands are each for themselves."""


def bank_of(
    likelihood: Likelihood, grid: Grid, nuisance: FloatArray, *, beside: FloatArray | None = None
) -> TemplateBank:
    """Make the template bank of a likelihood's model of one companion; see `TemplateBank`."""
    joint = likelihood.model.n_contrasts > 1 or likelihood.model.moves
    return (JointBank if joint else TemplateBank)(likelihood, grid, nuisance, beside=beside)


def rates_per_axis(likelihood: Likelihood) -> int:
    """Number of rates that are tried along east, and along north."""
    model, samples = likelihood.model, likelihood.samples
    if not model.moves:
        return 1
    fringe = 1.0 / samples.frequency.max() / MAS
    farthest = float(np.abs(samples.years(model.reference_mjd)).max())
    return 2 * int(np.ceil(RATE_STEPS_PER_FRINGE * model.fastest_mas_yr * farthest / fringe)) + 1


def trial_rates(likelihood: Likelihood) -> FloatArray:
    """Rates along east and north that are tried, mas/yr, (n, 2), symmetric about 0."""
    fastest, n = likelihood.model.fastest_mas_yr, rates_per_axis(likelihood)
    axis = np.linspace(-fastest, fastest, n) if n > 1 else np.zeros(1)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


class JointBank(TemplateBank):
    """Template bank of several bands with contrasts of their own, or of moving companions.

    Parameters
    ----------
    likelihood : Likelihood
    grid : Grid
        Of places at the reference date.
    nuisance : (n_nuisance,) float array
    beside : (n_dim,) float array, optional

    Notes
    -----
    `scan` and `templates_at` are those of a companion at rest, alike in every band.
    """

    joint = True

    def __init__(
        self,
        likelihood: Likelihood,
        grid: Grid,
        nuisance: FloatArray,
        *,
        beside: FloatArray | None = None,
    ) -> None:
        super().__init__(likelihood, grid, nuisance, beside=beside)
        model, samples = likelihood.model, likelihood.samples
        self._bands = [samples.band[:, None] == b for b in range(model.n_contrasts)]
        self._moves = model.moves
        self._years = samples.years(model.reference_mjd) if model.moves else np.zeros(len(samples))
        self.rates_mas_yr = trial_rates(likelihood)

    def survey(self, residuals: FloatArray) -> ScanResult:
        """Scan whitened residuals (n_data,): contrasts, rates and the largest gain everywhere."""
        data, n = self.project(residuals), len(self._bands)
        gain = np.zeros(len(self))
        tail = np.zeros((len(self), n + 2 * self._moves))
        for index, rate, templates in self._all_templates():
            units, found = templates.best(np.einsum("d,bdm->bm", data, templates.unit))
            better = found > gain[index]
            at = index[better]
            gain[at] = found[better]
            tail[at, :n] = (units * templates.sigma)[:, better].T
            if self._moves:
                tail[at, n:] = rate[better]
        return ScanResult(*self.scan(residuals), gain, tail, n)

    def largest_gain(
        self, data: NDArray[np.float32], weights: GroupWeights | None = None
    ) -> tuple[FloatArray, IntArray]:
        """Search many data sets (n_data, n): largest gain over the bank, and where."""
        highest, rows = RunningMaximum(data.shape[1]), np.ascontiguousarray(data.T)
        for index, _, templates in self._all_templates():
            match = [rows @ unit.astype(np.float32) for unit in templates.unit]
            if weights is None:
                _, gain = templates.best(match)
            else:
                gain = weighted_gain(weights, templates.unit, match)
            highest.update(index, gain)
        return np.asarray(highest.score, dtype=float), highest.position

    def matched_filter(self, residuals: FloatArray) -> MatchedFilter:
        """Make a function (east, north in mas) → (contrasts and rates, gain), off the lattice."""
        data = self.project(residuals)

        def best(position: FloatArray) -> tuple[FloatArray, float]:
            templates = self._at(position)
            units, gain = templates.best(np.einsum("d,bdm->bm", data, templates.unit))
            top = int(gain.argmax())
            rate = self.rates_mas_yr[top] if self._moves else np.empty(0)
            contrasts = (units * templates.sigma)[:, top]
            return np.concatenate([contrasts, rate]), float(gain[top])

        return best

    def _at(self, position: FloatArray) -> Templates:
        """Templates of one place at all rates."""
        moved = position[:, None, None] + self.rates_mas_yr.T[:, None] * self._years[:, None]
        turn = self._samples.u[:, None] * moved[0] + self._samples.v[:, None] * moved[1]
        angle = 2.0 * np.pi * MAS * turn
        cosine, sine = np.cos(angle), np.sin(angle)
        if self._smearing:
            damping = np.sinc((0.5 / np.pi) * self._samples.relative_band[:, None] * angle)
            cosine, sine = cosine * damping, sine * damping
        self._let_through(cosine, sine, *moved)
        return Templates(self._projected(self._dense(cosine, sine)[..., : len(turn.T)]))

    def by_band(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield positions (m,) and templates of unit norm of each band (n_bands, n_data, m)."""
        for index, _, templates in self._all_templates():
            yield index, templates.unit

    def _all_templates(self) -> Iterator[tuple[IntArray, FloatArray, Templates]]:
        """Yield positions (m,), rates (m, 2) and their templates."""
        half = len(self.grid) // 2
        for rate in self.rates_mas_yr:
            drift = (self._years * rate[0], self._years * rate[1]) if self._moves else None
            for index, cosine, sine in self._half_plane(drift):
                # The mirror image of a moving place moves the other way.
                rates = np.repeat([rate, -rate], len(index), axis=0)
                templates = Templates(self._projected(self._dense(cosine, sine)))
                yield np.concatenate([index, index + half]), rates, templates

    def _projected(self, templates: FloatArray) -> FloatArray:
        """Take the nuisance directions out of templates (n_bands, n_data, m)."""
        if not self.nuisance_basis.size:
            return templates
        along = np.einsum("dk,bdm->bkm", self.nuisance_basis, templates)
        return np.asarray(templates - np.einsum("dk,bkm->bdm", self.nuisance_basis, along))

    def _dense(self, cosine: FloatArray, sine: FloatArray) -> FloatArray:
        """Templates (n_bands, n_data, 2m) of places and of their mirror images."""
        m = cosine.shape[1]
        out = np.zeros((len(self._bands), self.n_data, 2 * m))
        change = cosine - self._primary[:, None]
        for template, here in zip(out, self._bands, strict=True):
            even = self._even.matrix @ np.where(here, change, 0.0)
            odd = self._odd.matrix @ np.where(here, sine, 0.0)
            template[self._even.rows] = np.hstack([even, even])
            template[self._odd.rows] += np.hstack([odd, -odd])
        return out


class Templates:
    """Templates of the bands at some places, and the best positive contrasts on them.

    Parameters
    ----------
    templates : (n_bands, n_data, m) float array

    Attributes
    ----------
    unit : (n_bands, n_data, m) float array
        Of unit length.
    sigma : (n_bands, m) float array
        Error of each contrast by itself, 1/length.
    """

    def __init__(self, templates: FloatArray) -> None:
        length = np.maximum(np.linalg.norm(templates, axis=1), 1e-300)
        self.unit, self.sigma = templates / length[:, None], 1.0 / length
        n = len(templates)
        pairs = [(a, b) for b in range(n) for a in range(b)]
        shared = {(a, b): np.einsum("dm,dm->m", self.unit[a], self.unit[b]) for a, b in pairs}
        self._shared = {p: s for p, s in shared.items() if np.abs(s).max() > UNCOUPLED}

    def best(self, match: Sequence[NDArray[Any]] | NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Contrasts that gain most, none below zero, by coordinate descent.

        Parameters
        ----------
        match : (n_bands, …, m) array
            Products of the templates of unit length with data.

        Returns
        -------
        contrasts : (n_bands, …, m) array
            In units of their errors.
        gain : (…, m) array
            In χ².
        """
        return best_positive(match, self._shared)

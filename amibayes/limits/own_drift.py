"""What a search takes of a companion for drift of the instrument, and how much brighter limits are.

Light of a companion is much the same in exposures that follow each other, and so is drift. What
exposures share of the noise is fitted to residuals that hold the companion, if there is one
(`amibayes.detection.exposure_noise`), and then a part of it counts for noise. Injections are
searched with the drift of the data at hand: here some of them are searched as real data are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import ndtri

from amibayes.companion_search.grid import Grid
from amibayes.companion_search.scan import scale_groups
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.companion_search.templates import BandTemplates
from amibayes.detection.exposure_noise import Exposures, exposures_of
from amibayes.detection.ratio import Ratio
from amibayes.detection.statistic import Statistic
from amibayes.detection.treatments import FreeScale
from amibayes.likelihood.exposure_rows import Drift
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.limits.critical import CriticalContrasts
from amibayes.limits.rings import Rings
from amibayes.parallel import Executor, Journals, SerialExecutor, run_job
from amibayes.units import FloatArray, IntArray

TRIALS, LEAST, MOST = 400, 3, 96
"""Companions in all, and on a ring. They go with 1/separation, as drift does: on the innermost ring
one companion differs by 0.3 of the logarithm from the next, beyond 2 λ/B by 0.05."""

LOOKS, CLOSE, FARTHEST = 5, 0.15, np.log(8.0)
"""Contrasts that are tried of a companion at most, the step of the logarithm that is taken without
another look (the root of the statistic is as good as straight in it), and the longest step."""

SLOPES = (0.3, 3.0)
"""Power of the contrast that the root of the statistic goes with: 1, less where it is noise."""

SMOOTH = 2
"""Degree of the polynomial in 1/separation that means follow: what a companion does changes the
faster from exposure to exposure the farther it is, and is the less like drift."""

FINER = 64
"""Parts of a step of the field's lattice that places are put at. Statistics are those at the place
itself: a search around it by half a fringe changes the mean factor by 1 %, which is its error."""


def with_own_drift(
    test: Statistic,
    threshold: float,
    rings: Rings,
    critical: CriticalContrasts,
    shares: FloatArray,
    seed: int,
    *,
    executor: Executor | None = None,
    journals: Journals | None = None,
) -> tuple[CriticalContrasts, FloatArray]:
    """Critical contrasts where what exposures share is fitted with the companion in the data.

    Those of detection are larger by a mean factor on each ring, and more different from each
    other. The same as before where exposures are taken to be independent.

    Parameters
    ----------
    test : Statistic
    threshold : float
        Statistic of a detection.
    rings : Rings
    critical : CriticalContrasts
        On these rings, with the drift of the data at hand.
    shares : (n_shares,) float array
    seed : int
    executor, journals : optional
        As in `amibayes.limits.completeness.detection_limit`.

    Returns
    -------
    critical : CriticalContrasts
    log_error : (n_rings, n_shares) float array
        Of the logarithms of contrasts at which shares are detected.
    """
    searched = _Searched.of(test)
    if searched is None:
        return critical, np.zeros((len(rings.separation_mas), len(shares)))
    far = rings.separation_mas.max()
    inverse = far / np.maximum(rings.separation_mas, 1e-3 * far)
    number = np.clip(TRIALS * inverse / inverse.sum(), LEAST, MOST).astype(int)
    pieces = [_some_places(rings, critical, k, n, seed) for k, n in enumerate(number)]
    done = run_job(
        partial(_piece, searched, threshold), pieces, executor or SerialExecutor(),
        journal=journals.of("drift") if journals else None,
    )  # fmt: skip
    kept, own = zip(*[(piece["kept"], piece["own"]) for piece in done], strict=True)
    change = [after - before for after, before in zip(own, kept, strict=True)]
    factor, error = _smooth(change, inverse)
    width, spread, spread_error = _spread(kept, own, factor)
    error = np.hypot(error[:, None], spread_error[:, None] * width * ndtri(shares))
    return critical.less_sensitive(np.exp(factor), spread), error


def _smooth(change: Sequence[FloatArray], inverse: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means (n_rings,) of changes that go smoothly with 1/separation, and their errors.

    Least squares with as many changes as a ring has; errors by what each ring scatters.
    """
    number = np.array([len(one) for one in change])
    mean = np.array([one.mean() for one in change])
    scatter = np.array([one.var(ddof=1) for one in change])
    powers = np.vander(inverse / inverse.max(), min(SMOOTH + 1, len(change)))
    hat = powers @ np.linalg.pinv(powers * np.sqrt(number)[:, None]) * np.sqrt(number)
    return hat @ mean, np.sqrt(hat**2 @ (scatter / number))


def _spread(
    kept: Sequence[FloatArray], own: Sequence[FloatArray], factor: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Spread of logarithms of contrasts, and how many times as wide it is, (n_rings,).

    Their variance grows by a part of the square of the mean change, the same for all rings. The
    last is the error of the ratio.
    """
    before, after = (np.concatenate([_off(one) ** 2 for one in values]) for values in (kept, own))
    square = np.repeat(factor**2, [len(one) for one in own])
    growth, weight = after - before, max(float(square @ square), 1e-300)
    part = max(float(growth @ square) / weight, 0.0)
    error = float(np.sqrt(((growth - part * square) ** 2) @ square**2)) / weight
    variance = max(float(before.mean()), 1e-300)
    ratio = np.sqrt(1.0 + part * factor**2 / variance)
    return float(np.sqrt(variance)), ratio, 0.5 * error * factor**2 / (variance * ratio)


def _off(values: FloatArray) -> FloatArray:
    """Deviations from the mean, their mean square that of the distribution."""
    return np.asarray((values - values.mean()) * np.sqrt(len(values) / (len(values) - 1)))


_Piece = tuple[FloatArray, float, np.random.Generator]


def _some_places(rings: Rings, critical: CriticalContrasts, ring: int, n: int, seed: int) -> _Piece:
    """Places (n, 2) all around a ring, the typical contrast there, and random numbers."""
    rng = np.random.default_rng([seed, ring])
    n_angles = rings.east_mas.shape[1]
    angles = ((np.arange(n) + rng.uniform()) * n_angles / n).astype(int) % n_angles
    places = np.column_stack([rings.east_mas[ring, angles], rings.north_mas[ring, angles]])
    known = critical.detected[ring][np.isfinite(critical.detected[ring])]
    return places, float(np.median(known)) if len(known) else 1.0, rng


def _piece(searched: _Searched, threshold: float, piece: _Piece) -> dict[str, FloatArray]:
    """Logarithms of critical contrasts at places, with drift as it was and fitted again."""
    places, typical, rng = piece
    noise, goal = searched.test.likelihood.noise.draw(len(places), rng), float(np.sqrt(threshold))
    trials = _Trials(searched, places, noise, [searched.units(place) for place in places])
    kept = _crossing(trials.roots, goal, np.full(len(places), np.log(typical)))
    return {"kept": kept, "own": _crossing(trials.roots_by_own_drift, goal, kept)}


def _crossing(
    roots: Callable[[IntArray, FloatArray], FloatArray], goal: float, start: FloatArray
) -> FloatArray:
    """Logarithms (n,) of the contrasts, 1 at most, at which roots of the statistic are ``goal``.

    ``roots`` gives those of some trials at contrasts of theirs.
    """
    x, slope = np.array(start), np.ones(len(start))
    before = np.full((2, len(start)), np.nan)
    todo = np.arange(len(start))
    for _ in range(LOOKS):
        here = x[todo]
        off = np.log(np.maximum(roots(todo, here), 1e-9) / goal)
        moved, risen = here - before[0, todo], off - before[1, todo]
        with np.errstate(invalid="ignore", divide="ignore"):
            new = np.clip(risen / moved, *SLOPES)
        slope[todo] = np.where(np.isfinite(moved) & (moved != 0.0), new, slope[todo])
        step = np.clip(-off / slope[todo], -FARTHEST, np.minimum(FARTHEST, -here))
        before[:, todo], x[todo] = (here, off), here + step
        todo = todo[np.abs(step) >= CLOSE]
        if not len(todo):
            break
    return x


@dataclass(frozen=True, eq=False)
class _Searched:
    """A statistic, and what of it does not depend on drift.

    Parameters
    ----------
    test : Statistic
    exposures : Exposures
    drifts : tuple of (Drift or None)
        Of V² and of closure phases, in the data at hand.
    likelihood : Likelihood
        Exposures are independent.
    bank : TemplateBank
        The same, of no place of its own.
    slopes : (n_rows, n_nuisance) float array
        Of the fit without a companion.
    treatment : FreeScale
    ratio : Ratio
    """

    test: Statistic
    exposures: Exposures
    drifts: tuple[Drift | None, Drift | None]
    likelihood: Likelihood
    bank: TemplateBank
    slopes: FloatArray
    treatment: FreeScale
    ratio: Ratio

    @classmethod
    def of(cls, test: Statistic) -> _Searched | None:
        """None where exposures are taken to be independent."""
        exposures = None if test.exposures is None else exposures_of(test.likelihood)
        if test.exposures is None or exposures is None or not exposures.series:
            return None
        likelihood = test.likelihood.with_noise(exposures.noise_of(exposures.rows))
        bank = TemplateBank(likelihood, test.bank.grid, test.single)
        slopes = single_likelihood(likelihood).jacobian(test.single)
        groups = scale_groups(likelihood.observables, bank.n_nuisance, exposures.rows)
        least = 1.0 if test.likelihood.noise.floor else 0.0
        treatment = FreeScale(groups, np.ones(bank.n_data), least)
        drifts = test.exposures.vis2, test.exposures.closure_phase
        ratio = Ratio.scale_free(bank.n_data - bank.n_nuisance)
        return cls(test, exposures, drifts, likelihood, bank, slopes, treatment, ratio)

    def units(self, place: FloatArray) -> list[FloatArray]:
        """Templates (n_contrasts, n_rows, 2) of a place (2,), mas, and its opposite, at all rates.

        Exposures are independent.
        """
        grid = self.bank.grid
        step = grid.step_mas / FINER
        half = np.rint(place / step).astype(int)[:, None]
        there = Grid(step, grid.inner_mas, grid.outer_mas, *np.hstack([half, -half]))
        return [unit for _, unit in self.bank.on(there).by_band()]


@dataclass(frozen=True, eq=False)
class _Trials:
    """Companions at places with noise of their own, searched there and opposite.

    Parameters
    ----------
    searched : _Searched
    places : (n, 2) float array
    noise : (n_data, n) float array
    units : list of list of float array
        As `_Searched.units` gives them for each place.
    """

    searched: _Searched
    places: FloatArray
    noise: FloatArray
    units: list[list[FloatArray]]

    def roots(self, which: IntArray, log_contrast: FloatArray) -> FloatArray:
        """Roots of the statistic of some trials with drift as in the data at hand."""
        white = self._white(which, log_contrast)
        pairs = zip(which.tolist(), white.T, strict=True)
        return np.array([self._root(k, own, self.searched.drifts) for k, own in pairs])

    def roots_by_own_drift(self, which: IntArray, log_contrast: FloatArray) -> FloatArray:
        """Roots of the statistic with drift fitted to residuals that hold the companion."""
        found = []
        for k, own in zip(which.tolist(), self._white(which, log_contrast).T, strict=True):
            both = np.column_stack([own, self.searched.slopes])
            found.append(self._root(k, own, self.searched.exposures.drifts_in(both)))
        return np.array(found)

    def _white(self, which: IntArray, log_contrast: FloatArray) -> FloatArray:
        """Residuals of some trials, whitened as independent exposures."""
        likelihood = self.searched.likelihood
        companions = np.column_stack([self.places[which], np.exp(log_contrast)])
        residual = self.searched.test.change_by(companions) + self.noise[:, which]
        return likelihood.noise.whiten(likelihood.wrapped(residual))

    def _root(
        self, trial: int, white: FloatArray, drifts: tuple[Drift | None, Drift | None]
    ) -> float:
        searched, units = self.searched, self.units[trial]
        columns = [white[:, None], searched.bank.nuisance_basis]
        columns += [np.hstack(list(unit)) for unit in units]
        turned = searched.exposures.whitened(drifts, np.hstack(columns))
        first = 1 + searched.bank.n_nuisance
        basis = np.linalg.qr(turned[:, 1:first])[0]
        rates = np.split(turned[:, first:], len(units), axis=1)
        bands = [one.reshape(len(white), -1, 2).swapaxes(0, 1) for one in rates]
        places = _Two([BandTemplates.beside(templates, basis) for templates in bands], basis)
        gain, chi2 = searched.treatment.field(places, turned[:, 0])
        return float(np.sqrt(searched.ratio(gain, chi2).max()))


@dataclass(frozen=True, eq=False)
class _Two:
    """A place and its opposite: templates of every rate, and what a fit of the star takes out.

    Parameters
    ----------
    rates : list of BandTemplates
    basis : (n_rows, n_nuisance) float array
        Orthonormal.
    """

    rates: list[BandTemplates]
    basis: FloatArray

    def __len__(self) -> int:
        return 2

    @property
    def n_data(self) -> int:
        """Number of independent data."""
        return len(self.basis)

    @property
    def n_nuisance(self) -> int:
        """Number of nuisance directions."""
        return int(self.basis.shape[1])

    def project(self, data: FloatArray) -> FloatArray:
        """Take the nuisance directions out of data (n_rows, …)."""
        return data - self.basis @ (self.basis.T @ data)

    def gains(self, residuals: FloatArray) -> FloatArray:
        """Largest gain in χ² of residuals (n_rows,), without nuisance directions, at both."""
        every = [one.best([residuals @ unit for unit in one.unit])[1] for one in self.rates]
        return np.asarray(np.max(every, axis=0))

    def by_band(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield positions (2,) and templates of unit norm of each band (n_bands, n_rows, 2)."""
        for one in self.rates:
            yield np.arange(2), one.unit

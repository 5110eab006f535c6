"""What a search takes of a companion for drift of the instrument, and how much brighter limits are.

Light of a companion is much the same in exposures that follow each other, and so is drift. What
exposures share of the noise is fitted to residuals that hold the companion, if there is one
(`amibayes.detection.exposure_noise`), and then a part of it counts for noise. Injections are
searched with the drift of the data at hand: here some of them are searched as real data are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from amibayes.companion_search.grid import Grid
from amibayes.detection.exposure_noise import Exposures, exposures_of
from amibayes.detection.statistic import Statistic, make_statistic
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.limits.critical import CriticalContrasts
from amibayes.limits.rings import Rings
from amibayes.parallel import Executor, Journals, SerialExecutor, run_job
from amibayes.units import FloatArray

LEAST_PER_RING, TRIALS, WANTED = 2, 96, 0.02
"""Companions on each ring at first, and in all at most: as many as it takes to know the logarithm
of the mean factor to so much. It differs by 0.3 from one companion to the next where drift is
large."""

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
    seed: int,
    *,
    executor: Executor | None = None,
    journals: Journals | None = None,
) -> tuple[CriticalContrasts, FloatArray]:
    """Critical contrasts where what exposures share is fitted with the companion in the data.

    Those of detection are larger by one factor on a ring: quantiles of some hundred trials are
    alike in it. The same as before where exposures are taken to be independent.

    Parameters
    ----------
    test : Statistic
    threshold : float
        Statistic of a detection.
    rings : Rings
    critical : CriticalContrasts
        On these rings, with the drift of the data at hand.
    seed : int
    executor, journals : optional
        As in `amibayes.limits.completeness.detection_limit`.

    Returns
    -------
    critical : CriticalContrasts
    log_error : (n_rings,) float array
        Error of the logarithm of the factor.
    """
    n_rings, exposures = len(rings.separation_mas), exposures_of(test.likelihood)
    if test.exposures is None or exposures is None or not exposures.series:
        return critical, np.zeros(n_rings)

    def changes(each: int, first: int) -> FloatArray:
        """Changes (n_rings, each) by companions from number ``first`` of each ring on."""
        rng = [np.random.default_rng([seed, ring, first]) for ring in range(n_rings)]
        pieces = [_some_places(rings, critical, k, each, own) for k, own in enumerate(rng)]
        journal = journals.of(f"drift from {first}") if journals else None
        work = partial(_piece, test, exposures, threshold)
        done = run_job(work, pieces, executor or SerialExecutor(), journal=journal)
        return np.stack([piece["change"] for piece in done])

    found = changes(LEAST_PER_RING, 0)
    factor, error = _smooth(found, rings.separation_mas)
    wanted = LEAST_PER_RING * (float(np.median(error)) / WANTED) ** 2
    if (more := int(min(np.ceil(wanted), TRIALS // n_rings)) - LEAST_PER_RING) > 0:
        every = np.hstack([found, changes(more, LEAST_PER_RING)])
        factor, error = _smooth(every, rings.separation_mas)
    return critical.less_sensitive(np.exp(factor)), error


def _smooth(change: FloatArray, separation_mas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean of changes (n_rings, n) that goes smoothly with separation, and its error (n_rings,)."""
    n_rings, n = change.shape
    powers = np.vander(separation_mas.min() / separation_mas, min(SMOOTH + 1, n_rings))
    basis = np.linalg.qr(powers)[0]
    mean = basis @ (basis.T @ change.mean(axis=1))
    left = ((change - mean[:, None]) ** 2).sum() / max(change.size - basis.shape[1], 1)
    return mean, np.sqrt(left / n * (basis**2).sum(axis=1))


_Piece = tuple[FloatArray, float, np.random.Generator]


def _some_places(
    rings: Rings, critical: CriticalContrasts, ring: int, n: int, rng: np.random.Generator
) -> _Piece:
    """Places (n, 2) all around a ring, the typical contrast there, and random numbers."""
    n_angles = rings.east_mas.shape[1]
    angles = ((np.arange(n) + rng.uniform()) * n_angles / n).astype(int) % n_angles
    places = np.column_stack([rings.east_mas[ring, angles], rings.north_mas[ring, angles]])
    known = critical.detected[ring][np.isfinite(critical.detected[ring])]
    return places, float(np.median(known)) if len(known) else 1.0, rng


def _piece(
    test: Statistic, exposures: Exposures, threshold: float, piece: _Piece
) -> dict[str, FloatArray]:
    """Change of ln of the critical contrasts at places, where drift is fitted again."""
    places, typical, rng = piece
    noise, goal = test.likelihood.noise.draw(len(places), rng).T, float(np.sqrt(threshold))
    change = []
    for place, own in zip(places, noise, strict=True):
        trial = _Trial(test, exposures, place, own)
        kept = _crossing(trial.root, goal, float(np.log(typical)))
        change.append(_crossing(trial.root_by_own_drift, goal, kept) - kept)
    return {"change": np.array(change)}


def _crossing(root: Callable[[float], float], goal: float, start: float) -> float:
    """Logarithm of the contrast, 1 at most, at which a root of the statistic is ``goal``."""
    x, slope, before = start, 1.0, None
    for _ in range(LOOKS):
        off = float(np.log(max(root(x), 1e-9) / goal))
        if before is not None and x != before[0]:
            slope = float(np.clip((off - before[1]) / (x - before[0]), *SLOPES))
        step = float(np.clip(-off / slope, -FARTHEST, min(FARTHEST, -x)))
        before, x = (x, off), x + step
        if abs(step) < CLOSE:
            break
    return x


class _Trial:
    """A companion at a place with noise of its own, searched there and opposite."""

    def __init__(
        self, test: Statistic, exposures: Exposures, place: FloatArray, noise: FloatArray
    ) -> None:
        self.test, self.exposures, self.place, self.noise = test, exposures, place, noise
        self.star = single_likelihood(test.likelihood).predict(np.atleast_2d(test.single))[:, 0]
        grid = test.bank.grid
        step = grid.step_mas / FINER
        half = np.rint(place / step).astype(int)[:, None]
        self.grid = Grid(step, grid.inner_mas, grid.outer_mas, *np.hstack([half, -half]))
        self.kept = make_statistic(test.likelihood, self.grid, test.single)

    def root(self, log_contrast: float) -> float:
        """Root of the statistic with drift as in the data at hand."""
        likelihood = self.test.likelihood
        residual = likelihood.wrapped((self._change(log_contrast) + self.noise)[:, None])
        return float(np.sqrt(self.kept.evaluate(likelihood.noise.whiten(residual))[0]))

    def root_by_own_drift(self, log_contrast: float) -> float:
        """Root of the statistic with drift fitted to residuals that hold the companion."""
        likelihood, single = self.test.likelihood, self.test.single
        data = self.star + self._change(log_contrast) + self.noise
        sheet = likelihood.observables.with_data(data)
        searched = Likelihood(sheet, likelihood.model, likelihood.noise, likelihood.samples)
        noise = self.exposures.noise(single_likelihood(searched), single)
        return float(np.sqrt(make_statistic(searched.with_noise(noise), self.grid, single).value))

    def _change(self, log_contrast: float) -> FloatArray:
        return self.test.change_by(np.array([[*self.place, np.exp(log_contrast)]]))[:, 0]

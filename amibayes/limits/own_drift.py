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
from amibayes.detection.exposure_noise import exposure_noise
from amibayes.detection.statistic import Statistic, make_statistic
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.linear_response import companions_beside
from amibayes.limits.critical import CriticalContrasts
from amibayes.limits.rings import Rings
from amibayes.parallel import Executor, Journal, SerialExecutor, run_job
from amibayes.units import FloatArray

TRIALS, LEAST_PER_RING = 96, 2
"""Companions in all, and on each ring at least: the logarithm of the factor differs by 0.3 from one
to the next, and its mean is then known to 0.03."""

RANGE, LESS, STEP = 8.0, 0.8, 0.35
"""Factor either way in which contrasts are looked for, the least of those with drift fitted again,
and steps of their logarithm, between which the root of the statistic is as good as straight."""

SMOOTH = 2
"""Degree of the polynomial in the number of the ring that means follow."""

FINER, AROUND = 64, 4
"""Parts of a step of the field's lattice that places are put at, and steps around a place in which
it is searched: half a fringe."""


def with_own_drift(
    test: Statistic,
    threshold: float,
    rings: Rings,
    critical: CriticalContrasts,
    seed: int,
    *,
    executor: Executor | None = None,
    journal: Journal | None = None,
) -> CriticalContrasts:
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
    executor, journal : optional
        As in `amibayes.limits.completeness.detection_limit`.
    """
    drift, n_rings = test.exposures, len(rings.separation_mas)
    if drift is None or (drift.vis2 is None and drift.closure_phase is None):
        return critical
    each = max(LEAST_PER_RING, -(-TRIALS // n_rings))
    pieces = [_some_places(rings, critical, ring, each, seed) for ring in range(n_rings)]
    work = partial(_piece, test, threshold)
    done = run_job(work, pieces, executor or SerialExecutor(), journal=journal)
    change = np.concatenate([piece["change"] for piece in done])
    number = np.arange(n_rings)
    line = np.polyfit(np.repeat(number, each), change, min(SMOOTH, n_rings - 1))
    return critical.less_sensitive(np.exp(np.polyval(line, number)))


_Piece = tuple[FloatArray, float, np.random.Generator]


def _some_places(rings: Rings, critical: CriticalContrasts, ring: int, n: int, seed: int) -> _Piece:
    """Places (n, 2) all around a ring, the typical contrast there, and random numbers."""
    rng, n_angles = np.random.default_rng([seed, ring]), rings.east_mas.shape[1]
    angles = ((np.arange(n) + rng.uniform()) * n_angles / n).astype(int) % n_angles
    places = np.column_stack([rings.east_mas[ring, angles], rings.north_mas[ring, angles]])
    known = critical.detected[ring][np.isfinite(critical.detected[ring])]
    return places, float(np.median(known)) if len(known) else 1.0, rng


def _piece(test: Statistic, threshold: float, piece: _Piece) -> dict[str, FloatArray]:
    """Change of ln of the critical contrasts at places, where drift is fitted again."""
    places, typical, rng = piece
    noise, goal = test.likelihood.noise.draw(len(places), rng).T, float(np.sqrt(threshold))
    change = []
    for place, own in zip(places, noise, strict=True):
        trial, start = _Trial(test, place, own), float(np.log(typical / RANGE))
        kept = _crossing(partial(trial.root, again=False), goal, start)
        change.append(_crossing(partial(trial.root, again=True), goal, kept + np.log(LESS)) - kept)
    return {"change": np.array(change)}


def _crossing(root: Callable[[float], float], goal: float, start: float) -> float:
    """Logarithm of the contrast, about 1 at most, at which a root of the statistic is ``goal``."""
    before, x = root(start), start
    if before >= goal:
        return start
    while x < min(start + 2.0 * np.log(RANGE), 0.0):
        there = root(x + STEP)
        if there >= goal:
            return x + STEP * (goal - before) / (there - before)
        before, x = there, x + STEP
    return x


class _Trial:
    """A companion at a place with noise of its own, searched there and opposite."""

    def __init__(self, test: Statistic, place: FloatArray, noise: FloatArray) -> None:
        self.test, self.place, self.noise = test, place, noise
        self.star = single_likelihood(test.likelihood).predict(np.atleast_2d(test.single))
        step = test.bank.grid.step_mas / FINER
        near = FINER * np.arange(-AROUND, AROUND + 1)
        half = np.rint(place / step).astype(int)[:, None] + np.stack(
            [x.ravel() for x in np.meshgrid(near, near)]
        )
        self.grid = Grid(
            step, test.bank.grid.inner_mas, test.bank.grid.outer_mas, *np.hstack([half, -half])
        )

    def root(self, log_contrast: float, *, again: bool) -> float:
        """Root of the statistic, with drift as in the data at hand, or fitted ``again``."""
        likelihood, single = self.test.likelihood, self.test.single
        companion = np.array([[*self.place, np.exp(log_contrast)]])
        seen = likelihood.observe(companions_beside(likelihood, single, companion))
        data = (self.star + likelihood.wrapped(seen - self.star))[:, 0] + self.noise
        sheet = likelihood.observables.with_data(data)
        searched = Likelihood(sheet, likelihood.model, likelihood.noise, likelihood.samples)
        found = exposure_noise(searched, single) if again else None
        if found is not None:
            searched = searched.with_noise(found.noise)
        return float(np.sqrt(make_statistic(searched, self.grid, single).value))

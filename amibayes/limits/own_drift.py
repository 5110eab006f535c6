"""What a search takes of a companion for drift of the instrument, and how much brighter limits are.

Light of a companion is much the same in exposures that follow each other, and so is drift. What
exposures share of the noise is fitted to residuals that hold the companion, if there is one
(`amibayes.detection.exposure_noise`), and then a part of it counts for noise. Injections are
searched with the drift of the data at hand: here some of them are searched as real data are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy.special import ndtri

from amibayes.companion_search.grid import Grid
from amibayes.detection.exposure_noise import Exposures, exposures_of
from amibayes.detection.statistic import Statistic, make_statistic
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.limits.critical import CriticalContrasts
from amibayes.limits.rings import Rings
from amibayes.parallel import Executor, Journals, SerialExecutor, run_job
from amibayes.units import FloatArray

TRIALS, LEAST, MOST = 128, 3, 32
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
    exposures = None if test.exposures is None else exposures_of(test.likelihood)
    if exposures is None or not exposures.series:
        return critical, np.zeros((len(rings.separation_mas), len(shares)))
    far = rings.separation_mas.max()
    inverse = far / np.maximum(rings.separation_mas, 1e-3 * far)
    number = np.clip(TRIALS * inverse / inverse.sum(), LEAST, MOST).astype(int)
    pieces = [_some_places(rings, critical, k, n, seed) for k, n in enumerate(number)]
    done = run_job(
        partial(_piece, test, exposures, threshold), pieces, executor or SerialExecutor(),
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


def _piece(
    test: Statistic, exposures: Exposures, threshold: float, piece: _Piece
) -> dict[str, FloatArray]:
    """Logarithms of critical contrasts at places, with drift as it was and fitted again."""
    places, typical, rng = piece
    noise, goal = test.likelihood.noise.draw(len(places), rng).T, float(np.sqrt(threshold))
    found = []
    for place, own in zip(places, noise, strict=True):
        trial = _Trial(test, exposures, place, own)
        kept = _crossing(trial.root, goal, float(np.log(typical)))
        found.append((kept, _crossing(trial.root_by_own_drift, goal, kept)))
    return dict(zip(("kept", "own"), np.array(found).T, strict=True))


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

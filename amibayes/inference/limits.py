"""Detection limits by injection and recovery, by the criterion of the search itself.

A companion is put into the fitted model without one, noise is drawn anew from the data's
covariance, and the search's statistic is formed: it is recovered where the false-alarm
probability is below α and the position is right. In whitened data a trial costs no more
than a null search, a column of a matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import optimize, special, stats

from amibayes.inference.bank import TemplateBank
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.refine import single_likelihood
from amibayes.inference.results import SearchResult
from amibayes.inference.search import resolution_mas
from amibayes.inference.significance import Significance, profiled
from amibayes.observables import BoolArray
from amibayes.parallel import Executor, Progress, SerialExecutor, run_job, slices, spawn
from amibayes.units import FloatArray, contrast_to_delta_mag, offset

N_SEPARATIONS = 16
N_LEVELS = 12
TRIALS_PER_CELL = 40

LEVELS = (0.45, 3.0)
"""Injected contrasts, in units of the one that linear theory detects half of the time."""

TRIALS_AT_ONCE = 2048

COMPLETENESS = 0.95

ALIAS = 0.875
"""Correlation of two templates above which the inner of their positions is reported."""


@dataclass(frozen=True, eq=False)
class DetectionLimit:
    """Contrast that is recovered with a stated probability at a stated false-positive rate.

    Parameters
    ----------
    method : str
    separation_mas : (n,) float array
    contrast : (n,) float array
        Recovered with probability ``completeness``; NaN where no injected one is.
    contrast_50 : (n,) float array
        Recovered half of the time.
    log_error : (n,) float array
        1σ error of ln contrast.
    false_positive_rate, completeness : float
    level : (n, n_levels) float array
        Injected contrasts.
    trials, recovered : (n, n_levels) int array
    """

    method: str
    separation_mas: FloatArray
    contrast: FloatArray
    contrast_50: FloatArray
    log_error: FloatArray
    false_positive_rate: float
    completeness: float
    level: FloatArray
    trials: FloatArray
    recovered: FloatArray

    @property
    def delta_mag(self) -> FloatArray:
        """The limit in magnitudes, (n,)."""
        return contrast_to_delta_mag(self.contrast)

    def jeffreys(self, level: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Jeffreys interval of the completeness of every cell, (n, n_levels) each."""
        rest = 0.5 * (1.0 - level)
        a, b = self.recovered + 0.5, self.trials - self.recovered + 0.5
        return np.asarray(stats.beta.ppf(rest, a, b)), np.asarray(stats.beta.isf(rest, a, b))


def detection_limit(
    result: SearchResult,
    significance: Significance,
    rng: np.random.Generator,
    *,
    n_separations: int = N_SEPARATIONS,
    trials_per_cell: int = TRIALS_PER_CELL,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> DetectionLimit:
    """Measure the detection limit of a search by injection and recovery.

    Parameters
    ----------
    result : SearchResult
        Its field, grid, model and data are those of the limit.
    significance : Significance
        Its null draws set the threshold, at its α.
    rng : numpy.random.Generator
    n_separations, trials_per_cell : int
    executor, progress
        As in `recover`.

    Returns
    -------
    DetectionLimit
    """
    likelihood = result.likelihood
    bank = TemplateBank(likelihood, result.grid, result.single_theta)
    threshold = significance.threshold()
    rho = np.linspace(result.grid.inner_mas, result.grid.outer_mas, n_separations + 2)[1:-1]
    half = _linear_half(result, rho, _gain_at(significance, bank))
    level = half[:, None] * np.geomspace(*LEVELS, N_LEVELS)
    shape = (n_separations, N_LEVELS, trials_per_cell)
    angle = rng.uniform(0.0, 360.0, shape)
    east, north = offset(np.broadcast_to(rho[:, None, None], shape), angle)
    contrast = np.minimum(np.broadcast_to(level[:, :, None], shape), 1.0)
    theta = np.stack([east, north, contrast], axis=-1).reshape(-1, 3)
    found = recover(
        likelihood,
        bank,
        result.single_theta,
        theta,
        threshold,
        rng,
        free_scale=significance.free_scale,
        executor=executor,
        progress=progress,
    ).reshape(shape)
    recovered = found.sum(axis=2)
    trials = np.full(recovered.shape, trials_per_cell)
    fits = [_logistic(np.log(c), r, n) for c, r, n in zip(level, recovered, trials, strict=True)]
    middle, slope, error = np.array(fits).T
    log_limit = middle + special.logit(COMPLETENESS) / slope
    return DetectionLimit(
        "injection",
        rho,
        _inside(log_limit, level),
        _inside(middle, level),
        error,
        significance.alpha,
        COMPLETENESS,
        level,
        trials,
        recovered,
    )


def recover(
    likelihood: Likelihood,
    bank: TemplateBank,
    single: FloatArray,
    theta: FloatArray,
    threshold: float,
    rng: np.random.Generator,
    *,
    free_scale: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> BoolArray:
    """Inject companions and say which of them the search recovers.

    Parameters
    ----------
    likelihood : Likelihood
    bank : TemplateBank
    single : (n_nuisance,) float array
        The fit without a companion.
    theta : (n, 3) float array
        east_mas, north_mas, contrast of each trial.
    threshold : float
        Statistic that counts as a detection.
    rng : numpy.random.Generator
    free_scale : bool
        The statistic is `profiled`, else the gain in χ².
    executor : Executor, optional
        Where it is computed; the result does not depend on it.
    progress : callable, optional
        Told (pieces done, pieces in all).

    Returns
    -------
    (n,) bool array
    """
    parts = slices(len(theta), TRIALS_AT_ONCE)
    pieces = [(theta[p], seed) for p, seed in zip(parts, spawn(rng, len(parts)), strict=True)]
    work = partial(_recover_piece, likelihood, bank, single, threshold, free_scale)
    return np.concatenate(
        list(run_job(work, pieces, executor or SerialExecutor(), progress=progress))
    )


def _recover_piece(
    likelihood: Likelihood,
    bank: TemplateBank,
    single: FloatArray,
    threshold: float,
    free_scale: bool,
    piece: tuple[FloatArray, np.random.SeedSequence],
) -> BoolArray:
    theta, seed = piece
    signal = injected_signal(likelihood, single, theta)
    noise = np.random.default_rng(seed).standard_normal(signal.shape)
    data = bank.project(signal + noise)
    gain, position = bank.largest_gain(data.astype(np.float32))
    if free_scale:
        gain = profiled(gain, (data**2).sum(axis=0), bank.n_data - bank.n_nuisance)
    east, north = bank.grid.east_mas[position], bank.grid.north_mas[position]
    away = np.hypot(east - theta[:, 0], north - theta[:, 1])
    near = away < 0.5 * resolution_mas(likelihood)
    # An alias farther out than the companion is reported at the companion's own place.
    outer = np.hypot(east, north) > np.hypot(theta[:, 0], theta[:, 1])
    doubtful = np.flatnonzero((gain > threshold) & ~near & outer)
    if len(doubtful):
        there = bank.templates_at(east[doubtful], north[doubtful])
        here = bank.templates_at(theta[doubtful, 0], theta[doubtful, 1])
        near[doubtful] = (there * here).sum(axis=0) > ALIAS
    return np.asarray(near & (gain > threshold))


def injected_signal(likelihood: Likelihood, single: FloatArray, theta: FloatArray) -> FloatArray:
    """Whitened change of the data by companions (n, 3) on top of the fit without one."""
    full = np.hstack([theta, np.broadcast_to(single, (len(theta), len(single)))])
    alone = single_likelihood(likelihood).predict(np.atleast_2d(single))
    change = likelihood.predict(full) - alone
    closure = change[likelihood.samples.squares.shape[0] :]
    closure -= 2.0 * np.pi * np.rint(closure / (2.0 * np.pi))
    return likelihood.observables.covariance.whiten(change)


def _gain_at(significance: Significance, bank: TemplateBank) -> float:
    """Gain in χ² that reaches the threshold, if the rest of χ² is its expectation."""
    threshold, n = significance.threshold(), bank.n_data - bank.n_nuisance
    return float(n * np.expm1(threshold / n)) if significance.free_scale else threshold


def _linear_half(result: SearchResult, rho: FloatArray, threshold: float) -> FloatArray:
    """Contrast whose expected statistic equals the threshold, median over the azimuth."""
    distance = np.hypot(result.grid.east_mas, result.grid.north_mas)
    width = max(0.5 * (rho[1] - rho[0]) if len(rho) > 1 else np.inf, result.grid.step_mas)
    sigma = [np.median(result.bank_sigma[np.abs(distance - r) <= width]) for r in rho]
    return np.asarray(np.sqrt(threshold) * np.array(sigma))


def _inside(log_contrast: FloatArray, level: FloatArray) -> FloatArray:
    """Contrasts that the injections bracket; NaN for what would be extrapolated."""
    bracketed = log_contrast <= np.log(np.minimum(level[:, -1], 1.0))
    bracketed &= log_contrast >= np.log(level[:, 0])
    return np.exp(np.where(bracketed, log_contrast, np.nan))


def _logistic(
    log_contrast: FloatArray, recovered: FloatArray, trials: FloatArray
) -> tuple[float, ...]:
    """Fit P = 1/(1 + exp(−k(ln c − m))): m, k and the error of m.

    A weak prior on ln k (width 1 about k = 6) keeps all-or-nothing data finite.
    """

    def loss(x: FloatArray) -> float:
        slope = np.exp(x[1])
        z = slope * (log_contrast - x[0])
        log_p, log_q = -np.logaddexp(0.0, -z), -np.logaddexp(0.0, z)
        prior = 0.5 * (x[1] - np.log(6.0)) ** 2
        return float(prior - (recovered * log_p + (trials - recovered) * log_q).sum())

    if not recovered.any():
        return np.inf, 1.0, np.inf
    start = np.array([np.interp(0.5, np.sort(recovered / trials), log_contrast), np.log(6.0)])
    best = optimize.minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-4}).x
    slope = float(np.exp(best[1]))
    p = special.expit(slope * (log_contrast - best[0]))
    information = (trials * p * (1.0 - p)).sum() * slope**2
    return float(best[0]), slope, float(1.0 / np.sqrt(max(information, 1e-12)))

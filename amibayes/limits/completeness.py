"""Detection limits by injection and recovery, by the criterion of the search itself.

Companions are injected at rings of separations and levels of contrast, in rounds whose size
is fixed beforehand: the first spreads evenly, the next go where the share of recovered ones
is least certain. The limit of a ring is the contrast that a logistic fit gives to the wanted
share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable
from scipy import optimize, special, stats

from amibayes.companion_search.result import SearchResult, null_likelihood
from amibayes.companion_search.search import resolution_mas
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.tables import UNITS, html_table, quantity_table
from amibayes.detection.false_alarm import Significance, clopper_pearson, null_maxima
from amibayes.limits.companion_removed import without_companion
from amibayes.limits.injection import (
    InjectionSetup,
    Recovery,
    Trials,
    ambiguous,
    inject,
    injected_signal,
    nearer_aliases,
    recover,
    spawned,
)
from amibayes.limits.rings import Rings, make_rings
from amibayes.parallel import Executor, Journals, Progress
from amibayes.support.quantities import takes_quantities
from amibayes.units import BoolArray, FloatArray, IntArray, contrast_to_delta_mag

MAX_STEPS, SETTLED = 100, 1e-10


TYPICAL = np.array([0.0, 6.0, 0.0, 0.0])


LOOSENESS = np.array([1e3, 20.0, 20.0, 20.0])
"""A wide Gaussian prior of the coefficients, which keeps all-or-nothing data finite."""


NODES = 401
"""Between which a crossing is bracketed."""


@dataclass(frozen=True, eq=False)
class Logistic:
    """logit P = Σ βₖ (x − x₀)ᵏ, k = 0 to 3, fitted; its tangent outside of the fitted range.

    Parameters
    ----------
    low, high : float
        Range of x that was fitted; x₀ is its middle.
    beta : (4,) float array
    covariance : (4, 4) float array
    """

    low: float
    high: float
    beta: FloatArray
    covariance: FloatArray

    @property
    def centre(self) -> float:
        """x₀."""
        return 0.5 * (self.low + self.high)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Probability at x."""
        return np.asarray(special.expit(self._logit(x)))

    def _logit(self, x: FloatArray | float) -> FloatArray:
        inside = np.clip(x, self.low, self.high)
        beyond = np.maximum(self._slope(inside), 0.0) * (x - inside)
        return np.asarray(_design(inside - self.centre) @ self.beta + beyond)

    def _slope(self, x: FloatArray | float) -> FloatArray:
        """Slope of the logit inside of the fitted range."""
        powers = np.arange(1, len(self.beta))
        return np.asarray(_design(x - self.centre)[..., :-1] @ (powers * self.beta[1:]))

    def crossing(self, probability: float) -> tuple[float, float]:
        """Find x above which the probability is exceeded, and its 1σ error.

        Infinite, with NaN for its error, where that is outside the fitted range.
        """
        goal = special.logit(probability)
        nodes = np.linspace(self.low, self.high, NODES)
        below = np.flatnonzero(self._logit(nodes) < goal)
        if not len(below):
            return -np.inf, np.nan
        if below[-1] == NODES - 1:
            return np.inf, np.nan
        between = nodes[below[-1]], nodes[below[-1] + 1]
        x = float(optimize.brentq(lambda at: float(self._logit(at)) - goal, *between))
        row = _design(x - self.centre)
        return x, float(np.sqrt(row @ self.covariance @ row) / self._slope(x))


def fit_logistic(x: FloatArray, successes: FloatArray, trials: FloatArray) -> Logistic:
    """Fit binomial counts by Newton's method.

    A statistic that scatters normally about the contrast, averaged over directions of unequal
    sensitivity, is no straight line in ln contrast: with the square and the cube the
    fit follows it to 0.5 % of probability, without them to 3 %.

    Parameters
    ----------
    x, successes, trials : (n,) float array
    """
    low, high = float(np.min(x)), float(np.max(x))
    design = _design(x - 0.5 * (low + high))
    precision = np.diag(LOOSENESS**-2.0)
    share = np.clip(successes.sum() / trials.sum(), 0.01, 0.99)
    beta = TYPICAL + np.array([special.logit(share), 0.0, 0.0, 0.0])
    for _ in range(MAX_STEPS):
        p = special.expit(design @ beta)
        information = (design.T * (trials * p * (1.0 - p))) @ design + precision
        gradient = design.T @ (successes - trials * p) - precision @ (beta - TYPICAL)
        step = np.linalg.solve(information, gradient)
        # Far from the answer the curvature is that of another place.
        step *= min(1.0, 3.0 / max(np.abs(step).max(), 1e-300))
        beta = beta + step
        if np.abs(step).max() < SETTLED:
            break
    return Logistic(low, high, beta, np.linalg.inv(information))


def _design(x: FloatArray | float) -> FloatArray:
    return np.stack([np.ones_like(x), x, np.square(x), np.power(x, 3)], axis=-1)


__all__ = ["DetectionLimit", "Recovery", "detection_limit", "injected_signal", "recover"]


N_SEPARATIONS = 16


N_LEVELS = 14


TRIALS_PER_CELL = 40


LEVELS = (0.4, 4.0)
"""Injected contrasts, in units of the one that linear theory detects half of the time."""


BEYOND = 2.0
"""Highest level in units of what the blindest direction that counts sees half of the time."""


COMPLETENESS = 0.95


MAX_AMBIGUOUS = 0.5 * (1.0 - COMPLETENESS)
"""Share of directions with an alias nearer in, above which detection alone is counted."""


SPREAD = (0.16, 0.5, 0.84)
"""Quantiles over the position angle."""


@dataclass(frozen=True, eq=False)
class DetectionLimit:
    """Contrast that is recovered with a stated probability at a stated false-positive rate.

    Parameters
    ----------
    method : str
    separation_mas : (n,) float array
    contrast : (n,) float array
        Recovered with probability ``completeness``, averaged over the position angle; NaN
        where no injected one is.
    contrast_50 : (n,) float array
        Recovered half of the time.
    log_error, log_error_50 : (n,) float array
        1σ errors of ln contrast.
    spread : (n, 3) float array
        Contrast recovered with probability ``completeness`` at one position angle: the 16, 50
        and 84 % points over all of them.
    by_detection : (n,) bool array
        Where the data cannot tell a position from one nearer to the star in more than
        `MAX_AMBIGUOUS` of the directions, hardly any contrast can be found at its place
        with probability ``completeness``: there a companion counts wherever it is seen.
    ambiguous : (n,) float array
        Share of the directions in which that is so.
    threshold : float
        Statistic of a detection.
    false_positive_rate : float
        α, at which the threshold was set.
    false_positives : (int, int)
        Searches of noise alone, other than those that set the threshold, that exceed it; and
        how many there were.
    completeness : float
    level : (n, n_levels) float array
        Injected contrasts.
    trials, detected, located : (n, n_levels) int array
    """

    method: str
    separation_mas: FloatArray
    contrast: FloatArray
    contrast_50: FloatArray
    log_error: FloatArray
    log_error_50: FloatArray
    spread: FloatArray
    by_detection: BoolArray
    ambiguous: FloatArray
    threshold: float
    false_positive_rate: float
    false_positives: tuple[int, int]
    completeness: float
    level: FloatArray
    trials: IntArray
    detected: IntArray
    located: IntArray

    def to_table(self) -> QTable:
        """The limit at every separation as an astropy table with units."""
        columns = {
            "separation_mas": self.separation_mas,
            "contrast": self.contrast,
            "log_error": self.log_error,
            "delta_mag": self.delta_mag,
            "contrast_50": self.contrast_50,
        }
        meta = {
            "method": self.method,
            "false_positive_rate": self.false_positive_rate,
            "completeness": self.completeness,
        }
        return quantity_table(columns, UNITS, meta)

    def __repr__(self) -> str:
        """One line for a notebook."""
        return (
            f"<DetectionLimit: {self.method}, {self.completeness:.0%} recovered at a "
            f"false-positive rate of {self.false_positive_rate:.2g}, "
            f"{len(self.separation_mas)} separations>"
        )

    def _repr_html_(self) -> str:
        """Show the curve in a notebook."""
        rows = [
            (f"{rho:.4g}", f"{mag:.2f}", f"{contrast:.3g}")
            for rho, mag, contrast in zip(
                self.separation_mas, self.delta_mag, self.contrast, strict=True
            )
        ]
        header = ("separation (mas)", "delta mag", "contrast")
        return html_table(repr(self).strip("<>"), header, rows)

    @property
    def delta_mag(self) -> FloatArray:
        """The limit in magnitudes, (n,)."""
        return contrast_to_delta_mag(self.contrast)

    @property
    def recovered(self) -> IntArray:
        """Recovered companions, (n, n_levels): located ones, or detected ones."""
        return np.where(self.by_detection[:, None], self.detected, self.located)

    @property
    def share(self) -> FloatArray:
        """Share of recovered companions, (n, n_levels); NaN where none was injected."""
        return np.where(self.trials > 0, self.recovered / np.maximum(self.trials, 1), np.nan)

    def probability(self, separation_mas: float, contrast: float) -> float:
        """Probability that a companion is recovered; NaN at separations that were not tried.

        By the logistic fits of the rings beside it, between which it is interpolated.
        """
        inner, outer = self.separation_mas[[0, -1]]
        if not inner <= separation_mas <= outer:
            return float("nan")
        behind = int(np.searchsorted(self.separation_mas, separation_mas, side="right")) - 1
        rings = [behind, min(behind + 1, len(self.separation_mas) - 1)]
        found = [float(self._fit(k)(np.log(contrast))) for k in rings]
        return float(np.interp(separation_mas, self.separation_mas[rings], found))

    def counts_anywhere(self, separation_mas: float) -> bool:
        """Whether a companion there counts as recovered wherever it is seen."""
        return bool(self.by_detection[np.abs(self.separation_mas - separation_mas).argmin()])

    def _fit(self, ring: int) -> Logistic:
        counts = self.recovered[ring].astype(float), self.trials[ring].astype(float)
        return fit_logistic(np.log(self.level[ring]), *counts)

    @property
    def false_positive_interval(self) -> tuple[float, float]:
        """95 % Clopper–Pearson interval of the measured false-positive rate."""
        return clopper_pearson(*self.false_positives)

    def jeffreys(self, level: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Jeffreys interval of the completeness of every cell, (n, n_levels) each."""
        rest = 0.5 * (1.0 - level)
        a, b = self.recovered + 0.5, self.trials - self.recovered + 0.5
        return np.asarray(stats.beta.ppf(rest, a, b)), np.asarray(stats.beta.isf(rest, a, b))


@takes_quantities
def detection_limit(
    result: SearchResult,
    significance: Significance,
    rng: np.random.Generator,
    *,
    n_separations: int = N_SEPARATIONS,
    separation_mas: Sequence[float] | None = None,
    trials_per_cell: int = TRIALS_PER_CELL,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journals: Journals | None = None,
) -> DetectionLimit:
    """Measure the detection limit of a search by injection and recovery.

    Parameters
    ----------
    result : SearchResult
        Its field, grid, model and data are those of the limit.
    significance : Significance
        Its null draws set the threshold, at its α.
    rng : numpy.random.Generator
    n_separations : int
        Rings from the inner to the outer edge of the field.
    separation_mas : sequence of float, optional
        These rings instead.
    trials_per_cell : int
        On average; there are `N_LEVELS` contrasts per ring.
    executor : Executor, optional
        Where it is computed; the result does not depend on it.
    progress : callable, optional
        Told (trials done, trials in all).
    journals : Journals, optional
        Keep finished pieces.

    Returns
    -------
    DetectionLimit
    """
    rings = make_rings(result, n_separations, separation_mas)
    bank, significance = without_companion(result, significance, rng, executor, journals)
    setting, lost, sigma = _prepared(result, bank, significance, rings, executor, journals)
    trials = inject(setting, trials_per_cell, rng, progress)
    false = _false_positives(setting, significance, rng)
    return _summarised(setting, trials, sigma, lost, significance.alpha, false)


def _prepared(
    result: SearchResult,
    bank: TemplateBank,
    significance: Significance,
    rings: Rings,
    executor: Executor | None,
    journals: Journals | None,
) -> tuple[InjectionSetup, FloatArray, FloatArray]:
    """What all rounds need, the ambiguous share of every ring, and errors of the contrast."""
    likelihood, frame = null_likelihood(result)
    gain = _gain_at(significance, bank)
    sigma = rings.sensitivity(bank, np.zeros(bank.n_data))[1]
    nearer = _nearer(bank, rings, result, executor, journals)
    seen_at = np.full(nearer.shape, (np.sqrt(gain) + stats.norm.ppf(COMPLETENESS)) ** 2)
    lost = ambiguous(nearer, seen_at).mean(axis=1)
    setting = InjectionSetup(
        likelihood=likelihood,
        single=result.single_theta,
        frame=frame,
        bank=bank,
        rings=rings,
        nearer=nearer,
        level=_levels(gain, sigma),
        by_detection=lost > MAX_AMBIGUOUS,
        threshold=significance.threshold(),
        free_scale=significance.free_scale,
        executor=executor,
        journals=journals,
    )
    return setting, lost, sigma


def _levels(gain: float, sigma: FloatArray) -> FloatArray:
    """Contrasts to inject at every ring, (n, N_LEVELS), from its errors (n, n_angles).

    Where some directions are nearly blind the levels reach on to what these see.
    """
    middle, blind = np.quantile(sigma, (0.5, COMPLETENESS + 0.02), axis=1)
    highest = np.maximum(LEVELS[1], BEYOND * blind / middle)
    steps = np.geomspace(LEVELS[0], highest, N_LEVELS, axis=1)
    return np.asarray(np.minimum(np.sqrt(gain) * middle[:, None] * steps, 1.0))


def _nearer(
    bank: TemplateBank,
    rings: Rings,
    result: SearchResult,
    executor: Executor | None,
    journals: Journals | None,
) -> FloatArray:
    """Correlation with the best alias nearer to the star, (n, n_angles)."""
    journal = journals.of("aliases") if journals else None
    fringe = resolution_mas(result.likelihood)
    places = rings.places.reshape(*rings.east_mas.shape, 2)
    return nearer_aliases(bank, places, fringe, executor=executor, journal=journal)


def _false_positives(
    setting: InjectionSetup, significance: Significance, rng: np.random.Generator
) -> tuple[int, int]:
    """Count false alarms among as many fresh searches of noise as set the threshold."""
    journal = setting.journals.of("false-positives") if setting.journals else None
    null = null_maxima(
        setting.bank,
        significance.n_draws,
        spawned(rng),
        free_scale=setting.free_scale,
        frame=setting.frame,
        executor=setting.executor,
        journal=journal,
    )
    return int((null > setting.threshold).sum()), len(null)


def _summarised(
    setting: InjectionSetup,
    trials: Trials,
    sigma: FloatArray,
    lost: FloatArray,
    alpha: float,
    false: tuple[int, int],
) -> DetectionLimit:
    """Fit every ring and gather what was found."""
    shape, level = setting.level.shape, setting.level
    n = trials.counts(np.ones(len(trials.ring), dtype=bool), shape)
    detected, located = (trials.counts(w, shape) for w in (trials.detected, trials.located))
    recovered = np.where(setting.by_detection[:, None], detected, located)
    limit, middle = (
        np.array([_crossing(*ring, p) for ring in zip(level, recovered, n, strict=True)])
        for p in (COMPLETENESS, 0.5)
    )
    return DetectionLimit(
        method="injection",
        separation_mas=setting.rings.separation_mas,
        contrast=limit[:, 0],
        contrast_50=middle[:, 0],
        log_error=limit[:, 1],
        log_error_50=middle[:, 1],
        spread=_spread(setting, trials, sigma),
        by_detection=setting.by_detection,
        ambiguous=lost,
        threshold=setting.threshold,
        false_positive_rate=alpha,
        false_positives=false,
        completeness=COMPLETENESS,
        level=level,
        trials=n,
        detected=detected,
        located=located,
    )


def _crossing(
    level: FloatArray, recovered: IntArray, trials: IntArray, probability: float
) -> tuple[float, float]:
    """Contrast of a given completeness, and the error of its logarithm; NaN outside the levels."""
    fit = fit_logistic(np.log(level), recovered.astype(float), trials.astype(float))
    return _bracketed(*fit.crossing(probability))


def _bracketed(log_contrast: float, error: float) -> tuple[float, float]:
    """Give a contrast and the error of its logarithm; NaN where the injections end before it."""
    if not np.isfinite(log_contrast):
        return np.nan, np.nan
    return float(np.exp(log_contrast)), error


def _spread(setting: InjectionSetup, trials: Trials, sigma: FloatArray) -> FloatArray:
    """Quantiles over the position angle of the limit at one position angle, (n, 3).

    At one position recovery depends on the contrast in units of its error there, c/σ(angle):
    a fit in that variable gives every direction its own limit.
    """
    out = np.full((len(sigma), len(SPREAD)), np.nan)
    found = np.where(setting.by_detection[trials.ring], trials.detected, trials.located)
    for k in range(len(sigma)):
        at = np.flatnonzero(trials.ring == k)
        strength = setting.level[k, trials.level[at]] / sigma[k, trials.angle[at]]
        fit = fit_logistic(np.log(strength), found[at].astype(float), np.ones(len(at)))
        out[k] = np.quantile(sigma[k], SPREAD) * _bracketed(*fit.crossing(COMPLETENESS))[0]
    return np.where(out <= 1.0, out, np.nan)


def _gain_at(significance: Significance, bank: TemplateBank) -> float:
    """Gain in χ² that reaches the threshold, if the rest of χ² is its expectation."""
    threshold, n = significance.threshold(), bank.n_data - bank.n_nuisance
    if significance.free_scale:
        return float(n * np.expm1(threshold / n))
    if bank.freedom is None:
        return threshold
    degrees = bank.freedom.degrees
    return float((n + degrees - 2.0) * np.expm1(threshold / (bank.n_data + degrees)))

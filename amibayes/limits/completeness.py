"""Detection limits by injection and recovery, by the criterion of the search itself.

Companions are injected at rings of separations and levels of contrast, in rounds whose size
is fixed beforehand: the first spreads evenly, the next go where the share of recovered ones
is least certain. The limit of a ring is the contrast that a logistic fit gives to the wanted
share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.result import SearchResult
from amibayes.detection.false_alarm import Significance, draws_needed
from amibayes.detection.statistic import Statistic
from amibayes.errors import UsageError
from amibayes.limits.aliases import ambiguous, nearer_aliases
from amibayes.limits.injection import (
    InjectionSetup,
    Trials,
    inject,
    spawned,
)
from amibayes.limits.limit import DetectionLimit
from amibayes.limits.logistic import fit_logistic
from amibayes.limits.rings import Rings, make_rings
from amibayes.parallel import Executor, Journals, Progress
from amibayes.support.arguments import checks_arguments, in_range
from amibayes.units import FloatArray, IntArray

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


@checks_arguments
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
    in_range("detection_limit", "trials_per_cell", trials_per_cell, 1)
    rings = make_rings(result, n_separations, separation_mas)
    test, threshold = _without_companion(result, significance, rng, executor, journals)
    setting, lost, sigma = _prepared(test, threshold, rings, executor, journals)
    trials = inject(setting, trials_per_cell, rng, progress)
    false = _false_positives(setting, significance.n_draws, rng)
    return _summarised(setting, trials, sigma, lost, significance.alpha, false)


def _without_companion(
    result: SearchResult,
    significance: Significance,
    rng: np.random.Generator,
    executor: Executor | None,
    journals: Journals | None,
) -> tuple[Statistic, float]:
    """Statistic and threshold as they were, had the companion that was detected not been there.

    Noise that is measured in the residuals would hold the companion: right for the test
    whether there is one, not for what would be seen where there is none.
    """
    test = significance.test
    if test is None:
        raise UsageError(
            "the significance holds no statistic", remedy="make it with amibayes.significance"
        )
    if significance.detected is None:
        raise UsageError(
            f"{significance.n_draws} null draws cannot set a threshold at a false-positive rate "
            f"of {significance.alpha:g}",
            remedy=f"draw {draws_needed(significance.alpha)} or more",
        )
    if not significance.detected:
        return test, significance.threshold()
    test = test.with_noise_of(test.likelihood.residuals(result.theta)[:, 0])
    if not test.null_rests_on_residuals:
        return test, significance.threshold()
    journal = journals.of("threshold") if journals else None
    null = test.draw_null(significance.n_draws, spawned(rng), executor=executor, journal=journal)
    return test, replace(significance, null=np.sort(null)).threshold()


def _prepared(
    test: Statistic,
    threshold: float,
    rings: Rings,
    executor: Executor | None,
    journals: Journals | None,
) -> tuple[InjectionSetup, FloatArray, FloatArray]:
    """What all rounds need, the ambiguous share of every ring, and errors of the contrast."""
    gain = test.gain_at(threshold)
    sigma = test.contrast_error(rings.places).reshape(rings.east_mas.shape)
    nearer = _nearer(test, rings, executor, journals)
    seen_at = np.full(nearer.shape, (np.sqrt(gain) + stats.norm.ppf(COMPLETENESS)) ** 2)
    lost = ambiguous(nearer, seen_at).mean(axis=1)
    setting = InjectionSetup(
        test=test,
        rings=rings,
        nearer=nearer,
        level=_levels(gain, sigma),
        by_detection=lost > MAX_AMBIGUOUS,
        threshold=threshold,
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
    test: Statistic, rings: Rings, executor: Executor | None, journals: Journals | None
) -> FloatArray:
    """Correlation with the best alias nearer to the star, (n, n_angles)."""
    journal = journals.of("aliases") if journals else None
    fringe = resolution_mas(test.likelihood)
    places = rings.places.reshape(*rings.east_mas.shape, 2)
    return nearer_aliases(test.bank, places, fringe, executor=executor, journal=journal)


def _false_positives(
    setting: InjectionSetup, n_draws: int, rng: np.random.Generator
) -> tuple[int, int]:
    """Count false alarms among as many fresh searches of noise as set the threshold."""
    journal = setting.journals.of("false-positives") if setting.journals else None
    null = setting.test.draw_null(n_draws, spawned(rng), executor=setting.executor, journal=journal)
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

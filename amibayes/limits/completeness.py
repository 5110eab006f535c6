"""Detection limits by injection and recovery, by the criterion of the search itself.

At rings of separations, at all position angles and for many draws of noise, the contrast is
found from which on the search recovers a companion (`amibayes.limits.critical`). The limit of a
ring is the contrast above which the wanted share of these numbers ends. Noise scatters as the
data may truly scatter: its size is drawn from its posterior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from amibayes.companion_search.result import SearchResult
from amibayes.detection.false_alarm import Significance, draws_needed
from amibayes.detection.statistic import Statistic, statistic_of
from amibayes.detection.tails import pareto_quantile
from amibayes.errors import UsageError
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.limits.components import over_components
from amibayes.limits.critical import (
    CriticalContrasts,
    Draws,
    critical_contrasts,
    directions_of,
)
from amibayes.limits.limit import SHARES, DetectionLimit
from amibayes.limits.own_drift import with_own_drift
from amibayes.limits.pooled import Pooled, quantiles
from amibayes.limits.rings import Rings, check_separations, make_rings
from amibayes.parallel import Executor, Journals, Progress, spawn
from amibayes.support.arguments import checks_arguments, in_range
from amibayes.support.options import LIMITS_TRIALS
from amibayes.units import FloatArray

N_SEPARATIONS = 16

MOST_ANGLES = 120
"""Position angles of a ring: the share of recovered companions is a mean over them, which the
beams of the outermost ring need not be resolved for."""

LEAST_PER_PLACE = 2
"""Draws of noise at every place: their differences are the Monte Carlo error."""

AFFORDABLE, SIGNAL_WORK = 5e10, 2000.0
"""Positions times data of all injected companions together, and how many of them the visibility of
a companion at one point is worth: some two seconds of one core. Large data on wide fields get
fewer companions."""

COMPLETENESS = 0.95

MAX_AMBIGUOUS = 0.5 * (1.0 - COMPLETENESS)
"""Share of directions with an alias nearer in, above which detection alone is counted."""

SPREAD = (0.16, 0.5, 0.84)
"""Quantiles over the position angle."""

N_LEVELS = 14

LEVELS = (0.4, 4.0)
"""Contrasts of the completeness map, in units of the one that linear theory detects half of the
time."""

NULL_DRAWS, FRESH_WORK = 20_000, 5e10
"""Null searches from which the threshold is known to 0.01 mag, and positions times data of those
that are added to the ones of the search: about a second of one core."""

BOOTSTRAPS = 40
"""Resampled thresholds: their error is then known to a tenth."""


@checks_arguments
def detection_limit(
    result: SearchResult,
    significance: Significance,
    rng: np.random.Generator,
    *,
    n_separations: int = N_SEPARATIONS,
    separation_mas: Sequence[float] | None = None,
    trials: int = LIMITS_TRIALS,
    noise: ExtraNoise | None = None,
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
    trials : int
        Companions that are injected per separation at most, each with noise and at a position
        angle of its own; its contrast is found. Large data get as many as `WANTED` asks for.
    noise : ExtraNoise, optional
        What the search fitted beside the stated errors; where there is any the errors are
        not taken to be as stated.
    executor : Executor, optional
        Where it is computed; the result does not depend on it.
    progress : callable, optional
        Told (pieces done, pieces in all).
    journals : Journals, optional
        Keep finished pieces.

    Returns
    -------
    DetectionLimit
    """
    in_range("detection_limit", "trials", trials, 1)
    check_separations(separation_mas)
    test, null = _without_companion(result, significance, rng, executor, journals)
    rings, draws = _planned(result, test, n_separations, separation_mas, trials, noise, rng)
    threshold = pareto_quantile(null.null, null.alpha)
    critical = _injected(
        test, threshold, rings, draws, trials,
        executor=executor, progress=progress, journals=journals,
    )  # fmt: skip
    critical, drift_error = with_own_drift(
        test, threshold, rings, critical, SHARES, draws.seed, executor=executor, journals=journals
    )
    return _summarised(test, null, threshold, rings, critical, drift_error)


def _injected(
    test: Statistic,
    threshold: float,
    rings: Rings,
    draws: Draws,
    trials: int,
    *,
    executor: Executor | None,
    progress: Progress | None,
    journals: Journals | None,
) -> CriticalContrasts:
    """Critical contrasts on rings, of as many draws of noise as their limits take to be known."""
    typical = _root(test, threshold) + stats.norm.ppf(COMPLETENESS)
    directions = directions_of(
        test, rings, typical=typical**2, most_ambiguous=MAX_AMBIGUOUS,
        executor=executor, journals=journals,
    )  # fmt: skip

    def of(draws: Draws, job: str) -> CriticalContrasts:
        return critical_contrasts(
            test, threshold, rings, directions, draws, executor=executor, progress=progress,
            journal=journals.of(job) if journals else None,
        )  # fmt: skip

    critical = of(draws, "injections")
    if more := _more(critical, trials):
        further = replace(draws, per_place=more, seed=draws.seed + 1)
        critical = critical.joined(of(further, "more injections"))
    return critical


def _more(critical: CriticalContrasts, trials: int) -> int:
    """Draws of noise for each place that are wanted beside those of large data, up to ``trials``.

    Large data begin with few: an error of `WANTED` asks for more.
    """
    n_angles, n = (int(size) for size in critical.located.shape[1:])
    most = trials // n_angles
    if most <= n:
        return 0
    pooled = Pooled.of(critical, over_components(critical))
    error = pooled.contrast(np.array([COMPLETENESS]))[1]
    known = error[np.isfinite(error)]
    if not len(known):
        return 0
    wanted = int(np.ceil(n * (float(np.median(known)) / WANTED) ** 2))
    return max(min(wanted, most) - n, 0)


WANTED = 0.025
"""Error of ln of a limit by its injections: 0.027 mag, and with that of the threshold 0.03."""


def _without_companion(
    result: SearchResult,
    significance: Significance,
    rng: np.random.Generator,
    executor: Executor | None,
    journals: Journals | None,
) -> tuple[Statistic, Significance]:
    """Statistic and null draws as they were, had the companion that was detected not been there.

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
    known = significance.null
    if significance.detected:
        if test.exposures is not None:
            test, known = statistic_of(result, companion_known=True), known[:0]
        test = test.with_noise_of(test.likelihood.residuals(result.theta)[:, 0])
        known = known[:0] if test.null_rests_on_residuals else known
    n = max(min(NULL_DRAWS - len(known), int(FRESH_WORK / test.bank.work_of_many)), 0)
    n = max(n, draws_needed(significance.alpha) if not len(known) else 0)
    own = np.random.default_rng(spawn(rng, 1)[0])
    journal = journals.of("threshold") if journals else None
    fresh = test.draw_null(n, own, executor=executor, journal=journal) if n else known[:0]
    return test, replace(significance, null=np.sort(np.concatenate([known, fresh])))


def _planned(
    result: SearchResult,
    test: Statistic,
    n_separations: int,
    separation_mas: Sequence[float] | None,
    trials: int,
    noise: ExtraNoise | None,
    rng: np.random.Generator,
) -> tuple[Rings, Draws]:
    """Rings and how much noise is drawn at each place of theirs."""
    n = n_separations if separation_mas is None else len(separation_mas)
    work = test.bank.work + SIGNAL_WORK * len(test.likelihood.samples)
    afforded = AFFORDABLE / (n * SEARCHES * work)
    trials = min(trials, max(int(afforded), LEAST_TRIALS))
    most = int(np.clip(trials // LEAST_PER_PLACE, 1, MOST_ANGLES))
    rings = make_rings(result, n_separations, separation_mas, most_angles=most)
    per_place = max(LEAST_PER_PLACE, round(trials / rings.east_mas.shape[1]))
    stated = noise is None or not (noise.any or noise.channels)
    return rings, Draws(per_place, int(rng.integers(2**62)), stated)


SEARCHES = 2.5
"""Searches that one companion takes, on average."""

LEAST_TRIALS = 80
"""However large the data are. Rings together then tell a limit to 0.03 mag, or how many more it
takes."""


def _summarised(
    test: Statistic,
    null: Significance,
    threshold: float,
    rings: Rings,
    critical: CriticalContrasts,
    drift_error: FloatArray,
) -> DetectionLimit:
    """Gather what was found on every ring."""
    in_errors = over_components(critical)
    pooled = Pooled.of(critical, in_errors)
    goal = _root(test, threshold), _threshold_error(test, null)
    level = _levels(goal[0], critical.sigma)
    counts = [
        (x[:, :, :, None] <= level[:, None, None]).sum(axis=(1, 2))
        for x in (critical.detected, critical.located)
    ]
    every, error = pooled.contrast(SHARES)
    every = np.maximum.accumulate(every, axis=1)
    error = np.hypot(error, goal[1] / (goal[0] + stats.norm.ppf(SHARES)))
    error = np.hypot(error, drift_error)
    at = [int(np.abs(SHARES - share).argmin()) for share in (COMPLETENESS, 0.5)]
    return DetectionLimit(
        method="injection",
        separation_mas=rings.separation_mas,
        contrast=every[:, at[0]],
        contrast_50=every[:, at[1]],
        log_error=error[:, at[0]],
        log_error_50=error[:, at[1]],
        spread=_spread(critical.sigma, in_errors),
        by_detection=critical.by_detection,
        ambiguous=critical.ambiguous,
        threshold=threshold,
        false_positive_rate=null.alpha,
        false_positives=(int((null.null > threshold).sum()), null.n_draws),
        completeness=COMPLETENESS,
        level=level,
        trials=np.full(level.shape, critical.located[0].size),
        detected=counts[0],
        located=counts[1],
        critical=every,
    )


def _root(test: Statistic, statistic: float) -> float:
    """Root of the gain in χ² of a statistic: standard deviations, of known errors."""
    return float(np.sqrt(test.gain_at(np.array(statistic))))


def _levels(middle: float, sigma: FloatArray) -> FloatArray:
    """Contrasts of the map at every ring, (n, N_LEVELS), from its errors (n, n_angles)."""
    blind = np.quantile(sigma, COMPLETENESS, axis=1) / np.median(sigma, axis=1)
    highest = np.maximum(LEVELS[1], 2.0 * blind)
    steps = np.geomspace(LEVELS[0], highest, N_LEVELS, axis=1)
    return np.asarray(np.minimum(middle * np.median(sigma, axis=1)[:, None] * steps, 1.0))


def _threshold_error(test: Statistic, null: Significance) -> float:
    """Error of the root of the threshold's gain, by bootstraps of the null draws."""
    rng, drawn = np.random.default_rng(0), null.null
    resampled = (np.sort(rng.choice(drawn, len(drawn))) for _ in range(BOOTSTRAPS))
    return float(np.std([_root(test, pareto_quantile(x, null.alpha)) for x in resampled]))


def _spread(sigma: FloatArray, in_errors: FloatArray) -> FloatArray:
    """Quantiles over the position angle of the limit at one position angle, (n, 3).

    At one position recovery depends on the contrast in units of its error there, c/σ(angle):
    a quantile of that gives every direction its own limit.
    """
    wanted = np.array([COMPLETENESS])
    at = np.array([quantiles(ring, wanted) for ring in in_errors])
    out = np.quantile(sigma, SPREAD, axis=1).T * at
    return np.where(out <= 1.0, out, np.nan)

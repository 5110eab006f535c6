"""Probabilities that were counted in draws: their intervals, and laws past the last draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import gamma, gammaln

from amibayes.units import FloatArray

TAIL_FRACTION = 0.05
"""Share of the null draws above the threshold of the generalised Pareto fit."""

QUANTILE_FRACTION, MIN_TAIL = 0.1, 30.0
"""Share of the null draws from which a quantile is found, and least number of them."""

BOOTSTRAPS = 40

MIN_PROBABILITY = 1e-30
"""Extrapolations below this are not told apart."""


@dataclass(frozen=True, eq=False)
class Tail:
    """Extrapolation of the null distribution past its draws, by two families.

    Parameters
    ----------
    generalised_pareto, extreme_value : float
        Probability of the observed statistic by a generalised Pareto fit of the largest
        `TAIL_FRACTION` of the draws, and by a generalised extreme-value fit of the largest
        of blocks of draws.
    log10_error : float
        Half the 68 % bootstrap interval of log10 of the Pareto probability, dex.
    """

    generalised_pareto: float
    extreme_value: float
    log10_error: float


def tail_of(null: FloatArray, statistic: float, rng: np.random.Generator) -> Tail:
    """Extrapolate sorted null draws to a statistic, with an error from bootstraps."""
    at = np.array(statistic)
    resampled: NDArray[np.float64] = np.array(
        [pareto_survival(np.sort(rng.choice(null, len(null))), at) for _ in range(BOOTSTRAPS)]
    )
    logs = np.log10(np.maximum(resampled, MIN_PROBABILITY))
    low, high = np.quantile(logs, [0.16, 0.84])
    pareto, extreme = pareto_survival(null, at), extreme_value_survival(null, at)
    return Tail(float(pareto), float(extreme), float(0.5 * (high - low)))


def extreme_value_survival(null: FloatArray, statistic: FloatArray) -> FloatArray:
    """P(null ≥ statistic), any shape, by a generalised extreme-value law of blocks' maxima.

    The law G of the largest of m = 1/`TAIL_FRACTION` draws by L-moments (Hosking, Wallis &
    Wood 1985), taken over all ways to form the blocks; then P = 1 − G^(1/m).
    """
    n, block = len(null), round(1.0 / TAIL_FRACTION)
    rank = np.arange(n + 1)
    # Share of the blocks whose largest member is at most the i-th smallest draw.
    log_share = gammaln(rank + 1.0) - gammaln(np.maximum(rank - block, 0) + 1.0)
    below = np.where(rank >= block, np.exp(log_share - log_share[-1]), 0.0)
    weight, middle = np.diff(below), 0.5 * (below[1:] + below[:-1])
    first, second, third = (float((weight * null * middle**k).sum()) for k in range(3))
    spread = 2.0 * second - first
    skewness = (6.0 * third - 6.0 * second + first) / spread
    ratio = 2.0 / (3.0 + skewness) - np.log(2.0) / np.log(3.0)
    shape = 7.859 * ratio + 2.9554 * ratio**2
    scale = spread * shape / ((1.0 - 2.0**-shape) * gamma(1.0 + shape))
    location = first - scale * (1.0 - gamma(1.0 + shape)) / shape
    log_cdf = stats.genextreme.logcdf(statistic, shape, location, scale)
    return np.asarray(-np.expm1(log_cdf / block))


def pareto_survival(null: FloatArray, statistic: FloatArray) -> FloatArray:
    """P(null ≥ statistic), any shape, by a generalised Pareto law over a high threshold.

    Moments (Hosking & Wallis 1987) rather than maximum likelihood: they are explicit, and
    stable near the exponential tail that the maximum of a χ² field has.
    """
    threshold, shape, scale = _pareto(null, TAIL_FRACTION)
    beyond = stats.genpareto.sf(np.asarray(statistic) - threshold, shape, scale=scale)
    return np.asarray(TAIL_FRACTION * beyond)


def pareto_quantile(null: FloatArray, alpha: float) -> float:
    """Statistic that sorted null draws exceed with probability alpha, by a generalised Pareto law.

    Of the largest `QUANTILE_FRACTION` of the draws: an error a quarter smaller than that of the
    order of the draws, and a value that does not move in steps. Beyond the law's range, and
    where the draws are few, it is the order of the draws.
    """
    if alpha >= QUANTILE_FRACTION or len(null) * QUANTILE_FRACTION < MIN_TAIL:
        return float(np.quantile(null, 1.0 - alpha))
    threshold, shape, scale = _pareto(null, QUANTILE_FRACTION)
    return threshold + float(stats.genpareto.isf(alpha / QUANTILE_FRACTION, shape, scale=scale))


def _pareto(null: FloatArray, fraction: float) -> tuple[float, float, float]:
    """Threshold, shape and scale of the law of the largest draws, by their moments."""
    excess = null[int(len(null) * (1.0 - fraction)) :]
    threshold = float(excess[0])
    mean, variance = (excess - threshold).mean(), (excess - threshold).var(ddof=1)
    ratio = float(mean * mean / max(variance, 1e-300))
    return threshold, 0.5 * (1.0 - ratio), 0.5 * float(mean) * (1.0 + ratio)


def clopper_pearson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Exact binomial interval of a probability (Clopper & Pearson 1934)."""
    rest = 0.5 * (1.0 - level)
    low = stats.beta.ppf(rest, successes, trials - successes + 1) if successes else 0.0
    high = stats.beta.isf(rest, successes + 1, trials - successes) if successes < trials else 1.0
    return float(low), float(high)

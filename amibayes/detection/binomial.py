"""Exact intervals of probabilities that were counted."""

from __future__ import annotations

from scipy import stats


def clopper_pearson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Exact binomial interval of a probability (Clopper & Pearson 1934)."""
    rest = 0.5 * (1.0 - level)
    low = stats.beta.ppf(rest, successes, trials - successes + 1) if successes else 0.0
    high = stats.beta.isf(rest, successes + 1, trials - successes) if successes < trials else 1.0
    return float(low), float(high)

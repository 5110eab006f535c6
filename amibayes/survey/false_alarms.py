"""The false alarms of many searches together.

A survey of m targets gives m probabilities, and the smallest of them is small by chance. Three
numbers answer three questions: the survey-wide false-alarm probability, whether any of the
survey's alarms as good as this one would be expected of noise (Šidák 1967); the false-discovery
rate, which share of the companions that are listed is expected to be noise (Benjamini &
Hochberg 1995); and the quantiles of the probabilities, whether the single targets' probabilities
are right at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from scipy import stats

from amibayes.errors import UsageError
from amibayes.units import BoolArray, FloatArray

FDR_LEVEL = 0.05
"""Share of false companions that the list of discoveries may have on average."""

NULLS_ABOVE = 0.2
"""Probabilities above this are of targets without companions but for a few: a companion that
would be found half of the time is above it in less than one survey of a thousand."""

BAND = 0.95


@dataclass(frozen=True, eq=False)
class FalseAlarms:
    """False-alarm probabilities of the targets of a survey, and what they mean together.

    Parameters
    ----------
    probability : (m,) float array
        Of each target that was tested.
    false_discovery_rate : (m,) float array
        The smallest level of the false-discovery rate at which the target is listed.
    survey_wide : (m,) float array
        Probability that m searches of noise give one as small anywhere.
    level : float
        Of the false-discovery rate, at which companions are listed.
    """

    probability: FloatArray
    false_discovery_rate: FloatArray
    survey_wide: FloatArray
    level: float

    @property
    def discovered(self) -> BoolArray:
        """Targets that are listed at the level, (m,)."""
        return np.asarray(self.false_discovery_rate <= self.level)

    def draws_needed(self) -> int:
        """Null searches with which a single companion in the survey could be listed.

        A probability counted from B null searches is 1/(1 + B) or more, and the smallest of m
        is listed only at level/m or less.
        """
        return max(ceil(len(self.probability) / self.level) - 1, 0)

    def uniformity(self) -> tuple[int, float] | None:
        """Test whether probabilities of noise are uniform: how many were used, and the p-value.

        Kolmogorov & Smirnov's test of those above `NULLS_ABOVE`, which are uniform from there
        to 1 whatever the number of companions; None with fewer than two of them.
        """
        nulls = self.probability[self.probability > NULLS_ABOVE]
        if len(nulls) < 2:
            return None
        scaled = (nulls - NULLS_ABOVE) / (1.0 - NULLS_ABOVE)
        return len(nulls), float(stats.kstest(scaled, "uniform").pvalue)


def false_alarms(probability: FloatArray, level: float = FDR_LEVEL) -> FalseAlarms:
    """Bring the false-alarm probabilities of a survey together.

    Probabilities that are too large, as the 1/(1 + B) of a target that no null search reaches,
    leave the false-discovery rate below what is stated.

    Parameters
    ----------
    probability : (m,) float array
        Of the targets that were tested, whatever came of them.
    level : float
        Of the false-discovery rate.

    Raises
    ------
    UsageError
        For what is no probability.
    """
    probability = np.asarray(probability, dtype=float)
    if not ((probability >= 0.0) & (probability <= 1.0)).all():
        raise UsageError("a false-alarm probability is not between 0 and 1")
    rate = stats.false_discovery_control(probability) if len(probability) else probability
    return FalseAlarms(probability, np.asarray(rate), survey_wide(probability), level)


def survey_wide(probability: FloatArray) -> FloatArray:
    """Probability that noise gives one as small in any of the m targets, 1 − (1 − p)^m, (m,)."""
    with np.errstate(divide="ignore"):  # p = 1 has the logarithm −∞ and the answer 1
        return np.asarray(-np.expm1(len(probability) * np.log1p(-probability)))


def expected_quantiles(m: int, band: float = BAND) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Give the median and the band of the kth smallest of m uniform probabilities, (m,) each.

    The kth smallest follows a beta distribution (k, m − k + 1); the band holds at every k by
    itself, not at all of them together.
    """
    k = np.arange(1, m + 1)
    rest = 0.5 * (1.0 - band)
    low, middle, high = (stats.beta.ppf(q, k, m - k + 1) for q in (rest, 0.5, 1.0 - rest))
    return np.asarray(middle), np.asarray(low), np.asarray(high)

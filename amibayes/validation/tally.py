"""Checks of many trials: ranks, coverage, false alarms and completeness, each with its chance.

Every check is a statement that holds for a correct implementation, and the probability that a
correct implementation does as badly. References: Talts et al. (2018, arXiv:1804.06788) for the
ranks; coverage and false alarms are binomial, completeness Poisson binomial.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from amibayes.detection.verdict import STATEMENTS
from amibayes.units import BoolArray, FloatArray, IntArray
from amibayes.validation.plan import RANGES, ValidationPlan
from amibayes.validation.trial import COVERED, LEVELS, RANKED

FEWEST = 8
"""Trials below which a check has no result."""

SURPRISING = 1e-3
"""A correct implementation fails a check with this probability."""

KOLMOGOROV = np.array([0.868731, 0.260333])
"""Mean and standard deviation of √n times the statistic, for many numbers."""

FALSE_ALARMS = (0.01, 0.05, 0.2)


@dataclass(frozen=True)
class Check:
    """One statement about amibayes, tested on its trials.

    Parameters
    ----------
    group : str
        ``ranks``, ``coverage``, ``false alarms``, ``completeness``, ``verdicts`` or
        ``second companion``.
    name : str
    n : int
        Trials it rests on.
    measured, expected, error : float
        Error: Monte Carlo, 1σ, of a correct implementation. NaN where there is no such number.
    p_value : float
        Probability that a correct implementation does as badly.
    """

    group: str
    name: str
    n: int
    measured: float
    expected: float
    error: float
    p_value: float

    @property
    def passed(self) -> bool:
        """Whether a correct implementation may well have done the same."""
        return self.p_value >= SURPRISING


@dataclass(frozen=True, eq=False)
class Validation:
    """The trials of a validation and their checks.

    Parameters
    ----------
    plan : ValidationPlan
    seed : int
    kind : (n,) tuple of str
    false_alarm_probability : (n,) float array
    truth, rank : (n, 3) float array
        East and north (mas) and contrast; ranks of `RANKED`. NaN without a companion.
    covered : (n, 3, 2) float array
        1 where the interval of a quantity of `COVERED` at a level of `LEVELS` holds the truth.
    found, expected : (n,) float array
        Whether it was found, and the probability that the limits state for it.
    statement : (n,) float array
        Number of the verdict's statement in `amibayes.detection.verdict.STATEMENTS`.
    second : (n,) float array
        False-alarm probability of a second companion, of which there is none.
    checks : tuple of Check
    """

    plan: ValidationPlan
    seed: int
    kind: tuple[str, ...]
    false_alarm_probability: FloatArray
    truth: FloatArray
    rank: FloatArray
    covered: FloatArray
    found: FloatArray
    expected: FloatArray
    statement: FloatArray
    second: FloatArray
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def of_kind(self, *kinds: str) -> IntArray:
        """Numbers of the trials of these kinds."""
        return np.flatnonzero(np.isin(self.kind, kinds))


def tally(plan: ValidationPlan, seed: int, answers: Sequence[Mapping[str, Any]]) -> Validation:
    """Put the answers of all trials together and check them.

    Parameters
    ----------
    plan : ValidationPlan
    seed : int
    answers : sequence of mapping
        Of `run_trial`, in the order of the plan's kinds.
    """
    kinds = tuple(plan.kinds)
    blank = {
        "truth": np.full(3, np.nan),
        "rank": np.full(3, np.nan),
        "covered": np.full((len(COVERED), len(LEVELS)), np.nan),
        "found": np.nan,
        "expected": np.nan,
        "statement": np.nan,
        "second": np.nan,
    }
    columns = {
        name: np.array([a.get(name, value) for a in answers], dtype=float)
        for name, value in blank.items()
    }
    alarm = np.array([float(a["false_alarm_probability"]) for a in answers])
    checks = (
        *_rank_checks(kinds, columns["rank"]),
        *_coverage_checks(columns["covered"]),
        *_alarm_checks(alarm[np.array(kinds) == "alone"], plan.null_draws),
        *_completeness_checks(columns["found"], columns["expected"]),
        *_verdict_checks(kinds, columns["statement"], plan.alpha),
        *_second_checks(columns["second"][np.array(kinds) == "bright"]),
    )
    return Validation(plan, seed, kinds, alarm, **columns, checks=checks)


def _rank_checks(kinds: Sequence[str], rank: FloatArray) -> Iterable[Check]:
    for kind in RANGES:
        mine = rank[np.array(kinds) == kind]
        for name, values in zip(RANKED, mine.T, strict=True):
            yield uniformity("ranks", f"{name}, {kind} companions", values)


def _coverage_checks(covered: FloatArray) -> Iterable[Check]:
    known = covered[np.isfinite(covered).all(axis=(1, 2))]
    for k, name in enumerate(COVERED):
        for m, level in enumerate(LEVELS):
            yield rate("coverage", f"{level:.0%} interval of {name}", known[:, k, m], level)


def _alarm_checks(probability: FloatArray, null_draws: int) -> Iterable[Check]:
    yield uniformity("false alarms", "probabilities of stars without a companion", probability)
    for alpha in FALSE_ALARMS:
        # (1 + #)/(1 + B) takes steps: it is below alpha with this probability.
        expected = np.ceil(alpha * (1.0 + null_draws) - 1.0) / (1.0 + null_draws)
        name = f"share below {alpha:g}"
        yield rate("false alarms", name, probability < alpha, float(expected))


def _completeness_checks(found: FloatArray, expected: FloatArray) -> Iterable[Check]:
    known = np.isfinite(expected)
    chance, hit = expected[known], found[known]
    yield unequal("completeness", "companions found within the range of the limits", hit, chance)
    near = (chance > 0.05) & (chance < 0.95)
    yield unequal("completeness", "the same, near the limit", hit[near], chance[near])


def _verdict_checks(kinds: Sequence[str], statement: FloatArray, alpha: float) -> Iterable[Check]:
    """The model is right in every trial: how often it is refused, or a star called a companion."""
    known = np.isfinite(statement)
    alone = (np.array(kinds) == "alone")[known]
    told = statement[known]
    refused = told >= STATEMENTS.index("model rejected")
    yield at_most("verdicts", "right models refused", refused, 2.0 * alpha)
    companions = told[alone] == STATEMENTS.index("companion")
    yield at_most("verdicts", "single stars called a companion", companions, alpha)


def _second_checks(probability: FloatArray) -> Iterable[Check]:
    """Beside a companion that was found there is no other."""
    for alpha in FALSE_ALARMS[:2]:
        name = f"second companions below {alpha:g}"
        yield at_most("second companion", name, probability < alpha, alpha)


def at_most(group: str, name: str, hits: BoolArray, largest: float) -> Check:
    """Check that a rate is not above a stated one (one-sided binomial)."""
    n, count = len(hits), int(np.sum(hits))
    if n < FEWEST:
        return Check(group, name, n, np.nan, largest, np.nan, 1.0)
    p_value = float(stats.binomtest(count, n, largest, alternative="greater").pvalue)
    error = float(np.sqrt(largest * (1.0 - largest) / n))
    return Check(group, name, n, count / n, largest, error, p_value)


def uniformity(group: str, name: str, values: FloatArray) -> Check:
    """Check that numbers are uniform between 0 and 1 (Kolmogorov–Smirnov)."""
    n = len(values)
    if n < FEWEST:
        return Check(group, name, n, np.nan, np.nan, np.nan, 1.0)
    test = stats.kstest(values, "uniform")
    mean, spread = KOLMOGOROV / np.sqrt(n)
    return Check(
        group,
        name,
        n,
        float(test.statistic),
        float(mean),
        float(spread),
        float(test.pvalue),
    )


def rate(group: str, name: str, hits: FloatArray | BoolArray, expected: float) -> Check:
    """Check a rate against a known one (two-sided binomial)."""
    n, count = len(hits), int(np.sum(hits))
    if n < FEWEST:
        return Check(group, name, n, np.nan, expected, np.nan, 1.0)
    p_value = float(stats.binomtest(count, n, expected).pvalue)
    error = float(np.sqrt(expected * (1.0 - expected) / n))
    return Check(group, name, n, count / n, expected, error, p_value)


def unequal(group: str, name: str, hits: FloatArray, chance: FloatArray) -> Check:
    """Check a number of hits against a probability of each (two-sided, exact)."""
    n = len(hits)
    if n < FEWEST:
        return Check(group, name, n, np.nan, np.nan, np.nan, 1.0)
    count, expected = int(hits.sum()), stats.poisson_binom(chance)
    below, above = float(expected.cdf(count)), float(expected.sf(count - 1))
    error = float(np.sqrt((chance * (1.0 - chance)).sum())) / n
    p_value = float(np.clip(2.0 * min(below, above), 0.0, 1.0))
    return Check(group, name, n, float(hits.mean()), float(chance.mean()), error, p_value)

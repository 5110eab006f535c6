"""What the comparison of models says in a sentence, and whether the verdict of the search agrees.

The verdict is on a star with at most one companion; the comparison may know better models.
"""

from __future__ import annotations

from dataclasses import dataclass

from amibayes.comparison.compare import ModelComparison
from amibayes.comparison.hypotheses import FAMILIES, Hypothesis
from amibayes.comparison.verdict import UNDECIDED
from amibayes.detection.verdict import REFUSED, Statement, Verdict
from amibayes.likelihood.chi2 import REJECTED
from amibayes.support.options import SKY_MODELS

OF_ONE = ("star", "companion")
"""Models that the verdict is about, and what it says where neither is right."""

SHORT = {"ring": "a ring", "crescent": "a crescent", "halo": "over-resolved light"}
"""Models whose words in `SKY_MODELS` say more than their name."""

PLURAL = ("two", FAMILIES["point"], FAMILIES["both"])

CLEAR = 10.0
"""Differences of ln Z from which on no digit after the point counts."""

POINTS = ("companion", FAMILIES["point"])
"""Statements of the comparison that a companion is no contradiction of."""


@dataclass(frozen=True)
class Agreement:
    """The comparison of models beside the verdict of the search.

    Parameters
    ----------
    summary : str
        What the comparison says, one sentence without its end.
    agrees : bool or None
        None where there is no verdict.
    leads : bool
        Whether the comparison is the answer, and not a star with at most one companion: where they
        contradict each other, and where it states light that the verdict has no word for.
    warning : str
        Empty where they agree.
    """

    summary: str
    agrees: bool | None
    leads: bool
    warning: str = ""


def agreement(found: ModelComparison, verdict: Verdict | None = None) -> Agreement:
    """Hold the verdict of a search against the comparison of models."""
    summary, stated = _summary(found), found.verdict.statement
    if verdict is None:
        return Agreement(summary, None, stated != UNDECIDED)
    if _agrees(found, verdict.statement):
        leads = verdict.statement == "no companion" and stated not in ("star", UNDECIDED)
        return Agreement(summary, True, leads)
    # Parts of the data that contradict each other come before any model.
    leads = verdict.statement != "inconsistent data"
    return Agreement(summary, False, leads, _warning(found, verdict.statement, summary))


def model_words(stated: str) -> str:
    """A model, or a kind of models, in words with its article."""
    parts = [p for p in stated.split("+") if p != "star"] or ["star"]
    if any(p not in SKY_MODELS for p in parts):
        return stated
    words = [SHORT.get(p, SKY_MODELS[p].partition(",")[0]) for p in parts]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _members(found: ModelComparison) -> list[str]:
    """Names of the models that are stated: one, or those of a kind."""
    stated, names = found.verdict.statement, [m.name for m in found.models]
    if stated in names:
        return [stated]
    return [n for n in names if FAMILIES[Hypothesis(n).family] == stated]


def _summary(found: ModelComparison) -> str:
    stated, because = found.verdict.statement, found.verdict.because
    if stated == UNDECIDED:
        return f"the comparison of models is undecided: {because}"
    log_z, mine = {m.name: m.log_z for m in found.models}, _members(found)
    rival = next((n for n in ("companion", "star") if n in log_z and n not in mine), None)
    if rival is None:
        return because
    gain = max(log_z[n] for n in mine) - log_z[rival]
    beside = f"{model_words(rival)}: ln Z {gain:+.{0 if gain >= CLEAR else 1}f}"
    if stated == "star":
        return f"the star alone is more probable than {beside}"
    verb = "explain" if "+" in stated or stated in PLURAL else "explains"
    return f"{model_words(stated)} {verb} the data better than {beside}"


def _agrees(found: ModelComparison, statement: Statement) -> bool:
    stated = found.verdict.statement
    if statement in REFUSED:
        return found.best.p_fit < REJECTED
    if statement == "companion":
        return stated in POINTS
    # Extended light is no companion, and what is undecided claims none.
    return stated == UNDECIDED or not Hypothesis(_members(found)[0]).companions


def _warning(found: ModelComparison, statement: Statement, summary: str) -> str:
    best = found.best
    if statement in REFUSED and best.name in OF_ONE:
        return (
            f"{best.name} is the most probable of the models of the sky that were compared, but "
            f"the verdict on it is: {statement}"
        )
    if statement in REFUSED:
        return (
            f"the verdict, {statement}, is on a star with at most one companion; of the models of "
            f"the sky that were compared {best.name} fits (chi2 {best.chi2:.4g} for {best.ndof} "
            f"degrees of freedom): {summary}"
        )
    wrong = "; fit and posterior are of one companion and nothing else"
    return f"the verdict is {statement}, but {summary}{wrong if statement == 'companion' else ''}"

"""What the comparison of models says: one of them, a kind of them, or nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from amibayes.comparison.hypotheses import FAMILIES, Hypothesis
from amibayes.support.options import MODEL_ODDS
from amibayes.units import FloatArray, IntArray

UNDECIDED = "undecided"

MAX_CONFUSION = 0.05
"""Share of the data sets of another model that may look as much like the chosen one as the data
do: beyond that the choice rests on luck."""


@dataclass(frozen=True, eq=False)
class Choice:
    """When a group of models is chosen, by probabilities alone.

    A model that holds the group and more (a companion beside the ring) is no rival of it while it
    is less probable: light too faint to be seen is as probable as none. What remains has to
    reach `MODEL_ODDS`. The star alone, which every model holds, is chosen where it is the most
    probable of them.

    Parameters
    ----------
    group : (k,) int array
        Models of the group.
    holders : (m,) int array
        Models that hold one of it, and are not of it.
    """

    group: IntArray
    holders: IntArray

    @classmethod
    def of(cls, models: Sequence[Hypothesis], group: IntArray) -> Choice:
        """Find the models that hold a group."""
        inside = [models[k] for k in group]
        found = [
            j
            for j, one in enumerate(models)
            if j not in group and any(part.within(one) for part in inside)
        ]
        return cls(group, np.array(found, dtype=np.intp))

    @property
    def rest(self) -> IntArray:
        """The group and those that hold it."""
        return np.concatenate([self.group, self.holders])

    def made(self, probability: FloatArray) -> Any:
        """Whether it is chosen, (…), given probabilities (…, n_models)."""
        mine = probability[..., self.group].sum(axis=-1)
        more = probability[..., self.holders]
        enough = mine + more.sum(axis=-1) >= MODEL_ODDS
        return enough & (mine >= more.max(axis=-1, initial=0.0))


@dataclass(frozen=True, eq=False)
class Confusion:
    """Evidences of simulated data.

    Parameters
    ----------
    models : tuple of Hypothesis
    log_z : (n_models, n_draws, n_models) float array
        Of every model (last axis) for data sets drawn from each (first axis).
    log_prior : (n_models,) float array
        Logarithm of the models' prior probabilities.
    """

    models: tuple[Hypothesis, ...]
    log_z: FloatArray
    log_prior: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        """Of the models."""
        return tuple(m.name for m in self.models)

    @property
    def n_draws(self) -> int:
        """Data sets of each model."""
        return int(self.log_z.shape[1])

    @property
    def probability(self) -> FloatArray:
        """Posterior probabilities, of the shape of ``log_z``."""
        log = self.log_z + self.log_prior
        return np.asarray(np.exp(log - logsumexp(log, axis=-1, keepdims=True)))

    def taken_for(self) -> tuple[tuple[str, ...], FloatArray]:
        """Share of the data sets of each model that are taken for each, or for a kind of models.

        Returns
        -------
        names : tuple of str
            Of the columns: models, kinds of several models, undecided.
        share : (n_models, n_columns) float array
        """
        groups = candidates(self.models)
        found = np.stack(
            [Choice.of(self.models, g).made(self.probability) for _, g in groups], axis=-1
        )
        # A kind is stated only where none of its models is.
        first = np.where(found.any(axis=-1), found.argmax(axis=-1), len(groups))
        share = (first[..., None] == np.arange(len(groups) + 1)).mean(axis=1)
        return (*(name for name, _ in groups), UNDECIDED), np.asarray(share)


def candidates(models: Sequence[Hypothesis]) -> list[tuple[str, IntArray]]:
    """What a verdict may state: every model, then every kind that several of them are of."""
    single = [(one.name, np.array([k])) for k, one in enumerate(models)]
    kinds = _kinds(models).items()
    return single + [(FAMILIES[k], g) for k, g in kinds if 1 < len(g) < len(models)]


@dataclass(frozen=True)
class ModelVerdict:
    """What the data choose.

    Parameters
    ----------
    statement : str
        A model, a kind of models, or ``undecided``.
    because : str
        The reason, one sentence.
    probability : float
        Posterior probability of what is stated, or of the most probable model where nothing is.
    p_confused : float
        Largest share, over the rivals, of simulated data sets that favour what is stated as
        strongly as the data do; (1 + count)/(1 + draws). NaN without rivals or draws.
    degenerate : bool
        What was found is smaller than λ/2B_max: size and flux cannot be told apart.
    """

    statement: str
    because: str
    probability: float
    p_confused: float
    degenerate: bool = False


def choose(
    models: Sequence[Hypothesis],
    log_z: FloatArray,
    log_prior: FloatArray,
    confusion: Confusion | None,
    *,
    degenerate: bool = False,
) -> ModelVerdict:
    """Choose by the odds and by what simulation says of them.

    Parameters
    ----------
    models : sequence of Hypothesis
    log_z, log_prior : (n_models,) float array
    confusion : Confusion, optional
    degenerate : bool
        Whether the most probable model's structure is smaller than λ/2B_max.
    """
    log = np.asarray(log_z) + np.asarray(log_prior)
    share = np.exp(log - logsumexp(log))
    best = int(np.argmax(share))
    refused = (
        f"the most probable model, {models[best].name}, has a probability of {share.max():.2f}"
    )
    for name, group in candidates(models):
        choice = Choice.of(models, group)
        if not choice.made(share):
            continue
        p, rival = _confused(choice, log, confusion)
        # With few draws p is never smaller: then one of them has to look as much like it.
        least = 1.0 / (1.0 + (confusion.n_draws if confusion else 0))
        if p > max(MAX_CONFUSION, least):
            refused = f"{p:.0%} of the data sets simulated with {rival} look as much like {name}"
            continue
        because = _because(name, choice, models, share, p, rival)
        return ModelVerdict(name, because, float(share[group].sum()), p, degenerate)
    p = _confused(Choice.of(models, np.array([best])), log, confusion)[0]
    return ModelVerdict(UNDECIDED, refused, float(share.max()), p, degenerate)


def _kinds(models: Sequence[Hypothesis]) -> dict[str, IntArray]:
    """Which models are of each family."""
    names = np.array([m.family for m in models])
    return {f: np.flatnonzero(names == f) for f in dict.fromkeys(names.tolist())}


def _confused(choice: Choice, log: FloatArray, confusion: Confusion | None) -> tuple[float, str]:
    """How often the worst rival's data favour a choice as strongly as the data do."""
    mine = choice.rest
    rivals = np.setdiff1d(np.arange(len(log)), mine)
    if confusion is None or not len(rivals) or not confusion.n_draws:
        return float("nan"), ""
    observed = logsumexp(log[mine]) - log[rivals]
    simulated = confusion.log_z + confusion.log_prior
    found = []
    for k, seen in zip(rivals, observed, strict=True):
        odds = logsumexp(simulated[k][:, mine], axis=1) - simulated[k][:, k]
        found.append((1.0 + float((odds >= seen).sum())) / (1.0 + confusion.n_draws))
    worst = int(np.argmax(found))
    return found[worst], confusion.names[rivals[worst]]


def _because(
    name: str,
    choice: Choice,
    models: Sequence[Hypothesis],
    share: FloatArray,
    p: float,
    rival: str,
) -> str:
    group = choice.group
    which = f" ({' or '.join(models[k].name for k in group)})" if len(group) > 1 else ""
    text = f"the probability of {name}{which} is {_percent(float(share[group].sum()))}"
    if len(choice.holders):
        more = _percent(float(share[choice.holders].sum()))
        text += f", and that of the same with more light {more}"
    if np.isfinite(p):
        text += f"; at most {p:.0%} of data sets simulated with {rival} look as much like it"
    return text


def _percent(probability: float) -> str:
    if probability < 0.001:
        return "below 0.1 %"
    return "above 99.9 %" if probability > 0.999 else f"{100.0 * probability:.3g} %"

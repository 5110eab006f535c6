"""The verdict of a search: companion, no companion, model rejected, or inconsistent data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from amibayes.companion_search.optimise import fit_single
from amibayes.companion_search.result import SearchResult
from amibayes.data.observables import Observables
from amibayes.data.systematics import calibration_errors
from amibayes.detection.alternatives import Alternative
from amibayes.detection.false_alarm import Significance
from amibayes.detection.note import SEE, note_of
from amibayes.detection.splits import Consistency, most_telling, motion_words
from amibayes.likelihood.channel_noise import share_of
from amibayes.likelihood.chi2 import chi2_of_part, chi2_survival
from amibayes.likelihood.extra_noise import MAX_ROUNDS, UNLIKELY, ExtraNoise, NoisePrior
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise_fit import noise_beside
from amibayes.likelihood.residuals import files_of
from amibayes.support.terminal import LEAST_TOLD
from amibayes.units import FloatArray

Statement = Literal["companion", "no companion", "model rejected", "inconsistent data"]

STATEMENTS: tuple[Statement, ...] = get_args(Statement)
"""All of them, in that order."""

REFUSED: tuple[Statement, ...] = ("model rejected", "inconsistent data")
"""Those that neither state a companion nor that there is none."""

NAMES = {"vis2": "V²", "cp": "closure phases"}

WITHIN = (
    "; what the fit leaves holds structure, smaller than the calibration errors known of the "
    "instrument"
)

SMALL = (
    "it changes the data by less than the calibration errors known of the instrument: one that "
    "lasted for a night may look like it (compare nights and calibrators)"
)


@dataclass(frozen=True)
class Verdict:
    """What the data say of a star with at most one companion.

    Parameters
    ----------
    statement : {"companion", "no companion", "model rejected", "inconsistent data"}
    because : str
        The reason, one sentence.
    p_model : float
        Probability of data that fit as badly, were the best model of the family and its noise
        the true one: the smaller one of χ² and of structure in the residuals, times two;
        structure within the errors of the calibration does not count.
    note : str
        Of a companion: what else may look like it, see `note_of`; also part of the reason.
    star : dict
        Without a companion: the star's parameters and errors, with the noise beside it.
    """

    statement: Statement
    because: str
    p_model: float
    note: str = ""
    star: dict[str, tuple[float, float]] = field(default_factory=dict)


def verdict(
    result: SearchResult,
    tested: Significance,
    structure: Significance,
    splits: Sequence[Consistency],
    *,
    structured: bool = True,
    noise: ExtraNoise | None = None,
    compared: bool = False,
    alone: tuple[Likelihood, FloatArray] | None = None,
) -> Verdict:
    """Give the verdict of a search whose null draws can tell a detection.

    Parameters
    ----------
    result : SearchResult
        With noise that is bounded by its prior.
    tested : Significance
        Of the companion.
    structure : Significance
        Of one more component, in what the best fit leaves.
    splits : sequence of Consistency
        Empty where no companion is detected.
    structured : bool
        Whether that structure is more than what the calibration of the instrument may leave: see
        `within_calibration`. Structure that is not does not speak against the model.
    noise : ExtraNoise, optional
        That was fitted: see `parts_of_fit`.
    compared : bool
        Whether models of the sky are compared too.
    alone : (Likelihood, (n_nuisance,) float array), optional
        As `star_alone` gives it: without a companion it has to fit.

    Notes
    -----
    Parts that each see a companion of their own come first: the model may be right for each of
    them. Then the model as a whole; then V² against closure phases, which an incomplete model
    sets against each other as well as a bad calibration does.
    """
    alpha = tested.alpha
    parts = parts_of_fit(result.likelihood, result.theta, result.ndof, noise)
    fit = joint_probability(parts)
    p_model = min(1.0, 2.0 * min(fit, structure.probability if structured else 1.0))
    apart = [s for s in splits if s.p * len(splits) < alpha]
    moves = result.likelihood.model.moves
    if split := most_telling(apart):
        return Verdict("inconsistent data", _apart(split, moves=moves), p_model)
    misfits = 2.0 * fit < _level(alpha, noise)
    small = 2.0 * structure.probability < alpha
    if misfits or (small and structured):
        worst = _worst(parts, result.likelihood.degrees) if misfits else None
        return Verdict("model rejected", _rejected(parts, worst, fit, structure), p_model)
    for split in apart:
        return Verdict("inconsistent data", _apart(split, moves=moves), p_model)
    left = WITHIN if small and not structured else ""
    if tested.detected:
        return _companion(result, tested, left, p_model, compared=compared)
    if alone is not None and (misfit := _misfit_alone(*alone, noise, alpha)):
        return Verdict("model rejected", f"{misfit}; and {_nothing(tested)}", p_model)
    return Verdict("no companion", _nothing(tested) + left, p_model)


def _companion(
    result: SearchResult, tested: Significance, left: str, p_model: float, *, compared: bool
) -> Verdict:
    """The verdict where a companion is detected, with what else may look like it."""
    note, data = note_of(result, compared=compared), result.likelihood.observables
    if not note and within_calibration(data, change_by_companion(result)):
        note = SMALL
    left += f"; but {note}" if note else ""
    found = result.companion
    if not found.separation_error_mas <= found.separation_mas:  # infinite, perhaps NaN
        left += "; its place is undetermined"
    return Verdict("companion", _found(tested) + left, p_model, note)


def star_alone(
    result: SearchResult, stated: Observables, prior: NoisePrior, *, per_file: bool
) -> tuple[Likelihood, FloatArray] | None:
    """The star alone that fits best, with the noise that is most likely beside it.

    The noise of a result is that of its best companion, which a star alone need not fit.

    Parameters
    ----------
    result : SearchResult
    stated : Observables
        The data that were searched, with the stated errors.
    prior : NoisePrior
    per_file : bool
        Every file has noise of its own.

    Returns
    -------
    (Likelihood, (n_nuisance,) float array) or None
        None of a robust search, where any misfit counts as outliers.
    """
    if result.robustness is not None:
        return None
    likelihood = Likelihood(stated, single_likelihood(result.likelihood).model)
    theta = fit_single(likelihood)[0]
    for _ in range(MAX_ROUNDS):
        _, noisy = noise_beside(likelihood, theta, per_file=per_file, prior=prior)
        before, theta = theta, fit_single(noisy)[0]
        if np.allclose(theta, before, rtol=1e-2, atol=0.0):
            break
    return noisy, theta


def at_the_edge(found: Verdict, result: SearchResult) -> Verdict:
    """The verdict where the fit of the companion ended at the outer edge of all that is searched.

    It fits best where the data know nothing of a companion, and whatever they hold is no
    companion inside.
    """
    rho = result.companion.separation_mas
    because = (
        f"the best companion is on the outer edge of the field, {rho:.4g} mas, and better outside: "
        "look for hot pixels and other faults, or give a field (--separation)"
    )
    return Verdict("model rejected", because, found.p_model)


def without_companion(
    found: Verdict, other: Alternative, result: SearchResult, *, compared: bool = False
) -> Verdict:
    """The verdict where a source without a companion fits as well as the one that was found.

    A star that changes with wavelength is one star, if by no more than is known of any; light
    around it is outside of the model.
    """
    against = f"fits as well (χ² {other.chi2:.4g}, with a companion {result.chi2_binary:.4g})"
    if other.kind != "chromatic star":
        because = f"{other.words} {against}: {SEE if compared else 'compare by --models'}"
    elif other.plausible:
        return Verdict("no companion", f"{other.words}, {against}", found.p_model)
    else:
        because = (
            f"{other.words}, {against}: no single star is known to, and these data do not tell"
        )
    return Verdict("model rejected", because, found.p_model)


SHAPE = 0.1
"""Relative error of a χ² by extra noise, which is fitted with one size for all data of a kind: real
noise differs between baselines and channels. It matters from some hundred data on."""

SHAPE_NODES, MOST_CORRELATED = 13, 0.99
"""Nodes of the means over what noise may be, and the largest correlation of channels."""


@dataclass(frozen=True)
class FitOfPart:
    """χ² of one kind of observable of one file, its degrees of freedom and probability."""

    kind: str
    source: str
    chi2: float
    dof: float
    p: float


def joint_probability(parts: Sequence[FitOfPart]) -> float:
    """Probability of a χ² as large as that of a fit: the smallest of parts, times their number.

    Noise is fitted to each kind of observable of each file where its χ² asks for it. That of all
    data together would refuse a model for misfits that noise within its prior explains, but that
    no part asks for.
    """
    return min(1.0, len(parts) * min(part.p for part in parts))


def parts_of_fit(
    likelihood: Likelihood, theta: FloatArray, ndof: int, noise: ExtraNoise | None = None
) -> list[FitOfPart]:
    """Kinds of observables of files, as a best fit leaves them, with the noise that was fitted.

    Where ``noise`` was fitted, probabilities are means over what it may be instead.
    """
    difference = likelihood.difference(np.atleast_2d(theta))[:, 0]
    covariance, share = likelihood.noise.covariance, ndof / likelihood.n_independent
    found = []
    for file in files_of(likelihood.observables):
        for kind in NAMES:
            at = np.flatnonzero(file.of_kind(kind))
            if not len(at):
                continue
            chi2, rank = chi2_of_part(covariance, at, difference)
            factors, weights = _sizes(noise, kind, file.source)
            each = chi2_survival(chi2 * factors, share * rank, likelihood.degrees)
            found.append(FitOfPart(kind, file.source, chi2, share * rank, float(weights @ each)))
    return found


def _sizes(noise: ExtraNoise | None, kind: str, source: str) -> tuple[FloatArray, FloatArray]:
    """Factors of χ² by noise of another shape than the one that was fitted, and their weights.

    Where channels are correlated by r, what neighbours differ by has a variance of 1 − r: if they
    are less correlated than it seems, to nothing at least, that makes χ² larger.
    """
    if noise is None:
        return np.ones(1), np.ones(1)
    nodes, weights = np.polynomial.hermite_e.hermegauss(SHAPE_NODES)
    weights /= weights.sum()
    share = share_of(noise.channels, source)
    found = share.vis2 if kind == "vis2" else share.closure_phase
    known = np.nan_to_num(found.error) * nodes if found.value > 0.0 else np.zeros(1)
    correlation = np.clip(found.value + known, 0.0, MOST_CORRELATED)
    factors = np.outer(np.exp(SHAPE * nodes), (1.0 - found.value) / (1.0 - correlation))
    each = weights if len(known) > 1 else np.ones(1)
    return factors.ravel(), np.outer(weights, each).ravel()


def _level(alpha: float, noise: ExtraNoise | None) -> float:
    """Probability of χ² below which a model is rejected.

    Noise is only fitted where χ² has a probability below `UNLIKELY`: a larger one, below a larger
    α, has not been found to be more than noise explains.
    """
    return alpha if noise is None else min(alpha, UNLIKELY)


def _misfit_alone(
    likelihood: Likelihood, theta: FloatArray, noise: ExtraNoise | None, alpha: float
) -> str:
    """Say how a star alone does not fit; empty where it does."""
    parts = parts_of_fit(likelihood, theta, likelihood.n_independent - len(theta), noise)
    if joint_probability(parts) >= _level(alpha, noise):
        return ""
    return f"a star alone does not fit: {_misfit(parts, _worst(parts, likelihood.degrees))}"


def within_calibration(observables: Observables, change: FloatArray) -> bool:
    """Whether a component changes the data by less than calibration errors known of them.

    Errors that hold for whole nights (diameters of calibrators, drifts) repeat from exposure to
    exposure as the light of a companion does: no null draw and no randomisation has them. Only
    their size is known, from the table of instruments. Changes are compared in units of these
    errors, as a root mean square over all data; data without an entry are never within.

    Parameters
    ----------
    observables : Observables
        Unflagged.
    change : (n_data,) float array
        By the component, of V² and closure phases in radians.
    """
    errors = calibration_errors(observables)
    return bool((errors > 0.0).all() and np.mean((change / errors) ** 2) < 1.0)


def change_by_companion(result: SearchResult) -> FloatArray:
    """Difference (n_data,) that the companion makes to what the star alone fits best."""
    likelihood, alone = result.likelihood, single_likelihood(result.likelihood)
    star = alone.predict(np.atleast_2d(result.single_theta))[:, 0]
    return likelihood.wrapped(likelihood.predict(np.atleast_2d(result.theta))[:, 0] - star)


def _apart(split: Consistency, *, moves: bool) -> str:
    if split.split == "calibrators":
        one, other = split.parts
        return (
            f"the companion depends on the calibrator: calibrated with {one} and with {other} the "
            f"target disagrees on it by Δχ² {split.delta_chi2:.3g}, which {_share(split.p)} of "
            "consistent calibrators exceed"
        )
    parts = " and ".join(NAMES.get(part, part) for part in split.parts[:3])
    more = f" and {len(split.parts) - 3} more" if len(split.parts) > 3 else ""
    motion = f"; {motion_words(moves=moves)} may explain it" if split.split == "epochs" else ""
    return (
        f"{parts}{more} disagree on the companion by Δχ² {split.delta_chi2:.3g}, which "
        f"{_share(split.p)} of consistent data exceed{motion}"
    )


def _rejected(
    parts: Sequence[FitOfPart], worst: FitOfPart | None, fit: float, structure: Significance
) -> str:
    """Why; ``worst`` is the part that fits worst, None where the fit itself rejects nothing."""
    if worst is not None and fit <= structure.probability:
        return _misfit(parts, worst, "the best companion and ")
    return (
        "what the best fit leaves still holds structure: one more component would gain more than "
        f"in all but {_share(structure.probability)} of data without it"
    )


def _worst(parts: Sequence[FitOfPart], degrees: float) -> FitOfPart:
    """The part that fits worst; by χ² as it is where probabilities are 0."""

    def chance(part: FitOfPart) -> tuple[float, float]:
        return float(chi2_survival(part.chi2, part.dof, degrees)), -part.chi2 / part.dof

    return min(parts, key=chance)


def _misfit(parts: Sequence[FitOfPart], worst: FitOfPart, beside: str = "") -> str:
    where = f" in {worst.source}" if len({part.source for part in parts}) > 1 else ""
    return (
        f"χ² of {NAMES[worst.kind]}{where} is {worst.chi2:.4g} for {worst.dof:.0f} degrees of "
        f"freedom with {beside}as much noise as its prior allows"
    )


def _found(tested: Significance) -> str:
    if tested.bright is not None:
        return (
            "it explains nearly all of what a star alone leaves, as noise alone does anywhere in "
            f"the field with a probability below {tested.bright:.2g}"
        )
    return (
        "noise alone gives something as good in the field with a probability below "
        f"{tested.interval[1]:.2g} (95 % confidence)"
    )


def _nothing(tested: Significance) -> str:
    unsure = tested.probability < tested.alpha
    more = f", which is not below {tested.alpha:.2g} with 95 % confidence: more null draws may tell"
    text = "noise alone gives something as good in the field with a probability of "
    return f"{text}{tested.probability:.2g}{more if unsure else ''}"


def _share(p: float) -> str:
    return f"{100.0 * p:.2g} %" if p >= LEAST_TOLD else f"less than {LEAST_TOLD:.0e}"

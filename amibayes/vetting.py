"""Vetting: may a calibrator be believed? Each against the rest, and each by itself.

A calibrator that disagrees with the others, has a companion of its own or is resolved puts
its own structure into the target. Calibrators are compared by calibrating each with the
others: what is left has to be a point source within errors that include the scatter between
calibrators. The worst one is dropped first and the rest are looked at again, so that one bad
calibrator does not take good ones along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from amibayes.calibration import Method, calibrate
from amibayes.errors import DataError
from amibayes.inference.bank import TemplateBank
from amibayes.inference.detection import chi2_survival
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.limits import DetectionLimit, detection_limit
from amibayes.inference.model import BinaryModel
from amibayes.inference.redraw import profiled
from amibayes.inference.refine import fit_single, single_likelihood
from amibayes.inference.results import SearchResult
from amibayes.inference.search import resolves_stars, search
from amibayes.inference.significance import (
    Significance,
    bank_statistic,
    significance,
)
from amibayes.observables import Observables

ALPHA = 0.003
"""Probability of each of the three tests below which a calibrator is dropped."""

NULL_DRAWS = 4000

CHARGE_FACTOR = 2.0
"""Charge levels further apart than this factor are pointed out."""


@dataclass(frozen=True, eq=False)
class Vetted:
    """What vetting says of one calibrator.

    Parameters
    ----------
    path : str
    kept : bool
    reason : str
        Why it was dropped; empty where it was kept.
    agreement : float or None
        Probability of a disagreement with the other calibrators as large as this one's;
        None where there is nothing to compare with.
    companion : SearchResult or None
        The best companion in what the other calibrators leave of it.
    significance : Significance or None
        Its false-alarm probability.
    diameter_mas, diameter_probability : float or None
        Best uniform disc, and the probability of as much gain from a point source; None
        where no disc that matters could be seen.
    charge_ratio : float or None
        Charge level over that of the target.
    limit : DetectionLimit or None
        Which companions its data rule out.
    """

    path: str
    kept: bool
    reason: str
    agreement: float | None = None
    companion: SearchResult | None = None
    significance: Significance | None = None
    diameter_mas: float | None = None
    diameter_probability: float | None = None
    charge_ratio: float | None = None
    limit: DetectionLimit | None = None


@dataclass(frozen=True, eq=False)
class Vetting:
    """Verdicts on a set of calibrators, in the order given."""

    calibrators: tuple[Vetted, ...]
    alpha: float

    @property
    def false_drop_rate(self) -> float:
        """Probability that a good calibrator is dropped: three tests at alpha."""
        return float(1.0 - (1.0 - self.alpha) ** 3)


def vet(
    calibrators: Sequence[Observables],
    *,
    calibrated: bool = False,
    separation_mas: tuple[float, float] | None = None,
    alpha: float = ALPHA,
    null_draws: int = NULL_DRAWS,
    limits: bool = True,
    charge_levels: Sequence[float] | None = None,
    seed: int = 1,
) -> Vetting:
    """Judge every calibrator, against the others and by itself.

    Parameters
    ----------
    calibrators : sequence of Observables
    calibrated : bool
        The data are calibrated already (a vetting programme): each is judged by itself.
    separation_mas : (inner, outer), optional
        Field of the companion search.
    alpha : float
        Probability of each test below which a calibrator is dropped.
    null_draws : int
        Null data sets of each companion search.
    limits : bool
        Measure the detection limit of each calibrator as well.
    charge_levels : sequence of float, optional
        Of the target, then of each calibrator.
    seed : int

    Raises
    ------
    DataError
        Where there is nothing to judge.
    """
    if not calibrators:
        raise DataError("no calibrator given", remedy="give at least one")
    data = [c.unflagged() for c in calibrators]
    compare = not calibrated and len(data) > 1
    leave_out = _LeaveOut(data)
    agreement, dropped = _compared(leave_out, alpha) if compare else ([None] * len(data), set())
    streams = np.random.SeedSequence(seed).spawn(len(data))
    verdicts = []
    for k, stream in enumerate(streams):
        others = [j for j in range(len(data)) if j != k and j not in dropped]
        left = leave_out.rest(k, others) if compare and others else data[k]
        # Alone and uncalibrated, the instrument's own closure phases would pass for a companion.
        judged = left if calibrated or (compare and others) else None
        verdict = Vetted(
            data[k].source, True, "", agreement[k], charge_ratio=_ratio(charge_levels, k)
        )
        if judged is not None:
            rng = np.random.default_rng(stream)
            verdict = _by_itself(verdict, judged, separation_mas, alpha, null_draws, limits, rng)
        verdicts.append(_decided(verdict, k in dropped, alpha))
    return Vetting(tuple(verdicts), alpha)


def _ratio(charge_levels: Sequence[float] | None, k: int) -> float | None:
    return None if charge_levels is None else float(charge_levels[1 + k] / charge_levels[0])


def _against(one: Observables, others: Sequence[Observables]) -> Observables:
    """What the other calibrators leave of one: V² = 1 and closure phase 0, if all are points."""
    # The scatter between calibrators is pooled over all baselines: two others can tell it.
    method: Method = "hierarchical" if len(others) > 1 else "weighted"
    return calibrate(one, others, method=method, clip=None).observables.unflagged()


class _LeaveOut:
    """Each calibrator calibrated with some of the others: made once, however often asked for."""

    def __init__(self, data: Sequence[Observables]) -> None:
        self.data = data
        self._made: dict[tuple[int, ...], Observables] = {}

    def rest(self, one: int, others: Sequence[int]) -> Observables:
        """What the others leave of one."""
        key = (one, *others)
        if key not in self._made:
            self._made[key] = _against(self.data[one], [self.data[j] for j in others])
        return self._made[key]

    def agreement(self, one: int, others: Sequence[int]) -> float:
        """Probability of `_chance` of one with the others."""
        return _chance(self.rest(one, others), len(others))


def _compared(leave_out: _LeaveOut, alpha: float) -> tuple[list[float | None], set[int]]:
    """Leave-one-out probabilities, the worst calibrator dropped before the rest are redone."""
    data = leave_out.data
    probability: list[float | None] = [None] * len(data)
    dropped: set[int] = set()
    while len(data) - len(dropped) > 2:
        rest = [k for k in range(len(data)) if k not in dropped]
        for k in rest:
            probability[k] = leave_out.agreement(k, [j for j in rest if j != k])
        worst = min(rest, key=lambda k: probability[k] or 0.0)
        if (probability[worst] or 0.0) >= alpha:
            return probability, dropped
        dropped.add(worst)
    first, second = (k for k in range(len(data)) if k not in dropped)
    probability[first] = probability[second] = leave_out.agreement(first, [second])
    return probability, dropped


def _chance(left: Observables, n_others: int) -> float:
    """Probability of a χ² of the leave-one-out prediction as large as this.

    The scatter that the prediction allows for is known from n(J − 1) numbers of J others:
    the ratio follows F, not χ² (conservative where the stated errors dominate).
    """
    expected = np.concatenate([np.ones(left.n_vis2), np.zeros(left.n_closure_phases)])
    white = left.covariance.whiten(left.data - expected)
    chi2, n = float((white**2).sum()), left.n_independent
    if n_others == 1:
        return chi2_survival(chi2, n, left.degrees_of_freedom)
    known = min(left.degrees_of_freedom, n * (n_others - 1))
    return float(stats.f.sf(chi2 / n, n, known))


def _by_itself(
    verdict: Vetted,
    data: Observables,
    separation_mas: tuple[float, float] | None,
    alpha: float,
    null_draws: int,
    limits: bool,
    rng: np.random.Generator,
) -> Vetted:
    """Search one calibrator for a companion, a disc, and what it rules out."""
    free = resolves_stars(Likelihood(data))
    likelihood = Likelihood(data, BinaryModel(diameter_mas="free" if free else 0.0))
    found = search(likelihood, separation_mas)
    bank = TemplateBank(likelihood, found.grid, found.single_theta)
    # Neither test takes the size of the stated errors on trust.
    residuals = single_likelihood(likelihood).residuals(found.single_theta)
    statistic = float(bank_statistic(bank, residuals, free_scale=True)[0])
    weight = significance(bank, statistic, null_draws, rng, alpha, free_scale=True)
    limit = detection_limit(found, weight, rng) if limits else None
    verdict = replace(verdict, companion=found, significance=weight, limit=limit)
    if not data.n_vis2:
        return verdict
    disc = Likelihood(data, BinaryModel(diameter_mas="free"))
    best, _ = fit_single(disc)
    chi2 = float(single_likelihood(disc).chi2(best)[0])
    point = float(disc.chi2([[0.0, 0.0, 0.0, 0.0]])[0])
    # A diameter cannot be negative: half of the χ² distribution of one degree of freedom.
    gain = profiled(np.array([max(point - chi2, 0.0)]), np.array([point]), data.n_independent)
    probability = 0.5 * float(stats.chi2.sf(gain[0], 1))
    return replace(verdict, diameter_mas=float(best[0]), diameter_probability=probability)


def _decided(verdict: Vetted, disagrees: bool, alpha: float) -> Vetted:
    reasons = []
    if disagrees:
        reasons.append(f"disagrees with the other calibrators (p = {verdict.agreement:.2g})")
    weight, found = verdict.significance, verdict.companion
    if weight is not None and found is not None and weight.probability < alpha:
        c = found.companion
        reasons.append(
            f"companion of {c.delta_mag:.1f} mag at {c.separation_mas:.1f} mas, "
            f"PA {c.position_angle_deg:.0f} deg (false-alarm probability {weight.probability:.2g})"
        )
    elif verdict.diameter_probability is not None and verdict.diameter_probability < alpha:
        reasons.append(
            f"resolved: {verdict.diameter_mas:.2f} mas (p = {verdict.diameter_probability:.2g})"
        )
    return replace(verdict, kept=not reasons, reason="; ".join(reasons))


def doubts(vetted: Vetted, alpha: float) -> list[str]:
    """Say what does not drop a calibrator and should be known."""
    said = []
    if vetted.kept and vetted.agreement is not None and vetted.agreement < alpha:
        said.append("disagrees with the only other calibrator left: either may be wrong")
    ratio = vetted.charge_ratio
    if ratio is not None and not 1.0 / CHARGE_FACTOR <= ratio <= CHARGE_FACTOR:
        said.append(f"its charge level is {ratio:.2g} times the target's")
    return said

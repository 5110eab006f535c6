"""Vetting: which calibrators to keep or drop. Each against the rest, and each by itself.

A calibrator that disagrees with the others, has a companion of its own or is resolved puts
its own structure into the target. Calibrators are compared by calibrating each with the
others: what is left has to be a point source within errors that include the scatter between
calibrators. The worst one is dropped first and the rest are compared again, so that one bad
calibrator does not take good ones along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import stats
from scipy.sparse.csgraph import connected_components

from amibayes.calibration import calibrate
from amibayes.calibration.matching import keys_of, match, sharing
from amibayes.companion_search.field import resolves_stars
from amibayes.companion_search.optimise import fit_single
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import search
from amibayes.data.observables import Observables
from amibayes.data.systematics import systematics_of
from amibayes.detection.false_alarm import Significance, beside_bright, significance
from amibayes.detection.ratio import Ratio
from amibayes.detection.statistic import statistic_of
from amibayes.detection.verdict import change_by_companion, within_calibration
from amibayes.errors import DataError
from amibayes.likelihood.channel_noise import noise_with_channels
from amibayes.likelihood.channel_rows import channel_layout
from amibayes.likelihood.chi2 import chi2_survival
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise import NoiseModel
from amibayes.limits.completeness import detection_limit
from amibayes.limits.limit import DetectionLimit
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions, past_first_null
from amibayes.support.options import SEED, VETTING_ALPHA, VETTING_NULL_DRAWS, CalibrationMethod
from amibayes.support.terminal import equals
from amibayes.units import BoolArray

CHARGE_FACTOR = 2.0
"""Charge levels further apart than this factor are pointed out."""


@dataclass(frozen=True, eq=False)
class Vetted:
    """The result of vetting for one calibrator.

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
    small_companion, small_disc : bool
        They change the data by less than the calibration errors known of the instrument: no
        reason to drop it.
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
    small_companion: bool = False
    small_disc: bool = False

    def shows_companion(self, alpha: float) -> bool:
        """Whether there is a companion, large enough for a reason or not."""
        return self.significance is not None and self.significance.probability < alpha

    def shows_disc(self, alpha: float) -> bool:
        """Likewise a disc."""
        return self.diameter_probability is not None and self.diameter_probability < alpha


@dataclass(frozen=True, eq=False)
class Vetting:
    """The results of vetting a set of calibrators, in the order given."""

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
    alpha: float = VETTING_ALPHA,
    null_draws: int = VETTING_NULL_DRAWS,
    limits: bool = True,
    charge_levels: Sequence[float] | None = None,
    fewest: int = 2,
    seed: int = SEED,
) -> Vetting:
    """Test every calibrator, against the others that share baselines with it and by itself.

    Parameters
    ----------
    calibrators : sequence of Observables
    calibrated : bool
        The data are calibrated already (a vetting programme): each is tested by itself.
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
    fewest : int
        Calibrators that must share baselines to be tested against each other; fewer are kept.
    seed : int

    Raises
    ------
    DataError
        Where there is nothing to test.
    """
    if not calibrators:
        raise DataError("no calibrator given", remedy="give at least one")
    data = [c.unflagged() for c in calibrators]
    leave_out = _LeaveOut(data)
    agreement: list[float | None] = [None] * len(data)
    # Alone and uncalibrated, the instrument's own closure phases would pass for a companion.
    alone: list[Observables | None] = list(data if calibrated else [None] * len(data))
    dropped: set[int] = set()
    for family in [] if calibrated else leave_out.families(max(fewest, 2)):
        dropped |= _compare(leave_out, family, agreement, alpha)
        for k in family:
            alone[k] = leave_out.rest(k, [j for j in family if j not in dropped])
    streams = np.random.SeedSequence(seed).spawn(len(data))
    calibrators_tested = []
    for k, stream in enumerate(streams):
        ratio = _ratio(charge_levels, k)
        vetted = Vetted(data[k].source, True, "", agreement[k], charge_ratio=ratio)
        if (left := alone[k]) is not None:
            rng = np.random.default_rng(stream)
            vetted = _by_itself(vetted, left, separation_mas, alpha, null_draws, limits, rng)
        calibrators_tested.append(_decided(vetted, k in dropped, alpha))
    return Vetting(tuple(calibrators_tested), alpha)


def agreement_of_two(first: Observables, second: Observables) -> float | None:
    """Probability that two calibrators, as points, disagree as much; None where nothing is shared.

    Which of them is the bad one they cannot tell.
    """
    return _LeaveOut([first.unflagged(), second.unflagged()]).agreement(0, [0, 1])


def _ratio(charge_levels: Sequence[float] | None, k: int) -> float | None:
    return None if charge_levels is None else float(charge_levels[1 + k] / charge_levels[0])


def _against(one: Observables, others: Sequence[Observables]) -> Observables:
    """What the other calibrators leave of one: V² = 1 and closure phase 0, if all are points."""
    # The scatter between calibrators is pooled over all baselines: two others are enough for it.
    keys = keys_of(one)
    seen = [np.bincount(match(other, keys).key, minlength=len(keys)) > 0 for other in others]
    method: CalibrationMethod = "hierarchical" if np.sum(seen, axis=0).max() > 1 else "weighted"
    return calibrate(one, others, method=method, clip=None).observables.unflagged()


class _LeaveOut:
    """Each calibrator calibrated with some of the others: made once, however often asked for."""

    def __init__(self, data: Sequence[Observables]) -> None:
        self.data = data
        self._made: dict[tuple[int, ...], Observables] = {}

    @cached_property
    def _sharing(self) -> BoolArray:
        return sharing(self.data)

    def families(self, fewest: int) -> list[list[int]]:
        """Calibrators that share baselines, with each other or by way of a third."""
        n, label = connected_components(self._sharing, directed=False)
        families = [np.flatnonzero(label == i).tolist() for i in range(n)]
        return [family for family in families if len(family) >= fewest]

    def rest(self, one: int, family: Sequence[int]) -> Observables | None:
        """What the others leave of one; None where none of them shares a baseline with it."""
        key = (one, *(j for j in family if j != one and self._sharing[one, j]))
        if len(key) == 1:
            return None
        if key not in self._made:
            self._made[key] = _against(self.data[one], [self.data[j] for j in key[1:]])
        return self._made[key]

    def agreement(self, one: int, family: Sequence[int]) -> float | None:
        """Probability of `_chance` of one with the others."""
        left = self.rest(one, family)
        others = sum(self._sharing[one, j] for j in family if j != one)
        return None if left is None else _chance(left, int(others))


def _compare(
    leave_out: _LeaveOut, family: list[int], agreement: list[float | None], alpha: float
) -> set[int]:
    """Fill leave-one-out probabilities in, the worst one dropped before the rest are redone."""
    dropped: set[int] = set()
    while len(family) - len(dropped) > 2:
        rest = [k for k in family if k not in dropped]
        for k in rest:
            agreement[k] = leave_out.agreement(k, rest)
        chance = {k: p for k in rest if (p := agreement[k]) is not None}
        worst = min(chance, key=chance.__getitem__, default=None)
        if worst is None or chance[worst] >= alpha:
            return dropped
        dropped.add(worst)
    first, second = (k for k in family if k not in dropped)
    agreement[first] = agreement[second] = leave_out.agreement(first, [second])
    return dropped


def _chance(left: Observables, n_others: int) -> float:
    """Probability of a χ² of the leave-one-out prediction as large as this.

    The scatter that the prediction allows for is known from n(J − 1) numbers of J others:
    the ratio follows F, not χ² (conservative where the stated errors dominate).
    """
    expected = np.concatenate([np.ones(left.n_vis2), np.zeros(left.n_closure_phases)])
    white = _noise(left).whiten(left.data - expected)
    chi2, n = float((white**2).sum()), left.n_independent
    if n_others == 1:
        return float(chi2_survival(chi2, n, left.degrees_of_freedom))
    known = min(left.degrees_of_freedom, n * (n_others - 1))
    return float(stats.f.sf(chi2 / n, n, known))


def _noise(data: Observables) -> NoiseModel:
    """Noise of what is left of a calibrator, with calibration errors as its instrument has them.

    Calibrators of one night differ by the drift of the instrument, which few of them cannot tell
    from stars that are no points.
    """
    return noise_with_channels(data, (), systematics_of(data))


def _by_itself(
    vetted: Vetted,
    data: Observables,
    separation_mas: tuple[float, float] | None,
    alpha: float,
    null_draws: int,
    limits: bool,
    rng: np.random.Generator,
) -> Vetted:
    """Search one calibrator for a companion, a disc, and what it rules out."""
    noise = _noise(data)
    found = _searched(data, noise, separation_mas)
    # Neither test takes the size of the stated errors for known.
    found_by_noise = significance(statistic_of(found), null_draws, rng, alpha)
    enough = limits and found_by_noise.detected is not None
    limit = detection_limit(found, found_by_noise, rng) if enough else None
    found_by_noise = beside_bright(found_by_noise, found, ExtraNoise())
    vetted = replace(
        vetted, companion=found, significance=found_by_noise, limit=limit,
        small_companion=within_calibration(data, change_by_companion(found)),
    )  # fmt: skip
    if not data.n_vis2:
        return vetted
    disc = Likelihood(data, BinaryModel(diameter_mas="free"), noise=noise)
    best, _ = fit_single(disc)
    chi2 = float(single_likelihood(disc).chi2(best)[0])
    point = float(disc.chi2([[0.0, 0.0, 0.0, 0.0]])[0])
    # A diameter cannot be negative: half of the χ² distribution of one degree of freedom.
    gain = Ratio.scale_free(data.n_independent)(np.array([max(point - chi2, 0.0)]), point)
    probability = 0.5 * float(stats.chi2.sf(gain[0], 1))
    star, single = single_likelihood(disc), np.array([best, np.zeros_like(best)])
    change = star.predict(single)
    return replace(
        vetted, diameter_mas=float(best[0]), diameter_probability=probability,
        small_disc=within_calibration(data, change[:, 0] - change[:, 1]),
    )  # fmt: skip


def _searched(
    data: Observables, noise: NoiseModel, separation_mas: tuple[float, float] | None
) -> SearchResult:
    """Search for a companion; of an interferometer's data as `search_companion` does.

    With a disc, its limb darkening, and the errors that channels share: resolved single stars had
    companions in their place.
    """
    likelihood = Likelihood(data, noise=noise)
    resolved = resolves_stars(likelihood) or past_first_null(likelihood)
    if resolved or channel_layout(data.unflagged()).any:
        return search_field(data, SearchOptions(separation_mas=separation_mas)).result
    return search(likelihood, separation_mas)


def _decided(vetted: Vetted, disagrees: bool, alpha: float) -> Vetted:
    reasons = []
    if disagrees:
        reasons.append(
            f"disagrees with the other calibrators (p {equals(vetted.agreement or 0.0)})"
        )
    tested, found = vetted.significance, vetted.companion
    seen = vetted.shows_companion(alpha) and not vetted.small_companion
    if seen and tested is not None and found is not None:
        c = found.companion
        reasons.append(
            f"companion of {c.delta_mag:.1f} mag at {c.separation_mas:.1f} mas, "
            f"PA {c.position_angle_deg:.0f} deg (false-alarm probability {tested.probability:.2g})"
        )
    elif vetted.shows_disc(alpha) and not vetted.small_disc:
        p = equals(vetted.diameter_probability or 0.0)
        reasons.append(f"resolved: {vetted.diameter_mas:.2f} mas (p {p})")
    return replace(vetted, kept=not reasons, reason="; ".join(reasons))


def notes(vetted: Vetted, vetting: Vetting) -> list[str]:
    """List what does not drop a calibrator and should be known."""
    found, alpha = [], vetting.alpha
    if vetted.kept and vetted.agreement is not None and vetted.agreement < alpha:
        rivals = any(v.kept for v in vetting.calibrators if v.path != vetted.path)
        left = "only other calibrator left: either may be wrong"
        found.append(f"disagrees with the {left if rivals else 'calibrator that is dropped'}")
    small = {
        "a companion": vetted.shows_companion(alpha) and vetted.small_companion,
        "a disc": vetted.shows_disc(alpha) and vetted.small_disc,
    }
    found += [
        f"{name} may be in its data, smaller than the calibration errors known of the instrument"
        for name, there in small.items()
        if there
    ]
    ratio = vetted.charge_ratio
    if ratio is not None and not 1.0 / CHARGE_FACTOR <= ratio <= CHARGE_FACTOR:
        found.append(f"its charge level is {ratio:.2g} times the target's")
    return found

"""Injection and recovery of companions by the criterion of the search itself.

A companion is put into the fitted model without one, noise is drawn anew from the data's
covariance (itself estimated anew where it was estimated), and the search's statistic is
formed: it is detected where the false-alarm probability is below α, and located where the
search would report it at its place too. In whitened data a trial costs no more than a null
search, a column of a matrix product.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from amibayes.companion_search.draws import Searched, likelihood_ratio, search_many
from amibayes.companion_search.search import resolution_mas
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.false_alarm import bounded, search_drawn
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.student import SymmetricWhitening
from amibayes.limits.rings import Rings
from amibayes.parallel import (
    Executor,
    Journal,
    Journals,
    Progress,
    SerialExecutor,
    run_job,
    slices,
    spawn,
)
from amibayes.units import BoolArray, FloatArray, IntArray

ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Trials:
    """Injections so far: ring, level and angle of each, (n,), and what became of it."""

    ring: IntArray
    level: IntArray
    angle: IntArray
    detected: BoolArray
    located: BoolArray

    def counts(self, which: BoolArray, shape: tuple[int, int]) -> IntArray:
        """Number of the chosen trials in every cell."""
        out: IntArray = np.zeros(shape, dtype=np.intp)
        np.add.at(out, (self.ring[which], self.level[which]), 1)
        return out


@dataclass(frozen=True, eq=False)
class InjectionSetup:
    """What stays the same over all rounds."""

    likelihood: Likelihood
    single: FloatArray
    frame: SymmetricWhitening | None
    bank: TemplateBank
    rings: Rings
    nearer: FloatArray
    level: FloatArray
    by_detection: BoolArray
    threshold: float
    free_scale: bool
    executor: Executor | None
    journals: Journals | None


def spawned(rng: np.random.Generator) -> np.random.Generator:
    """Make a generator of its own, so that what others draw does not move its numbers."""
    return np.random.default_rng(spawn(rng, 1)[0])


def inject(
    setting: InjectionSetup,
    trials_per_cell: int,
    rng: np.random.Generator,
    progress: Progress | None,
) -> Trials:
    """Inject in synchronous rounds: what the next one does depends on whole rounds only."""
    shape = setting.level.shape
    size = max(1, round(trials_per_cell * setting.level.size / ROUNDS))
    trials: IntArray = np.zeros(shape, dtype=np.intp)
    recovered: IntArray = np.zeros(shape, dtype=np.intp)
    done: list[Trials] = []
    for k in range(ROUNDS):
        extra = allocate(trials, recovered, size)
        fresh = _one_round(setting, extra, spawned(rng), k, _shifted(progress, k, size))
        done.append(fresh)
        trials += extra
        by = np.where(setting.by_detection[fresh.ring], fresh.detected, fresh.located)
        recovered += fresh.counts(by, shape)
    return Trials(*(np.concatenate([getattr(t, f) for t in done]) for f in _FIELDS))


_FIELDS = ("ring", "level", "angle", "detected", "located")


def _shifted(progress: Progress | None, k: int, size: int) -> Progress | None:
    """Tell trials of all rounds where a round tells its pieces."""
    if progress is None:
        return None
    return lambda done, _: progress(k * size + min(done * TRIALS_AT_ONCE, size), ROUNDS * size)


def allocate(trials: IntArray, recovered: IntArray, size: int) -> IntArray:
    """Share a round's trials out so that all in all they go as √(p(1 − p)) (Neyman 1934).

    That makes the summed variance of the map smallest for a given number of trials. The
    shares p are those of Jeffreys' prior, so that no cell is ever left out for good.

    Parameters
    ----------
    trials, recovered : (n, n_levels) int array
        So far.
    size : int
        Trials of the round.

    Returns
    -------
    (n, n_levels) int array
        Its sum is ``size``.
    """
    p = (recovered + 0.5) / (trials + 1.0)
    weight = np.sqrt(p * (1.0 - p))
    wanted = np.maximum(weight / weight.sum() * (trials.sum() + size) - trials, 0.0).ravel()
    wanted *= size / wanted.sum()
    out = np.floor(wanted).astype(np.intp)
    most_cut = np.argsort(out - wanted, kind="stable")[: size - out.sum()]
    out[most_cut] += 1
    return np.asarray(out.reshape(trials.shape))


def _one_round(
    setting: InjectionSetup,
    extra: IntArray,
    rng: np.random.Generator,
    k: int,
    progress: Progress | None,
) -> Trials:
    ring, level = (np.repeat(i.ravel(), extra.ravel()) for i in np.indices(extra.shape))
    angle = rng.integers(setting.nearer.shape[1], size=len(ring))
    theta = np.column_stack(
        [
            setting.rings.east_mas[ring, angle],
            setting.rings.north_mas[ring, angle],
            setting.level[ring, level],
        ]
    )
    found = recover(
        setting.likelihood,
        setting.bank,
        setting.single,
        theta,
        setting.threshold,
        rng,
        free_scale=setting.free_scale,
        frame=setting.frame,
        nearer=setting.nearer[ring, angle],
        executor=setting.executor,
        progress=progress,
        journal=setting.journals.of(f"round-{k}") if setting.journals else None,
    )
    return Trials(ring, level, angle, found.detected, found.located)


TRIALS_AT_ONCE = 2048


ALIAS = 0.875
"""Correlation of two templates on the lattice above which one position stands for the other."""


ALIKE = 0.75
"""Squared correlation that `innermost_first` calls alike, however bright the companion."""


SUBSTEPS = np.linspace(-0.5, 0.5, 5)
"""Where, in steps of the lattice, an alias is looked for around its best lattice point."""


@dataclass(frozen=True, eq=False)
class Recovery:
    """What became of injected companions.

    Parameters
    ----------
    detected : (n,) bool array
        The statistic exceeds the threshold, wherever its maximum is.
    located : (n,) bool array
        Detected, and the position that the search would report is the right one (within
        λ/2B_max; without closure phases, or its opposite).
    """

    detected: BoolArray
    located: BoolArray


def recover(
    likelihood: Likelihood,
    bank: TemplateBank,
    single: FloatArray,
    theta: FloatArray,
    threshold: float,
    rng: np.random.Generator,
    *,
    free_scale: bool = False,
    frame: SymmetricWhitening | None = None,
    nearer: FloatArray | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> Recovery:
    """Inject companions and say which of them the search recovers.

    Parameters
    ----------
    likelihood : Likelihood
    bank : TemplateBank
    single : (n_nuisance,) float array
        The fit without a companion.
    theta : (n, 3) float array
        east_mas, north_mas, contrast (the same in every band, at rest) of each trial. Trials
        at one place are cheapest side by side.
    threshold : float
        Statistic that counts as a detection.
    rng : numpy.random.Generator
    free_scale : bool
        The statistic is `profiled`, else 2Δln L with the errors as they are.
    frame : SymmetricWhitening, optional
        The statistic is the robust one; see `amibayes.detection.false_alarm.bank_statistic`.
    nearer : (n,) float array, optional
        From `nearer_alias` for the places of the trials, if it is known already.
    executor : Executor, optional
        Where it is computed; the result does not depend on it.
    progress : callable, optional
        Told (pieces done, pieces in all); a piece is `TRIALS_AT_ONCE` trials.
    journal : Journal, optional
        Keeps finished pieces.

    Returns
    -------
    Recovery
    """
    parts = slices(len(theta), TRIALS_AT_ONCE)
    pieces = [
        (theta[p], None if nearer is None else nearer[p], seed)
        for p, seed in zip(parts, spawn(rng, len(parts)), strict=True)
    ]
    work = partial(_recover_piece, likelihood, bank, single, threshold, free_scale, frame)
    executor = executor or SerialExecutor()
    done = list(run_job(work, pieces, executor, journal=journal, progress=progress))
    return Recovery(
        np.concatenate([d["detected"] for d in done]), np.concatenate([d["located"] for d in done])
    )


def _recover_piece(
    likelihood: Likelihood,
    bank: TemplateBank,
    single: FloatArray,
    threshold: float,
    free_scale: bool,
    frame: SymmetricWhitening | None,
    piece: tuple[FloatArray, FloatArray | None, np.random.SeedSequence],
) -> dict[str, BoolArray]:
    theta, nearer, seed = piece
    signal = injected_signal(likelihood, single, theta)
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(signal.shape)
    hit = search_drawn(bank, noise, rng, frame, signal, own_scales=free_scale)
    fringe, places = resolution_mas(likelihood), theta[:, :2]
    found = _judged(bank, fringe, places, hit, threshold, free_scale=free_scale, nearer=nearer)
    return {name: found[name] for name in ("detected", "located")}


def judge(
    bank: TemplateBank,
    fringe_mas: float,
    places: FloatArray,
    white: FloatArray,
    threshold: float,
    *,
    free_scale: bool = False,
    frame: SymmetricWhitening | None = None,
    nearer: FloatArray | None = None,
) -> dict[str, Any]:
    """Search data sets that hold a companion each.

    Parameters
    ----------
    bank : TemplateBank
    fringe_mas : float
        λ/B_max.
    places : (n, 2) float array
        east_mas, north_mas of the companions.
    white : (n_data, n) float array
        Whitened residuals of the fit without a companion.
    threshold : float
        Statistic that counts as a detection.
    free_scale : bool
        The statistic is `profiled`, else 2Δln L with the errors as they are.
    frame : SymmetricWhitening, optional
        The statistic is the robust one; see `amibayes.detection.false_alarm.bank_statistic`.
    nearer : (n,) float array, optional
        From `nearer_alias` for the places, if it is known already.

    Returns
    -------
    dict of (n,) arrays
        ``detected`` and ``located`` as in `Recovery`, and the ``statistic``.
    """
    own = free_scale and frame is None
    hit = search_many(bank, bounded(bank, white, frame), own_scales=own)
    return _judged(bank, fringe_mas, places, hit, threshold, free_scale=free_scale, nearer=nearer)


def _judged(
    bank: TemplateBank,
    fringe_mas: float,
    places: FloatArray,
    hit: Searched,
    threshold: float,
    *,
    free_scale: bool,
    nearer: FloatArray | None,
) -> dict[str, Any]:
    """What the search makes of what was found, as `judge` has it."""
    statistic = likelihood_ratio(bank, hit.gain, hit.chi2, free_scale=free_scale)
    position, detected = hit.position, statistic > threshold
    found = np.column_stack([bank.grid.east_mas[position], bank.grid.north_mas[position]])
    right = at_its_place(found, places, fringe_mas)
    doubtful = np.flatnonzero(detected & ~right)
    right[doubtful] = _correlation(bank, found[doubtful], places[doubtful]) > ALIAS
    # Aliases are the dearest part: only those are asked for that decide something.
    sure = np.flatnonzero(detected & right)
    if nearer is None:
        distinct, which = np.unique(places[sure], axis=0, return_inverse=True)
        closer = nearer_alias(bank, fringe_mas, distinct)[which.ravel()]
    else:
        closer = nearer[sure]
    located = np.zeros(len(places), dtype=bool)
    located[sure] = ~ambiguous(closer, hit.gain[sure])
    return {"detected": detected, "located": located, "statistic": statistic}


def at_its_place(found: FloatArray, places: FloatArray, fringe_mas: float) -> BoolArray:
    """Whether positions (…, 2) are those of companions: nearer than λ/2B_max."""
    return np.asarray(np.linalg.norm(found - places, axis=-1) < 0.5 * fringe_mas)


def _correlation(bank: TemplateBank, there: FloatArray, here: FloatArray) -> FloatArray:
    """Correlations of the templates at pairs of places (n, 2), (n,)."""
    if not len(there):
        return np.empty(0)
    pair = [bank.templates_at(*place.T) for place in (there, here)]
    return np.asarray((pair[0] * pair[1]).sum(axis=0))


def ambiguous(nearer: FloatArray, gain: FloatArray) -> BoolArray:
    """Say where the search would report an alias that is nearer to the star.

    Parameters
    ----------
    nearer : (n,) float array
        From `nearer_alias`.
    gain : (n,) float array
        In χ². Fits that differ by less than 9 over all the data are alike to
        `amibayes.companion_search.search.innermost_first`, and so are any whose difference is less
        than half of the signal.
    """
    alike = np.minimum(1.0 - ALIKE, 9.0 / np.maximum(gain, 1e-30))
    return np.asarray(1.0 - np.clip(nearer, 0.0, 1.0) ** 2 < alike)


def nearer_aliases(
    bank: TemplateBank,
    places: FloatArray,
    fringe_mas: float,
    *,
    executor: Executor | None = None,
    journal: Journal | None = None,
) -> FloatArray:
    """`nearer_alias` of many places, (n_pieces, n, 2), as a job; (n_pieces, n)."""
    work = partial(_alias_piece, bank, fringe_mas)
    done = run_job(work, list(places), executor or SerialExecutor(), journal=journal)
    return np.array([piece["correlation"] for piece in done])


def _alias_piece(
    bank: TemplateBank, fringe_mas: float, places: FloatArray
) -> dict[str, FloatArray]:
    return {"correlation": nearer_alias(bank, fringe_mas, places)}


def nearer_alias(bank: TemplateBank, fringe_mas: float, places: FloatArray) -> FloatArray:
    """Largest correlation with a position that is nearer to the star and not the same one.

    Parameters
    ----------
    bank : TemplateBank
    fringe_mas : float
        Positions within it are the same. Without closure phases so are those within half of
        it about the opposite place, which no data tell and no rule prefers.
    places : (n, 2) float array
        east_mas, north_mas.

    Returns
    -------
    (n,) float array
        0 where there is none.
    """
    clear, marginal = _best_inward(bank, fringe_mas, places)
    radius = np.hypot(*places.T)
    found = np.zeros(len(places))
    for most, where in (clear, marginal):
        most, at = _between_lattice_points(bank, places, most, where)
        found = np.maximum(found, np.where(np.hypot(*at.T) < radius, most, 0.0))
    return found


def _best_inward(
    bank: TemplateBank, fringe_mas: float, places: FloatArray
) -> list[tuple[FloatArray, IntArray]]:
    """Largest correlations on the lattice and where they are, (n,) each.

    First among positions nearer to the star by a step of the lattice or more, then among
    those at the same separation within a step, of which the lattice cannot tell.
    """
    own = bank.templates_at(*places.T)
    radius, grid = np.hypot(*places.T)[:, None], bank.grid
    best = [(np.zeros(len(places)), np.zeros(len(places), dtype=np.intp)) for _ in range(2)]
    each = np.arange(len(places))
    for index, templates in bank.chunks():
        match = own.T @ templates
        east, north = grid.east_mas[index], grid.north_mas[index]
        match[_same_place(bank, fringe_mas, places, east, north)] = 0.0
        inward = (radius - np.hypot(east, north)) / grid.step_mas
        for (most, where), zone in zip(best, (inward > 1.0, np.abs(inward) <= 1.0), strict=True):
            here = np.where(zone, match, 0.0)
            top = here.argmax(axis=1)
            better = here[each, top] > most
            most[better], where[better] = here[each, top][better], index[top[better]]
    return best


def _same_place(
    bank: TemplateBank,
    fringe_mas: float,
    places: FloatArray,
    east: FloatArray,
    north: FloatArray,
) -> BoolArray:
    """Which positions (m,) count as the same as a place (n, 2), or as its opposite; (n, m)."""
    along = np.outer(places[:, 0], east) + np.outer(places[:, 1], north)
    square = (east**2 + north**2)[None] + (places**2).sum(axis=1)[:, None]
    same = square - 2.0 * along < fringe_mas**2
    if bank.symmetric:
        same |= square + 2.0 * along < (0.5 * fringe_mas) ** 2
    return np.asarray(same)


def _between_lattice_points(
    bank: TemplateBank, places: FloatArray, most: FloatArray, where: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Look around the best lattice points: near 1 a correlation must be known well.

    Returns
    -------
    best : (n,) float array
    at : (n, 2) float array
        Where it is.
    """
    grid = bank.grid
    at = np.column_stack([grid.east_mas[where], grid.north_mas[where]])
    likely = np.flatnonzero(most**2 > 0.8 * ALIKE)
    if not len(likely):
        return most, at
    own = bank.templates_at(*places[likely].T)
    best, middle = most[likely], at[likely]
    for shift in itertools.product(SUBSTEPS * grid.step_mas, repeat=2):
        there = middle + shift
        match = (own * bank.templates_at(*there.T)).sum(axis=0)
        better = match > best
        best[better], at[likely[better]] = match[better], there[better]
    out = most.copy()
    out[likely] = best
    return out, at


def injected_signal(likelihood: Likelihood, single: FloatArray, theta: FloatArray) -> FloatArray:
    """Whitened change of the data by companions (n, 3) on top of the fit without one."""
    whole = likelihood.model.at_rest(theta)
    full = np.hstack([whole, np.broadcast_to(single, (len(theta), len(single)))])
    alone = single_likelihood(likelihood).predict(np.atleast_2d(single))
    change = likelihood.predict(full) - alone
    closure = change[likelihood.samples.squares.shape[0] :]
    closure -= 2.0 * np.pi * np.rint(closure / (2.0 * np.pi))
    return likelihood.observables.covariance.whiten(change)

"""Injection and recovery of companions by the criterion of the search itself.

A companion is put into the fitted model without one, noise is drawn anew from the data's
covariance (itself estimated anew where it was estimated), and the search's statistic is
formed: it is detected where the false-alarm probability is below α, and located where the
search would report it at its place too. In whitened data a trial costs no more than a null
search, a column of a matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.statistic import Hits, Statistic
from amibayes.errors import UsageError
from amibayes.limits.aliases import ambiguous, nearer_alias
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
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Shown
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

    test: Statistic
    rings: Rings
    nearer: FloatArray
    level: FloatArray
    by_detection: BoolArray
    threshold: float
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
        setting.test,
        theta,
        setting.threshold,
        rng,
        nearer=setting.nearer[ring, angle],
        executor=setting.executor,
        progress=progress,
        journal=setting.journals.of(f"round-{k}") if setting.journals else None,
    )
    return Trials(ring, level, angle, found.detected, found.located)


TRIALS_AT_ONCE = 2048


ALIAS = 0.875
"""Correlation of two templates on the lattice above which one position stands for the other."""


@dataclass(frozen=True, eq=False, repr=False)
class Recovery(Shown):
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


@checks_arguments
def recover(
    test: Statistic,
    companions: FloatArray,
    threshold: float,
    rng: np.random.Generator,
    *,
    nearer: FloatArray | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> Recovery:
    """Inject companions and say which of them the search recovers.

    Parameters
    ----------
    test : Statistic
        Draws the noise, and searches.
    companions : (n, 3) float array
        east_mas, north_mas, contrast (the same in every band, at rest) of each trial. Trials
        at one place are cheapest side by side.
    threshold : float
        Statistic that counts as a detection.
    rng : numpy.random.Generator
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
    companions = np.asarray(companions, dtype=float)
    if companions.ndim != 2 or companions.shape[1] != 3 or not np.isfinite(companions).all():
        raise UsageError("companions are not rows of 3 columns of finite numbers", source="recover")
    parts = slices(len(companions), TRIALS_AT_ONCE)
    pieces = [
        (companions[p], None if nearer is None else nearer[p], seed)
        for p, seed in zip(parts, spawn(rng, len(parts)), strict=True)
    ]
    work = partial(_recover_piece, test, threshold)
    executor = executor or SerialExecutor()
    done = list(run_job(work, pieces, executor, journal=journal, progress=progress))
    return Recovery(
        np.concatenate([d["detected"] for d in done]), np.concatenate([d["located"] for d in done])
    )


def _recover_piece(
    test: Statistic,
    threshold: float,
    piece: tuple[FloatArray, FloatArray | None, np.random.SeedSequence],
) -> dict[str, BoolArray]:
    companions, nearer, seed = piece
    rng = np.random.default_rng(seed)
    hits = test.simulated(len(companions), rng, test.signal_of(companions))
    found = classify_recovery(test, companions[:, :2], hits, threshold, nearer=nearer)
    return {"detected": found.detected, "located": found.located}


def classify_recovery(
    test: Statistic,
    places: FloatArray,
    hits: Hits,
    threshold: float,
    *,
    nearer: FloatArray | None = None,
) -> Recovery:
    """Say which data sets that hold a companion each were recovered.

    Parameters
    ----------
    test : Statistic
    places : (n, 2) float array
        east_mas, north_mas of the companions.
    hits : Hits
        What the statistic made of the data sets.
    threshold : float
        Statistic that counts as a detection.
    nearer : (n,) float array, optional
        From `nearer_alias` for the places, if it is known already.
    """
    bank, fringe = test.bank, resolution_mas(test.likelihood)
    position, detected = hits.position, hits.statistic > threshold
    found = np.column_stack([bank.grid.east_mas[position], bank.grid.north_mas[position]])
    right = at_its_place(found, places, fringe)
    elsewhere = np.flatnonzero(detected & ~right)
    right[elsewhere] = _correlation(bank, found[elsewhere], places[elsewhere]) > ALIAS
    # Aliases are the dearest part: only those are looked for that decide something.
    sure = np.flatnonzero(detected & right)
    if nearer is None:
        distinct, which = np.unique(places[sure], axis=0, return_inverse=True)
        closer = nearer_alias(bank, fringe, distinct)[which.ravel()]
    else:
        closer = nearer[sure]
    located = np.zeros(len(places), dtype=bool)
    located[sure] = ~ambiguous(closer, hits.gain[sure])
    return Recovery(detected, located)


def at_its_place(found: FloatArray, places: FloatArray, fringe_mas: float) -> BoolArray:
    """Whether positions (…, 2) are those of companions: nearer than λ/2B_max."""
    return np.asarray(np.linalg.norm(found - places, axis=-1) < 0.5 * fringe_mas)


def _correlation(bank: TemplateBank, there: FloatArray, here: FloatArray) -> FloatArray:
    """Correlations of the templates at pairs of places (n, 2), (n,)."""
    if not len(there):
        return np.empty(0)
    pair = [bank.templates_at(*place.T) for place in (there, here)]
    return np.asarray((pair[0] * pair[1]).sum(axis=0))

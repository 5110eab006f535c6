"""Rounds of injections: where companions are injected, and how often.

The size of every round is fixed beforehand, and what one does depends only on whole rounds
before it: the result is the same for any number of workers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amibayes.inference.bank import TemplateBank
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.recovery import TRIALS_AT_ONCE, recover
from amibayes.inference.rings import Rings
from amibayes.inference.robust import Frame
from amibayes.observables import BoolArray
from amibayes.parallel import Executor, Journals, Progress, spawn
from amibayes.units import FloatArray

IntArray = NDArray[np.intp]

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
class Setting:
    """What stays the same over all rounds."""

    likelihood: Likelihood
    single: FloatArray
    frame: Frame | None
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
    setting: Setting, trials_per_cell: int, rng: np.random.Generator, progress: Progress | None
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
    setting: Setting,
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

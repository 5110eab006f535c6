"""From which contrast on a companion is recovered, for one place and one realisation of noise.

An injected companion that is just too faint is found where it is made a little brighter: the
same noise is searched with companions of other contrasts, until the statistic is at the
threshold. One such number tells as much as many injections that are found or not, and it moves
smoothly with the data, so that a limit does not depend on rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.special import ndtri

from amibayes.companion_search.field import resolution_mas
from amibayes.detection.statistic import Statistic
from amibayes.limits.aliases import ambiguous, nearer_aliases
from amibayes.limits.injection import classify_recovery
from amibayes.limits.rings import Rings
from amibayes.parallel import Executor, Journal, Journals, Progress, SerialExecutor, run_job
from amibayes.units import BoolArray, FloatArray, IntArray

ROUNDS = 8
"""Contrasts that are tried: two suffice for faint companions, whose signal is linear."""

CLOSE = 0.15
"""Standard deviations from the threshold within which the line through two contrasts is taken."""

CELLS, REFINEMENTS = 5, 2
"""Parts of a range of contrasts that are looked at together, and how often the first of them that
shows a companion at its place is parted again: to 8 % of the contrast."""

WIDE = 4.0
"""Range of contrasts in which a companion is looked for at its place, above which up to 1: in
units of the one that linear theory detects half of the time."""

FEW = 0.02
"""Share of the trials for which no further look at the whole bank is taken: theirs is then the
contrast on the last straight line."""

NUMBERS_AT_ONCE, MOST_AT_ONCE = 8_000_000, 1024
"""Numbers of data, and data sets, that are searched together."""


@dataclass(frozen=True, eq=False)
class CriticalContrasts:
    """Contrasts from which on injected companions are recovered.

    Parameters
    ----------
    detected, located : (n_rings, n_angles, n_noise) float array
        Infinite where they are not recovered however bright. ``located`` is that of detection
        where detection alone counts.
    sigma : (n_rings, n_angles) float array
        Error of a faint companion's contrast.
    component, width : (n_rings, n_angles, n_noise) float array
        Component of the noise along the companion's template, in its standard deviations, and
        these in the noise's expected ones: 0 where noise is not linear in the component.
    ambiguous : (n_rings,) float array
        Share of the directions in which a typical companion is taken for one nearer in.
    by_detection : (n_rings,) bool array
        Where a companion counts wherever it is seen.
    """

    detected: FloatArray
    located: FloatArray
    sigma: FloatArray
    component: FloatArray
    width: FloatArray
    ambiguous: FloatArray
    by_detection: BoolArray

    def joined(self, other: CriticalContrasts) -> CriticalContrasts:
        """These with those of other draws of noise at the same places."""
        names = ("detected", "located", "component", "width")
        both = ((getattr(self, name), getattr(other, name)) for name in names)
        each = (np.concatenate(pair, axis=2) for pair in both)
        return replace(self, **dict(zip(names, each, strict=True)))

    def less_sensitive(self, factor: FloatArray, spread: FloatArray) -> CriticalContrasts:
        """The same where detection takes contrasts larger by factors (n_rings,).

        Logarithms of them are spread about a ring's median as many times as wide (n_rings,).
        From which contrast on a companion that is detected is seen at its place does not change.
        """
        middle = np.median(self.detected, axis=(1, 2), keepdims=True)
        middle = np.where(np.isfinite(middle), middle, 1.0)
        wider = (self.detected / middle) ** spread[:, None, None]
        detected = middle * factor[:, None, None] * wider
        return replace(
            self,
            detected=detected,
            located=np.maximum(self.located, detected),
            sigma=self.sigma * factor[:, None],
        )


@dataclass(frozen=True)
class Draws:
    """How much noise is drawn, and how.

    Parameters
    ----------
    per_place : int
        Realisations at every place.
    seed : int
    stated_probable : bool
        As in `amibayes.detection.treatments.ErrorTreatment.scatter_posterior`.
    """

    per_place: int
    seed: int
    stated_probable: bool


@dataclass(frozen=True, eq=False)
class Directions:
    """What is known of the places of rings before any noise is drawn.

    Parameters
    ----------
    sigma : (n_places,) float array
        Error of a faint companion's contrast.
    nearer : (n_places, …) float array
        As `amibayes.limits.aliases.nearer_aliases` gives it.
    ambiguous : (n_rings,) float array
        Share of the directions in which a typical companion is taken for one nearer in.
    by_detection : (n_rings,) bool array
        Where a companion counts wherever it is seen.
    """

    sigma: FloatArray
    nearer: FloatArray
    ambiguous: FloatArray
    by_detection: BoolArray


def directions_of(
    test: Statistic,
    rings: Rings,
    *,
    typical: float,
    most_ambiguous: float,
    executor: Executor | None = None,
    journals: Journals | None = None,
) -> Directions:
    """Find which places of rings are ambiguous.

    Parameters
    ----------
    test : Statistic
    rings : Rings
    typical : float
        Gain in χ² of a companion at the limit, for which ambiguity is stated.
    most_ambiguous : float
        Share of the directions above which detection alone is counted.
    executor, journals : optional
        As in `amibayes.limits.completeness.detection_limit`.
    """
    places = rings.places
    nearer = nearer_aliases(
        test.bank, places, resolution_mas(test.likelihood),
        executor=executor, journal=journals.of("aliases") if journals else None,
    )  # fmt: skip
    every = ambiguous(nearer, np.full(len(places), typical))
    lost = every.reshape(rings.east_mas.shape).mean(axis=1)
    return Directions(test.contrast_error(places), nearer, lost, lost > most_ambiguous)


def critical_contrasts(
    test: Statistic,
    threshold: float,
    rings: Rings,
    directions: Directions,
    draws: Draws,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> CriticalContrasts:
    """Find the critical contrasts at all places of some rings, for several draws of noise.

    Parameters
    ----------
    test : Statistic
    threshold : float
        Statistic of a detection.
    rings : Rings
    directions : Directions
        Of these rings.
    draws : Draws
    executor, progress, journal : optional, see `amibayes.parallel.run_job`
    """
    shape, places = rings.east_mas.shape, rings.places
    every, anywhere = np.arange(len(places)), np.repeat(directions.by_detection, shape[1])
    whole = _Part(every, places, directions.sigma, directions.nearer, anywhere)
    done = list(
        run_job(
            partial(_piece, test, threshold, draws, shape[1]),
            [whole.at(k) for k in _parts(shape, draws, test.bank.n_data)],
            executor or SerialExecutor(),
            journal=journal,
            progress=progress,
        )
    )
    detected, located, component, width = (
        np.concatenate([d[key] for d in done]).reshape(*shape, -1)
        for key in ("detected", "located", "component", "width")
    )
    return CriticalContrasts(
        detected, located, directions.sigma.reshape(shape), component, width,
        directions.ambiguous, directions.by_detection,
    )  # fmt: skip


def _parts(shape: tuple[int, int], draws: Draws, n_data: int) -> list[IntArray]:
    """Places of whole rings that are searched together."""
    each = shape[1] * draws.per_place
    rings = max(1, min(MOST_AT_ONCE, NUMBERS_AT_ONCE // n_data) // each)
    every = np.arange(shape[0] * shape[1])
    return np.split(every, np.arange(rings * shape[1], len(every), rings * shape[1]))


@dataclass(frozen=True, eq=False)
class _Part:
    """Some places: their numbers, (n, 2) coordinates, errors, aliases, and what counts there."""

    number: IntArray
    places: FloatArray
    sigma: FloatArray
    nearer: FloatArray
    anywhere: BoolArray

    def at(self, which: IntArray) -> _Part:
        """Some of the places, or some of them again."""
        return _Part(
            self.number[which],
            self.places[which],
            self.sigma[which],
            self.nearer[which],
            self.anywhere[which],
        )


def _piece(
    test: Statistic, threshold: float, draws: Draws, n_angles: int, part: _Part
) -> dict[str, FloatArray]:
    """Critical contrasts of whole rings of places."""
    noise, along, width = _noise(test, draws, n_angles, part)
    trial = np.repeat(np.arange(len(part.number)), draws.per_place)
    trials = _Trials(test, threshold, part.at(trial), noise, along)
    detected, right = trials.detected()
    located = trials.located(detected, right)
    numbers = {"detected": detected, "located": located, "component": along, "width": width}
    return {key: x.reshape(len(part.number), draws.per_place) for key, x in numbers.items()}


def _noise(
    test: Statistic, draws: Draws, n_angles: int, part: _Part
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Noise (n_data, n) of all trials, place by place, and its components along the templates.

    And their standard deviations, which the drawn scatter sets. The components decide most. On
    every ring each realisation has one from every n_angles-th of the normal distribution, which
    takes their chance out of the limit.
    """
    rng = np.random.default_rng([draws.seed, int(part.number[0])])
    shape = (len(part.number) // n_angles, draws.per_place, n_angles)
    cell = rng.permuted(np.broadcast_to(np.arange(n_angles), shape), axis=2)
    level = (cell + rng.uniform(size=shape)) / n_angles
    along = ndtri(level).swapaxes(1, 2).ravel()
    own = np.repeat(test.bank.templates_at(*part.places.T), draws.per_place, axis=1)
    normals = test.bank.normals(len(along), rng)
    normals += own * (along - (own * normals).sum(axis=0))
    scatter = test.scatter_posterior(len(along), rng, stated_probable=draws.stated_probable)
    width = (own**2 * scatter).sum(axis=0) if test.linear_noise else np.zeros(len(along))
    return test.noise(normals * scatter, rng), along, width


@dataclass(frozen=True, eq=False)
class _Trials:
    """Companions (n,) at places, each with noise of its own."""

    test: Statistic
    threshold: float
    at: _Part
    noise: FloatArray
    along: FloatArray

    @cached_property
    def goal(self) -> float:
        """Root of the gain in χ² of a detection."""
        return float(np.sqrt(self.test.gain_at(np.array(self.threshold))))

    def detected(self) -> tuple[FloatArray, BoolArray]:
        """Contrasts (n,) from which on they are detected, and whether that is at their place.

        By the secant rule, from linear theory.
        """
        goal, sigma = self.goal, self.at.sigma
        every, slope = np.arange(len(sigma)), 1.0 / sigma
        contrast = np.clip(sigma * np.maximum(goal - self.along, 0.2 * goal), 0.0, 1.0)
        seen, right = self._seen(every, contrast)
        for _ in range(ROUNDS):
            hidden = (contrast == 1.0) & (seen < goal)
            todo = every[(np.abs(seen - goal) > CLOSE) & ~hidden]
            if len(todo) <= FEW * len(every):
                break
            before, there = contrast[todo], seen[todo]
            step = np.clip(before + (goal - there) / slope[todo], 0.25 * before, 4.0 * before)
            contrast[todo] = np.minimum(step, 1.0)
            seen[todo], right[todo] = self._seen(todo, contrast[todo])
            with np.errstate(invalid="ignore", divide="ignore"):
                new = (seen[todo] - there) / (contrast[todo] - before)
            # Where noise makes the maximum the statistic hardly moves: linear theory goes on.
            fair = np.isfinite(new) & (new > 0.2 / sigma[todo])
            slope[todo] = np.where(fair, new, 1.0 / sigma[todo])
        reached = np.maximum(contrast + (goal - seen) / slope, 0.5 * contrast)
        hidden = (contrast == 1.0) & (seen < goal)
        return np.where(hidden, np.inf, reached), right

    def located(self, detected: FloatArray, right: BoolArray) -> FloatArray:
        """Contrasts (n,) from which on they are seen at their place, where that is asked for."""
        found = np.where(detected <= 1.0, detected, np.inf)
        wrong = np.flatnonzero(np.isfinite(found) & ~self.at.anywhere & ~right)
        low = found[wrong]
        high = np.minimum(np.maximum(WIDE * self.goal * self.at.sigma[wrong], 2.0 * low), 1.0)
        low, high = self._parted(wrong, low, high, CELLS)
        beyond = np.isinf(high)
        top = low[beyond], np.ones(int(beyond.sum()))
        low[beyond], high[beyond] = self._parted(wrong[beyond], *top, CELLS)
        some = np.isfinite(high)
        for _ in range(REFINEMENTS - 1):
            low[some], high[some] = self._parted(wrong[some], low[some], high[some], CELLS)
        found[wrong] = np.sqrt(low * high)
        return found

    def _parted(
        self, which: IntArray, low: FloatArray, high: FloatArray, n: int
    ) -> tuple[FloatArray, FloatArray]:
        """Contrasts between which trials are first seen at their place; inf if not at the highest.

        Of n equal parts, in the logarithm, of the ranges from ``low`` to ``high``, (k,) each.
        """
        steps = np.arange(1, n + 1) / n
        level = low[:, None] * (high / low)[:, None] ** steps
        right = self._seen(np.repeat(which, n), level.ravel())[1].reshape(-1, n)
        first, each = right.argmax(axis=1), np.arange(len(which))
        below = np.where(first == 0, low, level[each, np.maximum(first - 1, 0)])
        some = right.any(axis=1)
        return np.where(some, below, high), np.where(some, level[each, first], np.inf)

    def _seen(self, which: IntArray, contrast: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Root of the gain in χ² of some trials with companions of contrasts (k,).

        And whether the position that the search would report is the companion's.
        """
        if not len(which):
            return np.empty(0), np.empty(0, dtype=bool)
        at = self.at.at(which)
        signal = self.test.signal_of(np.column_stack([at.places, contrast]))
        hits = self.test.hits_in(self.noise[:, which], signal)
        found = classify_recovery(self.test, at.places, hits, -np.inf, nearer=at.nearer)
        return np.sqrt(self.test.gain_at(hits.statistic)), found.located

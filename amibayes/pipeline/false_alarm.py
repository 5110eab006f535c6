"""The false-alarm probability of a search, and of a second companion beside the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amibayes.calibration.transfer import Diameter
from amibayes.companion_search.field import on_outer_edge
from amibayes.companion_search.result import SearchResult, stated_parameters
from amibayes.data.observables import Observables
from amibayes.detection.alternatives import Alternative, alternative
from amibayes.detection.consistency import MAX_PARTS, by_night, consistency
from amibayes.detection.false_alarm import (
    Significance,
    beside_bright,
    draws_needed,
    significance,
)
from amibayes.detection.randomised import Randomised, randomised
from amibayes.detection.residuals import correlated
from amibayes.detection.splits import Consistency, motion_words
from amibayes.detection.statistic import BankStatistic, statistic_of
from amibayes.detection.verdict import (
    Verdict,
    at_the_edge,
    star_alone,
    verdict,
    within_calibration,
    without_companion,
)
from amibayes.errors import DataError
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.residuals import files_of
from amibayes.parallel import Executor, Journal, Progress, spawn
from amibayes.pipeline.field import FieldSearch, search_field
from amibayes.pipeline.options import SearchOptions, noise_prior
from amibayes.support.options import NULL_DRAWS
from amibayes.units import BoolArray

MAX_RANDOMISED = 5000
"""Randomised data sets: enough for an upper bound of 7e-4 where none is above."""


STRUCTURE_DRAWS = 2000
"""Null draws of the structure that a fit leaves: a probability of 5e-4 is enough to reject."""

FIRST_DRAWS, NOT_SMALL = 500, 0.1
"""Draws after which a probability is given, if it is larger than that: no more would be made of
it if it were known better."""

NULL_WORK = 3e11
"""Positions times data of all null searches together: ten seconds of one core."""

MORE = 5
"""How many times as many draws are made, anew, where α is within the interval of the probability:
half of the probabilities from 0.7 to 1.3 α are then told from it."""

LEAST_DRAWS = 3000
"""Null searches where each is dear: α is then known to a half."""


def false_alarm(
    result: SearchResult,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> Significance:
    """Find the chance that noise alone gives what the search found.

    Unless ``options`` take the stated errors for right, by a statistic free of their scale.
    """
    test = statistic_of(result, stated_errors=not options.extra_noise)
    wanted = null_draws(test, options)

    def with_draws(times: int, journal: Journal | None) -> Significance:
        spawned = np.random.default_rng(spawn(rng, 1)[0])
        found = significance(
            test, times * wanted, rng, options.alpha,
            executor=executor, progress=progress, journal=journal,
        )  # fmt: skip
        if correlated(result) is not None:
            # Laws fitted to draws that are too good say nothing of what lies beyond them.
            found = replace(found, tail=None)
        draws = times * min(wanted, MAX_RANDOMISED)
        return found.beside(_randomised(test, draws, spawned, executor, progress))

    tested = with_draws(1, journal)
    low, high = tested.interval
    if options.null_draws is None and tested.detected is False and low < options.alpha <= high:
        tested = with_draws(MORE, None)
    return replace(tested, field=test.field(test.observed))


def null_draws(test: BankStatistic, options: SearchOptions) -> int:
    """Find how many null searches are made: by default as many as their cost allows."""
    if options.null_draws is not None:
        return options.null_draws
    least = max(LEAST_DRAWS, draws_needed(options.alpha))
    return max(least, min(NULL_DRAWS, int(NULL_WORK / test.bank.work)))


def _randomised(
    test: BankStatistic,
    draws: int,
    rng: np.random.Generator,
    executor: Executor | None,
    progress: Progress | None = None,
) -> Randomised:
    """Compare with randomised residuals, few where these already reach the statistic often."""
    few = randomised(test, min(FIRST_DRAWS, draws), rng, executor=executor)
    if few.probability is None or few.probability > NOT_SMALL or draws <= FIRST_DRAWS:
        return few
    return randomised(test, draws, rng, executor=executor, progress=progress)


def second_false_alarm(
    result: SearchResult,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Significance:
    """Find the chance that noise alone gives a second companion beside the first.

    All that the first companion can do by moving or brightening is projected out, of the
    data and of the null sets.
    """
    test = statistic_of(result, stated_errors=not options.extra_noise, beside=True)
    draws = null_draws(test, options)
    return significance(test, draws, rng, options.alpha, executor=executor, progress=progress)


def structure(
    test: BankStatistic,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
) -> Significance:
    """Find the chance that noise alone leaves as much structure beside the best fit.

    That of a second companion, with fewer draws, and randomised residuals where they say
    something. ``test`` is of one more component beside the best fit.
    """
    draws = min(null_draws(test, options), STRUCTURE_DRAWS)
    few = significance(test, min(FIRST_DRAWS, draws), rng, options.alpha, executor=executor)
    if few.probability > NOT_SMALL:
        return few
    found = significance(test, draws, rng, options.alpha, executor=executor)
    return found.beside(_randomised(test, draws, rng, executor))


def verdict_of(
    found: FieldSearch,
    tested: Significance,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
    calibrators: Sequence[tuple[Observables, Diameter]] = (),
) -> tuple[Verdict, tuple[Consistency, ...]]:
    """Give the verdict of a search, and how its parts agree where a companion is detected.

    ``calibrators`` are those that are exchangeable, with their diameters.
    """
    result, stated = found.result, found.observables
    splits: tuple[Consistency, ...] = ()
    if tested.detected:
        data = stated.only(options.observables) if options.extra_noise else None
        splits = consistency(
            result,
            rng,
            noise=found.noise,
            stated=data,
            prior=noise_prior(stated, options),
            calibrators=calibrators,
            alpha=options.alpha,
        )
    test = statistic_of(result, stated_errors=not options.extra_noise, beside=True)
    rest = structure(test, options, rng, executor)
    change = test.change_by(test.strongest)[:, 0]
    within = within_calibration(result.likelihood.observables, change)
    structured = rest.probability > options.alpha or not within
    noise = found.noise if options.extra_noise else None
    compared = options.models is not None
    alone = None
    if not tested.detected:
        alone = star_alone(
            result,
            stated.only(options.observables),
            noise_prior(stated, options),
            per_file=options.file_noise is not False,
        )
    said = verdict(
        result, tested, rest, splits,
        structured=structured, noise=noise, compared=compared, alone=alone,
    )  # fmt: skip
    other = alternative(result) if said.statement in ("companion", "model rejected") else None
    if other is not None and said.statement == "companion":
        said = without_companion(said, other, result, compared=compared)
    elif other is not None:
        said = with_what_fits(said, other, result)
    if said.statement == "companion" and options.separation_mas is None and on_outer_edge(result):
        said = at_the_edge(said, result)
    if said.statement == "no companion" and (seen := _seen_in_one_part(found, options, rng)):
        said = Verdict("inconsistent data", seen, said.p_model)
    if said.statement == "no companion" and options.extra_noise and alone is not None:
        said = replace(said, star=stated_parameters(*alone))
    return said, splits


def with_what_fits(said: Verdict, other: Alternative, result: SearchResult) -> Verdict:
    """The verdict where the model is rejected, with a source that fits far better than it."""
    if other.chi2 > FAR_BETTER * result.chi2_binary:
        return said
    better = f"fits better (χ² {other.chi2:.4g}, with a companion {result.chi2_binary:.4g})"
    return replace(said, because=f"{said.because}; {other.words}, {better}")


FAR_BETTER = 0.75
"""Part of χ² that a source leaves which is worth naming where no model fits: with more parameters
any leaves a tenth less, and noise that was fitted to the model makes all χ² small."""


def _seen_in_one_part(found: FieldSearch, options: SearchOptions, rng: np.random.Generator) -> str:
    """Say which night or file by itself shows a companion; empty where none does.

    One that moves from night to night, or that a file has and others have not (another star,
    another orientation), fits all of them together so badly that it passes for noise. Each part
    is searched and tested as if there were no other, and the parts share the probability of a
    false alarm. Files are parts where noise was fitted to them: else a star alone explains them.
    """
    data = found.observables.only(options.observables).unflagged()
    parts = _nights_and_files(data, found.noise, moves=options.motion)
    if not 1 < len(parts) <= 2 * MAX_PARTS:
        return ""
    own = replace(options, alpha=options.alpha / len(parts), motion=False, null_draws=None)
    few = replace(own, null_draws=FIRST_DRAWS)
    for name, mask, why in parts:
        try:
            part = search_field(data.select(mask[: data.n_vis2], mask[data.n_vis2 :]), own)
        except DataError:  # too few data to be searched
            continue
        if false_alarm(part.result, few, rng).probability > NOT_SMALL:
            continue
        tested = beside_bright(false_alarm(part.result, own, rng), part.result, part.noise)
        if tested.detected and verdict_of(part, tested, own, rng)[0].statement == "companion":
            return _told(name, part, why)
    return ""


def _nights_and_files(
    data: Observables, noise: ExtraNoise, *, moves: bool
) -> list[tuple[str, BoolArray, str]]:
    """Name, mask (n_data,) and what may set it apart of each part; a file may be a night."""
    apart = "another star, orientation or calibration of a file"
    nights = by_night(data)
    parts = [(f"the night of {n}", mask, motion_words(moves=moves)) for n, mask in nights.items()]
    if noise.exceeds_stated:
        known = {mask.tobytes() for mask in nights.values()}
        files = {f.source: np.concatenate([f.vis2, f.closure_phase]) for f in files_of(data)}
        parts += [(n, mask, apart) for n, mask in files.items() if mask.tobytes() not in known]
    return [part for part in parts if not part[1].all()]


def _told(part: str, found: FieldSearch, why: str) -> str:
    """Say where the companion of one part is."""
    c = found.result.companion
    return (
        f"{part} shows a companion by itself ({c.delta_mag:.1f} mag at "
        f"{c.separation_mas:.3g} mas, PA {c.position_angle_deg:.0f} deg), all data together none "
        f"that is as likely; {why} may explain it"
    )

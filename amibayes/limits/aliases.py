"""Positions nearer to the star that data cannot tell from a companion's own."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np

from amibayes.companion_search.template_bank import TemplateBank
from amibayes.parallel import Executor, Journal, SerialExecutor, run_job, slices
from amibayes.units import BoolArray, FloatArray, IntArray

ALIKE = 0.75
"""Squared correlation that `innermost_first` calls alike, however bright the companion."""


SUBSTEPS = np.linspace(-0.5, 0.5, 5)
"""Where, in steps of the lattice, an alias is looked for around its best lattice point."""


def ambiguous(nearer: FloatArray, gain: FloatArray) -> BoolArray:
    """Say where the search would report an alias that is nearer to the star.

    Parameters
    ----------
    nearer : (n,) float array
        From `nearer_alias`.
    gain : (n,) float array
        In χ². Fits that differ by less than 9 over all the data are alike to
        `amibayes.companion_search.modes.innermost_first`, and so are any whose difference is less
        than half of the signal.
    """
    alike = np.minimum(1.0 - ALIKE, 9.0 / np.maximum(gain, 1e-30))
    return np.asarray(1.0 - np.clip(nearer, 0.0, 1.0) ** 2 < alike)


PLACES_AT_ONCE = 1024
"""Places that share a look at the whole bank."""


def nearer_aliases(
    bank: TemplateBank,
    places: FloatArray,
    fringe_mas: float,
    *,
    executor: Executor | None = None,
    journal: Journal | None = None,
) -> FloatArray:
    """`nearer_alias` of many places (n, 2), as a job; (n,)."""
    work = partial(_alias_piece, bank, fringe_mas)
    pieces = [places[part] for part in slices(len(places), PLACES_AT_ONCE)]
    done = run_job(work, pieces, executor or SerialExecutor(), journal=journal)
    return np.concatenate([piece["correlation"] for piece in done])


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
    # Single precision: what counts is looked at again between the lattice's points.
    own = bank.templates_at(*places.T).astype(np.float32)
    radius, grid = np.hypot(*places.T)[:, None], bank.grid
    best = [(np.zeros(len(places)), np.zeros(len(places), dtype=np.intp)) for _ in range(2)]
    each, every = np.arange(len(places)), grid.places
    for index, match in bank.matches(own, float(radius.max(initial=0.0)) + grid.step_mas):
        east, north = every[:, index]
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
    """Search around the best lattice points: near 1 a correlation must be known well.

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
        match = bank.match_at(own, *there.T)
        better = match > best
        best[better], at[likely[better]] = match[better], there[better]
    out = most.copy()
    out[likely] = best
    return out, at

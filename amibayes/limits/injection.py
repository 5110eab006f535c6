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
from amibayes.parallel import Executor, Journal, Progress, SerialExecutor, run_job, slices, spawn
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Shown
from amibayes.units import BoolArray, FloatArray

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

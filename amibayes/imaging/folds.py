"""Parts of the data that are left out in turn: baselines, with every triangle that they are in."""

from __future__ import annotations

import numpy as np

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.units import BoolArray, IntArray

N_FOLDS = 5


def folds_of(
    observables: Observables, rng: np.random.Generator, n_folds: int = N_FOLDS
) -> list[tuple[tuple[BoolArray, BoolArray], tuple[BoolArray, BoolArray]]]:
    """Split data by baselines, at random.

    Closure phases share baselines: a triangle by itself could be told from the others, with
    their noise. What is left out is therefore all V² of some baselines and all triangles with one
    of them. Kernel phases are left out one by one.

    Parameters
    ----------
    observables : Observables
        Unflagged.
    rng : numpy.random.Generator
    n_folds : int

    Returns
    -------
    list of ((vis2, phases), (vis2, phases))
        Masks of what is fitted, and of what it is compared with.
    """
    v2, cp = observables.vis2, observables.closure_phase
    ends = (v2.stations, cp.stations[:, [0, 1]], cp.stations[:, [1, 2]], cp.stations[:, [0, 2]])
    tables = (v2, cp, cp, cp)
    labels = [_labels(t, pair) for t, pair in zip(tables, ends, strict=True)]
    _, index = np.unique(np.concatenate(labels), axis=0, return_inverse=True)
    index = index.ravel()
    n = int(index.max(initial=-1)) + 1
    number = rng.permutation(np.arange(n) % max(min(n_folds, n), 1))
    fold = number[index]
    parts = np.split(fold, np.cumsum([len(t) for t in tables])[:-1])
    found = []
    for k in range(int(number.max(initial=-1)) + 1):
        out = parts[0] == k, (parts[1] == k) | (parts[2] == k) | (parts[3] == k)
        kept = ~out[0], ~out[1]
        if (kept[0].any() or kept[1].any()) and (out[0].any() or out[1].any()):
            found.append((kept, out))
    return found


def _labels(table: Measurements, pair: IntArray) -> IntArray:
    """Setup and stations, in rising order, of a baseline of every entry, (n, 3)."""
    return np.column_stack([table.setup, np.sort(pair, axis=1)])

"""The best contrasts of several bands, none below zero."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.units import FloatArray

SWEEPS = 8
"""Rounds over the bands in which the contrasts of bands that are coupled find their best."""


def best_positive(
    match: Sequence[NDArray[Any]] | NDArray[Any], shared: Mapping[tuple[int, int], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Non-negative least squares on templates of unit norm, by coordinate descent.

    Parameters
    ----------
    match : (n_bands, …, m) array
        Products of the templates with data.
    shared : mapping of (a, b) to (…, m) array
        Products of the templates of two bands, where these are coupled.

    Returns
    -------
    contrasts : (n_bands, …, m) array
        In units of their errors.
    gain : (…, m) array
        In χ².
    """
    coupled: dict[int, list[tuple[int, FloatArray]]] = {b: [] for b in range(len(match))}
    for (a, b), s in shared.items():
        s = s.astype(match[0].dtype)
        coupled[a].append((b, s))
        coupled[b].append((a, s))
    best = [np.maximum(m, 0.0) if not coupled[b] else 0.0 * m for b, m in enumerate(match)]
    for _ in range(SWEEPS if shared else 0):
        for b in [b for b in coupled if coupled[b]]:
            best[b] = np.maximum(match[b] - sum(s * best[a] for a, s in coupled[b]), 0.0)
    gain = sum(
        x * (2.0 * m - x - sum(s * best[a] for a, s in coupled[b]))
        for b, (x, m) in enumerate(zip(best, match, strict=True))
    )
    return np.asarray(best), np.asarray(gain)

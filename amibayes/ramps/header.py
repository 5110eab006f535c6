"""What was taken out of images, in the header of the file that was made of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from amibayes.ramps.converter import WAVES
from amibayes.ramps.migration import Migration, MigrationSource
from amibayes.ramps.transfer import KINDS

KEY = "AMIBAYES MIGRATION"
"""Beginning of the keywords, which FITS calls hierarchical."""

SOURCE, P_VALUES = f"{KEY} SOURCE", (f"{KEY} P", f"{KEY} P BEND")

Cards = dict[str, str | int | float | bool]


def migration_cards(migration: Migration | None) -> Cards:
    """Keywords of a migration, its whole covariance with it; only that it is off where absent."""
    if migration is None:
        return {f"HIERARCH {SOURCE}": "off"}
    value, error = migration.mean
    cards: Cards = {SOURCE: migration.source, f"{KEY} VALUE": value, f"{KEY} ERROR": error}
    for k, kind in enumerate(migration.kinds, 1):
        cards |= {f"{KEY} KIND{k}": kind, f"{KEY} VALUE{k}": float(migration.value[k - 1])}
        for j in range(1, k + 1):
            cards[f"{KEY} COVARIANCE{j} {k}"] = float(migration.covariance[j - 1, k - 1])
    return {f"HIERARCH {key}": card for key, card in cards.items()}


def migration_of(header: Mapping[str, Any]) -> Migration | None:
    """Migration that a header states; None where it states none, or one that makes no sense."""
    stated = header.get(SOURCE)
    sources: tuple[MigrationSource, ...] = get_args(MigrationSource)
    source = next((s for s in sources if s == stated and s != "off"), None)
    if source is None:
        return None
    kinds: list[str] = []
    while isinstance(kind := header.get(f"{KEY} KIND{len(kinds) + 1}"), str):
        kinds.append(kind)
    n = len(kinds)
    covariance = np.empty((n, n))
    try:
        value = np.array([float(header[f"{KEY} VALUE{k}"]) for k in range(1, n + 1)])
        for k in range(n):
            for j in range(k + 1):
                number = float(header[f"{KEY} COVARIANCE{j + 1} {k + 1}"])
                covariance[j, k] = covariance[k, j] = number
    except (KeyError, TypeError, ValueError):
        return None
    if not n or set(kinds) - {*KINDS, *WAVES} or not np.isfinite([*value, *covariance.flat]).all():
        return None
    return Migration(tuple(kinds), value, covariance, source)

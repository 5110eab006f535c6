"""Numbers that a result holds, each array as a few of them, to be recorded and compared.

An array is kept as the logarithm of its norm, its mean and that of its scatter, and a few
projections, all of order one: one absolute tolerance then means the same of all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import fields, is_dataclass
from datetime import date
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import issparse

from amibayes.data.blocks import BlockCovariance

PASSED_OVER = frozenset({"basis", "blocks", "factors", "header", "journal", "path", "source"})
"""Fields whose signs are arbitrary, that tell of the machine, or that other fields repeat."""

RAW, PROJECTIONS, TINY = 6, 4, 1e-7
"""Arrays up to this size are kept whole; scatter below this share of the norm is rounding."""


def numbers_of(
    *, passed_over: Collection[str] = (), properties: bool = True, **things: Any
) -> dict[str, np.ndarray]:
    """All numbers of results, by name, ready for ``num_regression``.

    Parameters
    ----------
    passed_over : collection of str
        Fields that are not looked at.
    properties : bool
        Take the properties of the results too, not of what they hold.
    **things
        Containers, arrays, numbers, or tuples and mappings of them.
    """
    out: dict[str, np.ndarray] = {}
    skipped = PASSED_OVER | set(passed_over)
    for name, thing in things.items():
        _add(out, name, thing, skipped, properties)
    return out


def checker(num_regression: Any, tolerance: float = 1e-6) -> Callable[..., None]:
    """A function that compares numbers of results with those recorded."""

    def check(**things: Any) -> None:
        numbers = numbers_of(**things)
        num_regression.check(numbers, default_tolerance={"atol": tolerance, "rtol": 0.0})

    return check


def _add(out: dict[str, Any], name: str, thing: Any, skipped: set[str], properties: bool) -> None:
    if thing is None or isinstance(thing, str | bytes | Path | date) or callable(thing):
        return
    parts = _parts(thing, skipped, properties)
    if parts is not None:
        for key, value in parts.items():
            if str(key) not in skipped:
                _add(out, f"{name}.{key}", value, skipped, False)
        return
    array = np.asarray(thing.toarray() if issparse(thing) else thing)
    if array.dtype.kind in "biufc":
        out[name] = condensed(array)


def _parts(thing: Any, skipped: set[str], properties: bool) -> Mapping[Any, Any] | None:
    """What a container holds, by name; None of an array or a number."""
    if isinstance(thing, BlockCovariance):
        return _of_covariance(thing)
    if is_dataclass(thing):
        names = [f.name for f in fields(thing) if not f.name.startswith("_")]
        names += _properties(type(thing)) if properties else []
        return {n: getattr(thing, n) for n in names if n not in skipped}
    if isinstance(thing, Mapping):
        return thing
    if isinstance(thing, list | tuple) and not all(np.isscalar(x) for x in thing):
        return dict(enumerate(thing))
    return None


def _of_covariance(covariance: BlockCovariance) -> dict[str, Any]:
    """The sign of its eigenvectors, and the order of its blocks, are not looked at."""
    there = np.cos(1.0 + np.arange(covariance.size))
    return {
        "variance": covariance.variance,
        "times": covariance.dense() @ there,
        "rank": covariance.rank,
        "logdet": covariance.logdet(),
        "chi2": float(np.sum(covariance.whiten(there) ** 2)),
    }


def _properties(kind: type) -> list[str]:
    return sorted(
        name
        for name in dir(kind)
        if not name.startswith("_")
        and isinstance(getattr(kind, name, None), property | cached_property)
    )


def condensed(array: np.ndarray) -> np.ndarray:
    """A few numbers of order one that change where any number of an array does."""
    if np.iscomplexobj(array):
        array = np.stack([array.real, array.imag])
    values = np.asarray(array, dtype=float).ravel()
    finite = np.isfinite(values)
    missing = float(np.cos(np.arange(len(values)))[~finite].sum()) + float((~finite).sum())
    values = np.where(finite, values, 0.0)
    norm = float(np.linalg.norm(values))
    if norm < 1e-30:
        return np.array([-99.0, len(values), missing])
    scaled = values / norm
    if len(values) <= RAW:
        return np.array([np.log10(norm), missing, *scaled])
    rest = scaled - scaled.mean()
    scatter = float(np.linalg.norm(rest))
    numbers = [np.log10(norm), missing, scaled.mean() * np.sqrt(len(values))]
    if scatter < TINY:
        return np.array([*numbers, len(values)])
    place = np.arange(1, PROJECTIONS + 1)[:, None] + np.sqrt(2.0) * np.arange(len(values))
    frequency = np.array([0.31, 0.77, 1.3, 2.1])[:, None]
    return np.array([*numbers, np.log10(scatter), *(np.cos(frequency * place) @ rest / scatter)])

"""Results as columns of numbers, few for each array, to be recorded and compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from scipy.sparse import issparse

from amibayes.units import FloatArray

MOST = 16
"""Longer arrays are recorded by their size, their root mean square and some projections."""

PROJECTIONS = 5
NEGLIGIBLE = 1e-9
"""Parts of an array's largest number below which a number is rounding, and recorded as zero."""


def columns_of(array: Any) -> FloatArray:
    """The numbers of one array that are recorded, (n,).

    Infinite and undefined numbers of a long array are counted, and projected as zeros.
    """
    values = np.asarray(array)
    if np.iscomplexobj(values):
        values = np.stack([values.real, values.imag])
    values = values.astype(float).ravel()
    finite = np.isfinite(values)
    if len(values) > MOST:
        n, kept = len(values), np.where(finite, values, 0.0)
        waves = np.cos(np.outer(np.sqrt(2.0 + np.arange(PROJECTIONS)), 1.0 + np.arange(n)))
        square = np.sqrt((kept**2).mean())
        counts = [float(n), float(finite.sum())]
        return np.array([*counts, square, kept.mean(), *(waves @ kept / np.sqrt(n))])
    # Infinities cannot be compared with a tolerance.
    values = np.where(np.isinf(values), np.sign(values) * 1e99, values)
    largest = np.abs(values[finite]).max(initial=0.0)
    return np.where(np.abs(values) < NEGLIGIBLE * largest, 0.0, values)


def numbers_of(**results: Any) -> dict[str, FloatArray]:
    """Numbers of arrays, of containers of arrays by their fields, and of mappings, by name.

    Texts, functions and what else is no number are left out.
    """
    found: dict[str, FloatArray] = {}
    for name, value in results.items():
        _add(found, name, value)
    return found


def _add(found: dict[str, FloatArray], name: str, value: Any) -> None:
    if issparse(value):
        value = value.toarray()
    if isinstance(value, Mapping):
        for key, part in value.items():
            _add(found, f"{name}.{key}", part)
    elif is_dataclass(value):
        for field in fields(value):
            _add(found, f"{name}.{field.name}", getattr(value, field.name))
    elif isinstance(value, tuple | list) and not _is_array(value):
        for k, part in enumerate(value):
            _add(found, f"{name}.{k}", part)
    elif _is_array(value) and np.size(value):
        found[name] = columns_of(value)


def _is_array(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "biufc"
    except ValueError:  # of unequal lengths
        return False

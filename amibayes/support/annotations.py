"""Whether a value is what an annotation asks for, and both in words."""

from __future__ import annotations

import os
import typing
from collections import abc
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union

import numpy as np
from numpy.typing import ArrayLike

MAX_TEXT = 40
"""Characters of a value that a message shows."""

NUMERIC = "biufc"
"""Kinds of numpy types that are numbers."""


def fits(value: Any, hint: Any) -> bool:
    """Whether a value is what an annotation asks for; what it cannot tell passes."""
    if hint == ArrayLike:
        return _is_numeric(value)
    origin = typing.get_origin(hint)
    if origin in FITS_ORIGIN:
        return bool(FITS_ORIGIN[origin](value, typing.get_args(hint)))
    if hint in FITS_PLAIN:
        return bool(FITS_PLAIN[hint](value))
    if not isinstance(hint, type):
        return True
    if getattr(hint, "_is_protocol", False):
        return _has_all(value, hint)
    return isinstance(value, hint)


def _is_numeric(value: Any) -> bool:
    """Whether numpy makes numbers of a value; rows of different lengths are none."""
    try:
        return np.asarray(value).dtype.kind in NUMERIC
    except ValueError:
        return False


def _is_flag(value: Any) -> bool:
    return isinstance(value, bool | np.bool_)


def _is_number(value: Any) -> bool:
    scalar = isinstance(value, Real) or (isinstance(value, np.ndarray) and value.ndim == 0)
    return scalar and not _is_flag(value)


def _fits_tuple(value: Any, parts: tuple[Any, ...]) -> bool:
    if not isinstance(value, tuple | list | np.ndarray):
        return False
    if len(parts) == 2 and parts[1] is Ellipsis:
        return all(fits(one, parts[0]) for one in value)
    return len(value) == len(parts) and all(map(fits, value, parts))


def _fits_sequence(value: Any, parts: tuple[Any, ...]) -> bool:
    if not isinstance(value, abc.Sequence | np.ndarray):
        return False
    return all(fits(one, part) for part in parts[:1] for one in value)


def _fits_any(value: Any, parts: tuple[Any, ...]) -> bool:
    return any(fits(value, part) for part in parts)


def _has_all(value: Any, protocol: type) -> bool:
    """Whether a value has the public names of a protocol."""
    for base in protocol.__mro__[:-1]:
        if getattr(base, "_is_protocol", False):
            names = [*vars(base), *vars(base).get("__annotations__", {})]
            if not all(hasattr(value, name) for name in names if not name.startswith("_")):
                return False
    return True


FITS_PLAIN: dict[Any, abc.Callable[[Any], bool]] = {
    Any: lambda value: True,
    None: lambda value: value is None,
    type(None): lambda value: value is None,
    float: _is_number,
    int: lambda value: isinstance(value, Integral) and not _is_flag(value),
    bool: _is_flag,
    os.PathLike: lambda value: isinstance(value, os.PathLike),
}
"""Annotations that are a name, and their tests."""

FITS_ORIGIN: dict[Any, abc.Callable[[Any, tuple[Any, ...]], bool]] = {
    Union: _fits_any,
    UnionType: _fits_any,
    Literal: lambda value, parts: isinstance(value, str | int) and value in parts,
    tuple: _fits_tuple,
    abc.Sequence: _fits_sequence,
    abc.Callable: lambda value, parts: callable(value),
    abc.Mapping: lambda value, parts: isinstance(value, abc.Mapping),
    np.ndarray: lambda value, parts: _is_numeric(value),
}
"""Annotations of parts, by what they are made of, and their tests."""


def describe(value: Any) -> str:
    """Say what was given: a number or text as it is, anything else by its class."""
    if value is None or _is_flag(value) or _is_number(value):
        return str(value)
    if isinstance(value, str):
        return repr(value if len(value) <= MAX_TEXT else value[: MAX_TEXT - 1] + "…")
    if isinstance(value, tuple | list):
        kinds = dict.fromkeys(type(part).__name__ for part in value)
        return f"{len(value)} value(s) of the type {', '.join(kinds)}" if value else "empty"
    return _with_article(type(value).__name__)


def wanted(hint: Any) -> str:
    """Say what an annotation asks for."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if hint == ArrayLike or origin is np.ndarray:
        return "an array of numbers"
    if origin in (Union, UnionType):
        words = [wanted(part) for part in parts if part is not type(None)]
        return " or ".join(
            dict.fromkeys(w for w in words if w != "a text" or "a path" not in words)
        )
    if origin is Literal:
        return " or ".join(repr(part) for part in parts)
    if origin in (tuple, abc.Sequence):
        several = origin is abc.Sequence or Ellipsis in parts
        return f"a list of {'' if several else f'{len(parts)} '}{_plural(wanted(parts[0]))}"
    return WORDS.get(hint) or _with_article(getattr(hint, "__name__", str(hint)))


WORDS = {
    float: "a number",
    int: "a whole number",
    bool: "True or False",
    str: "a text",
    Path: "a path",
}
"""What annotations are in words."""


def _plural(singular: str) -> str:
    """Several of what `wanted` says."""
    words = singular.removeprefix("an ").removeprefix("a ")
    plain = words.islower() and " or " not in words and not words.startswith("list")
    return f"{words}s" if plain else words


def _with_article(name: str) -> str:
    return f"{'an' if name[:1] in 'AEIOaeio' else 'a'} {name}"

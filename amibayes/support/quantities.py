"""Quantities of astropy at the edges: with a unit, a value becomes what its name asks for."""

from __future__ import annotations

from typing import Any

from amibayes.errors import UsageError

UNITS = {"mas": "mas", "rad": "rad", "deg": "deg", "m": "m", "s": "s", "days": "day"}
"""Last word of a name → unit of its number."""


def plain(name: str, value: Any) -> Any:
    """Give the number of a quantity in the unit that a name ends in.

    Parameters
    ----------
    name : str
        Such as ``separation_mas``.
    value : object
        A quantity, or a tuple or list of them; what has no unit is given back.

    Raises
    ------
    UsageError
        Where the name has no unit, or one that the quantity is not of.
    """
    if isinstance(value, tuple | list):
        return type(value)(plain(name, part) for part in value)
    if not has_unit(value):
        return value
    unit = UNITS.get(name.rpartition("_")[2])
    if unit is None:
        raise UsageError(f"{name} is a plain number, and {value} has a unit")
    try:
        return value.to_value(unit)
    except ValueError as error:
        raise UsageError(f"{name} is in {unit}, which {value} cannot be") from error


def has_unit(value: Any) -> bool:
    """Whether it is a quantity, or holds one."""
    if isinstance(value, tuple | list):
        return any(has_unit(part) for part in value)
    return hasattr(value, "to_value") and hasattr(value, "unit")

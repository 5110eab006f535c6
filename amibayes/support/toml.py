"""Reading TOML so that a fault is named by file, key and what is wrong with it."""

from __future__ import annotations

import difflib
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from amibayes.errors import DataError
from amibayes.units import FloatArray

_MISSING: Any = object()


class Section:
    """One table of a TOML file; every getter checks what it hands out.

    Parameters
    ----------
    values : dict
        The table.
    source : str
        The file, for messages.
    name : str
        Dotted name of the table in the file, empty for the top.
    """

    def __init__(self, values: dict[str, Any], source: str, name: str = "") -> None:
        self._values = values
        self._asked: set[str] = set()
        self.source = source
        self.name = name

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def keys(self) -> list[str]:
        """Keys of the table, in the order of the file."""
        return list(self._values)

    def fault(self, key: str, what: str, remedy: str = "") -> DataError:
        """Make the error that describes what is wrong with ``key``."""
        dotted = f"{self.name}.{key}" if self.name else key
        return DataError(f"key '{dotted}' {what}", source=self.source, remedy=remedy)

    def number(
        self,
        key: str,
        default: float = _MISSING,
        *,
        above: float = -math.inf,
        at_least: float = -math.inf,
        at_most: float = math.inf,
    ) -> float:
        """Return a finite number, within its bounds.

        Raises
        ------
        DataError
            Where it is absent (and has no default), not a number, or out of bounds.
        """
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fault(key, f"is {value!r}, not a number")
        if not math.isfinite(value):
            raise self.fault(key, f"is {value}, not a finite number")
        if value <= above or value < at_least:
            bound = f"above {above:g}" if value <= above else f"at least {at_least:g}"
            raise self.fault(key, f"is {value:g}; it must be {bound}")
        if value > at_most:
            raise self.fault(key, f"is {value:g}; it must be at most {at_most:g}")
        return float(value)

    def whole(
        self, key: str, default: int = _MISSING, *, at_least: int = 0, at_most: int | None = None
    ) -> int:
        """Return a whole number between ``at_least`` and ``at_most``."""
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.fault(key, f"is {value!r}, not a whole number")
        if value < at_least:
            raise self.fault(key, f"is {value}; it must be at least {at_least}")
        if at_most is not None and value > at_most:
            raise self.fault(key, f"is {value}; it must be at most {at_most}")
        return value

    def flag(self, key: str, default: bool = _MISSING) -> bool:
        """Return true or false."""
        value = self._get(key, default)
        if not isinstance(value, bool):
            raise self.fault(key, f"is {value!r}, neither true nor false")
        return value

    def text(self, key: str, default: str = _MISSING, *, choices: tuple[str, ...] = ()) -> str:
        """Return a string, one of ``choices`` where these are given."""
        value = self._get(key, default)
        if not isinstance(value, str):
            raise self.fault(key, f"is {value!r}, not a text")
        if choices and value not in choices:
            raise self.fault(key, f"is '{value}'", f"choose from {', '.join(choices)}")
        return value

    def numbers(self, key: str, *, columns: int | None = None) -> FloatArray:
        """Return a list of finite numbers, or of rows of ``columns`` numbers."""
        value = self._get(key, _MISSING)
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError):
            raise self.fault(key, "is not a list of numbers") from None
        wanted = 1 if columns is None else 2
        if array.ndim != wanted or (columns is not None and array.shape[1] != columns):
            shape = "numbers" if columns is None else f"rows of {columns} numbers"
            raise self.fault(key, f"is not a list of {shape}")
        if not np.all(np.isfinite(array)):
            raise self.fault(key, "holds a number that is not finite")
        return array

    def scalars(self) -> dict[str, str | float]:
        """Return all keys of a table of texts and numbers.

        Raises
        ------
        DataError
            Where one is something else.
        """
        found: dict[str, str | float] = {}
        for key in self._values:
            value = self._get(key, _MISSING)
            found[key] = self.text(key) if isinstance(value, str) else self.number(key)
        return found

    def section(self, key: str) -> Section:
        """Return the table called ``key``."""
        value = self._get(key, _MISSING)
        if not isinstance(value, dict):
            raise self.fault(key, "is not a table")
        return Section(value, self.source, f"{self.name}.{key}" if self.name else key)

    def sections(self, key: str) -> list[Section]:
        """Return the array of tables called ``key`` (``[[key]]`` in the file)."""
        value = self._get(key, [])
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise self.fault(key, "is not a list of tables", f"write [[{key}]]")
        return [
            Section(entry, self.source, f"{key}[{number}]") for number, entry in enumerate(value, 1)
        ]

    def refuse_unknown(self, known: tuple[str, ...] = ()) -> None:
        """Refuse keys that nobody asked for: most are spelling mistakes.

        Raises
        ------
        DataError
            Naming the first such key and the nearest known one.
        """
        allowed = self._asked | set(known)
        for key in self._values:
            if key not in allowed:
                near = difflib.get_close_matches(key, allowed, n=1)
                raise self.fault(key, "is not known", f"did you mean '{near[0]}'?" if near else "")

    def _get(self, key: str, default: Any) -> Any:
        self._asked.add(key)
        value = self._values.get(key, default)
        if value is _MISSING:
            raise self.fault(key, "is missing")
        return value


def read_toml(path: str | Path) -> Section:
    """Read a TOML file.

    Raises
    ------
    DataError
        Where it cannot be opened or is not TOML.
    """
    try:
        with Path(path).open("rb") as stream:
            return Section(tomllib.load(stream), str(path))
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", source=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"is not valid TOML: {error}", source=path) from error

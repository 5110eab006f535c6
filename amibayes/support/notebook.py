"""Containers as an interpreter and a notebook show them: a few lines, arrays by their shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from html import escape

import numpy as np

Rows = Sequence[tuple[str, object]]

MAX_TEXT = 90
"""Characters of one value: a line then fits on a terminal of 120 columns with its name."""


class Shown:
    """A container that is shown as its class and rows of name and value.

    Dataclasses that inherit it are made with ``repr=False``, or their own text would come first.
    """

    def rows(self) -> Rows:
        """Names and values, for a reader; by default all fields that are not private."""
        if not is_dataclass(self):
            return ()
        values = ((f.name, getattr(self, f.name)) for f in fields(self) if f.repr)
        return [(name, value) for name, value in values if name[0] != "_" and value is not None]

    def __repr__(self) -> str:
        rows = [(name, short(value)) for name, value in self.rows()]
        wide = max((len(name) for name, _ in rows), default=0)
        return "\n".join(
            [type(self).__name__, *(f"  {name:{wide}}  {text}" for name, text in rows)]
        )

    def _repr_html_(self) -> str:
        """Show it in a notebook."""
        return html_table(type(self).__name__, (), [(n, short(v)) for n, v in self.rows()])


def short(value: object) -> str:
    """A value in a line: text as it is, arrays by type and shape, containers by their class."""
    if isinstance(value, np.ndarray):
        if value.ndim == 0 or value.size <= 3:
            return str(value)
        return f"{value.dtype.name} array {value.shape}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple | list) and any(map(_is_large, value)):
        return f"{len(value)} of {' or '.join(dict.fromkeys(type(v).__name__ for v in value))}"
    text = _named(value) if _is_large(value) else " ".join(str(value).split())
    return text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 1] + "…"


def _named(value: object) -> str:
    """Class of a container, with its name where it has one."""
    name = getattr(value, "name", "")
    return f"{type(value).__name__} {name if isinstance(name, str) else ''}".rstrip()


def _is_large(value: object) -> bool:
    """Whether a value has parts that would fill a page."""
    return isinstance(value, np.ndarray) or is_dataclass(value) or isinstance(value, Shown)


def html_table(title: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Lay texts out as a small HTML table; everything is escaped."""

    def line(cells: Sequence[object], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(str(c))}</{tag}>" for c in cells) + "</tr>"

    head = line(header, "th") if header else ""
    body = "".join(line(row, "td") for row in rows)
    caption = f'<caption style="text-align:left"><strong>{escape(title)}</strong></caption>'
    return f"<table>{caption}{head}{body}</table>"


def ranged(value: float, ends: Sequence[float], digits: str = ".3g") -> str:
    """A value with its interval of 95 %."""
    low, high = ends
    return f"{value:{digits}} (95 %: {low:{digits}} to {high:{digits}})"

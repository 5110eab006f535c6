"""A self-contained HTML page: words, numbers, tables and pictures in one file.

A page is data: `Page` holds a statement and sections, `page_html` turns it into one file
that needs nothing else (no font, no picture, no script from anywhere), and every text in it
is escaped. Its one script is named by its digest, so that no other can run; without scripts the
pictures stay as they are, and what a reader could move over is left out. Any command can make
a page of its own result this way.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from amibayes import __version__
from amibayes.errors import DataError
from amibayes.support.atomic_files import write_text

Kind = Literal["found", "none", "open"]
"""Of a statement: something is there, nothing is, or nothing is claimed."""

MAX_ON_A_TELEPHONE = 4
"""Columns of named rows that fit beside each other on a telephone."""

SCRIPTS = ("pictures.js", "explorer.js")
"""Files of `templates` that are the page's script: dark pictures, then maps to hover over."""

PNG_HEAD = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Column:
    """A column of a table; numbers are aligned to the right, code may break anywhere."""

    title: str
    kind: Literal["text", "number", "code"] = "number"


@dataclass(frozen=True)
class Table:
    """Rows of texts under columns; every row has one text for each column."""

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError(f"a row of {self.caption!r} has not one text for each column")

    @property
    def stacks(self) -> bool:
        """Whether its rows are too wide for a telephone and are stacked there."""
        kinds = [column.kind for column in self.columns]
        return "code" in kinds or (kinds[0] == "text" and len(kinds) > MAX_ON_A_TELEPHONE)


@dataclass(frozen=True)
class Fact:
    """A number with its name, and one line on what it means."""

    name: str
    value: str
    meaning: str = ""


@dataclass(frozen=True)
class Figure:
    """A picture of the page.

    Parameters
    ----------
    name : str
        Of its file, without the ending.
    title : str
        What it shows, in a few words.
    alt : str
        What it shows, for those who cannot see it.
    uri : str
        The PNG itself as a ``data:`` address.
    width, height : int
        Pixels.
    section : str
        Of the page, where the page sorts its pictures.
    """

    name: str
    title: str
    alt: str
    uri: str
    width: int
    height: int
    section: str = ""

    @property
    def aspect(self) -> float:
        """Width by height."""
        return self.width / self.height


@dataclass(frozen=True)
class Mark:
    """A place on the sketch of the sky."""

    east_mas: float
    north_mas: float
    kind: Literal["companion", "candidate", "mode"]


@dataclass(frozen=True)
class Sky:
    """A sketch of the field: north up, east left, the star in the middle."""

    inner_mas: float
    outer_mas: float
    marks: tuple[Mark, ...]
    description: str

    @property
    def scale_mas(self) -> float:
        """The half width of the sketch."""
        return 1.08 * self.outer_mas

    @property
    def bar_mas(self) -> float:
        """Length of the scale bar: the largest 1, 2, 5 × 10ⁿ within 40 % of the half width."""
        room = 0.4 * self.scale_mas
        power = 10.0 ** int(f"{room:e}".split("e")[1])
        return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= room)


@dataclass(frozen=True)
class Section:
    """A heading and what is under it, in this order; an explorer comes before the tables."""

    title: str
    text: tuple[str, ...] = ()
    facts: tuple[Fact, ...] = ()
    tables: tuple[Table, ...] = ()
    code: str = ""
    notes: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    explorer: Mapping[str, Any] | None = None

    @property
    def rows(self) -> tuple[tuple[Figure, ...], ...]:
        """Pictures two by two; a row is as high as both, whose widths go with their shapes."""
        pairs = zip_longest(self.figures[::2], self.figures[1::2])
        return tuple(tuple(f for f in pair if f is not None) for pair in pairs)

    @property
    def anchor(self) -> str:
        """The name that links use."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.casefold()).strip("-")


@dataclass(frozen=True)
class Statement:
    """The answer in words: a label, one sentence, and what qualifies it."""

    kind: Kind
    label: str
    headline: str
    sentences: tuple[str, ...] = ()


@dataclass(frozen=True)
class Page:
    """A page, from the answer down to the details.

    Parameters
    ----------
    command : str
        The command that made it, such as ``amibayes search``.
    title : str
    subtitle : str
    statement : Statement
    facts : tuple of Fact
        The few numbers under the statement.
    sections : tuple of Section
    sky : Sky, optional
    warnings : tuple of str, optional
        None where the page has none to give; empty where there are none.
    """

    command: str
    title: str
    subtitle: str
    statement: Statement
    facts: tuple[Fact, ...] = ()
    sections: tuple[Section, ...] = ()
    sky: Sky | None = None
    warnings: tuple[str, ...] | None = None


@cache
def environment() -> Environment:
    """Give the templates of pages: every text in them is escaped."""
    environment = Environment(
        loader=PackageLoader("amibayes.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["pairs"] = zip
    environment.filters["embedded"] = _embedded
    return environment


def page_html(page: Page) -> str:
    """Turn a page into the text of one HTML file."""
    template = environment().get_template("page.html")
    script = _script()
    # Only this very text may run: nothing that a file's name brings in is a script.
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    settings = {"version": __version__, "script": Markup(script), "digest": digest}
    return template.render(page=page, **settings) + "\n"


@cache
def _script() -> str:
    """Text of the page's script."""
    parts = resources.files("amibayes.report") / "templates"
    return "\n".join((parts / name).read_text(encoding="utf-8") for name in SCRIPTS)


def _embedded(content: Mapping[str, Any]) -> Markup:
    """JSON that can stand in a page: nothing in it ends the element that holds it."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    return Markup(text.replace("<", "\\u003c"))


def write_page(path: str | Path, page: Page) -> None:
    """Write a page as HTML, whole or not at all."""
    write_text(path, page_html(page))


def read_figure(path: str | Path, title: str, alt: str, section: str = "") -> Figure:
    """Take a PNG into a page.

    Raises
    ------
    DataError
        Where the file cannot be read or is no PNG.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", source=path) from error
    if not content.startswith(PNG_HEAD) or len(content) < 24:
        raise DataError("is no PNG", source=path)
    width, height = struct.unpack(">II", content[16:24])
    uri = "data:image/png;base64," + base64.b64encode(content).decode("ascii")
    return Figure(Path(path).stem, title, alt, uri, width, height, section)

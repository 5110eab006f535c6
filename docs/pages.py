"""Tables that scripts make, between the lines of a page that mark them.

    python -m benchmarks.survey_study cost | python docs/pages.py howto/survey.md \\
        "cost: benchmarks/survey_study.py"

puts the tables that a script prints (lines that begin with ``|``) where the page has the marks
``cost: benchmarks/survey_study.py`` and, for a second table, the same with `` 2``. Scripts of this
folder call `put_table` themselves.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import made_with


def put_table(
    page: str, lines: Sequence[str], mark: str, answers: Sequence[Mapping[str, Any]] = ()
) -> None:
    """Replace what is between ``<!-- mark -->`` and ``<!-- end of mark -->``.

    With which code it was made is recorded, see `made_with`.

    Parameters
    ----------
    page : str
        A page of the documentation, relative to this folder.
    lines : sequence of str
    mark : str
        Name of the table and the script that makes it: ``table: docs/power.py``.
    answers : sequence of mapping
        Kept answers that it is made of (`trials`). Where some are older than the code, so is the
        table, and nothing is recorded.

    Raises
    ------
    ValueError
        Where the page has no such mark.
    """
    path = Path(__file__).parent / page
    begin, end = f"<!-- {mark} -->\n", f"<!-- end of {mark} -->\n"
    head, found, rest = path.read_text(encoding="utf-8").partition(begin)
    _, closed, tail = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page} has no lines {begin.strip()} and {end.strip()}")
    text = "\n".join([begin, *lines, "", end])
    path.write_text(head + text + tail, encoding="utf-8")
    script = mark.partition(": ")[2].split()[0]
    if all(answer.get("code") == made_with.code_of(script) for answer in answers):
        made_with.record(script)


def put_tables(page: str, printed: Iterable[str], mark: str) -> None:
    """Put the tables that a script printed at its marks: ``mark``, ``mark 2`` and so on."""
    runs = groupby(printed, key=lambda line: line.startswith("|"))
    tables = [[line.rstrip() for line in lines] for is_table, lines in runs if is_table]
    for n, table in enumerate(tables, start=1):
        put_table(page, table, mark if n == 1 else f"{mark} {n}")


if __name__ == "__main__":
    put_tables(sys.argv[1], sys.stdin, sys.argv[2])

"""Answers of many trials, kept in a file as they come: a script that was cut off goes on.

Each answer has a digest of the code that it was found with (``code``): a table of older answers
does not count as made with the code of today.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from made_with import code_of

Answer = dict[str, Any]


def known_answers(path: Path) -> list[Answer]:
    """Read the answers of a file, one JSON object a line; a line that was cut short is none."""
    lines = path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []
    return [json.loads(line) for line in lines]


def keep_answer(path: Path, answer: Answer, script: str) -> None:
    """Put one more answer of a script, relative to the root of the clone, into a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(answer | {"code": code_of(script)}, default=float) + "\n")


def forget_answers(path: Path, which: Callable[[Answer], bool]) -> None:
    """Take answers out of a file."""
    kept = [answer for answer in known_answers(path) if not which(answer)]
    path.write_text("".join(json.dumps(answer) + "\n" for answer in kept), encoding="utf-8")


def answers(path: Path, n: int, trial: Callable[[int], Answer], script: str) -> list[Answer]:
    """Give the answers of trials 0 to n − 1: those of the file, then new ones, put there at once.

    Parameters
    ----------
    path : path
    n : int
    trial : callable
        Its answer depends on the number alone, so that any n goes on from any other.
    script : str
        As for `keep_answer`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    known = known_answers(path)
    whole = "".join(json.dumps(answer) + "\n" for answer in known)
    path.write_text(whole, encoding="utf-8")
    for k in range(len(known), n):
        keep_answer(path, trial(k), script)
    return known_answers(path)[:n]

"""Whether two runs were asked the same: what every ``--resume`` goes by.

A request is the digest of all that an answer depends on: the version of amibayes, the content
and the order of the files, and every option. It is part of the JSON of the answer, names the
folder of a journal, and belongs to the chain of a posterior.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amibayes import __version__
from amibayes.errors import DataError, UsageError
from amibayes.support.atomic_files import sha256


def request_of(
    targets: Sequence[str | Path], calibrators: Sequence[str | Path], *options: Any
) -> str:
    """Digest what is asked: files by their content, and options.

    Raises
    ------
    DataError
        Where a file cannot be read.
    """
    try:
        return digest([Path(p) for p in targets], [Path(p) for p in calibrators], *options)
    except OSError as error:
        raise DataError(
            f"cannot be read: {error.strerror or error}", source=error.filename
        ) from error


def read_answer(path: Path) -> dict[str, Any] | None:
    """Read the JSON of an answer; None where there is none that can be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def answers(path: Path, request: str) -> dict[str, Any] | None:
    """Give the answer to this very request; None where the file is not it."""
    content = read_answer(path)
    return content if content and request and content.get("request") == request else None


def refuse_other(path: Path, request: str, journal: Path) -> None:
    """Refuse to go on where the answer to another request is, unless this one was begun.

    Parameters
    ----------
    path : Path
        Of the answer.
    request : str
    journal : Path
        Folder of journals.

    Raises
    ------
    UsageError
    """
    begun = (journal / request).is_dir()
    if path.is_file() and not begun and answers(path, request) is None:
        raise UsageError(
            "is the result of other data or options, or of another version",
            source=path,
            remedy="give --overwrite or another --out",
        )


def digest(*inputs: Any) -> str:
    """Hexadecimal digest of everything that a job's answer depends on.

    Parameters
    ----------
    *inputs
        Numbers, text, arrays, paths (the file's content counts, not its name), seeds,
        frozen dataclasses, and lists, tuples and dictionaries of these. The version of
        amibayes is always part of it.

    Raises
    ------
    TypeError
        For anything else, since a digest that misses an input would revive stale work.
    """
    running = hashlib.sha256(__version__.encode())
    for item in inputs:
        _feed(running, item)
    return running.hexdigest()[:32]


def _feed(running: Any, item: Any) -> None:
    running.update(f"<{type(item).__name__}>".encode())
    if isinstance(item, np.ndarray):
        running.update(f"{item.dtype.str}{item.shape}".encode())
        running.update(np.ascontiguousarray(item).tobytes())
    elif isinstance(item, Path):
        running.update(sha256(item).encode())
    elif (parts := _parts(item)) is not None:
        running.update(f"{len(parts)}".encode())
        for part in parts:
            _feed(running, part)
    else:
        running.update(_text(item).encode())


def _parts(item: Any) -> list[Any] | None:
    """Give the inputs that an input consists of; None for a single value."""
    if is_dataclass(item) and not isinstance(item, type):
        return [(field.name, getattr(item, field.name)) for field in fields(item)]
    if isinstance(item, np.random.SeedSequence):
        return [item.entropy, item.spawn_key, item.pool_size]
    if isinstance(item, Mapping):
        return sorted(item.items())
    if isinstance(item, list | tuple):
        return list(item)
    return None


def _text(item: Any) -> str:
    if isinstance(item, np.generic):
        item = item.item()
    if isinstance(item, complex):
        item = [item.real, item.imag]
    if isinstance(item, bytes):
        item = item.hex()
    return json.dumps(item)

"""Writing files whole or not at all, and saying what a file was."""

from __future__ import annotations

import errno
import glob
import hashlib
import json
import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows has other locks
    fcntl = None  # type: ignore[assignment]

from amibayes.errors import RunError, UsageError

TEMPORARY = ".{}.{}{}"
"""Name of a file that is being written: stem, 8 random digits, suffix."""


@contextmanager
def atomic_path(path: str | Path, *, lasting: bool = True) -> Iterator[Path]:
    """Give a temporary path beside ``path`` that replaces it when the block succeeds.

    Parameters
    ----------
    path : path
    lasting : bool
        Force it to the disk, so that a power cut leaves it whole.

    Raises
    ------
    RunError
        Where the folder cannot be written or the disk is full.
    """
    final = Path(path)
    temporary = final.with_name(TEMPORARY.format(final.stem, secrets.token_hex(4), final.suffix))
    HALF_WRITTEN.add(temporary)
    try:
        # Made with the mode of any new file: asking for the umask would change it for a moment,
        # for all threads.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        if lasting:
            _flush(temporary)
        temporary.replace(final)
        if lasting:
            _flush(final.parent)
    except OSError as error:
        raise cannot_write(final, error) from error
    finally:
        with suppress(OSError):  # it is not there, or where it was to be is no folder
            temporary.unlink()
        HALF_WRITTEN.discard(temporary)


HALF_WRITTEN: set[Path] = set()
"""Temporary files of this process: one that must end at once removes them."""


def _flush(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk: a power cut then leaves it whole."""
    if path.is_dir() and os.name == "nt":
        return  # Windows does not open folders
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that cannot
            raise
    finally:
        os.close(handle)


def cannot_write(path: Path, error: OSError) -> RunError:
    """Describe in one line an output that could not be written."""
    return RunError(
        f"cannot be written: {_reason(error)}",
        source=path,
        remedy="choose a writable folder with space left",
    )


def _reason(error: OSError) -> str:
    """The message of the system, without what a library wraps around it."""
    return os.strerror(error.errno) if error.errno else str(error)


def write_text(path: str | Path, text: str) -> None:
    """Write ``text`` to ``path``, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, content: Any) -> None:
    """Write strict JSON (no NaN, no infinity) to ``path``, whole or not at all."""
    write_text(path, to_json(content))


def to_json(content: Any) -> str:
    """Strict, indented JSON text; a NaN in it is a programming error."""
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as stream:
        while chunk := stream.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def short_names(paths: Sequence[str | Path]) -> list[str]:
    """Names of files, with as many of their folders as it takes to be distinct."""
    parts = [Path(path).parts for path in paths]
    names = []
    for mine in parts:
        others = [other for other in parts if other != mine]
        depth = 1
        while depth < len(mine) and any(o[-depth:] == mine[-depth:] for o in others):
            depth += 1
        names.append(str(Path(*mine[-depth:])) if mine else "")
    return names


@dataclass
class _OutputRun:
    """A run's folders: each with the handle that locks it, and those that were not there."""

    outer: _OutputRun | None = None
    held: dict[Path, int] = field(default_factory=dict)
    made: set[Path] = field(default_factory=set)

    def has(self, folder: Path) -> bool:
        """Whether this run, or the one that it is a part of, writes into a folder."""
        return folder in self.held or (self.outer is not None and self.outer.has(folder))


_WITHOUT_RUN = _OutputRun()
"""Of calls outside of `output_locks`: their locks end with the process."""

_run: ContextVar[_OutputRun] = ContextVar("run", default=_WITHOUT_RUN)
"""The run of this thread: several may write into folders of their own in one process."""


@contextmanager
def output_locks() -> Iterator[None]:
    """Let go, at the end, of the folders that `output_folder` has taken meanwhile.

    Those that it made and nothing was written into are taken away again. Locks belong to the
    run that took them, not to the process: other threads have runs of their own.
    """
    own = _OutputRun(_run.get())
    token = _run.set(own)
    try:
        yield
    finally:
        _run.reset(token)
        for folder in own.made:
            with suppress(OSError):  # what holds files stays
                folder.rmdir()
        for handle in own.held.values():
            os.close(handle)


def _sweep(folder: Path, names: Sequence[str]) -> None:
    """Take away what a run that was killed while it wrote these files has left of them."""
    for name in map(Path, names):
        if len(name.parts) == 1:
            pattern = TEMPORARY.format(glob.escape(name.stem), "[0-9a-f]" * 8, name.suffix)
            for left in folder.glob(pattern):
                left.unlink(missing_ok=True)


def _hold(folder: Path) -> bool:
    """Keep other runs out of a folder; the lock ends with this process, however it ends.

    Returns
    -------
    bool
        Whether it was taken now: nobody else writes there.

    Raises
    ------
    UsageError
        Where another run has it.
    """
    key = folder.resolve()
    run = _run.get()
    if fcntl is None or run.has(key):
        return False
    handle = os.open(key, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise UsageError(
            "another run is writing here", source=folder, remedy="wait for it, or choose --out"
        ) from None
    except OSError:  # a file system without locks: nothing can be known, and work goes on
        os.close(handle)
        return False
    run.held[key] = handle
    return True


def output_folder(folder: str | Path, names: list[str], *, overwrite: bool) -> Path:
    """Make ``folder`` ready for files called ``names``, and keep other runs out of it.

    The lock is released by `output_locks`, or with the process; a folder that stays empty goes
    with it.

    Raises
    ------
    UsageError
        Where one of the files is there already and ``overwrite`` is false, where another
        run has the folder, or where it is a file, cannot be made or not be written into.
    """
    path = Path(folder)
    is_new = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"cannot be made a folder: {error.strerror}", source=path, remedy="choose another --out"
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise UsageError("cannot be written into", source=path, remedy="choose another --out")
    if is_new:
        _run.get().made.add(path.resolve())
    if _hold(path):
        _sweep(path, names)
    present = [name for name in names if (path / name).exists()]
    if present and not overwrite:
        raise UsageError(
            "is there already", source=path / present[0], remedy="give --overwrite or another --out"
        )
    return path

"""The journal of finished pieces: a killed run goes on where it stopped.

One file per piece, written whole or not at all, in a folder named after the digest of
everything that the job's answer depends on: a journal of other inputs is never read.
"""

from __future__ import annotations

import shutil
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.parallel.kept_stages import read_stage, write_stage
from amibayes.support.atomic_files import atomic_path, cannot_write
from amibayes.support.interrupts import ending

NAMES = {"null": "the null searches", "limits": "the injections"}
"""What the jobs of a search are called."""

STAGE = "stage-{}.pickle"
"""Name of the file of a finished stage."""

Columns = dict[str, NDArray[Any]]
"""What a journalled piece returns: named arrays."""


class Journal:
    """Finished pieces of one job in a folder.

    Parameters
    ----------
    folder : path
        Where journals live; made if missing.
    key : str
        Digest of the job's inputs (`amibayes.support.request.digest`).
    resume : bool
        Keep the pieces that are there; otherwise start afresh.

    Raises
    ------
    RunError
        Where the folder cannot be written.
    """

    def __init__(self, folder: str | Path, key: str, *, resume: bool) -> None:
        self.path = Path(folder) / key
        if not resume:
            self.remove()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def read(self, index: int) -> Columns | None:
        """Give the arrays of a finished piece; None where it has to be computed."""
        try:
            with np.load(self._file(index), allow_pickle=False) as stored:
                return {name: stored[name] for name in stored.files}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            return None

    def write(self, index: int, columns: Mapping[str, Any]) -> Columns:
        """Record a finished piece and return it as `read` will give it."""
        arrays = {name: np.asarray(column) for name, column in columns.items()}
        with atomic_path(self._file(index)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
        return arrays

    def remove(self) -> None:
        """Forget all pieces of this job; a folder of journals that is empty then goes too."""
        _forget(self.path)

    def _file(self, index: int) -> Path:
        return self.path / f"piece-{index:06d}.npz"


class Journals:
    """Journals of the several jobs of one run, each under a name of its own.

    Parameters
    ----------
    folder, key, resume
        As for `Journal`.
    """

    def __init__(self, folder: str | Path, key: str, *, resume: bool) -> None:
        self.path = Path(folder) / key
        self._resume = resume
        if not resume:
            self.remove()

    def of(self, job: str) -> Journal:
        """Open the journal of a job."""
        return Journal(self.path, job, resume=self._resume)

    def read_stage(self, stage: str) -> Any | None:
        """Give what a finished stage made; None where it has to be done."""
        return read_stage(self.path / STAGE.format(stage)) if self._resume else None

    def write_stage(self, stage: str, result: Any) -> None:
        """Keep what a stage made, which has now ended.

        Raises
        ------
        RunError
            Where the folder cannot be written or the disk is full.
        """
        path = self.path / STAGE.format(stage)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(path, error) from error
        write_stage(path, result)

    def under(self, part: str) -> Journals:
        """Open the journals of a part of the run."""
        return Journals(self.path, part, resume=self._resume)

    @contextmanager
    def telling(self, chain: Path | None = None) -> Iterator[None]:
        """Say what is kept where the run is interrupted.

        Parameters
        ----------
        chain : Path, optional
            Of a posterior, which is kept too.
        """
        try:
            with ending():
                yield
        except KeyboardInterrupt:
            raise KeyboardInterrupt(self.kept(chain)) from None

    def kept(self, chain: Path | None = None) -> str:
        """Say in words what a run that is cut off leaves for `resume`."""
        begin, end = STAGE.split("{}")
        files = sorted(self.path.rglob(STAGE.format("*")), key=lambda path: path.stat().st_mtime_ns)
        ended = list(dict.fromkeys(path.name[len(begin) : -len(end)] for path in files))
        pieces = sorted(self.path.rglob("piece-*.npz"), reverse=True)  # null searches come first
        folders = [path.relative_to(self.path).parts[:-1] for path in pieces]
        stages = Counter(
            next((NAMES[part] for part in parts if part in NAMES), parts[0]) for parts in folders
        )
        parts = [f"the stages {', '.join(ended)}"] if ended else []
        parts += [f"{n} piece{'' if n == 1 else 's'} of {name}" for name, n in stages.items()]
        if chain is not None and chain.is_file():
            parts.append("the chain so far")
        return f"kept {', '.join(parts)}" if parts else "no stage that can be kept was begun"

    def remove(self) -> None:
        """Forget all jobs of this run; a folder of journals that is empty then goes too."""
        _forget(self.path)


def _forget(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.parent.rmdir()

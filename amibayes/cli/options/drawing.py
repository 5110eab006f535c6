"""Pictures of a run, drawn by processes of their own where there are cores for them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from amibayes.errors import RunError

if TYPE_CHECKING:
    from amibayes.parallel import Beside, Executor
    from amibayes.pipeline.report_types import SearchReport


def draw(arguments: argparse.Namespace, save: Callable[..., Any], *of: object) -> Any:
    """Let pictures be drawn, and for a target of a table in a process that draws those of all.

    Without a table ``save`` gets, beside what they are of, an executor for several at a time.
    """
    from amibayes.parallel import run_apart

    if getattr(arguments, "in_batch", False):
        return run_apart(save, *of)
    with closing(_executor(arguments)) as executor:
        return save(*of, executor)


def _executor(arguments: argparse.Namespace) -> Executor:
    """Draw at once what the cores allow: workers that are no forks load longer than they draw."""
    from amibayes.parallel import ForkExecutor, SerialExecutor

    n = _processes(arguments)
    return ForkExecutor(n, first_here=False) if n > 1 else SerialExecutor()


def _processes(arguments: argparse.Namespace) -> int:
    """Number of processes that draw."""
    from amibayes.parallel import CAN_FORK, at_hand

    elsewhere = arguments.scheduler is not None or not CAN_FORK
    return 1 if elsewhere else arguments.workers or at_hand()


class Drawing:
    """Pictures of a search: those of its first stages are drawn while the last ones run.

    Parameters
    ----------
    arguments : argparse.Namespace
    folder : path
    apart : path
        Where pictures wait for the end of the run: until then those of an older one stay.
    """

    def __init__(self, arguments: argparse.Namespace, folder: Path, apart: Path) -> None:
        self._arguments, self._folder, self._apart = arguments, folder, apart
        self._beside: Beside | None = None
        self._begun: list[Path] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._beside is not None:
            self._beside.end()

    def begin(self, report: SearchReport) -> None:
        """Draw what there is of a report in a process beside this one."""
        if self._arguments.no_pictures or _processes(self._arguments) == 1:
            return
        from amibayes.parallel import Beside
        from amibayes.plots.pictures import picture_files, save_pictures

        self._apart.mkdir(parents=True, exist_ok=True)
        # Where the system has no room for a process they are drawn here in the end.
        with suppress(RunError):
            self._beside = Beside(partial(save_pictures, report), self._apart)
            self._begun = picture_files(report, self._folder)

    def finish(self, report: SearchReport) -> list[Path]:
        """Draw what is left; give the files of all pictures."""
        if self._arguments.no_pictures:
            return []
        from amibayes.plots.pictures import draw_files, picture_files, save_pictures

        if self._beside is None:
            drawn: list[Path] = draw(self._arguments, save_pictures, report, self._folder)
            return drawn
        files = picture_files(report, self._folder)
        with closing(_executor(self._arguments)) as executor:
            draw_files(report, [path for path in files if path not in self._begun], executor)
        if self._beside.result() is None:  # a process that was killed, for want of memory say
            save_pictures(report, self._folder)
            return files
        for path in self._apart.iterdir():
            path.replace(self._folder / path.name)
        return files

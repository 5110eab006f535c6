"""What all stages of a run share: executor, journals and progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TypeVar

from amibayes.parallel import Executor, Journal, Journals, Progress

Made = TypeVar("Made")

Announce = Callable[[str], None]


def silent(stage: str) -> None:
    """Announce nothing."""


@dataclass(frozen=True)
class Run:
    """One run of a job.

    Parameters
    ----------
    announce : callable
        Called with the name of each stage as it begins.
    progress : callable, optional
        Called with (done, expected) within the longer stages.
    executor : Executor, optional
        Where null draws and injections are computed; the result does not depend on it.
    journals : Journals, optional
        Keep finished pieces, so that a run that was cut off goes on.
    seconds : dict
        What each stage took, filled in as they end.
    """

    announce: Announce = silent
    progress: Progress | None = None
    executor: Executor | None = None
    journals: Journals | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Announce a stage and time it."""
        self.announce(name)
        begin = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - begin

    def keep(self, part: str, make: Callable[[], Made]) -> Made:
        """Give what a part of the job makes, or made before it was cut off.

        Parameters
        ----------
        part : str
            Name of its file.
        make : callable
            Ends by giving all that the rest of the job takes from it; random numbers that it
            draws are its own.
        """
        if self.journals is None:
            return make()
        kept: tuple[Made, dict[str, float]] | None = self.journals.read_stage(part)
        if kept is None:
            before = set(self.seconds)
            made = make()
            own = {name: s for name, s in self.seconds.items() if name not in before}
            self.journals.write_stage(part, (made, own))
            return made
        self.seconds.update(kept[1])
        return kept[0]

    def keep_stage(self, part: str, make: Callable[[], Made], name: str = "") -> Made:
        """Do a stage, announced by its name or that of the part, unless it is kept."""

        def timed() -> Made:
            with self.stage(name or part):
                return make()

        return self.keep(part, timed)

    def journal(self, job: str) -> Journal | None:
        """Open the journal of a job, where finished pieces are kept."""
        return None if self.journals is None else self.journals.of(job)

    def alone(self) -> Run:
        """Give the same run without workers, that tells nothing: of a process beside others."""
        return replace(self, announce=silent, progress=None, executor=None)

    def under(self, part: str) -> Run:
        """Give the same run with journals of a part of their own."""
        if self.journals is None:
            return self
        return replace(self, journals=self.journals.under(part))

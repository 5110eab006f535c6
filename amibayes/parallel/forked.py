"""Processes that are forked from this one: they have all that a job needs in memory.

Others take a second each to load libraries, and get a job's arrays through a pipe, which work of
seconds is not worth. Linux only: libraries of macOS may fail in a forked process, and Windows has
none.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from amibayes.errors import RunError
from amibayes.parallel.processes import Lost, ProcessExecutor, Worker, start
from amibayes.parallel.threads import know_pools, run_here

CAN_FORK = sys.platform == "linux"

MOST_AT_HAND = 4
"""Processes that a run takes unasked: each needs memory of its own, and jobs of one target are
some ten pieces."""

WORTH_A_FORK_S = 0.3
"""Seconds of work from which on processes are forked: that takes 0.05 s, and memory that is then
written to is copied."""


def at_hand() -> int:
    """Number of processes that a run of seconds takes unasked: the cores that it may use.

    One inside a worker process, whose siblings use them.
    """
    if not CAN_FORK or multiprocessing.parent_process() is not None:
        return 1
    return min(len(os.sched_getaffinity(0)), MOST_AT_HAND)


class ForkExecutor(ProcessExecutor):
    """Compute pieces in processes that are forked for each job.

    Parameters
    ----------
    workers : int
    first_here : bool
        Compute the first piece of a job here, and the others too where it tells that they take
        too little time to be worth a fork.
    """

    def __init__(self, workers: int, *, first_here: bool = True) -> None:
        super().__init__(workers)
        self._first_here = first_here

    def map(
        self, function: Callable[[Any], Any], pieces: Sequence[Any], lost: Lost | None = None
    ) -> Iterator[Any]:
        """See `Executor.map`."""
        begun, here = time.perf_counter(), 0
        if self._first_here and len(pieces):
            first, here = run_here(function, pieces[0]), 1
            took = time.perf_counter() - begun
            yield first
            if len(pieces) < 3 or took * (len(pieces) - 1) < WORTH_A_FORK_S:
                yield from (run_here(function, piece) for piece in pieces[1:])
                return
        know_pools()
        try:
            self._workers.append(start(function))
        except RunError:  # no room for a process, which nobody may have asked for
            yield from (run_here(function, piece) for piece in pieces[here:])
            return
        instead = None if lost is None else lambda k, error: lost(k + here, error)
        try:
            yield from super().map(function, pieces[here:], instead)
        finally:
            self.close()  # they know this job only

    def _started(self, function: Callable[[Any], Any]) -> Worker:
        return start(function)


class Beside:
    """One call in a forked process, while this one goes on.

    Parameters
    ----------
    function : callable
    argument : object
        What it is called with; both are as they are now.
    """

    def __init__(self, function: Callable[[Any], Any], argument: Any) -> None:
        know_pools()
        self._worker = start(function)
        self._worker.give(function, 0, argument)

    def result(self) -> Any | None:
        """Wait for what it gives, None where the process is gone; what it raises is raised."""
        try:
            good, answer = self._worker.connection.recv()
        except (EOFError, ConnectionError):
            return None
        finally:
            self.end()
        if not good:
            raise answer
        return answer

    def end(self) -> None:
        """End the process, finished or not."""
        self._worker.end()

"""A job: one function over a list of pieces that is fixed beforehand."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

import numpy as np

from amibayes.errors import UsageError
from amibayes.parallel.cluster import DaskExecutor, MPIExecutor
from amibayes.parallel.forked import CAN_FORK, ForkExecutor
from amibayes.parallel.journal import Journal
from amibayes.parallel.processes import Lost, ProcessExecutor
from amibayes.parallel.progress import Progress
from amibayes.parallel.threads import run_here

Piece = TypeVar("Piece")
Result = TypeVar("Result")


class Executor(Protocol):
    """Something that computes pieces."""

    def map(
        self,
        function: Callable[[Piece], Result],
        pieces: Sequence[Piece],
        lost: Lost | None = None,
    ) -> Iterator[Result]:
        """Give the results in the order of the pieces, each as soon as it may be had.

        ``function`` and the pieces travel to other processes, so the function is one of
        a module (or a ``functools.partial`` of one). Pieces are handed out only a little
        ahead of the consumer, which keeps memory flat. What ``lost`` returns stands for a
        piece that has ended worker after worker; without it the run ends with an error.
        """

    def close(self) -> None:
        """End the workers."""


class SerialExecutor:
    """Compute the pieces here, one after the other."""

    def map(
        self,
        function: Callable[[Piece], Result],
        pieces: Sequence[Piece],
        lost: Lost | None = None,
    ) -> Iterator[Result]:
        """See `Executor.map`."""
        for piece in pieces:
            yield run_here(function, piece)

    def close(self) -> None:
        """Nothing to end."""


@contextmanager
def open_executor(
    workers: int = 1, scheduler: str | None = None, *, forked: bool = False
) -> Iterator[Executor]:
    """Choose where a job runs, and end its workers afterwards.

    Parameters
    ----------
    workers : int
        Processes on this machine; 1 computes in this one.
    scheduler : str, optional
        Address of a running dask scheduler (``tcp://host:8786``), or ``mpi`` for the
        ranks that this program was started with.
    forked : bool
        Fork the processes for each job, where the system can: for jobs of seconds.

    Raises
    ------
    UsageError
        For a number below one or an address of no known kind.
    RunError
        Where the scheduler cannot be reached or its package is missing.
    """
    executor = _choose(workers, scheduler, forked=forked)
    try:
        yield executor
    finally:
        executor.close()


def _choose(workers: int, scheduler: str | None, *, forked: bool) -> Executor:
    if scheduler == "mpi":
        return MPIExecutor()
    if scheduler is not None:
        if "://" not in scheduler:
            raise UsageError(
                f"{scheduler!r} is not an address",
                source="--scheduler",
                remedy="give tcp://host:port, or mpi",
            )
        return DaskExecutor(scheduler)
    if workers < 1:
        raise UsageError(f"{workers} is below one", source="--workers")
    if workers == 1:
        return SerialExecutor()
    return ForkExecutor(workers) if forked and CAN_FORK else ProcessExecutor(workers)


def run_job(
    function: Callable[[Any], Any],
    pieces: Sequence[Any],
    executor: Executor,
    *,
    journal: Journal | None = None,
    progress: Progress | None = None,
    lost: Lost | None = None,
) -> Iterator[Any]:
    """Compute the pieces that are not yet in the journal; give all results in order.

    Parameters
    ----------
    function : callable
        Called with one piece. With a journal it returns a dictionary of arrays.
    pieces : sequence
        The job list.
    executor : Executor
        Where the pieces are computed.
    journal : Journal, optional
        Where finished pieces are kept.
    progress : Progress, optional
        Called after each piece.
    lost : callable, optional
        Called with the index of a piece that has ended worker after worker and the error; what
        it returns is the piece's result. Without it the error is raised.

    Yields
    ------
    object
        Result of each piece, in the order of ``pieces``.
    """
    kept = {i for i in range(len(pieces)) if journal is not None and journal.read(i) is not None}
    todo = [i for i in range(len(pieces)) if i not in kept]
    instead = None if lost is None else lambda k, error: lost(todo[k], error)
    fresh = executor.map(function, [pieces[i] for i in todo], instead)
    report = progress or _ignore
    report(len(kept), len(pieces))
    finished = len(kept)
    for index in range(len(pieces)):
        if journal is not None and index in kept:
            yield journal.read(index)
            continue
        result = next(fresh)
        finished += 1
        report(finished, len(pieces))
        yield result if journal is None else journal.write(index, result)


def _ignore(done: int, total: int) -> None:
    """Take the place of a progress bar that nobody asked for."""


def slices(total: int, size: int) -> list[slice]:
    """Cut ``range(total)`` into slices of ``size`` (the last may be shorter)."""
    return [slice(i * size, min((i + 1) * size, total)) for i in range(math.ceil(total / size))]


def spawn(rng: np.random.Generator, n: int) -> list[np.random.SeedSequence]:
    """Give ``n`` independent seeds, one per piece, that depend on ``rng``'s seed alone."""
    parent = rng.bit_generator.seed_seq
    if not isinstance(parent, np.random.SeedSequence):
        raise TypeError("rng was not made from a SeedSequence (use numpy.random.default_rng)")
    return parent.spawn(n)


def child_seeds(seed: np.random.SeedSequence, n: int) -> list[np.random.SeedSequence]:
    """Give the first ``n`` children of a seed, the same ones however often asked.

    ``SeedSequence.spawn`` counts its children and never gives one twice, so that a job
    run again with the same seed would differ.
    """
    return [
        np.random.SeedSequence(
            seed.entropy, spawn_key=(*seed.spawn_key, k), pool_size=seed.pool_size
        )
        for k in range(n)
    ]

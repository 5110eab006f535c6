"""Processes on this machine.

Each worker has a pipe of its own, so that a worker that is killed, even in the middle of
handing over a result, is seen as the end of its pipe: the piece is given to a new worker
and nothing waits forever. A worker ends by itself as soon as its parent is gone.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any

from amibayes.errors import RunError
from amibayes.parallel.memory import keep_memory
from amibayes.parallel.threads import run_in_worker
from amibayes.support.atomic_files import HALF_WRITTEN

ATTEMPTS = 3
"""How many workers a piece may lose before the run gives up."""

TIDY_S = 1.0
"""How long a forked process may take to leave before it is killed."""

Lost = Callable[[int, RunError], Any]
"""Called with the index of a piece that has cost too many workers, and the error."""


@contextmanager
def _without_interrupt(*, forked: bool) -> Iterator[None]:
    """Hold Ctrl-C back: a process that starts meanwhile never hears it, this one afterwards.

    A worker cannot ignore it by itself before it has started up, which takes a second.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    if not forked:
        # Started with the first process otherwise, and it lets every signal through again.
        resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Worker:
    """One process and this end of its pipe; forked where it is given a function."""

    def __init__(self, function: Callable[[Any], Any] | None = None) -> None:
        forked = function is not None
        context: Any = multiprocessing.get_context("fork" if forked else "spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, function), daemon=True)
        with _without_interrupt(forked=forked), warnings.catch_warnings():
            # Of threads that a child does not have: none of ours holds a lock that it needs.
            warnings.filterwarnings("ignore", ".*fork", DeprecationWarning)
            self.process.start()
        theirs.close()  # or the end of the worker would not be the end of the pipe
        self.piece: int | None = None
        self._knows, self._forked = function, forked

    def give(self, function: Callable[[Any], Any], index: int, piece: Any) -> None:
        """Hand over a piece, and the function only where it is a new one."""
        self.piece = index
        self.connection.send((None if function is self._knows else function, piece))
        self._knows = function

    def end(self) -> None:
        """End the process, whatever it is doing; a forked one may tidy up, it may draw pictures."""
        self.connection.close()
        if self._forked:
            self.process.terminate()
            self.process.join(TIDY_S)
        self.process.kill()
        self.process.join()


def _work(connection: Connection, function: Any) -> None:
    """Compute what comes through the pipe until its other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    signal.signal(signal.SIGTERM, _leave)
    HALF_WRITTEN.clear()  # those of the parent
    _end_with_parent()
    keep_memory()
    while True:
        try:
            new_function, piece = connection.recv()
            function = new_function or function
            answer = True, run_in_worker(function, piece)
        except (EOFError, ConnectionError):
            return
        except Exception as error:  # noqa: BLE001 - travels to the parent, which raises it
            answer = False, _noted(error)
        _send(connection, answer)


def _leave(number: int, frame: FrameType | None) -> None:
    """Remove what is half written, and go at once: an exception may be lost in a callback."""
    for path in tuple(HALF_WRITTEN):
        path.unlink(missing_ok=True)
    os._exit(0)


def _noted(error: Exception) -> Exception:
    """Add the worker's traceback, which does not travel by itself."""
    error.add_note("in a worker process:\n" + "".join(traceback.format_exception(error)))
    return error


def _send(connection: Connection, answer: tuple[bool, Any]) -> None:
    try:
        connection.send(answer)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        connection.send((False, RuntimeError(f"an answer cannot travel: {error}: {answer[1]!r}")))
    except ConnectionError:
        return


def _end_with_parent() -> None:
    """End this process when the one that started it is gone, whatever it is doing."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@dataclass
class _Job:
    """What is left to do, and what is done but not yet handed on."""

    function: Callable[[Any], Any]
    pieces: Sequence[Any]
    todo: deque[int]
    instead: Lost | None = None
    done: dict[int, Any] = field(default_factory=dict)
    lost: Counter[int] = field(default_factory=Counter)
    next: int = 0


class ProcessExecutor:
    """Compute pieces in ``workers`` processes of this machine."""

    def __init__(self, workers: int) -> None:
        if multiprocessing.parent_process() is not None:
            raise RunError(
                "a worker process cannot start workers",
                remedy='in a script, start the work below if __name__ == "__main__":',
            )
        self.workers = workers
        self._workers: list[Worker] = []

    def map(
        self, function: Callable[[Any], Any], pieces: Sequence[Any], lost: Lost | None = None
    ) -> Iterator[Any]:
        """See `Executor.map`.

        Raises
        ------
        RunError
            When a piece has lost three workers.
        """
        job = _Job(function, pieces, deque(range(len(pieces))), lost)
        try:
            for job.next in range(len(pieces)):
                while job.next not in job.done:
                    self._hand_out(job)
                    self._collect(job)
                yield job.done.pop(job.next)
        finally:  # a consumer that stopped early leaves workers at pieces of no use
            self._end([worker for worker in self._workers if worker.piece is not None])

    def close(self) -> None:
        """End the workers."""
        self._end(list(self._workers))

    def _end(self, workers: list[Worker]) -> None:
        for worker in workers:
            self._workers.remove(worker)
            worker.end()

    def _hand_out(self, job: _Job) -> None:
        """Give every idle worker a piece, never far ahead of the consumer."""
        while job.todo and job.todo[0] < job.next + 2 * self.workers:
            worker = self._idle(job)
            if worker is None:
                return
            index = job.todo.popleft()
            try:
                worker.give(job.function, index, job.pieces[index])
            except ConnectionError:
                self._lose(worker, job)

    def _idle(self, job: _Job) -> Worker | None:
        idle = next((worker for worker in self._workers if worker.piece is None), None)
        if idle is None and len(self._workers) < self.workers:
            try:
                idle = self._started(job.function)
            except RunError:
                if self._workers:  # fewer of them do it, too
                    return None
                raise
            self._workers.append(idle)
        return idle

    def _started(self, function: Callable[[Any], Any]) -> Worker:
        """Start a worker, which gets its functions with its pieces."""
        return start()

    def _collect(self, job: _Job) -> None:
        """Wait until a worker has sent something or ended."""
        busy: dict[Any, Worker] = {w.connection: w for w in self._workers if w.piece is not None}
        for connection in wait(list(busy)) if busy else []:
            worker = busy[connection]
            try:
                good, answer = worker.connection.recv()
            except (EOFError, ConnectionError):
                self._lose(worker, job)
                continue
            if not good:
                raise answer
            assert worker.piece is not None
            job.done[worker.piece] = answer
            worker.piece = None

    def _lose(self, worker: Worker, job: _Job) -> None:
        """Take a dead worker's piece back, unless it has cost too many already."""
        self._end([worker])
        assert worker.piece is not None
        job.lost[worker.piece] += 1
        if job.lost[worker.piece] < ATTEMPTS:
            job.todo.appendleft(worker.piece)
            return
        error = _died(worker.piece, worker.process.exitcode)
        if job.instead is None:
            raise error
        job.done[worker.piece] = job.instead(worker.piece, error)


def start(function: Callable[[Any], Any] | None = None) -> Worker:
    """Start a worker; fork it where it is given a function, which it then has.

    Raises
    ------
    RunError
        Where the system has no room for another process.
    """
    try:
        return Worker(function)
    except OSError as error:
        raise RunError(
            f"a worker process cannot be started: {error.strerror}", remedy="fewer --workers"
        ) from error


def _died(piece: int, exitcode: int | None) -> RunError:
    status = exitcode or 0
    how = f"signal {-status}" if status < 0 else f"exit status {status}"
    return RunError(
        f"piece {piece} lost its worker process {ATTEMPTS} times ({how})",
        remedy="fewer --workers need less memory",
    )

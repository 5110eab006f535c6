"""Workers on other machines: dask.distributed and MPI, both optional packages."""

from __future__ import annotations

import importlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import partial
from typing import Any

from amibayes.errors import RunError
from amibayes.parallel.processes import Lost
from amibayes.parallel.threads import run_in_worker

PATIENCE_S = 60.0
"""How long a job waits for a cluster that has no workers before it gives up."""

AHEAD = 16
"""Pieces in flight at least, so that a growing cluster finds work."""


AHEAD_PER_THREAD = 4
"""Pieces in flight for each thread: results are taken in order, and a target that takes longer
than its neighbours leaves the others with work."""


def _in_order(
    submit: Callable[[Any], Any], result: Callable[[Any], Any], pieces: Sequence[Any], ahead: int
) -> Iterator[Any]:
    """Give results in order, with at most ``ahead`` pieces in flight."""
    flying: deque[Any] = deque()
    for piece in pieces:
        flying.append(submit(piece))
        if len(flying) >= ahead:
            yield result(flying.popleft())
    while flying:
        yield result(flying.popleft())


def _same(function: Any) -> Any:
    return function


def _optional(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RunError(
            f"the package {module.split('.')[0]} is missing",
            source="--scheduler",
            remedy=f"pip install 'amibayes[{extra}]'",
        ) from error


@dataclass(frozen=True)
class _Killed:
    """Stands for the result of a piece that killed several workers."""

    error: RunError


class DaskExecutor:
    """Compute pieces on the workers of a running dask scheduler.

    Parameters
    ----------
    address : str
        Such as ``tcp://host:8786``.
    patience_s : float
        How long to wait while the cluster has no worker at all.

    Raises
    ------
    RunError
        Where dask.distributed is missing or nothing answers at the address.
    """

    def __init__(self, address: str, *, patience_s: float = PATIENCE_S) -> None:
        self.address = address
        self._patience_s = patience_s
        self._distributed = _optional("distributed", "cluster")
        try:
            self._client = self._distributed.Client(address, timeout="5s", set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise self._lost("no dask scheduler answers") from error

    def map(
        self, function: Callable[[Any], Any], pieces: Sequence[Any], lost: Lost | None = None
    ) -> Iterator[Any]:
        """See `Executor.map`; a piece whose worker dies goes to another one.

        Raises
        ------
        RunError
            When a piece killed several workers, or the cluster went away.
        """
        # a task of its own: sent once, and made again where the worker that held it dies
        shared = self._client.submit(_same, function, pure=False)
        submit = partial(self._client.submit, run_in_worker, shared, pure=False)
        ahead = max(AHEAD, AHEAD_PER_THREAD * sum(self._client.nthreads().values()))
        found = _in_order(submit, self._result, pieces, ahead)
        return (self._or_instead(k, answer, lost) for k, answer in enumerate(found))

    def close(self) -> None:
        """Let the scheduler go; its workers are not ours to end."""
        self._client.close()

    @staticmethod
    def _or_instead(index: int, answer: Any, lost: Lost | None) -> Any:
        if not isinstance(answer, _Killed):
            return answer
        if lost is None:
            raise answer.error
        return lost(index, answer.error)

    def _result(self, future: Any) -> Any:
        alone_since: float | None = None
        look_s = 1.0
        while True:
            # A finished piece whose worker is gone before its result was fetched is computed
            # again, so that no wait may last forever; but a long result has its time.
            failed = future.status == "error"
            try:
                return future.result(timeout=look_s)
            except TimeoutError:
                if failed:  # the piece's own error, not our impatience
                    raise
            except self._distributed.KilledWorker as error:
                killed = self._lost("a piece killed its worker again and again")
                killed.__cause__ = error
                return _Killed(killed)
            except CancelledError as error:
                raise self._lost("the dask scheduler went away") from error
            alone_since = self._alone(alone_since)
            look_s = min(1.5 * look_s, PATIENCE_S)

    def _alone(self, since: float | None) -> float | None:
        """Give the time since which there is no worker; give up when it is too long."""
        try:
            workers = self._client.scheduler_info()["workers"]
        except (OSError, TimeoutError) as error:
            raise self._lost("the dask scheduler went away") from error
        if self._client.status != "running":
            raise self._lost("the dask scheduler went away")
        if workers:
            return None
        now = time.monotonic()
        if since is not None and now - since > self._patience_s:
            raise self._lost("the dask scheduler has no workers")
        return since or now

    def _lost(self, what: str) -> RunError:
        return RunError(
            what,
            source=self.address,
            remedy="start it (dask scheduler) and its workers (dask worker), and run again",
        )


class MPIExecutor:
    """Compute pieces on the ranks of ``mpiexec -n N python -m mpi4py.futures -m amibayes …``.

    Raises
    ------
    RunError
        Where mpi4py is missing.
    """

    def __init__(self) -> None:
        self._pool = _optional("mpi4py.futures", "mpi").MPIPoolExecutor()
        self._pool.bootup(wait=True)

    def map(
        self, function: Callable[[Any], Any], pieces: Sequence[Any], lost: Lost | None = None
    ) -> Iterator[Any]:
        """See `Executor.map`; a rank that dies ends all of them, as MPI has it."""
        submit = partial(self._pool.submit, run_in_worker, function)
        ahead = max(AHEAD, 2 * self._pool.num_workers)
        return _in_order(submit, lambda future: future.result(), pieces, ahead)

    def close(self) -> None:
        """End the pool."""
        self._pool.shutdown()

"""One BLAS thread inside a piece: sums are then done in one order on every machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from threadpoolctl import threadpool_limits


def run_here(function: Callable[[Any], Any], piece: Any) -> Any:
    """Compute a piece in this process, and give its threads back afterwards."""
    with threadpool_limits(limits=1):
        return function(piece)


def run_in_worker(function: Callable[[Any], Any], piece: Any) -> Any:
    """Compute a piece in a process that does nothing else.

    The limit stays: a worker may compute two pieces in two threads, and the one that
    finishes first must not give the other its threads back. It is set anew for every
    piece since libraries that were loaded in between have pools of their own.
    """
    threadpool_limits(limits=1)
    return function(piece)

"""One BLAS thread inside a piece: sums are then done in one order on every machine."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController


@lru_cache(maxsize=1)
def _pools(n_modules: int) -> ThreadpoolController:
    """Libraries with threads. To look for them takes milliseconds; new ones come with a module."""
    return ThreadpoolController()


def know_pools() -> None:
    """Look for libraries with threads now: processes that are forked afterwards need not."""
    _pools(len(sys.modules))


def run_here(function: Callable[[Any], Any], piece: Any) -> Any:
    """Compute a piece in this process, and give its threads back afterwards."""
    with _pools(len(sys.modules)).limit(limits=1):
        return function(piece)


def run_in_worker(function: Callable[[Any], Any], piece: Any) -> Any:
    """Compute a piece in a process that does nothing else.

    The limit stays: a worker may compute two pieces in two threads, and the one that
    finishes first must not give the other its threads back. It is set anew for every
    piece since libraries that were loaded in between have pools of their own.
    """
    _pools(len(sys.modules)).limit(limits=1)
    return function(piece)

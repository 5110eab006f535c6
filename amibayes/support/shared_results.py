"""Results that targets of a survey have in common, kept by what they depend on.

A key is the digest of everything that a result is made from, pickled: arrays byte for byte, the
state of random numbers included. What differs in anything is another key, so that a result is the
same whether it was made or was there, for any order of targets and any number of workers. Nothing
is kept outside of `sharing`: a process that does one target has nothing to share.
"""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

from amibayes.support.atomic_files import sha256

Result = TypeVar("Result")

MAX_BYTES = 64_000_000
"""Of all results of a process: eight hundred null distributions, or some fifty vetted sets of
calibrators, and a quarter of what a worker needs anyway."""


class SharedResults:
    """Results by the digest of their content, the latest used ones, up to so many bytes.

    They are kept pickled: their size is then known, and nobody can change them.

    Parameters
    ----------
    max_bytes : int

    Attributes
    ----------
    found, made : int
        How often a result was there, and how often it was made.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self.max_bytes = max_bytes
        self.found = self.made = self._size = 0
        self._kept: OrderedDict[bytes, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def of(self, make: Callable[[], Result], *content: Any) -> Result:
        """Give the result of ``make``, which depends on ``content`` alone; see `shared`."""
        key = hashlib.sha256(pickle.dumps(content)).digest()
        with self._lock:
            held = self._kept.get(key)
            if held is not None:
                self._kept.move_to_end(key)
                self.found += 1
        if held is not None:
            known: Result = pickle.loads(held)
            return known
        # Outside of the lock: two threads may make one result twice, and it is the same.
        result = make()
        self._keep(key, pickle.dumps(result))
        return result

    def _keep(self, key: bytes, held: bytes) -> None:
        with self._lock:
            self.made += 1
            if key in self._kept or len(held) > self.max_bytes:
                return
            self._kept[key] = held
            self._size += len(held)
            while self._size > self.max_bytes:
                self._size -= len(self._kept.popitem(last=False)[1])


_OF_PROCESS = SharedResults()
"""What a worker keeps from one target to the next; a task of a cluster has no other memory."""

_current: ContextVar[SharedResults | None] = ContextVar("shared results", default=None)


@contextmanager
def sharing(results: SharedResults | None = None) -> Iterator[SharedResults]:
    """Share results within the block, by default with all other targets of this process."""
    token = _current.set(_OF_PROCESS if results is None else results)
    try:
        yield _OF_PROCESS if results is None else results
    finally:
        _current.reset(token)


def shared(make: Callable[[], Result], *content: Any) -> Result:
    """Give the result of ``make``, made once for all targets that `sharing` holds together.

    Parameters
    ----------
    make : callable
        Without side effects.
    *content
        All that the result depends on, with a name of what is made; can be pickled.
    """
    results = _current.get()
    return make() if results is None else results.of(make, *content)


MAX_FILE_BYTES = 4_000_000
"""Of files whose reading is shared: an OIFITS file of a snapshot has some 20 kB and takes 20 ms to
read, its digest 0.1 ms; images have reading enough to do once."""


def shared_of_file(make: Callable[[], Result], path: str | Path, *content: Any) -> Result:
    """Give the result of ``make``, which depends on a small file's bytes and on ``content``.

    Parameters
    ----------
    make : callable
        Without side effects; what it gives may name the file.
    path : path
    *content
        As in `shared`.
    """
    file = Path(path)
    if _current.get() is None or not file.is_file() or file.stat().st_size > MAX_FILE_BYTES:
        return make()
    return shared(make, str(path), sha256(file), *content)

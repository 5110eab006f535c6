"""Requests to end (Ctrl-C, SIGTERM), which no library may replace by an error of its own."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_asked = threading.Event()


def _end(number: int, frame: FrameType | None) -> None:
    _asked.set()
    raise KeyboardInterrupt


@contextmanager
def polite_end() -> Iterator[None]:
    """Make a request to end (SIGTERM) as gentle as Ctrl-C, and remember that it came."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # A worker, or a command that the shell put into the background, ignores Ctrl-C: it still does.
    ours = [number for number, handler in before.items() if handler != signal.SIG_IGN]
    for number in ours:
        signal.signal(number, _end)
    try:
        yield
    finally:
        _asked.clear()
        for number in ours:
            signal.signal(number, before[number] or signal.SIG_DFL)


@contextmanager
def ending() -> Iterator[None]:
    """Raise KeyboardInterrupt where it was asked for and something else came of it.

    A handler's exception comes up wherever Python code runs, inside libraries too, and some replace
    it: numpy's comparison of structured arrays makes a TypeError of it.

    Raises
    ------
    KeyboardInterrupt
    """
    try:
        yield
    except Exception:
        if _asked.is_set():
            raise KeyboardInterrupt from None
        raise
    if _asked.is_set():
        raise KeyboardInterrupt

"""How the C library keeps memory between arrays."""

from __future__ import annotations

import ctypes
import sys

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Numbers of these settings in glibc's ``malloc.h``."""

KEPT = 256 << 20
"""Bytes of free memory at the end of the heap that are kept for the next array."""

LARGEST = 32 << 20
"""Bytes of the largest array that is laid there, the most that glibc allows."""


def keep_memory() -> None:
    """Let arrays be laid where others were, without the system clearing each page anew.

    Searches make and leave arrays of megabytes thousands of times: this saves a tenth of a
    long search. Nothing is done where the C library is another.
    """
    if sys.platform != "linux":
        return
    setting = getattr(ctypes.CDLL(None), "mallopt", None)
    if setting is not None:
        setting(MMAP_THRESHOLD, LARGEST)
        setting(TRIM_THRESHOLD, KEPT)

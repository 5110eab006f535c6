"""Functions that the tests of `amibayes.parallel` send to other processes."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info

from amibayes.errors import DataError
from amibayes.support.atomic_files import atomic_path


def noisy_product(seed: np.random.SeedSequence) -> dict[str, Any]:
    """A matrix product large enough for BLAS to split it among threads, and its noise."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(300, 400))
    return {"product": a @ a.T, "total": a.sum(), "draws": rng.poisson(50.0, 100)}


def blas_threads(piece: int) -> int:
    np.ones((2, 2)) @ np.ones((2, 2))
    return max(pool["num_threads"] for pool in threadpool_info())


def square(x: int) -> int:
    return x * x


def column(x: int) -> dict[str, Any]:
    return {"square": x * x}


def counted_column(task: tuple[Path, int]) -> dict[str, Any]:
    """Leave a trace of every evaluation."""
    folder, x = task
    with (folder / f"{x}").open("a") as stream:
        stream.write("once\n")
    return {"square": x * x}


def fail(x: int) -> int:
    raise DataError("is empty", source="a.fits", remedy="give another")


def cannot_travel(x: int) -> Any:
    return lambda: x


def apply(task: tuple[Any, int]) -> Any:
    """Do what a piece asks for by itself."""
    function, x = task
    return function(x)


def kill_self_once(task: tuple[Path, int]) -> int:
    """Die without a word the first time a piece is tried."""
    folder, x = task
    try:
        (folder / f"tried-{x}").touch(exist_ok=False)
    except FileExistsError:
        return x * x
    os.kill(os.getpid(), signal.SIGKILL)
    return -1


def kill_self(x: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return -1


def sleep_after_saying_who(task: tuple[Path, int]) -> int:
    folder, x = task
    (folder / f"pid-{os.getpid()}").touch()
    time.sleep(60.0)
    return x


def whether_interrupts_are_blocked(x: int) -> bool:
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def slow_process(_: object) -> int:
    """Take longer than a fork, and say which process did it."""
    time.sleep(0.2)
    return os.getpid()


def write_without_end(path: Path) -> None:
    """Begin a file, say so by another one beside it, and go on writing."""
    with atomic_path(path) as temporary:
        temporary.write_text("begun")
        path.with_suffix(".begun").touch()
        time.sleep(60.0)

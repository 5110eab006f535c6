"""A process of its own that is asked one thing after the other."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator

import pytest

from amibayes.errors import DataError, RunError
from amibayes.parallel.apart import Apart


def where(number: int) -> tuple[int, int]:
    sys.stdout.write("what is printed disturbs no answer")
    return os.getpid(), number


def fail(kind: str) -> None:
    if kind == "data":
        raise DataError("is wrong", source="x.fits")
    raise ZeroDivisionError("odd")


def end() -> None:
    os._exit(3)


@pytest.fixture(scope="module")
def apart() -> Iterator[Apart]:
    one = Apart()
    yield one
    one.close()


def test_threads_share_one_process(apart: Apart) -> None:
    found: list[tuple[int, int]] = []
    threads = [threading.Thread(target=lambda k=k: found.append(apart(where, k))) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(number for _, number in found) == list(range(8))
    assert len({pid for pid, _ in found}) == 1
    assert found[0][0] != os.getpid()


def test_errors_travel(apart: Apart) -> None:
    with pytest.raises(DataError, match=r"x\.fits: is wrong"):
        apart(fail, "data")
    with pytest.raises(RuntimeError, match="ZeroDivisionError: odd"):
        apart(fail, "other")


def test_one_that_ends_is_one_line_and_the_next_question_starts_another(apart: Apart) -> None:
    with pytest.raises(RunError, match="ended"):
        apart(end)
    assert apart(where, 5)[1] == 5

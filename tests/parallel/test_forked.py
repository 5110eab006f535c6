"""Forked processes: the bits of a serial run, and nothing lost with a process that ends."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import parallel_work as work
import pytest

from amibayes.errors import DataError, RunError
from amibayes.parallel import (
    CAN_FORK,
    Beside,
    ForkExecutor,
    SerialExecutor,
    at_hand,
    open_executor,
    run_job,
    spawn,
)

pytestmark = pytest.mark.skipif(not CAN_FORK, reason="the system does not fork safely")


@pytest.fixture
def forks() -> Iterator[ForkExecutor]:
    executor = ForkExecutor(2, first_here=False)
    yield executor
    executor.close()


def process_of(_: Any) -> int:
    return os.getpid()


def test_forks_give_the_bits_of_a_serial_run(forks: ForkExecutor) -> None:
    seeds = spawn(np.random.default_rng(5), 7)
    serial = list(SerialExecutor().map(work.noisy_product, seeds))
    for found in (forks.map(work.noisy_product, seeds), forks.map(work.noisy_product, seeds)):
        for one, other in zip(serial, found, strict=True):
            assert all(np.array_equal(one[name], other[name]) for name in one)


def test_what_a_function_holds_need_not_travel(forks: ForkExecutor) -> None:
    """A fork has it in memory: here what no pickle can hold."""
    apply = lambda function, piece: function(piece)  # noqa: E731 - a lambda cannot travel
    doubled = partial(apply, lambda x: 2 * x)
    assert list(forks.map(doubled, [1, 2, 3])) == [2, 4, 6]


def test_blas_has_one_thread_inside_a_piece(forks: ForkExecutor) -> None:
    assert list(forks.map(work.blas_threads, [0, 1, 2])) == [1, 1, 1]


def test_error_of_a_piece_arrives_as_it_was(forks: ForkExecutor) -> None:
    with pytest.raises(DataError) as raised:
        list(forks.map(work.fail, [1, 2]))
    assert str(raised.value) == "a.fits: is empty (give another)"


def test_killed_fork_is_replaced(tmp_path: Path, forks: ForkExecutor) -> None:
    pieces = [(tmp_path, x) for x in range(5)]
    assert list(forks.map(work.kill_self_once, pieces)) == [0, 1, 4, 9, 16]
    with pytest.raises(RunError, match=r"lost its worker process 3 times \(signal 9\)"):
        list(forks.map(work.kill_self, [1, 2]))


def test_small_jobs_stay_here_and_long_ones_do_not() -> None:
    executor, here = ForkExecutor(2), os.getpid()
    assert set(executor.map(process_of, range(9))) == {here}
    assert list(executor.map(work.slow_process, range(3))) != [here] * 3
    answers = run_job(work.slow_process, range(3), executor)
    assert next(iter(answers)) == here
    executor.close()


def test_a_call_beside_this_process() -> None:
    assert Beside(process_of, 0).result() != os.getpid()
    with pytest.raises(DataError, match="is empty"):
        Beside(work.fail, 1).result()
    assert Beside(work.kill_self, 1).result() is None
    left = Beside(work.slow_process, 1)
    left.end()
    left.end()


def test_what_a_process_was_writing_goes_with_it(tmp_path: Path) -> None:
    beside = Beside(work.write_without_end, tmp_path / "a.png")
    begun = tmp_path / "a.begun"
    waited = time.monotonic() + 10.0
    while not begun.exists() and time.monotonic() < waited:
        time.sleep(0.01)
    assert len(list(tmp_path.iterdir())) == 2
    beside.end()
    assert list(tmp_path.iterdir()) == [begun]


def test_cores_at_hand_are_used_where_the_system_forks() -> None:
    assert 1 <= at_hand() <= len(os.sched_getaffinity(0))
    with open_executor(2, forked=True) as executor:
        assert isinstance(executor, ForkExecutor)
    with open_executor(1, forked=True) as executor:
        assert isinstance(executor, SerialExecutor)

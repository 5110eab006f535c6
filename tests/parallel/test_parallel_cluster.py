"""A real dask cluster on this machine: one scheduler, two worker processes."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from dask_cluster import MPI_ALLOWED, end, free_port, start_dask, start_worker

sys.path.insert(0, str(Path(__file__).parents[1]))
import parallel_work as work

from amibayes.errors import RunError
from amibayes.parallel import DaskExecutor, SerialExecutor, open_executor, spawn

pytest.importorskip("distributed", reason="dask.distributed is not installed")

HERE = str(Path(__file__).parents[1])


@pytest.fixture
def scheduler() -> Iterator[str]:
    port = free_port()
    process = start_dask(
        "dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"
    )
    yield f"tcp://127.0.0.1:{port}"
    end(process)


@pytest.fixture
def workers(scheduler: str) -> Iterator[list[subprocess.Popen[bytes]]]:
    processes = [start_worker(scheduler), start_worker(scheduler)]
    yield processes
    for process in processes:
        end(process)


def test_two_dask_workers_give_the_bits_of_a_serial_run_though_one_is_killed(
    scheduler: str, workers: list[subprocess.Popen[bytes]]
) -> None:
    seeds = spawn(np.random.default_rng(5), 40)
    expected = list(SerialExecutor().map(work.noisy_product, seeds))
    with open_executor(scheduler=scheduler) as executor:
        results = executor.map(work.noisy_product, seeds)
        found = [next(results)]
        os.kill(workers[0].pid, signal.SIGKILL)
        found.extend(results)
    for a, b in zip(expected, found, strict=True):
        assert all(np.asarray(a[k]).tobytes() == np.asarray(b[k]).tobytes() for k in a)


@pytest.mark.slow
def test_cluster_without_workers_is_given_up_in_one_line(
    scheduler: str, workers: list[subprocess.Popen[bytes]]
) -> None:
    executor = DaskExecutor(scheduler, patience_s=2.0)
    results = executor.map(work.square, list(range(1000)))
    next(results)
    for process in workers:
        end(process)
    with pytest.raises(RunError, match="has no workers"):
        list(results)
    executor.close()


@pytest.mark.slow
def test_piece_that_kills_its_workers_is_one_line(
    scheduler: str, workers: list[subprocess.Popen[bytes]]
) -> None:
    executor = DaskExecutor(scheduler, patience_s=2.0)
    with pytest.raises(RunError, match=r"has no workers|killed its worker"):
        list(executor.map(work.kill_self, [1, 2]))
    executor.close()


class _Late:
    """A future that is not there at the first look, or never because its piece failed."""

    def __init__(self, status: str) -> None:
        self.status = status
        self._looks = 0

    def result(self, timeout: float) -> int:
        self._looks += 1
        if self._looks == 1:
            raise TimeoutError("not yet")
        return 7


def test_a_timeout_of_the_piece_is_raised_and_one_of_ours_is_not() -> None:
    executor = object.__new__(DaskExecutor)
    executor._distributed = type("distributed", (), {"KilledWorker": RuntimeError})
    executor._alone = lambda since: None
    assert executor._result(_Late("pending")) == 7
    assert executor._result(_Late("finished")) == 7
    with pytest.raises(TimeoutError, match="not yet"):
        executor._result(_Late("error"))


@pytest.mark.slow
def test_scheduler_that_does_not_answer_is_one_line() -> None:
    started = time.monotonic()
    with pytest.raises(RunError, match="no dask scheduler answers"):
        DaskExecutor(f"tcp://127.0.0.1:{free_port()}")
    assert time.monotonic() - started < 30.0


MPI_SCRIPT = """
import numpy as np
import parallel_work as work
from amibayes.parallel import SerialExecutor, open_executor, spawn

if __name__ == "__main__":
    seeds = spawn(np.random.default_rng(5), 20)
    expected = SerialExecutor().map(work.noisy_product, seeds)
    with open_executor(scheduler="mpi") as executor:
        found = list(executor.map(work.noisy_product, seeds))
    for a, b in zip(expected, found, strict=True):
        assert all(np.asarray(a[k]).tobytes() == np.asarray(b[k]).tobytes() for k in a)
    print("same bits")
"""


def test_mpi_ranks_give_the_bits_of_a_serial_run(tmp_path: Path) -> None:
    pytest.importorskip("mpi4py", reason="mpi4py is not installed")
    mpiexec = shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("mpiexec is not installed")
    script = tmp_path / "job.py"
    script.write_text(MPI_SCRIPT)
    finished = subprocess.run(
        [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures", str(script)],
        env=os.environ | MPI_ALLOWED | {"PYTHONPATH": os.pathsep.join([HERE, *sys.path])},
        capture_output=True,
        text=True,
        timeout=100.0,
    )
    assert finished.stdout.strip() == "same bits", finished.stderr

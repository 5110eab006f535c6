"""A dask cluster on this machine: a scheduler and workers in processes of their own."""

from __future__ import annotations

import socket
import subprocess

from commands import start

MPI_ALLOWED = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
}
"""What Open MPI asks for where a container's user is root and cores are few; MPICH ignores it."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def start_dask(program: str, *words: str) -> subprocess.Popen[bytes]:
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return start(f"distributed.cli.{program}", *words, start_new_session=True, **silent)


def start_worker(address: str, threads: int = 1) -> subprocess.Popen[bytes]:
    words = ("--nthreads", str(threads), "--no-dashboard", "--no-nanny")
    return start_dask("dask_worker", address, *words)


def end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()

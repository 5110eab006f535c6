"""Limits that are killed, go on, and give the same bytes; workers and clusters likewise."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from commands import alive, start

from amibayes.cli import main

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("--separations", "4", "--trials", "100", "--null-draws", "8000", "--separation", "60:400")
# Runs of other processes are compared byte by byte, pictures and all.
pytestmark = pytest.mark.usefixtures("full_pictures")

FILES = ("limits.json", "limits.ecsv", "limits.png", "completeness.png")


@pytest.fixture(scope="module")
def whole(star: Path, tmp_path_factory) -> dict[str, bytes]:
    """Files of a run that nobody disturbed."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert main(["limits", str(star), "--out", str(out), "--quiet", *SMALL]) == 0
    return contents(out)


def contents(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in FILES}


def resumed(star: Path, out: Path, *more: str) -> subprocess.Popen[bytes]:
    return start("amibayes", "limits", star, "--out", out, "--resume", "--quiet", *SMALL, *more)


def finished_pieces(out: Path) -> int:
    return len(list(out.glob("limits.journal/**/piece-*.npz")))


def children_of(pid: int) -> list[int]:
    path = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in path.read_text().split()] if path.exists() else []


def kill_after(process: subprocess.Popen[bytes], out: Path, pieces: int) -> list[int]:
    """Kill a run at once when so many pieces are finished; give the workers it had."""
    while process.poll() is None and finished_pieces(out) < pieces:
        time.sleep(0.002)
    workers = children_of(process.pid)
    process.kill()
    process.wait()
    return workers


def killed_and_resumed(star: Path, out: Path, kills: int, seed: int) -> dict[str, bytes]:
    """Kill a run at random moments, then let it finish."""
    rng = np.random.default_rng(seed)
    for k, pieces in enumerate(sorted(rng.choice(np.arange(1, 28), kills, replace=False))):
        before = finished_pieces(out)
        more = ("--workers", "2") if k % 2 else ()
        # The first piece of a job is made before its processes are forked.
        least = before + (3 if more else 1)
        workers = kill_after(resumed(star, out, *more), out, max(int(pieces), least))
        assert finished_pieces(out) > before
        assert not (out / "limits.json").exists()
        if more:
            assert len(workers) >= 2
        # They finish the pieces that they are at, which count for the next run.
        deadline = time.monotonic() + 20.0
        while any(alive(pid) for pid in workers) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not any(alive(pid) for pid in workers)
    assert resumed(star, out).wait(120) == 0
    assert not (out / "limits.journal").exists()
    return contents(out)


@pytest.mark.slow
def test_killed_twice_and_resumed_the_same_bytes(star, whole, tmp_path) -> None:
    assert killed_and_resumed(star, tmp_path / "out", 2, seed=1) == whole


@pytest.mark.slow
def test_killed_five_times_and_resumed_the_same_bytes(star, whole, tmp_path) -> None:
    assert killed_and_resumed(star, tmp_path / "out", 5, seed=2) == whole


def test_two_workers_give_the_same_bytes(star, whole, tmp_path) -> None:
    words = ("--out", str(tmp_path / "out"), "--quiet", "--workers", "2", *SMALL)
    assert main(["limits", str(star), *words]) == 0
    assert contents(tmp_path / "out") == whole


@pytest.mark.slow
def test_dask_workers_give_the_same_bytes_though_one_is_killed(star, whole, tmp_path) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    from dask_cluster import end, free_port, start_dask, start_worker

    port, out = free_port(), tmp_path / "out"
    words = ("--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
    address = f"tcp://127.0.0.1:{port}"
    processes = [start_dask("dask_scheduler", *words)]
    try:
        processes += [start_worker(address), start_worker(address)]
        run = resumed(star, out, "--scheduler", address)
        while run.poll() is None and finished_pieces(out) < 20:
            time.sleep(0.01)
        os.kill(processes[1].pid, signal.SIGKILL)
        assert run.wait(120) == 0
    finally:
        for process in processes:
            end(process)
    assert contents(out) == whole

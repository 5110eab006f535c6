"""One survey in four ways, each killed twice and resumed: the same bytes, CPU time and memory.

In this process, by two processes, by two dask workers of two threads, by MPI. All processes of a
way, a dask scheduler too, are killed when a third and when two thirds of the targets are done.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

LOOKED_AT_S = 0.3
"""How often time and memory of the processes are read."""

SUMMARIES = ("survey.json", "survey.ecsv", "survey.html")

MORE = 1e-6
"""MB per byte."""


@dataclass
class Usage:
    """CPU seconds of every process that was seen, and the largest memory of one, MB."""

    cpu_s: dict[tuple[int, float], float] = field(default_factory=dict)
    peak_mb: float = 0.0

    def look(self, roots: list[psutil.Process]) -> None:
        """Read the processes and all that come from them."""
        for process in family(roots):
            try:
                used, key = process.cpu_times(), (process.pid, process.create_time())
                self.cpu_s[key] = used.user + used.system
                self.peak_mb = max(self.peak_mb, MORE * process.memory_info().rss)
            except psutil.NoSuchProcess:
                continue


def family(roots: list[psutil.Process]) -> list[psutil.Process]:
    """Processes and all that come from them."""
    found = []
    for root in roots:
        try:
            found += [root, *root.children(recursive=True)]
        except psutil.NoSuchProcess:
            continue
    return found


def _amibayes(*words: object) -> list[str]:
    return [sys.executable, "-m", "amibayes", *map(str, words)]


@contextmanager
def _alone(words: list[object]) -> Iterator[list[subprocess.Popen[bytes]]]:
    yield [_started(_amibayes(*words))]


@contextmanager
def _processes(words: list[object]) -> Iterator[list[subprocess.Popen[bytes]]]:
    yield [_started(_amibayes(*words, "--workers", 2))]


@contextmanager
def _dask(words: list[object]) -> Iterator[list[subprocess.Popen[bytes]]]:
    from dask_cluster import end, free_port, start_dask, start_worker

    address = f"tcp://127.0.0.1:{free_port()}"
    port = address.rsplit(":", 1)[1]
    cluster = [
        start_dask("dask_scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    ]
    cluster += [start_worker(address, threads=2) for _ in range(2)]
    try:
        yield [_started(_amibayes(*words, "--scheduler", address)), *cluster]
    finally:
        for process in cluster:
            end(process)


@contextmanager
def _mpi(words: list[object]) -> Iterator[list[subprocess.Popen[bytes]]]:
    from dask_cluster import MPI_ALLOWED

    ranks = [str(shutil.which("mpiexec")), "-n", "3", sys.executable, "-m", "mpi4py.futures"]
    command = [*ranks, "-m", "amibayes", *map(str, words), "--scheduler", "mpi"]
    yield [_started(command, MPI_ALLOWED)]


def _started(
    command: list[str], environment: dict[str, str] | None = None
) -> subprocess.Popen[bytes]:
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, env=os.environ | (environment or {}), **silent)


WAYS: dict[str, Callable[[list[object]], Any]] = {
    "one process": _alone,
    "two processes": _processes,
    "two dask workers of two threads": _dask,
    "MPI, two of three ranks working": _mpi,
}


def finished(out: Path) -> int:
    """Targets whose result is written."""
    return len(list(out.glob("*/result.json")))


def survey(name: str, words: list[object], out: Path, targets: int) -> dict[str, Any]:
    """Do a survey in one way, killed when a third and when two thirds of it are done."""
    usage, begin, kills = Usage(), time.perf_counter(), []
    for wanted in (targets // 3, 2 * targets // 3, None):
        with WAYS[name]([*words, "--out", out, "--resume"]) as processes:
            roots = [psutil.Process(p.pid) for p in processes]
            while processes[0].poll() is None and (wanted is None or finished(out) < wanted):
                usage.look(roots)
                time.sleep(LOOKED_AT_S)
            usage.look(roots)
            if wanted is not None:
                for process in family(roots):
                    process.kill()
                kills.append(finished(out))
            for process in processes[:1]:
                process.wait()
    return {
        "way": name,
        "targets": targets,
        "cpu_s": round(sum(usage.cpu_s.values()), 1),
        "wall_s": round(time.perf_counter() - begin, 1),
        "peak_mb": round(usage.peak_mb),
        "killed_at": kills,
        "load": round(os.getloadavg()[1], 1),
    }


def same(first: Path, second: Path) -> int:
    """Files that have the same bytes in both folders, but for the time that targets took.

    Raises
    ------
    SystemExit
        Where a file differs or is missing.
    """
    names = [{p.relative_to(f) for p in f.rglob("*") if p.is_file()} for f in (first, second)]
    if names[0] != names[1]:
        raise SystemExit(f"{second}: not the same files: {sorted(names[0] ^ names[1])[:5]}")
    for name in sorted(names[0]):
        if _content(first / name) != _content(second / name):
            raise SystemExit(f"{second / name}: other bytes")
    return len(names[0])


def _content(path: Path) -> Any:
    if path.name != "result.json":
        return path.read_bytes()
    content = json.loads(path.read_text())
    content.pop("timing_s")
    return content


def ways(table: Path, folder: Path, targets: int, path: Path, words: tuple[str, ...]) -> None:
    """Do a survey in each of the ways that is not done yet; add a line for each to a file."""
    lines = path.read_text().splitlines() if path.exists() else []
    done = {line["way"] for line in map(json.loads, lines) if line["targets"] == targets}
    outs = {name: folder / name.replace(" ", "_").replace(",", "") for name in WAYS}
    for name, out in outs.items():
        if name in done:
            continue
        shutil.rmtree(out, ignore_errors=True)
        line = survey(name, ["search", "--batch", table, "--quiet", *words], out, targets)
        line["files_equal"] = same(outs["one process"], out)
        with path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")


def ways_table(path: Path) -> list[str]:
    """Table of what came of `ways`."""
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    heads = [
        f"| {rows[0]['targets']} targets | killed at | files, equal | CPU of a target, with all "
        "starts | memory of a process |",
        "|---|---|---|---|---|",
    ]
    return heads + [
        f"| {r['way']} | {r['killed_at'][0]}, {r['killed_at'][1]} | {r['files_equal']} | "
        f"{r['cpu_s'] / r['targets']:.2f} s | {r['peak_mb']} MB |"
        for r in rows
    ]

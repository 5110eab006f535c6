"""A survey has the same bytes wherever it is computed, and however often it is killed."""

from __future__ import annotations

import json
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
from astropy.table import Table
from commands import run, start
from dask_cluster import MPI_ALLOWED, end, free_port, start_dask, start_worker
from helpers import niriss, simulated

from amibayes.oifits import write_oifits

# Pages hold their pictures, and the runs compared draw them in this process or in another.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("full_pictures")]

HERE = Path(__file__).parents[1]
SUMMARIES = ("survey.json", "survey.ecsv", "survey.html")
WORDS = (
    "--no-pictures",
    "--null-draws",
    3000,
    "--no-posterior",
    "--no-limits",
    "--separation",
    "60:300",
    "--quiet",
)


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six targets, one that is no file, and what a serial run makes of them."""
    folder = tmp_path_factory.mktemp("survey")
    for k in range(5):
        theta = [110.0, -75.0, 0.01 * (k == 2)]
        data = simulated(niriss(), theta, np.random.default_rng(k))
        write_oifits(folder / f"s{k}.oifits", data)
    (folder / "s5.oifits").write_text("not a FITS file")
    table = Table({"target": [f"s{k}.oifits" for k in range(6)]})
    table.write(folder / "targets.ecsv")
    assert (
        run("search", "--batch", folder / "targets.ecsv", *WORDS, "--out", folder / "serial") == 4
    )
    return folder


def same(survey: Path, other: Path, reference: str = "serial") -> None:
    """All files but the timing of the single targets."""
    serial = survey / reference
    assert {p.name for p in serial.iterdir()} == {p.name for p in other.iterdir()}
    for path in sorted(serial.rglob("*")):
        twin = other / path.relative_to(serial)
        if path.name == "result.json":
            first, second = (json.loads(p.read_text()) for p in (path, twin))
            assert first.pop("timing_s").keys() == second.pop("timing_s").keys()
            assert first == second
        elif path.name in SUMMARIES or path.suffix == ".png":
            assert path.read_bytes() == twin.read_bytes(), path


def test_two_processes(survey: Path, tmp_path: Path) -> None:
    words = ("--batch", survey / "targets.ecsv", *WORDS, "--out", tmp_path / "out")
    assert run("search", *words, "--workers", 2) == 4
    same(survey, tmp_path / "out")


@pytest.fixture
def cluster() -> Iterator[str]:
    """Two dask workers of two threads."""
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    port = free_port()
    words = ("--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
    processes = [start_dask("dask_scheduler", *words)]
    processes += [start_worker(f"tcp://127.0.0.1:{port}", threads=2) for _ in range(2)]
    yield f"tcp://127.0.0.1:{port}"
    for process in processes:
        end(process)


def test_two_dask_workers_of_two_threads(survey: Path, tmp_path: Path, cluster: str) -> None:
    """With their pictures, which both threads want at a time."""
    Table({"target": ["s2.oifits", "s3.oifits"]}).write(survey / "two.ecsv")
    words = ("--batch", survey / "two.ecsv", *WORDS[1:])
    assert run("search", *words, "--out", survey / "drawn") == 0
    assert run("search", *words, "--out", tmp_path / "out", "--scheduler", cluster) == 0
    assert len(list((survey / "drawn").glob("*/*.png"))) >= 10
    same(survey, tmp_path / "out", "drawn")


def test_ranks_of_mpi(survey: Path, tmp_path: Path) -> None:
    pytest.importorskip("mpi4py", reason="mpi4py is not installed")
    mpiexec = shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("mpiexec is not installed")
    words = ["search", "--batch", survey / "targets.ecsv", *WORDS, "--out", tmp_path / "out"]
    path = os.pathsep.join([str(HERE.parent), *sys.path])
    finished = subprocess.run(
        [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures", "-m", "amibayes",
         *map(str, words), "--scheduler", "mpi"],
        env=os.environ | MPI_ALLOWED | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=200.0,
    )  # fmt: skip
    assert (tmp_path / "out" / "survey.json").is_file(), finished.stderr
    same(survey, tmp_path / "out")


def finished_targets(out: Path) -> int:
    return len(list(out.glob("*/result.json")))


@pytest.mark.parametrize("workers", [1, 2])
def test_killed_twice_and_resumed(survey: Path, tmp_path: Path, workers: int) -> None:
    out = tmp_path / "out"
    words = ("amibayes", "search", "--batch", survey / "targets.ecsv", *WORDS, "--out", out)
    words += ("--workers", workers, "--resume")
    for wanted in (1, 3):
        process = start(*words, stderr=subprocess.DEVNULL)
        limit = time.monotonic() + 100.0
        while finished_targets(out) < wanted and time.monotonic() < limit:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert wanted <= finished_targets(out) < 5
    kept = {p: p.stat().st_mtime_ns for p in out.glob("*/result.json")}
    assert start(*words, stderr=subprocess.DEVNULL).wait(timeout=100.0) == 4
    assert all(p.stat().st_mtime_ns == t for p, t in kept.items())
    same(survey, out)


def test_a_target_killed_when_it_was_done_leaves_nothing(survey: Path, tmp_path: Path) -> None:
    """Between its result and the end of its journal."""
    out = tmp_path / "out"
    shutil.copytree(survey / "serial", out)
    (out / "s2" / "search.journal" / "digest").mkdir(parents=True)
    words = ("--batch", survey / "targets.ecsv", *WORDS, "--out", out, "--resume")
    assert run("search", *words) == 4
    same(survey, out)


def test_interrupt_says_what_is_kept(survey: Path, tmp_path: Path) -> None:
    out, many = tmp_path / "out", 60  # more than are done before the signal comes
    names = {"target": ["s0.oifits"] * many, "name": [f"t{k}" for k in range(many)]}
    Table(names).write(survey / "many.ecsv")
    words = ("amibayes", "search", "--batch", survey / "many.ecsv", *WORDS, "--out", out)
    process = start(*words, stderr=subprocess.PIPE)
    limit = time.monotonic() + 100.0
    while finished_targets(out) < 1 and time.monotonic() < limit:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=60.0)[1].decode().strip()
    assert process.returncode == 4
    assert "interrupted: " in error, error
    told = int(error.split("interrupted: ")[1].split(f" of {many} targets are done")[0])
    entries = json.loads((out / "survey.json").read_text())["targets"]
    assert told == sum(e["status"] == "done" for e in entries)
    assert told in (finished_targets(out), finished_targets(out) - 1)
    assert error.endswith("(run again with --resume to go on)")

"""The same answer to the last bit wherever it is computed, and after any interruption."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import alive

from amibayes.support.request import digest

sys.path.insert(0, str(Path(__file__).parents[1]))
import parallel_work as work

from amibayes.errors import DataError, RunError, UsageError
from amibayes.parallel import (
    Journal,
    Journals,
    ProcessExecutor,
    SerialExecutor,
    child_seeds,
    open_executor,
    progress_bar,
    run_job,
    slices,
    spawn,
    stage_bars,
)


@pytest.fixture(scope="module", autouse=True)
def workers_find_the_tests() -> Iterator[None]:
    here = str(Path(__file__).parents[1])
    before = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join([here, before])
    yield
    os.environ["PYTHONPATH"] = before


@pytest.fixture(scope="module")
def two_processes() -> Iterator[ProcessExecutor]:
    executor = ProcessExecutor(2)
    yield executor
    executor.close()


def same_bytes(left: list[dict[str, Any]], right: list[dict[str, Any]]) -> bool:
    return all(
        np.asarray(a[name]).tobytes() == np.asarray(b[name]).tobytes()
        for a, b in zip(left, right, strict=True)
        for name in a
    )


def seeds(n: int = 7) -> list[np.random.SeedSequence]:
    return spawn(np.random.default_rng(5), n)


def test_processes_give_the_bits_of_a_serial_run(two_processes: ProcessExecutor) -> None:
    serial = list(SerialExecutor().map(work.noisy_product, seeds()))
    assert same_bytes(serial, list(two_processes.map(work.noisy_product, seeds())))
    one = ProcessExecutor(1)
    assert same_bytes(serial, list(one.map(work.noisy_product, seeds())))
    one.close()


def test_blas_has_one_thread_inside_a_piece(two_processes: ProcessExecutor) -> None:
    assert list(SerialExecutor().map(work.blas_threads, [0])) == [1]
    assert list(two_processes.map(work.blas_threads, [0, 1, 2])) == [1, 1, 1]


def test_results_come_in_order_and_no_further_ahead_than_needed(
    tmp_path: Path, two_processes: ProcessExecutor
) -> None:
    results = two_processes.map(work.counted_column, [(tmp_path, x) for x in range(40)])
    assert next(results)["square"] == 0
    time.sleep(0.3)
    assert len(list(tmp_path.iterdir())) <= 5
    assert [r["square"] for r in results] == [x * x for x in range(1, 40)]


def test_executor_serves_again_after_a_consumer_stopped_early(
    two_processes: ProcessExecutor,
) -> None:
    results = two_processes.map(work.square, list(range(20)))
    next(results)
    results.close()  # type: ignore[attr-defined]
    assert list(two_processes.map(work.square, [3, 4])) == [9, 16]


def test_error_of_a_piece_arrives_as_it_was(two_processes: ProcessExecutor) -> None:
    with pytest.raises(DataError) as raised:
        list(two_processes.map(work.fail, [1, 2]))
    assert str(raised.value) == "a.fits: is empty (give another)"
    assert "parallel_work.py" in raised.value.__notes__[0]
    with pytest.raises(RuntimeError, match="cannot travel"):
        list(two_processes.map(work.cannot_travel, [1]))


def test_killed_worker_is_replaced(tmp_path: Path, two_processes: ProcessExecutor) -> None:
    pieces = [(tmp_path, x) for x in range(5)]
    assert list(two_processes.map(work.kill_self_once, pieces)) == [0, 1, 4, 9, 16]


def test_piece_that_kills_every_worker_ends_the_run_in_one_line(
    two_processes: ProcessExecutor,
) -> None:
    with pytest.raises(RunError, match=r"piece \d lost its worker process 3 times \(signal 9\)"):
        list(two_processes.map(work.kill_self, [1, 2]))


def test_a_piece_that_kills_every_worker_may_be_answered_for(
    tmp_path: Path, two_processes: ProcessExecutor
) -> None:
    """Other pieces are done; the index is that of the job, whatever its journal has."""
    pieces = [(work.square, 3), (work.kill_self, 1), (work.square, 5), (work.kill_self, 2)]
    answers = run_job(work.apply, pieces, two_processes, lost=lambda k, error: (k, error.what))
    assert list(answers)[::2] == [9, 25]
    again = list(run_job(work.apply, pieces, two_processes, lost=lambda k, _: k))
    assert again == [9, 1, 25, 3]


PARENT = """
import sys
from pathlib import Path
import parallel_work as work
from amibayes.parallel import ProcessExecutor

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    list(ProcessExecutor(2).map(work.sleep_after_saying_who, [(folder, 1), (folder, 2)]))
"""


def wait_until(condition: Any, seconds: float = 20.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, str(script), str(tmp_path)])
    assert wait_until(lambda: len(list(tmp_path.glob("pid-*"))) == 2)
    parent.kill()
    parent.wait()
    pids = [int(path.name[4:]) for path in tmp_path.glob("pid-*")]
    assert wait_until(lambda: not any(alive(pid) for pid in pids), 5.0)


INTERRUPTED = """
import parallel_work as work
from amibayes.parallel import ProcessExecutor

if __name__ == "__main__":
    print(list(ProcessExecutor(2).map(work.whether_interrupts_are_blocked, [1, 2])))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_no_worker_ever_hears_an_interrupt(tmp_path: Path) -> None:
    """Not even the first of a process, with which Python starts a helper of its own."""
    script = tmp_path / "parent.py"
    script.write_text(INTERRUPTED)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("[True, True]\n", "")


def test_journal_resumes_where_a_run_was_killed(tmp_path: Path) -> None:
    pieces = [(tmp_path, x) for x in range(6)]
    key = digest("squares", 6)
    run = run_job(
        work.counted_column,
        pieces,
        SerialExecutor(),
        journal=Journal(tmp_path / "journal", key, resume=True),
    )
    for _ in range(4):
        next(run)
    run.close()  # type: ignore[attr-defined]
    told: list[tuple[int, int]] = []
    journal = Journal(tmp_path / "journal", key, resume=True)
    (journal.path / "piece-000001.npz").write_bytes(b"PK half a file")
    results = list(
        run_job(
            work.counted_column,
            pieces,
            SerialExecutor(),
            journal=journal,
            progress=lambda done, total: told.append((done, total)),
        )
    )
    assert [int(r["square"]) for r in results] == [0, 1, 4, 9, 16, 25]
    evaluations = [(tmp_path / f"{x}").read_text().count("once") for x in range(6)]
    assert evaluations == [1, 2, 1, 1, 1, 1]
    assert told == [(3, 6), (4, 6), (5, 6), (6, 6)]


def test_journalled_results_are_the_bits_of_fresh_ones(tmp_path: Path) -> None:
    fresh = list(SerialExecutor().map(work.noisy_product, seeds(3)))
    key = digest(seeds(3))
    for resume in (False, True):
        journal = Journal(tmp_path, key, resume=resume)
        kept = list(run_job(work.noisy_product, seeds(3), SerialExecutor(), journal=journal))
        assert same_bytes(fresh, kept)


def test_journal_without_resume_starts_afresh(tmp_path: Path) -> None:
    Journal(tmp_path, "key", resume=False).write(0, {"x": 1})
    assert Journal(tmp_path, "key", resume=True).read(0) == {"x": 1}
    assert Journal(tmp_path, "key", resume=False).read(0) is None


def test_an_interrupted_run_says_what_its_journals_keep(tmp_path: Path) -> None:
    journals = Journals(tmp_path, "key", resume=False)
    nothing = "no stage that can be kept was begun"
    with pytest.raises(KeyboardInterrupt, match=nothing), journals.telling():
        raise KeyboardInterrupt
    null = journals.of("null")
    for k in range(3):
        null.write(k, {"x": 1})
    journals.under("limits").of("aliases").write(0, {"x": 1})
    (tmp_path / "chain.h5").touch()
    told = r"kept 3 pieces of the null searches, 1 piece of the injections, the chain so far"
    with pytest.raises(KeyboardInterrupt, match=told), journals.telling(tmp_path / "chain.h5"):
        raise KeyboardInterrupt
    assert not {"null", "limits"} - {p.name for p in journals.path.iterdir()}


def test_unwritable_journal_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RunError, match="cannot be written"):
        Journal(tmp_path / "file", "key", resume=True)


@dataclass(frozen=True)
class InjectionSetup:
    wavelength_m: float
    name: str


def test_digest_tells_inputs_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    path.write_bytes(b"1")
    inputs: list[Any] = [
        1,
        1.0,
        "1",
        None,
        True,
        [1, 2],
        [[1], 2],
        {"a": 1},
        {"a": 2},
        np.arange(6),
        np.arange(6.0),
        np.arange(6).reshape(2, 3),
        np.float64(2.5),
        1j,
        b"1",
        InjectionSetup(4.3e-6, "F430M"),
        InjectionSetup(4.8e-6, "F430M"),
        np.random.SeedSequence(1),
        np.random.SeedSequence(1).spawn(1)[0],
        path,
    ]
    assert len({digest(item) for item in inputs}) == len(inputs)
    before = digest(path)
    path.write_bytes(b"2")
    assert digest(path) != before
    with pytest.raises(TypeError):
        digest(object())


def test_seeds_depend_on_the_parent_seed_only() -> None:
    first, again = (spawn(np.random.default_rng(9), 3) for _ in range(2))
    assert [s.generate_state(2).tolist() for s in first] == [
        s.generate_state(2).tolist() for s in again
    ]


def test_children_of_a_seed_are_always_the_same() -> None:
    seed = np.random.SeedSequence(4)
    twice = [[c.generate_state(2).tolist() for c in child_seeds(seed, 3)] for _ in range(2)]
    assert twice[0] == twice[1]
    assert twice[0] == [c.generate_state(2).tolist() for c in seed.spawn(3)]


def test_slices_cover_everything_once() -> None:
    assert slices(10, 4) == [slice(0, 4), slice(4, 8), slice(8, 10)]
    assert slices(0, 4) == []


def test_choice_of_executor() -> None:
    with open_executor() as executor:
        assert isinstance(executor, SerialExecutor)
    with open_executor(2) as executor:
        assert isinstance(executor, ProcessExecutor)
    with pytest.raises(UsageError, match="below one"), open_executor(0):
        pass
    with pytest.raises(UsageError, match="not an address"), open_executor(1, "localhost"):
        pass


def test_progress_bar_draws_on_standard_error_only(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with progress_bar("injections", unit="trial", scale=100) as progress:
        progress(2, 10)
        progress(5, 10)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "injections" in shown.err
    assert "500/1000" in shown.err
    with progress_bar("injections", quiet=True) as progress:
        progress(1, 2)
    assert capsys.readouterr().err == ""


def test_stages_follow_each_other(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with stage_bars(unit="draw") as bars:
        bars.stage("read")
        bars.stage("search")
        bars.update(40, 100)
        bars.update(100, 200)
        bars.stage("write")
    said = capsys.readouterr()
    assert said.out == ""
    for part in ("read …", "search", "40/100", "100/200", "write …"):
        assert part in said.err
    with stage_bars(quiet=True) as bars:
        bars.stage("read")
        bars.update(1, 2)
    assert capsys.readouterr().err == ""

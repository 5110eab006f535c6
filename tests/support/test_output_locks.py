"""Locks of output folders: of a run, of which one process may have several."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import pytest

from amibayes.errors import UsageError
from amibayes.support.atomic_files import output_folder, output_locks

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such locks")


def test_threads_have_runs_of_their_own(tmp_path: Path) -> None:
    """One ends while the other goes on: its folder stays locked, and is kept."""
    first_has, first_may_end = threading.Event(), threading.Event()

    def first() -> None:
        with output_locks():
            output_folder(tmp_path / "a", [], overwrite=True)
            first_has.set()
            first_may_end.wait(10.0)

    thread = threading.Thread(target=first)
    thread.start()
    assert first_has.wait(10.0)
    with output_locks():
        output_folder(tmp_path / "b", [], overwrite=True)
    assert (tmp_path / "a").is_dir()  # the other run's empty folder is not ours to take away
    assert not (tmp_path / "b").exists()
    with output_locks(), pytest.raises(UsageError, match="another run is writing here"):
        output_folder(tmp_path / "a", [], overwrite=True)
    first_may_end.set()
    thread.join()
    with output_locks():
        output_folder(tmp_path / "a", [], overwrite=True)


def test_a_part_of_a_run_shares_its_locks(tmp_path: Path) -> None:
    with output_locks():
        output_folder(tmp_path, [], overwrite=True)
        with output_locks():
            output_folder(tmp_path, [], overwrite=True)
            output_folder(tmp_path / "inner", [], overwrite=True)


def test_what_a_killed_run_left_half_written_is_taken_away(tmp_path: Path) -> None:
    ours = [".survey.0123abcd.ecsv", ".result.00000000.json"]
    others = [".survey.0123abc.ecsv", ".other.0123abcd.ecsv", "survey.ecsv", ".survey.ecsv"]
    for name in (*ours, *others):
        (tmp_path / name).touch()
    with output_locks():
        output_folder(tmp_path, ["survey.ecsv", "result.json"], overwrite=True)
        assert {p.name for p in tmp_path.iterdir()} == set(others)
        # Of the run itself, while it writes.
        (tmp_path / ours[0]).touch()
        output_folder(tmp_path, ["survey.ecsv"], overwrite=True)
        assert (tmp_path / ours[0]).exists()

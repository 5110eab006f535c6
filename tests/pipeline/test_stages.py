"""The stages of the main job: what they share, and what a run that was cut off keeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amibayes.errors import UsageError
from amibayes.parallel import Journals
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.run import Run
from amibayes.pipeline.search import search_companion
from amibayes.support.request import answers, refuse_other, request_of

QUICK = SearchOptions(separation_mas=(60.0, 300.0), null_draws=2000, posterior=False, limits=False)


def test_finished_null_draws_are_kept(target: Path, tmp_path: Path, monkeypatch) -> None:
    journals = Journals(tmp_path / "journal", "key", resume=True)
    stages: list[str] = []
    first = search_companion([target], [], QUICK, journals=journals, announce=stages.append)
    assert stages == ["read", "search", "significance"]
    assert set(first.timing_s) == set(stages)
    assert list(tmp_path.glob("journal/**/piece-*.npz"))

    def fail(*arguments: object) -> None:
        raise AssertionError("drawn again")

    monkeypatch.setattr("amibayes.detection.null_draws._piece", fail)
    again = search_companion([target], [], QUICK, journals=journals)
    assert first.significance is not None
    assert again.significance is not None
    np.testing.assert_array_equal(first.significance.null, again.significance.null)


def test_a_run_times_its_stages_and_divides_its_journals(tmp_path: Path) -> None:
    run = Run(journals=Journals(tmp_path / "journal", "key", resume=True))
    with run.under("vis2").stage("limits"):
        pass
    assert list(run.seconds) == ["limits"]
    journal = run.under("vis2").journal("null")
    assert journal is not None
    assert journal.path == tmp_path / "journal" / "key" / "vis2" / "null"
    assert Run().journal("null") is None


def test_a_request_is_files_in_their_roles_and_options(tmp_path: Path) -> None:
    one, two = tmp_path / "a", tmp_path / "b"
    one.write_text("1")
    two.write_text("2")
    requests = {
        request_of([one], [two], QUICK),
        request_of([two], [one], QUICK),
        request_of([one, two], [], QUICK),
        request_of([two, one], [], QUICK),
        request_of([one], [two], SearchOptions()),
    }
    assert len(requests) == 5
    two.write_text("3")
    assert request_of([one], [two], QUICK) not in requests
    two.rename(tmp_path / "c")
    two.write_text("2")
    assert request_of([one], [two], QUICK) in requests


def test_the_answer_to_another_request_is_refused_unless_this_one_was_begun(tmp_path: Path) -> None:
    path, journal = tmp_path / "result.json", tmp_path / "journal"
    refuse_other(path, "asked", journal)
    path.write_text('{"request": "other"}')
    with pytest.raises(UsageError, match="other data or options"):
        refuse_other(path, "asked", journal)
    (journal / "asked").mkdir(parents=True)
    refuse_other(path, "asked", journal)
    path.write_text('{"request": "asked"}')
    assert answers(path, "asked") == {"request": "asked"}
    path.write_text('{"request": ""}')
    assert answers(path, "") is None

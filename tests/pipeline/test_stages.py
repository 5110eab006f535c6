"""The stages of the main job: what they share, and what a run that was cut off keeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.errors import UsageError
from amibayes.oifits import write_oifits
from amibayes.parallel import Journals
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.report_types import SearchReport
from amibayes.pipeline.run import Run
from amibayes.pipeline.search import search_companion
from amibayes.report import result_json
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


STAGES = {
    "amibayes.pipeline.search.prepare": ["data"],
    "amibayes.pipeline.search.search_field": ["data", "search"],
    "amibayes.pipeline.search.false_alarm": ["data", "search", "significance"],
    "amibayes.pipeline.search.verdict_of": ["data", "search", "significance", "verdict"],
    "amibayes.pipeline.search.detection_limit": [
        "data", "search", "significance", "verdict", "limits",
    ],
}  # fmt: skip
"""What does each stage, and the stages that are kept once it has ended."""


def fail(*arguments: object, **more: object) -> None:
    raise AssertionError("done again")


def numbers(report: SearchReport) -> dict[str, object]:
    """All of the answer but how long it took."""
    content = result_json(report, "key")
    assert content.pop("timing_s")
    return content


@pytest.mark.parametrize(
    "after",
    [
        pytest.param(k, marks=() if k in (1, len(STAGES) - 1) else pytest.mark.slow)
        for k in range(1, len(STAGES))
    ],
)
def test_a_run_goes_on_behind_every_finished_stage(target, tmp_path, monkeypatch, after) -> None:
    """Cut off before a stage, it does none again of those before, with the same numbers."""
    options = replace(QUICK, null_draws=4000, limits=after == len(STAGES) - 1)
    whole = search_companion([target], [], options)
    work = list(STAGES)
    with monkeypatch.context() as patch:
        patch.setattr(work[after], interrupt)
        with pytest.raises(KeyboardInterrupt):
            search_companion([target], [], options, journals=Journals(tmp_path, "k", resume=False))
    kept = Journals(tmp_path, "k", resume=True)
    assert f"the stages {', '.join(STAGES[work[after - 1]])}" in kept.kept()
    for done in work[:after]:
        monkeypatch.setattr(done, fail)
    again = search_companion([target], [], options, journals=kept)
    assert numbers(again) == numbers(whole)
    assert again.timing_s.keys() == whole.timing_s.keys()


def interrupt(*arguments: object, **more: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_all_stages_of_a_whole_run_are_read_back(target, tmp_path, monkeypatch) -> None:
    """Calibrators, a second companion, evidence, posterior, models: every class of theirs."""
    calibrators = []
    for k in range(3):
        data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(20 + k))
        calibrators.append(tmp_path / f"c{k}.oifits")
        write_oifits(calibrators[-1], data)
    options = SearchOptions(
        separation_mas=(60.0, 300.0),
        null_draws=2000,
        companions=(0, 1, 2),
        models=("star", "companion", "ring"),
    )
    words = [target], calibrators, options
    first = search_companion(*words, journals=Journals(tmp_path, "k", resume=False))
    work = [*STAGES, "amibayes.pipeline.search._significance", "amibayes.pipeline.search.sample"]
    names = ("grid_posterior", "compare_models", "bootstrap", "compare_stage", "limits_stage")
    for name in (*work, *(f"amibayes.pipeline.search.{n}" for n in names)):
        monkeypatch.setattr(name, fail)
    again = search_companion(*words, journals=Journals(tmp_path, "k", resume=True))
    assert numbers(again) == numbers(first)

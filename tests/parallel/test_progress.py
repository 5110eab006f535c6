"""Progress off a terminal: a line a minute, and none for what is done before."""

from __future__ import annotations

import pytest

from amibayes.parallel import progress_bar, stage_bars


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [1000.0]
    monkeypatch.setattr("amibayes.parallel.progress.time.perf_counter", lambda: now[0])
    return now


def test_a_long_stage_reports_once_a_minute_off_a_terminal(clock, capsys) -> None:
    with progress_bar("targets", unit="target") as report:
        report(100, 1000)  # an earlier run left these
        for k in range(1, 31):
            clock[0] += 10.0
            report(100 + 5 * k, 1000)
    lines = capsys.readouterr().err.strip().split("\n")
    assert len(lines) == 5
    assert lines[0] == "amibayes: targets: 130 of 1000 targets, 0.5 targets/s, 29:00 left"


def test_short_and_quiet_runs_write_nothing(clock, capsys) -> None:
    with stage_bars() as bars:
        for stage in ("search", "limits"):
            bars.stage(stage)
            for k in range(5):
                clock[0] += 5.0
                bars.update(k, 5)
    assert not capsys.readouterr().err
    with progress_bar("targets", quiet=True) as report:
        report(0, 2)
        clock[0] += 500.0
        report(1, 2)
    assert not capsys.readouterr().err


def test_the_line_is_of_the_stage_that_runs(clock, capsys) -> None:
    with stage_bars(unit="draw") as bars:
        bars.stage("significance")
        bars.update(0, 10)
        clock[0] += 40.0
        bars.update(9, 10)
        bars.stage("limits")
        bars.update(0, 4)
        clock[0] += 30.0
        bars.update(1, 4)
    assert capsys.readouterr().err == "amibayes: limits: 1 of 4 draws, 0.0333 draws/s, 01:30 left\n"

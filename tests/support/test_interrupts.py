"""A request to end is one, whatever the library that it came up in makes of it."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from astropy.table import Table
from commands import run

from amibayes.cli import search
from amibayes.support.interrupts import ending, polite_end


@pytest.fixture(autouse=True)
def _heeded() -> Iterator[None]:
    """What is started behind a shell's & ignores Ctrl-C, and so would these tests."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupted(number: signal.Signals, instead: TypeError | None) -> None:
    """Receive a signal where a library raises an error of its own, or none, for what comes up."""
    try:
        signal.raise_signal(number)
    except KeyboardInterrupt:
        if instead:
            raise instead from None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("instead", [TypeError("no common dtype"), None])
def test_request_that_a_library_replaces(number: signal.Signals, instead: TypeError | None) -> None:
    with polite_end(), pytest.raises(KeyboardInterrupt), ending():
        interrupted(number, instead)


def test_errors_without_a_request_stay() -> None:
    with polite_end(), pytest.raises(TypeError, match="of its own"), ending():
        raise TypeError("of its own")


def test_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with polite_end():
        assert signal.getsignal(signal.SIGINT) is not before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_survey_ends_where_a_library_replaces_the_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """numpy makes a TypeError of what is raised while it compares structured arrays."""

    replaced = TypeError("Cannot compare structured arrays")
    monkeypatch.setattr(search, "perform", lambda _: interrupted(signal.SIGINT, replaced))
    Table({"target": ["a.oifits", "b.oifits"]}).write(tmp_path / "targets.ecsv")
    out = tmp_path / "out"
    assert run("search", "--batch", tmp_path / "targets.ecsv", "--out", out) == 4
    assert "interrupted: 0 of 2 targets are done" in capsys.readouterr().err
    entries = json.loads((out / "survey.json").read_text())["targets"]
    assert [e["status"] for e in entries] == ["pending", "pending"]

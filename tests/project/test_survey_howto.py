"""The page on surveys: its table is read, its programs are programs, its names are real."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path

import pytest

from amibayes.cli.main import build_parser
from amibayes.pipeline.batch import read_targets

PAGE = (Path(__file__).parents[2] / "docs" / "howto" / "survey.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


def test_the_table_of_targets_is_one(tmp_path: Path) -> None:
    (text,) = blocks("text")
    (tmp_path / "targets.ecsv").write_text(text)
    first, second = read_targets(tmp_path / "targets.ecsv")
    assert first.cal == ("cal1.oifits", "cal2.oifits")
    assert second.facts == {"distance_pc": 41.0}


def test_programs_are_programs() -> None:
    assert len(blocks("python")) == 2
    for text in blocks("python"):
        ast.parse(text)


COMMANDS = [
    line
    for text in blocks("bash")
    for line in text.replace("\\\n", " ").splitlines()
    if line.startswith("amibayes ")
]


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_are_understood(line: str) -> None:
    words = shlex.split(line.split("#")[0])[1:]
    parsed = build_parser(words[0]).parse_args(words)
    assert parsed.batch.endswith("targets.ecsv")


def test_several_commands_were_found() -> None:
    assert len(COMMANDS) >= 3

"""One list of choices and defaults: the command line, the API and the documentation agree."""

from __future__ import annotations

import argparse
import inspect
import re
from dataclasses import replace
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from amibayes.cli import limits as limits_command
from amibayes.cli import search as search_command
from amibayes.cli.main import COMMANDS, build_parser, command_parsers
from amibayes.extraction import ExtractOptions
from amibayes.extraction.reading import ImageOptions
from amibayes.pipeline.limits import LimitsOptions
from amibayes.pipeline.options import SearchOptions
from amibayes.support.options import EVIDENCE_METHODS, EXTRACTION_METHODS, entry

TABLES = {"method": EXTRACTION_METHODS, "evidence_method": EVIDENCE_METHODS}
"""Choices that are a table, to which a kind may be added."""


def parsed(command: str, *words: str) -> argparse.Namespace:
    return build_parser(command).parse_args([command, *words])


def actions(command: str) -> dict[str, argparse.Action]:
    parser = command_parsers(build_parser(command))[command]
    return {flag: a for a in parser._actions for flag in a.option_strings}


def without_images(options: SearchOptions) -> SearchOptions:
    return replace(options, images=None)


def test_the_command_asks_what_the_function_does_unless_told() -> None:
    options = search_command._options(parsed("search", "x.oifits"))
    assert options.images == ImageOptions(ExtractOptions(), options.images.header)
    assert not any(options.images.header.values())
    assert without_images(options) == SearchOptions()
    found = limits_command._options(parsed("limits", "x.oifits"))
    assert replace(found, search=without_images(found.search)) == LimitsOptions()


@pytest.mark.parametrize("kind", [SearchOptions, LimitsOptions, ExtractOptions])
def test_docstrings_list_the_choices(kind: type) -> None:
    listed = dict(re.findall(r"^    (\w+) : \{(.*?)\}", str(kind.__doc__), flags=re.MULTILINE))
    hints = get_type_hints(kind)
    for name in listed:
        known = list(literals(hints[name])) or list(TABLES[name])
        assert re.findall(r'"(.*?)"', listed[name]) == known, name


@pytest.mark.parametrize("method", EXTRACTION_METHODS)
def test_every_method_of_extraction_can_be_made(method: str) -> None:
    parameters = inspect.signature(entry(EXTRACTION_METHODS[method])).parameters
    assert list(parameters)[::2] == ["view", "fit"]


def literals(hint: Any) -> tuple[str, ...]:
    """Values of the ``Literal`` in a type."""
    if get_origin(hint) is not None and all(isinstance(a, str) for a in get_args(hint)):
        return get_args(hint)
    return tuple(value for part in get_args(hint) for value in literals(part))


def test_one_name_means_one_thing_in_every_command() -> None:
    """Choices and metavar of an option are those of the other commands that have it."""
    seen: dict[str, tuple[Any, ...]] = {}
    for command in COMMANDS:
        for flag, action in actions(command).items():
            meaning = (action.metavar, action.choices, action.nargs)
            assert seen.setdefault(flag, meaning) == meaning, (command, flag)

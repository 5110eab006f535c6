"""What the documentation says exists, and what exists is in the documentation."""

from __future__ import annotations

import argparse
import ast
import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import script

import amibayes
from amibayes.cli import main as amibayes_command
from amibayes.cli.main import COMMANDS, build_parser
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.search import search_companion
from amibayes.report import result_json

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [p for p in sorted(DOCS.rglob("*.md")) if not p.relative_to(DOCS).parts[0].startswith("_")]
FREE_FORM = {"convergence", "prior", "timing_s", "parameters", "confusion"}
"""Objects of result.json whose keys are parameters of the model, or stages."""


@pytest.fixture(scope="module")
def generate() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(DOCS / "generate.py")))


def test_the_reference_of_python_lists_what_is_public_and_nothing_else() -> None:
    text = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\.\. auto\w+:: amibayes\.(\w+)$", text, re.MULTILINE)
    assert sorted(listed) == sorted(amibayes.__all__)


def options_of(command: str, generate: SimpleNamespace) -> argparse.ArgumentParser:
    return generate.child(build_parser(command), command)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_reference_of_commands_holds_every_option(
    command: str, generate: SimpleNamespace
) -> None:
    parser = options_of(command, generate)
    page = generate.page(parser, command, COMMANDS[command])
    for option in parser._option_string_actions:
        assert option in page
    assert "%(default)s" not in page


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda p: p.name)
def test_every_option_that_a_page_tells_to_use_exists(
    page: Path, generate: SimpleNamespace
) -> None:
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    for command, rest in re.findall(r"\bamibayes ([a-z]+) ([^`\n]*)", text):
        if command in COMMANDS:
            known = options_of(command, generate)._option_string_actions
            for option in re.findall(r"(?<!\S)--[a-z][a-z-]*", rest):
                assert option in known, f"{page.name}: amibayes {command} {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(DOCS)))
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_page_stands_in_a_table_of_contents() -> None:
    listed = {DOCS / "index.md"}
    for page in PAGES:
        for tree in re.findall(r"^```{toctree}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S):
            entries = [e for e in tree.split() if not e.startswith(":")]
            listed |= {(page.parent / f"{entry}.md").resolve() for entry in entries}
    assert not set(PAGES) - listed


@pytest.mark.parametrize("page", [p for p in PAGES if "_generated/" in p.read_text()], ids=str)
def test_pictures_are_those_that_a_script_makes(page: Path) -> None:
    scripts = {"tutorial": "tutorial.py", "gallery": "gallery.py", "statistics": "figures.py"}
    pictures = ROOT / "amibayes" / "plots" / "pictures.py"
    for folder, name in re.findall(r"_generated/(\w+)/(\w+)\.png", page.read_text("utf-8")):
        code = (DOCS / scripts[folder]).read_text("utf-8") + pictures.read_text("utf-8")
        assert name in code, f"{page.name}: {folder}/{name}.png"


def python_of(page: Path) -> list[str]:
    """The blocks of Python of a page."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


@pytest.mark.parametrize("page", [p for p in [*PAGES, ROOT / "README.md"] if python_of(p)], ids=str)
def test_python_on_a_page_names_what_there_is(page: Path) -> None:
    for block in python_of(page):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("amibayes"):
                module = importlib.import_module(str(node.module))
                assert all(hasattr(module, name.name) for name in node.names), block


def test_the_notebook_of_the_how_to_runs(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    blocks = python_of(DOCS / "howto" / "notebook.md")
    if importlib.util.find_spec("arviz") is None:
        blocks = [block for block in blocks if "to_inference_data" not in block]
    (tmp_path / "notebook.py").write_text("\n".join(blocks))
    names = runpy.run_path(str(tmp_path / "notebook.py"))
    assert (tmp_path / "closure_phases.ecsv").stat().st_size > 1000
    assert names["low"] - 0.1 < 5.0 < names["high"] + 0.1
    assert len(names["samples"]) > 1000


def keys_of(content: object) -> set[str]:
    if isinstance(content, list):
        return set().union(*(keys_of(item) for item in content)) if content else set()
    if not isinstance(content, dict):
        return set()
    nested = [keys_of(value) for key, value in content.items() if key not in FREE_FORM]
    return set(content).union(*nested)


@pytest.mark.slow
def test_every_key_of_the_result_is_explained() -> None:
    data = ROOT / "examples" / "data"
    options = SearchOptions(null_draws=1000, separation_mas=(94.0, 200.0))
    report = search_companion([data / "target.oifits"], sorted(data.glob("cal*.oifits")), options)
    page = (DOCS / "reference" / "result_json.md").read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", page.split("## An example")[0]))
    content = result_json(report)
    assert set(content.pop("options")) == {field.name for field in fields(SearchOptions)}
    missing = (keys_of(content) | {"options"}) - words
    assert not missing


def test_the_mask_of_the_how_to_is_one() -> None:
    mine = amibayes.load_instrument(DOCS / "howto" / "my_mask.toml", "K")
    assert mine.mask.n_baselines == 15
    assert mine.mask.non_redundant


@pytest.mark.slow
def test_the_readme_prints_what_the_command_does(tmp_path: Path, monkeypatch, capsys) -> None:
    """All lines but those of the far tail, whose extrapolation any change of a library moves."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"bin/amibayes (search .*)", readme)
    target, _, pattern, _ = shlex.split(command)[1:]
    cals = sorted(str(p) for p in Path().glob(pattern))
    assert amibayes_command(["search", target, "--cal", *cals]) == 0
    printed = capsys.readouterr().out.splitlines()
    (told,) = re.findall(r"^```\n(verdict .*?)^```", readme, re.MULTILINE | re.DOTALL)
    tail = "extrapolated"
    assert [x.split(tail)[0] for x in printed] == [x.split(tail)[0] for x in told.splitlines()]


@pytest.mark.slow
def test_the_tutorial_finds_its_companion(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, *script("generate").STRICT, str(DOCS / "tutorial.py"), str(tmp_path)],
        check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
    )
    for name in ("map", "fit", "null", "corner", "limits"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000

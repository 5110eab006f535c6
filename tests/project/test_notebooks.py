"""The notebooks run as they stand, and are notebooks."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import ROOT

FOLDER = ROOT / "docs" / "notebooks"
SCRIPTS = sorted(p for p in FOLDER.glob("*.py") if p.name != "make.py")


@pytest.fixture(scope="module")
def make() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(FOLDER / "make.py")))


DEAR = ("survey",)  # four searches with limits
EACH = [pytest.param(p, marks=[pytest.mark.slow] * (p.stem in DEAR), id=p.stem) for p in SCRIPTS]


@pytest.mark.parametrize("script", EACH)
def test_a_notebook_runs(script: Path, monkeypatch, capsys) -> None:
    """Its assertions hold what it says of the truth."""
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(script))
    capsys.readouterr()


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_cells_hold_all_of_the_script(script: Path, make: SimpleNamespace) -> None:
    text = script.read_text(encoding="utf-8")
    found = make.cells(text)
    assert found[0][0] == "markdown"
    assert found[0][1].startswith("# ")
    code = "\n".join(body for kind, body in found if kind == "code")
    compile(code, script.name, "exec")
    wanted = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert [line for line in code.splitlines() if line and not line.startswith("#")] == wanted


def test_notebooks_are_written(tmp_path: Path) -> None:
    subprocess.run([sys.executable, str(FOLDER / "make.py"), str(tmp_path)], check=True,
                   capture_output=True)  # fmt: skip
    assert {p.stem for p in tmp_path.glob("*.ipynb")} == {p.stem for p in SCRIPTS}
    content = json.loads((tmp_path / "first_look.ipynb").read_text())
    assert content["nbformat"] == 4
    assert {cell["cell_type"] for cell in content["cells"]} == {"markdown", "code"}


@pytest.mark.slow
def test_a_notebook_is_executed_by_jupyter(make: SimpleNamespace) -> None:
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    made = make.executed(make.notebook((FOLDER / "first_look.py").read_text(encoding="utf-8")))
    shown = [cell["outputs"] for cell in made["cells"] if cell["cell_type"] == "code"]
    assert any("text/html" in output.get("data", {}) for outputs in shown for output in outputs)


def test_the_tutorial_of_the_repository_is_that_of_the_documentation() -> None:
    """Its prose and code; the output is that of the run it was made from."""
    page = (ROOT / "examples" / "tutorial" / "README.md").read_text(encoding="utf-8")
    source = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    code = (ROOT / "docs" / "tutorial.py").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)\n```", page, re.M | re.S)
    assert len(blocks) >= 8
    assert all(block in code for block in blocks)
    headings = re.findall(r"^#+ .*", source, re.M)
    assert [line for line in page.splitlines() if line in headings] == headings
    assert "{literalinclude}" not in page
    pictures = re.findall(r"!\[.+\]\((\w+\.png)\)", page)
    assert len(pictures) >= 5
    for name in pictures:
        assert (ROOT / "examples" / "tutorial" / name).stat().st_size < 100_000
    for link in re.findall(r"\]\((\.\./[^)#]+)", page):
        assert (ROOT / "examples" / "tutorial" / link).exists(), link


def test_inclusions_are_cut_at_their_marks() -> None:
    make = runpy.run_path(str(ROOT / "docs" / "render_tutorial.py"))
    text = "# [a]\none\n# [/a]\n# [b]\ntwo\n# [/b]\n"
    options = ':start-after: "# [b]"\n:end-before: "# [/b]"\n'
    assert make["part"](text, options) == "two"
    assert make["part"](text, ":language: text\n") == text.strip("\n")

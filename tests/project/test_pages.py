"""Tables go to their marks, and what they were made with is told apart from what came later."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import ModuleType

import pytest
from conftest import ROOT
from helpers import script_of_docs

MARKS = [
    (page.relative_to(ROOT / "docs").as_posix(), mark)
    for page in sorted((ROOT / "docs").rglob("*.md"))
    for mark in re.findall(
        r"^<!-- (\w+: [\w/]+\.py.*) -->$", page.read_text(encoding="utf-8"), re.M
    )
]

BEGIN, END = "<!-- table: docs/script.py -->", "<!-- end of table: docs/script.py -->"


@pytest.fixture
def made_with(tmp_path: Path, monkeypatch) -> ModuleType:
    """The module on a small project: a script that uses one of two packages."""
    module = script_of_docs("made_with")
    texts = {
        "docs/script.py": "from amibayes.used import f\n",
        "docs/lazy.py": "import amibayes as ab\nprint(ab.f)\n",
        "docs/page.md": f"a\n{BEGIN}\nold\n{END}\nb\n",
        "amibayes/__init__.pyi": "from .used import f as f\n",
        "amibayes/used/__init__.py": "from amibayes.deeper.part import g\n\ndef f(): return g()\n",
        "amibayes/deeper/part.py": "def g(): return 1\n",
        "amibayes/other.py": "h = 1\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "KEPT", tmp_path / "made_with.json")
    module._public.cache_clear()
    yield module
    module._public.cache_clear()


@pytest.mark.parametrize("script", ["docs/script.py", "docs/lazy.py"])
def test_only_code_that_a_script_uses_makes_it_old(made_with: ModuleType, script: str) -> None:
    root = made_with.ROOT
    made_with.record(script)
    assert made_with.changed() == {script: []}
    (root / "amibayes/other.py").write_text("h = 2\n")
    (root / "amibayes/deeper/part.py").write_text('def g():\n    """Say."""\n    return 1  # one\n')
    made_with._tree.cache_clear()
    assert made_with.changed() == {script: []}
    (root / "amibayes/deeper/part.py").write_text("def g(): return 2\n")
    made_with._tree.cache_clear()
    assert made_with.changed() == {script: ["deeper"]}
    made_with.record(script)
    assert made_with.changed() == {script: []}


def test_a_table_goes_to_its_mark(made_with: ModuleType, monkeypatch) -> None:
    pages = script_of_docs("pages")
    monkeypatch.setattr(pages, "made_with", made_with)
    monkeypatch.setattr(pages, "__file__", str(made_with.ROOT / "docs" / "pages.py"))
    for _ in range(2):
        pages.put_tables(
            "page.md", ["made in 3 s\n", "| x |\n", "|---|\n", "end\n"], "table: docs/script.py"
        )
        page = (made_with.ROOT / "docs/page.md").read_text()
        assert page == f"a\n{BEGIN}\n\n| x |\n|---|\n\n{END}\nb\n"
    assert list(made_with.changed()) == ["docs/script.py"]
    with pytest.raises(ValueError, match="no lines"):
        pages.put_table("page.md", [], "table: docs/other.py")


@pytest.mark.parametrize(("page", "mark"), MARKS)
def test_every_mark_names_a_script_and_ends(page: str, mark: str) -> None:
    assert (ROOT / mark.split()[1]).is_file()
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    between = text.partition(f"<!-- {mark} -->")[2]
    assert f"<!-- end of {mark} -->" in between


def test_scripts_are_found_with_what_they_measure() -> None:
    made_with = script_of_docs("made_with")
    assert {"companion_search", "detection"} <= made_with.digests(ROOT / "docs/power.py").keys()
    for name in json.loads(made_with.KEPT.read_text(encoding="utf-8")):
        assert (ROOT / name).is_file(), f"{name} has gone: take it out of docs/made_with.json"


def test_a_table_of_older_answers_is_not_new(made_with: ModuleType, monkeypatch) -> None:
    """Each answer has the digest of its code: one from before a change keeps the table old."""
    pages, trials = script_of_docs("pages"), script_of_docs("trials")
    monkeypatch.setattr(pages, "made_with", made_with)
    monkeypatch.setattr(trials, "code_of", made_with.code_of)
    monkeypatch.setattr(pages, "__file__", str(made_with.ROOT / "docs" / "pages.py"))
    path, script = made_with.ROOT / "answers.jsonl", "docs/script.py"

    def written() -> dict[str, list[str]]:
        pages.put_table("page.md", ["| x |"], f"table: {script}", trials.known_answers(path))
        return made_with.changed()

    trials.keep_answer(path, {"k": 0}, script)
    assert written() == {script: []}
    (made_with.ROOT / "amibayes/deeper/part.py").write_text("def g(): return 2\n")
    made_with._tree.cache_clear()
    made_with.code_of.cache_clear()
    trials.keep_answer(path, {"k": 1}, script)
    assert written() == {script: ["deeper"]}
    trials.forget_answers(path, lambda answer: answer["k"] == 0)
    assert written() == {script: []}

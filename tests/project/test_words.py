"""Plain terms of the field: words that a reader would have to translate are not used."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

INSTEAD = {
    r"as a reader would tell": "name the stages",
    r"\bbelie(?:ved?|ves|ving)\b": "use, keep, trust by a number",
    r"\bcautions?\b|\bdoubts\b": "warnings, notes",
    r"\bjudg(?:es?|ed|ing)\b": "test, classify",
    r"\bweigh(?:s|ed|ing)?\b": "false-alarm probability, compare",
    r"left standing": "modes within Δχ² 25",
    r"sound programme": "correct implementation",
    r"\bhangs? (?:on|together)\b": "depends on, is correlated",
    r"\bmended\b": "fixed, corrected",
    r"\babsurd\b": "unusable",
    r"\bblam(?:e|ing)\b": "name the source",
    r"stands? off the others": "is an outlier",
    r"\bsettles?\b": "converges",
    r"whole story|\bhouse is built\b|[Ll]ight comes in": "what it is",
}
"""Words that are not used, and what to write instead."""

LATER = {"amibayes/extraction/geometry.py"}
"""Files that are still to follow."""


def texts() -> list[Path]:
    """Code and pages, but for what is made from them."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    for folder in ("amibayes", "docs", "examples", "benchmarks"):
        found += [p for s in ("*.py", "*.md", "*.toml", "*.pyi") for p in (ROOT / folder).rglob(s)]
    made = {"_generated", "_build"}
    return [p for p in found if not made & set(p.parts) and str(p.relative_to(ROOT)) not in LATER]


@cache
def lines() -> list[tuple[str, str]]:
    """Every line with its place."""
    return [
        (f"{path.relative_to(ROOT)}:{n}", line)
        for path in texts()
        for n, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
    ]


@pytest.mark.parametrize("word", INSTEAD)
def test_plain_words(word: str) -> None:
    found = [f"{at}: {line.strip()[:90]}" for at, line in lines() if re.search(word, line)]
    assert not found, f"instead: {INSTEAD[word]}\n" + "\n".join(found)

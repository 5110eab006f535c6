"""Every proof that the page of claims names is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from conftest import ROOT

PAGE = (ROOT / "docs" / "claims.md").read_text(encoding="utf-8")
ROWS = [line for line in PAGE.splitlines() if line.startswith("| ") and "`" in line]
PROOFS = sorted(set(re.findall(r"`((?:tests|docs|benchmarks)/[^`]+)`", PAGE)))


@pytest.mark.parametrize("proof", PROOFS)
def test_a_proof_is_there(proof: str) -> None:
    path, _, name = proof.partition("::")
    assert (ROOT / path).is_file()
    assert path.startswith("tests/") == bool(name)
    if name:
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_claim_has_a_place_and_a_proof() -> None:
    assert len(ROWS) > 25
    for row in ROWS:
        claim, where, proof = (cell.strip() for cell in row.strip("|").split(" | "))
        assert claim
        assert "README" in where or "](" in where
        assert "`" in proof


def test_scripts_that_pages_name_are_there() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    for page in pages:
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"`((?:tests|docs|benchmarks|examples)/[\w/]+\.py)`", text):
            assert (ROOT / Path(name)).is_file(), f"{page.name}: {name}"

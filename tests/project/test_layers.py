"""Imports point one way only: a module uses what stands above it, never what stands below."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "amibayes"

LAYERS = [
    "__init__",
    "units",
    "errors",
    "support",
    "parallel",
    "scene",
    "instrument",
    "optics",
    "cube",
    "simulation",
    "data",
    "oifits",
    "extraction",
    "calibration",
    "models",
    "likelihood",
    "companion_search",
    "detection",
    "posterior",
    "limits",
    "pipeline",
    "validation",
    "plots",
    "report",
    "cli",
    "__main__",
]


def layer_of(module: str) -> int:
    return LAYERS.index(module.split(".")[1] if "." in module else "__init__")


def module_name(path: Path) -> str:
    parts = ("amibayes", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(part for part in parts if part != "__init__")


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"


def imported(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped = {
        id(n) for block in ast.walk(tree) if is_type_checking(block) for n in ast.walk(block)
    }
    names: set[str] = set()
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {
                f"{node.module}.{a.name}" if node.module == "amibayes" else str(node.module)
                for a in node.names
            }
    return {name for name in names if name.split(".")[0] == "amibayes"}


def resolve(name: str) -> str:
    """`from amibayes import __version__` names the package, not a module of it."""
    target = name.split(".")
    if len(target) > 1 and target[1] in LAYERS:
        return name
    return "amibayes"


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=module_name)
def test_imports_point_only_upward(path: Path) -> None:
    module = module_name(path)
    own = layer_of(module)
    for name in imported(path):
        assert layer_of(resolve(name)) <= own, f"{module} (layer {own}) imports {name}"

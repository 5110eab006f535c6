"""Imports point one way only: a module uses what stands above it, never what stands below."""

from __future__ import annotations

import ast
from collections import Counter
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from sizes import nodes

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
    "ramps",
    "simulation",
    "data",
    "oifits",
    "kpfits",
    "extraction",
    "calibration",
    "models",
    "likelihood",
    "companion_search",
    "detection",
    "posterior",
    "limits",
    "comparison",
    "survey",
    "imaging",
    "pipeline",
    "validation",
    "plots",
    "report",
    "cli",
    "__main__",
]

MAX_LOOSE, MAX_IN_FOLDER = 8, 18
"""Modules beside the packages, and modules in one folder, that a reader can still take in."""


def layer_of(module: str) -> int:
    return LAYERS.index(module.split(".")[1] if "." in module else "__init__")


def module_name(path: Path) -> str:
    parts = ("amibayes", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(part for part in parts if part != "__init__")


PATHS = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def imported(path: Path) -> set[str]:
    """Modules of the package that a module imports: at its top, in a function, for its types."""
    names: set[str] = set()
    for node in nodes(path.read_text(encoding="utf-8")):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            longer = {f"{node.module}.{a.name}" for a in node.names}
            names |= {name if name in PATHS else str(node.module) for name in longer}
    return {name for name in names if name.split(".")[0] == "amibayes"}


@pytest.mark.parametrize("module", PATHS)
def test_imports_point_only_upward(module: str) -> None:
    own = layer_of(module)
    for name in imported(PATHS[module]):
        assert layer_of(name) <= own, f"{module} (layer {own}) imports {name}"


def test_no_module_imports_itself_by_way_of_others() -> None:
    graph = TopologicalSorter({name: imported(path) - {name} for name, path in PATHS.items()})
    try:
        graph.prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_a_circle_is_found() -> None:
    with pytest.raises(CycleError):
        TopologicalSorter({"a": {"b"}, "b": {"c"}, "c": {"a"}}).prepare()


def test_folders_can_be_taken_in() -> None:
    counts = Counter(path.parent for path in PATHS.values())
    assert counts.pop(PACKAGE) <= MAX_LOOSE
    assert not {str(p.relative_to(PACKAGE)): n for p, n in counts.items() if n > MAX_IN_FOLDER}


def test_files_of_tests_have_names_of_their_own() -> None:
    """Two modules of one name in different folders cannot be collected together."""
    names = Counter(path.name for path in (PACKAGE.parent / "tests").rglob("*.py"))
    shared = {name for name, n in names.items() if n > 1}
    assert shared <= {"__init__.py", "conftest.py"}

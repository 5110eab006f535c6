"""Which tables and pictures of the documentation are older than the code that they measure.

    python docs/made_with.py

says for every script that wrote into a page, or into `static/`, which packages have changed since.
What a package is when a script runs is kept in `made_with.json` as digests of its syntax trees,
without docstrings: comments and layout change nothing. Only the packages that the script imports
count, with those that they import. What the documentation makes anew at every build is not here.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TypeGuard

ROOT = Path(__file__).resolve().parents[1]
KEPT = Path(__file__).with_name("made_with.json")
SHOWN_ONLY = ("cli", "report", "plots", "support", "parallel", "errors", "units", "__init__")
"""Packages that show or carry numbers and make none."""
TOOLS = ("docs/pages.py", "docs/made_with.py")


def record(script: Path | str) -> None:
    """Keep what the packages are now, under the name of a script that has just written.

    Parameters
    ----------
    script : path
        Relative to the root of the clone, or absolute.
    """
    name = (ROOT / script).resolve().relative_to(ROOT).as_posix()
    kept = _kept() | {name: digests(ROOT / name)}
    KEPT.write_text(json.dumps(dict(sorted(kept.items())), indent=1) + "\n", encoding="utf-8")


def changed() -> dict[str, list[str]]:
    """Packages that have changed since each recorded script wrote; empty where none has."""
    found = {}
    for name, before in _kept().items():
        now = digests(ROOT / name) if (ROOT / name).is_file() else {}
        found[name] = sorted(package for package in now if before.get(package) != now[package])
    return found


@cache
def code_of(script: Path | str) -> str:
    """One digest of all that a script uses, which goes with each answer that it keeps."""
    parts = digests((ROOT / script).resolve())
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]


def digests(script: Path) -> dict[str, str]:
    """A digest for each package that a script uses, and for the script itself."""
    trees = defaultdict(list)
    for path in sorted(_reached([script]) - {ROOT / name for name in TOOLS}):
        trees[_package(path)].append(_tree(path))
    return {
        name: hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]
        for name, parts in sorted(trees.items())
        if name not in SHOWN_ONLY
    }


def _kept() -> dict[str, dict[str, str]]:
    kept: dict[str, dict[str, str]] = json.loads(KEPT.read_text()) if KEPT.is_file() else {}
    return kept


def _package(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[1] if parts[0] == "amibayes" else "/".join(parts[:-1]) or parts[0]


def _reached(start: Iterable[Path]) -> set[Path]:
    """Files of this project that these import, and those that those import."""
    found: set[Path] = set()
    waiting = list(start)
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imports(path)
    return found


@cache
def _tree(path: Path) -> str:
    """The syntax of a file without its docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [part for part in body if not _is_text(part)]  # type: ignore[attr-defined]
    return ast.dump(tree)


def _is_text(part: ast.AST) -> bool:
    return (
        isinstance(part, ast.Expr)
        and isinstance(part.value, ast.Constant)
        and isinstance(part.value.value, str)
    )


@cache
def _imports(path: Path) -> tuple[Path, ...]:
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    names = {name for node in nodes for name in _names(node)}
    for alias in (part for node in nodes if isinstance(node, ast.Import) for part in node.names):
        if alias.name == "amibayes":  # its names come lazily, as attributes
            short = alias.asname or alias.name
            names |= {f"amibayes.{n.attr}" for n in nodes if _is_attribute_of(n, short)}
    return tuple(sorted({found for name in names if (found := _file_of(name, path)) is not None}))


def _is_attribute_of(node: ast.AST, name: str) -> TypeGuard[ast.Attribute]:
    is_attribute = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
    return is_attribute and node.value.id == name  # type: ignore[attr-defined]


def _names(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (part.name for part in node.names)
    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
        for part in node.names:
            yield f"{node.module}.{part.name}"


def _file_of(name: str, importer: Path) -> Path | None:
    """The file of a module, of the module that a name stands in, or of a public name.

    Scripts find helpers beside themselves and in the tests.
    """
    if name.startswith("amibayes.") and name.count(".") == 1 and name.split(".")[1] in _public():
        name = _public()[name.split(".")[1]]
    for at in (ROOT, importer.parent, ROOT / "tests", ROOT / "tests" / "detection"):
        path = at.joinpath(*name.split("."))
        for found in (path.with_suffix(".py"), path / "__init__.py"):
            if found.is_file():
                return found.resolve()
    return _file_of(name.rpartition(".")[0], importer) if "." in name else None


@cache
def _public() -> dict[str, str]:
    """The module of each public name."""
    tree = ast.parse((ROOT / "amibayes" / "__init__.pyi").read_text(encoding="utf-8"))
    lines = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return {part.name: f"amibayes.{n.module}.{part.name}" for n in lines for part in n.names}


def main() -> None:
    """Print what is older than its code."""
    for name, packages in changed().items():
        state = "is older than " + ", ".join(packages) if packages else "is as new as its code"
        print(f"{name}: what it wrote {state}")


if __name__ == "__main__":
    main()

"""Print how long the functions and modules of the package are.

    python tests/sizes.py [FOLDER]

A function counts from its ``def`` to its last line, comments and blank lines included; with and
without its docstring, since the public ones state shapes, units and errors at length. A module
counts every line.

``python docs/sizes_table.py`` compares `measured` with the package before it was restructured.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

PACKAGE = Path(__file__).resolve().parent.parent / "amibayes"


def functions(folder: Path = PACKAGE, *, docstrings: bool = False) -> dict[str, int]:
    """Lines of every function and method, by ``path:line name``."""
    out = {}
    for path in sorted(folder.rglob("*.py")):
        for node in nodes(path.read_text(encoding="utf-8")):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                name = f"{path.relative_to(folder)}:{node.lineno} {node.name}"
                whole = int(node.end_lineno or node.lineno) - node.lineno + 1
                out[name] = whole if docstrings else whole - docstring_lines(node)
    return out


def docstring_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function's docstring, 0 without one."""
    if ast.get_docstring(node) is None:
        return 0
    first = node.body[0]
    return int(first.end_lineno or first.lineno) - first.lineno + 1


def modules(folder: Path = PACKAGE) -> dict[str, int]:
    """Lines of every module."""
    return {
        str(path.relative_to(folder)): len(path.read_text(encoding="utf-8").splitlines())
        for path in sorted(folder.rglob("*.py"))
    }


@cache
def nodes(source: str) -> list[ast.AST]:
    """Everything in a module, parsed once."""
    return list(ast.walk(ast.parse(source)))


@cache
def code(source: str) -> list[tuple[int, str]]:
    """Lines of code with their numbers: no comments, docstrings, imports or blank lines."""
    passed: set[int] = set()
    for node in nodes(source):
        text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if text or isinstance(node, ast.Import | ast.ImportFrom):
            passed |= set(range(node.lineno, int(node.end_lineno or node.lineno) + 1))
    lines = enumerate(map(str.strip, source.splitlines()), start=1)
    return [(k, text) for k, text in lines if text and text[0] != "#" and k not in passed]


RUN = 6
"""Lines that stand twice are worth a look from here on; shorter runs are how code looks."""


def repeated_runs(folder: Path = PACKAGE) -> int:
    """Runs of `RUN` or more lines of code that stand in the package before, to the letter."""
    every = [list(_windows(path)) for path in sorted(folder.rglob("*.py"))]
    number = Counter(window for windows in every for window in windows)
    first: set[tuple[str, ...]] = set()
    runs = 0
    for windows in every:
        inside = False
        for window in windows:
            again = number[window] > 1 and window in first
            runs += again and not inside
            inside = again
            first.add(window)
    return runs


def _windows(path: Path) -> Iterator[tuple[str, ...]]:
    # Lines without a word, as lone brackets, are no content.
    lines = [text for _, text in code(path.read_text(encoding="utf-8")) if re.search(r"\w", text)]
    for k in range(len(lines) - RUN + 1):
        yield tuple(lines[k : k + RUN])


def public_names(folder: Path = PACKAGE) -> int:
    """Names that the package gives, as type checkers read them."""
    stub = folder / "__init__.pyi"
    source = (stub if stub.is_file() else folder / "__init__.py").read_text(encoding="utf-8")
    imports = [n for n in nodes(source) if isinstance(n, ast.ImportFrom)]
    own = [n for n in imports if n.level or str(n.module).startswith("amibayes")]
    return sum(len(node.names) for node in own)


def measured(folder: Path = PACKAGE) -> dict[str, float]:
    """What tells how easily the package can be taken in."""
    paths = sorted(folder.rglob("*.py"))
    folders = Counter(path.parent for path in paths)
    texts = [path.read_text(encoding="utf-8") for path in paths]
    lengths = list(functions(folder).values())
    return {
        "modules": len(paths),
        "modules beside the packages": folders[folder],
        "modules of the fullest folder": max(n for at, n in folders.items() if at != folder),
        "lines": sum(len(text.splitlines()) for text in texts),
        "lines of code": sum(len(code(text)) for text in texts),
        f"runs of {RUN} lines or more that stand twice": repeated_runs(folder),
        "functions": len(lengths),
        "lines of the median function": float(np.median(lengths)),
        "lines of the longest function": max(lengths),
        "public names": public_names(folder),
    }


def main(folder: Path) -> None:
    """Print the distribution of both, and what is longest."""
    measured = {
        "functions": functions(folder),
        "functions with docstrings": functions(folder, docstrings=True),
        "modules": modules(folder),
    }
    for kind, sizes in measured.items():
        lines = np.array(list(sizes.values()))
        print(
            f"{len(lines)} {kind}: median {np.median(lines):.0f}, nine in ten at most "
            f"{np.quantile(lines, 0.9, method='inverted_cdf'):.0f}, longest {lines.max()} lines"
        )
        for name in sorted(sizes, key=lambda name: -sizes[name])[:5]:
            print(f"  {sizes[name]:4} {name}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PACKAGE)

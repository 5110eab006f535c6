"""Print how long the functions and modules of the package are.

    python tests/sizes.py [FOLDER]

A function counts from its ``def`` to its last line, comments and blank lines included; with and
without its docstring, since the public ones state shapes, units and errors at length. A module
counts every line.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import numpy as np

PACKAGE = Path(__file__).resolve().parent.parent / "amibayes"


def functions(folder: Path = PACKAGE, *, docstrings: bool = False) -> dict[str, int]:
    """Lines of every function and method, by ``path:line name``."""
    out = {}
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
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

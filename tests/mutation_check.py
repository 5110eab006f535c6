"""Change operators of the package one at a time and ask whether the nearest tests notice.

    python tests/mutation_check.py [--count 200] [--seed 1] [--workers 2] [--package likelihood …]

Each mutant lives in a copy of the checkout of its own. The nearest tests of a module are the
test files that import it, or else those of its package; a mutant that they all pass, within the
time that the unchanged module allows, survives and is printed with its line. Run by hand: 200
mutants take about an hour on two cores.
"""

from __future__ import annotations

import argparse
import ast
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
NUMERICAL = (
    *("calibration", "companion_search", "cube", "data", "detection", "extraction", "likelihood"),
    *("limits", "models", "oifits", "optics", "posterior", "scene", "simulation"),
)
SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.MatMult: ast.Mult,
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.USub: ast.UAdd,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
SECONDS = 300
"""Longest run of the nearest tests, in time of a processor, which does not depend on what else the
machine does; a mutant that takes longer counts as noticed."""


@dataclass(frozen=True)
class Mutant:
    """One operator of one file: its place among those of the file, and its line."""

    path: Path
    number: int
    line: int


class _Swap(ast.NodeTransformer):
    """Swap the operator that stands at one place among those of a file."""

    def __init__(self, number: int) -> None:
        self.number, self.count, self.lines = number, 0, []

    def _one(self, node: ast.AST, operator: ast.AST) -> ast.AST:
        swapped = SWAPPED.get(type(operator))
        if swapped is None:
            return operator
        self.lines.append(getattr(node, "lineno", 0))
        self.count += 1
        return swapped() if self.count - 1 == self.number else operator

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        # A union of types is no arithmetic.
        if not (isinstance(node.op, ast.BitOr) and _is_type(node)):
            node.op = self._one(node, node.op)
        return self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AST:
        node.op = self._one(node, node.op)
        return self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        node.op = self._one(node, node.op)
        return self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        node.op = self._one(node, node.op)
        return self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        node.ops = [self._one(node, operator) for operator in node.ops]
        return self.generic_visit(node)


def _is_type(node: ast.BinOp) -> bool:
    sides = (node.left, node.right)
    names = [getattr(s, "id", getattr(s, "attr", getattr(s, "value", ""))) for s in sides]
    return None in names or any(isinstance(n, str) and n[:1].isupper() for n in names)


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Every operator of a file that can be swapped."""
    swap = _Swap(-1)
    swap.visit(ast.parse(path.read_text(encoding="utf-8")))
    for number, line in enumerate(swap.lines):
        yield Mutant(path, number, line)


def nearest_tests(path: Path) -> list[str]:
    """Test files that import a module, or else all of its package's."""
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    package = path.relative_to(ROOT / "amibayes").parts[0]
    tests = sorted((ROOT / "tests").rglob("test_*.py"))
    own = [t for t in tests if t.parent.name == package]
    direct = [t for t in tests if module in t.read_text(encoding="utf-8")]
    return [str(t.relative_to(ROOT)) for t in dict.fromkeys([*direct, *own])]


def passes(folder: Path, tests: list[str]) -> bool:
    """Whether the tests pass in a copy of the checkout."""
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=environment,
            capture_output=True,
            timeout=20 * SECONDS,  # for those that wait and do not work
            preexec_fn=_limited,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def _limited() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))


def survives(mutant: Mutant, folders: SimpleQueue[Path]) -> bool:
    """Run the nearest tests of a mutant in a free copy of the checkout."""
    folder = folders.get()
    target = folder / mutant.path.relative_to(ROOT)
    original = target.read_text(encoding="utf-8")
    tree = _Swap(mutant.number).visit(ast.parse(original))
    try:
        target.write_text(ast.unparse(ast.fix_missing_locations(tree)), encoding="utf-8")
        return passes(folder, nearest_tests(mutant.path))
    finally:
        target.write_text(original, encoding="utf-8")
        folders.put(folder)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--package", nargs="*", default=NUMERICAL)
    options = parser.parse_args()
    paths = [p for name in options.package for p in (ROOT / "amibayes" / name).rglob("*.py")]
    every = [mutant for path in sorted(paths) for mutant in mutants_of(path)]
    rng = np.random.default_rng(options.seed)
    chosen = [every[k] for k in rng.permutation(len(every))[: options.count]]
    folders: SimpleQueue[Path] = SimpleQueue()
    with tempfile.TemporaryDirectory() as work:
        for k in range(options.workers):
            folder = Path(work) / f"{k}" / "checkout"
            shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(".git", ".venv*", "_build"))
            (folder.parent / "shared").symlink_to(ROOT.parent / "shared")
            folders.put(folder)
        survivors = 0
        with ThreadPoolExecutor(options.workers) as pool:
            for mutant, alive in zip(
                chosen, pool.map(lambda m: survives(m, folders), chosen), strict=True
            ):
                survivors += alive
                text = mutant.path.read_text(encoding="utf-8").split("\n")[mutant.line - 1]
                where = f"{mutant.path.relative_to(ROOT)}:{mutant.line} ({mutant.number})"
                outcome = "survives" if alive else "noticed "
                print(f"{outcome}  {where}  {text.strip()}", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} mutants noticed")
    return 0


if __name__ == "__main__":
    sys.exit(main())

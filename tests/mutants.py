"""Small changes of Python code, each of which a test should notice: what can change, and where."""

from __future__ import annotations

import ast
import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.MatMult: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
PAIRS = (
    *(("sin", "cos"), ("min", "max"), ("argmin", "argmax"), ("minimum", "maximum")),
    *(("any", "all"), ("floor", "ceil"), ("zeros", "ones"), ("real", "imag"), ("log", "log10")),
    *(("zeros_like", "ones_like"), ("nanmin", "nanmax"), ("deg2rad", "rad2deg"), ("exp", "expm1")),
    *(("sum", "mean"), ("median", "mean"), ("std", "var"), ("sqrt", "abs"), ("hypot", "subtract")),
    *(("vstack", "hstack"), ("fft2", "ifft2"), ("radians", "degrees"), ("sinh", "cosh")),
)
FUNCTIONS = {b: a for a, b in PAIRS} | {a: b for a, b in PAIRS}
DROPPED = frozenset({"abs", "conj", "sorted", "sort", "cumsum", "ravel", "unique", "wrapped"})
"""Functions whose argument may stand in their place."""

PASSED_OVER = frozenset({"annotation", "returns", "decorator_list", "type_params", "bases"})


@dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Parameters
    ----------
    path : Path
    number : int
        Among the changes of the file.
    kind : str
    before, after : str
        The expression.
    line : int
    lines : tuple of int
        First and last that a test runs where the change matters: those of the statement, or, of
        code that runs on import, of the whole file.
    """

    path: Path
    number: int
    kind: str
    before: str
    after: str
    line: int
    lines: tuple[int, int]


@dataclass(frozen=True)
class _Site:
    kind: str
    node: ast.AST
    new: ast.AST
    lines: tuple[int, int]
    put: Callable[[ast.AST], None]


def mutants_of(path: Path, root: Path) -> Iterator[Mutant]:
    """Every change of a file that can be made; its path is kept relative to a folder."""
    for number, site in enumerate(_sites(ast.parse(path.read_text(encoding="utf-8")))):
        before, after = ast.unparse(site.node), ast.unparse(site.new)
        line = getattr(site.node, "lineno", 0)
        yield Mutant(path.relative_to(root), number, site.kind, before, after, line, site.lines)


def mutated(source: str, number: int) -> str:
    """A file with one of its changes made."""
    tree = ast.parse(source)
    site = list(_sites(tree))[number]
    site.put(site.new)
    return ast.unparse(ast.fix_missing_locations(tree))


WHOLE = (1, 10**6)


def _sites(node: ast.AST, lines: tuple[int, int] = WHOLE) -> Iterator[_Site]:
    if isinstance(node, ast.Raise | ast.JoinedStr) or _is_strict(node):
        return
    for name, value in ast.iter_fields(node):
        if name in PASSED_OVER:
            continue
        for k, child in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(child, ast.AST) or _is_text(child):
                continue
            put = _putter(node, name, k if isinstance(value, list) else None)
            own = _span(child, lines) if isinstance(child, ast.stmt) else lines
            for kind, new in _changes(child):
                yield _Site(kind, child, new, own, put)
            yield from _sites(child, own)


def _putter(node: ast.AST, name: str, k: int | None) -> Callable[[ast.AST], None]:
    if k is None:
        return lambda new: setattr(node, name, new)
    return lambda new: getattr(node, name).__setitem__(k, new)


def _span(node: ast.stmt, around: tuple[int, int]) -> tuple[int, int]:
    """Lines of a statement; of one with a body, those above it; of a function, its body's."""
    body, last = getattr(node, "body", None), int(node.end_lineno or node.lineno)
    if isinstance(node, ast.FunctionDef):
        return body[0].lineno, last
    if around == WHOLE:
        return WHOLE
    return (node.lineno, max(node.lineno, body[0].lineno - 1)) if body else (node.lineno, last)


def _is_strict(node: ast.AST) -> bool:
    """The ``strict`` of `zip`, which matters only where the code is wrong already."""
    return isinstance(node, ast.keyword) and node.arg == "strict"


def _is_text(node: ast.AST) -> bool:
    """A docstring, or a sum of texts."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant)
    return isinstance(node, ast.BinOp) and any(
        isinstance(side, ast.JoinedStr)
        or (isinstance(side, ast.Constant) and isinstance(side.value, str))
        for side in (node.left, node.right)
    )


def _changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    match node:
        case ast.BinOp() if not _is_type(node):
            yield from _with_operator(node, "arithmetic")
            if isinstance(node.op, ast.Add | ast.Sub | ast.Mult | ast.Div):
                yield "term dropped", node.left
        case ast.AugAssign():
            yield from _with_operator(node, "arithmetic")
        case ast.BoolOp():
            yield from _with_operator(node, "boolean")
        case ast.UnaryOp(op=ast.USub()):
            yield "sign", node.operand
        case ast.UnaryOp(op=ast.Not() | ast.Invert()):
            yield "boolean", node.operand
        case ast.Compare():
            yield from _compared(node)
        case ast.Constant(value=bool() | int() | float()):
            yield "constant", ast.Constant(_other(node.value))
        case ast.Call():
            yield from _called(node)


def _with_operator(node: ast.AST, kind: str) -> Iterator[tuple[str, ast.AST]]:
    new = copy.copy(node)
    swapped = SWAPPED.get(type(node.op))
    if swapped is not None:
        new.op = swapped()
        yield kind, new


def _compared(node: ast.Compare) -> Iterator[tuple[str, ast.AST]]:
    for k, operator in enumerate(node.ops):
        new = copy.copy(node)
        new.ops = [*node.ops[:k], SWAPPED[type(operator)](), *node.ops[k + 1 :]]
        yield "comparison", new


def _other(value: float) -> float:
    """A constant that is wrong: the other truth, the next integer, twice the number, or 1 for 0."""
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else (2.0 * value or 1.0)


def _called(node: ast.Call) -> Iterator[tuple[str, ast.AST]]:
    name = getattr(node.func, "attr", getattr(node.func, "id", ""))
    if name in FUNCTIONS:
        new = copy.copy(node)
        new.func = copy.copy(node.func)
        setattr(new.func, "attr" if isinstance(node.func, ast.Attribute) else "id", FUNCTIONS[name])
        if isinstance(node.func, ast.Name) and FUNCTIONS[name] not in {"min", "max", "any", "all"}:
            return
        yield "function", new
    if name in DROPPED:
        method = isinstance(node.func, ast.Attribute) and not node.args
        if method or node.args:
            yield "function", node.func.value if method else node.args[0]


def _is_type(node: ast.BinOp) -> bool:
    """Whether a | is a union of types, which is no arithmetic."""
    if not isinstance(node.op, ast.BitOr):
        return False
    sides = (node.left, node.right)
    names = [getattr(s, "id", getattr(s, "attr", getattr(s, "value", ""))) for s in sides]
    return None in names or any(isinstance(n, str) and n[:1].isupper() for n in names)

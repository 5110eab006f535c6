"""Functions and modules stay small; `python tests/sizes.py` prints how small they are."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import sizes


def test_functions_are_small() -> None:
    found = sizes.functions()
    lines = np.array(list(found.values()))
    assert np.median(lines) <= 8
    assert np.quantile(lines, 0.9, method="inverted_cdf") <= 30


def test_functions_are_small_with_their_docstrings() -> None:
    found = sizes.functions(docstrings=True)
    assert np.quantile(list(found.values()), 0.9, method="inverted_cdf") <= 30
    assert not {name: n for name, n in found.items() if n > 60}


def test_modules_are_small() -> None:
    assert not {name: n for name, n in sizes.modules().items() if n > 400}


def test_what_is_counted(tmp_path: Path) -> None:
    text = 'def f(x):\n    """Say.\n\n    More.\n    """\n\n    # Why.\n    return x\n'
    (tmp_path / "one.py").write_text(text)
    assert sizes.functions(tmp_path) == {"one.py:1 f": 4}
    assert sizes.functions(tmp_path, docstrings=True) == {"one.py:1 f": 8}
    assert sizes.modules(tmp_path) == {"one.py": 8}


def test_the_table_of_sizes_is_of_today() -> None:
    """Within 5 %, so that not every change has to make it anew."""
    page = (sizes.PACKAGE.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for name, value in sizes.measured().items():
        (told,) = re.findall(rf"^\| {re.escape(name)} \| .* \| (.*) \|$", page, re.M)
        remedy = f"{name}: run python docs/sizes_table.py"
        assert float(told) == pytest.approx(value, rel=0.05, abs=2.0), remedy


def test_lines_that_stand_twice_are_counted(tmp_path: Path) -> None:
    lines = [f"x{k} = {k}" for k in range(8)]
    (tmp_path / "__init__.py").write_text("from amibayes.a import b, c\nfrom os import path\n")
    (tmp_path / "one.py").write_text("\n".join([*lines, "y = 0", *lines[:6], "# Why."]))
    assert sizes.repeated_runs(tmp_path) == 1
    (tmp_path / "two.py").write_text("\n".join(["import os", *lines[1:4], "", *lines[4:7]]))
    assert sizes.repeated_runs(tmp_path) == 2
    assert sizes.public_names(tmp_path) == 2
    source = "# Why.\n'''One.\n\nTwo.\n'''\nx = 1\n\ny = 2"
    assert [number for number, _ in sizes.code(source)] == [6, 8]

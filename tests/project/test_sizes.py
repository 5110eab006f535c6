"""Functions and modules stay small; `python tests/sizes.py` prints how small they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
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

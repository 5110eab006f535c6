"""Summaries that fit on a terminal."""

from __future__ import annotations

import pytest

from amibayes.support.terminal import MAX_LINES, shortened, with_warnings


@pytest.mark.parametrize("n", [0, 1, 18, 19, 20, 50])
def test_nothing_is_lost_unsaid(n: int) -> None:
    lines = [str(k) for k in range(n)]
    found = shortened(lines, ["end"])
    assert len(found) <= MAX_LINES
    assert found[-1] == "end"
    left = n - sum(line in lines for line in found[:-1])
    assert (f"and {left} more lines" in found) == (left > 0)


def test_warnings_that_do_not_fit_are_counted() -> None:
    found = with_warnings(["a"] * 15, [f"w{k}" for k in range(9)], "end", "result.json")
    assert len(found) == MAX_LINES
    assert found[15:18] == [f"WARNING     w{k}" for k in range(3)]
    assert found[18:] == ["WARNING     6 more warnings in result.json", "end"]

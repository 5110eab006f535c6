"""Tables that scripts make, between the lines of a page that mark them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def put_table(page: str, lines: Sequence[str], mark: str = "table") -> None:
    """Replace what is between ``<!-- mark -->`` and ``<!-- end of mark -->``.

    Parameters
    ----------
    page : str
        Name of a page of the documentation.
    lines : sequence of str
    mark : str
    """
    path = Path(__file__).with_name(page)
    head, _, rest = path.read_text(encoding="utf-8").partition(f"<!-- {mark} -->\n")
    tail = rest.partition(f"<!-- end of {mark} -->\n")[2]
    text = "\n".join([f"<!-- {mark} -->", "", *lines, "", f"<!-- end of {mark} -->", ""])
    path.write_text(head + text + tail, encoding="utf-8")

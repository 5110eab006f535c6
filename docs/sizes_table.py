"""Table of CONTRIBUTING: size of the package before and after it was restructured.

    python docs/sizes_table.py

``before`` is a revision of the repository, so that a full clone is needed. The same is counted of
both by `tests/sizes.py`.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import tempfile
from io import BytesIO
from pathlib import Path

from pages import put_table

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import sizes  # noqa: E402

MARK = "sizes: docs/sizes_table.py"
BEFORE = "b5fa7f5"
"""The last revision with a folder `inference/`."""

VARIANTS = {
    "a free scale of the errors as a case": r"\bfree_scale\b",
    "attributes put into made objects": r"object\.__new__|__dict__\.update|copy\.copy\(",
    "an instrument by its name": r'== "(?:NIRISS|VAMPIRES|PIONIER|GRAVITY|MIRC)',
}
"""Ways in which a module tells variants apart by hand, and what they look like."""


def modules_with(folder: Path, pattern: str) -> int:
    """Modules of the package that hold a pattern, where data are analysed."""
    paths = (p for p in folder.rglob("*.py") if not {"plots", "report", "cli"} & set(p.parts))
    return sum(bool(re.search(pattern, path.read_text(encoding="utf-8"))) for path in paths)


def measured(folder: Path) -> dict[str, float]:
    """What is counted of a package, by the name of the row."""
    found = {f"modules with {k}": modules_with(folder, v) for k, v in VARIANTS.items()}
    return sizes.measured(folder) | found


def table(before: dict[str, float], now: dict[str, float]) -> list[str]:
    """Lines of the table."""
    rows = [f"| {name} | {before[name]:g} | {now[name]:g} |" for name in now]
    return ["| | before | now |", "|---|---|---|", *rows]


def main() -> None:
    """Count both and put the table into the page."""
    archive = subprocess.run(
        ["git", "archive", BEFORE, "amibayes"], cwd=ROOT, check=True, capture_output=True
    ).stdout
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=BytesIO(archive)) as packed:
            packed.extractall(folder, filter="data")
        before = measured(Path(folder) / "amibayes")
    put_table("../CONTRIBUTING.md", table(before, measured(ROOT / "amibayes")), MARK)


if __name__ == "__main__":
    main()

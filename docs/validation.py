"""Put the result of ``amibayes validate`` into docs/validation.md.

Usage: python docs/validation.py FOLDER
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

from pages import put_table

DOCS = Path(__file__).parent
PICTURES = ("ranks", "coverage", "false_alarms", "completeness")


def number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def lines_of(content: dict) -> list[str]:
    outcome = "all checks hold" if content["passed"] else "some checks fail"
    rows = [
        f"| {c['name']} | {c['n']} | {number(c['measured'])} | {number(c['expected'])} "
        f"| {number(c['error'])} | {c['p_value']:.2g} | {'holds' if c['passed'] else '**fails**'} |"
        for c in content["checks"]
    ]
    return [
        f"Result of the {content['plan']} plan, seed {content['seed']}, {content['n_trials']} "
        f"stars: {outcome}.",
        "",
        "| check | stars | measured | expected | error | p | |",
        "|---|---|---|---|---|---|---|",
        *rows,
        "",
        *(f"![{name.replace('_', ' ')}](static/validation_{name}.png)" for name in PICTURES),
    ]


def main(folder: str) -> int:
    content = json.loads((Path(folder) / "validation.json").read_text(encoding="utf-8"))
    for name in PICTURES:
        shutil.copy(Path(folder) / f"{name}.png", DOCS / "static" / f"validation_{name}.png")
    put_table("validation.md", lines_of(content))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

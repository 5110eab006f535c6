"""The search against brute force over simulated binaries: a table of `statistics.md`.

    python docs/global_search.py RESULTS.jsonl 60

searches and fits 60 binaries of each of five coverages (half of them in a field to where channels
smear companions out, half with the companion's diameter free), puts one line for each into
RESULTS.jsonl, and writes the table when all are there. A run that was ended goes on where it was.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from brute_force import COVERAGES, Compared, case, compared  # noqa: E402
from pages import put_table  # noqa: E402
from trials import keep_answer, known_answers  # noqa: E402

PAGE, SCRIPT = "statistics.md", "docs/global_search.py"
MARK = f"table: {SCRIPT}"

STARTS, FIRST_SEED = 300, 1000
"""Fits of brute force for each binary, and seeds that no test uses."""

NAMES = {
    "pionier": "PIONIER",
    "gravity": "GRAVITY",
    "mirc4t": "MIRC, four telescopes",
    "mirc6t": "MIRC, six telescopes",
    "niriss": "NIRISS",
}


def one(name: str, k: int) -> Compared:
    """Case number k of a coverage."""
    seed = FIRST_SEED + k
    # Seeds alternate between companions that are resolved and not (`case`).
    drawn = case(name, seed, smeared=k // 2 % 2 == 1, disc=k // 4 % 2 == 1)
    return compared(drawn, STARTS, np.random.default_rng(seed))


def table(found: dict[tuple[str, int], Compared]) -> Iterator[str]:
    """The lines of the table."""
    yield (
        "| coverage | binaries | worst Δχ² of the search | worse by more than 1 "
        "| brute force worse by more than 1 | NLopt alone worse by more than 1 "
        "| NLopt better by more than 0.1 |"
    )
    yield "|---" * 7 + "|"
    for name in (*NAMES, ""):
        rows = [row for (n, _), row in found.items() if name in (n, "")]
        excess = np.array([row.excess for row in rows])
        check = np.array([row.check_excess for row in rows])
        counts = excess > 1.0, excess < -1.0, check > 1.0, [row.check_adopted for row in rows]
        columns = [f"{excess.max():.2f}", *(str(int(np.sum(c))) for c in counts)]
        yield f"| {NAMES.get(name, 'all')} | {len(rows)} | {' | '.join(columns)} |"


def main(results: Path, n: int) -> None:
    """Compare what is not in the file yet, and write the table."""
    found: dict[tuple[str, int], Compared] = {}
    for row in known_answers(results):
        found[row["name"], row["k"]] = Compared(**row["compared"])
    for k, name in product(range(n), COVERAGES):
        if (name, k) in found:
            continue
        begin = time.process_time()
        found[name, k] = one(name, k)
        row = {"name": name, "k": k, "compared": vars(found[name, k])}
        keep_answer(results, row | {"cpu_s": time.process_time() - begin}, SCRIPT)
    put_table(PAGE, list(table(found)), MARK, known_answers(results))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))

"""Coverage and error rates of what a search writes, under many conditions: docs/validation.md.

    python docs/validation.py --minutes 30     as many stars as that takes of one core
    python docs/validation.py --full           2000 stars alone and 1000 not
    python docs/validation.py --table          the page, from the answers that are there

Answers are kept in ``docs/static/validation`` or the folder that is given, one file for each
condition, and every run goes on from them; delete them where the code has changed too much.
The conditions take turns so that each has the same time.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from pages import put_table  # noqa: E402
from poppy_stars import PoppyExposure  # noqa: E402
from trials import Answer, answers, known_answers  # noqa: E402

from amibayes.plots.style import save  # noqa: E402
from amibayes.report.validation import validation_pictures  # noqa: E402
from amibayes.validation import QUICK, SimulatedExposure, Validation  # noqa: E402
from amibayes.validation.plan import RANGES, Condition, ValidationPlan  # noqa: E402
from amibayes.validation.tables import SimulatedTable  # noqa: E402
from amibayes.validation.tally import FALSE_ALARMS, Check, tally  # noqa: E402
from amibayes.validation.trial import COVERED, run_trial  # noqa: E402

DOCS, SCRIPT = Path(__file__).parent, "docs/validation.py"
PICTURES = ("ranks", "coverage", "false_alarms", "completeness")
CYCLE = ("alone", "bright", "alone", "alone", "middling", "alone", "alone", "faint", "alone")
FULL = 334 * len(CYCLE)

VLTI = SimulatedTable("vlti", 0.02, 0.5, field_mas=(1.5, 12.0), calibration=(0.03, 0.5))
CONDITIONS: dict[str, Condition] = {
    "NIRISS": SimulatedTable(),
    "V² noisier: 0.05, closure phases 0.1°": SimulatedTable(vis2_error=0.05, closure_error_deg=0.1),
    "5 % of outliers": SimulatedTable(outliers=0.05),
    "two epochs": SimulatedTable(epochs=2),
    "VLTI": VLTI,
    "VLTI, channels correlated": replace(VLTI, common=0.6),
    "VLTI, companion of 1.5 mas": replace(VLTI, companion_mas=1.5),
    "images, three calibrators": SimulatedExposure("F430M", 7, 30, 3),
    "images, one calibrator": SimulatedExposure("F430M", 7, 30, 1),
    "images, charge migration": SimulatedExposure("F480M", 19, 30, 2, 6.75, 3.6e-7),
    "images by poppy": PoppyExposure(),
    "VLTI, no calibration errors": replace(VLTI, calibration=(0.0, 0.0)),
}
OTHER = "VLTI, no calibration errors"
"""Data without the errors that the search takes for granted: not counted with all others."""


@dataclass(frozen=True)
class AsTheyCame(ValidationPlan):
    """A plan whose trials are of these kinds."""

    came: tuple[str, ...] = ()

    @property
    def kinds(self) -> list[str]:
        return list(self.came)


def plan_of(*settings: Condition, kinds: Iterable[str] = ()) -> AsTheyCame:
    return AsTheyCame("docs", settings, 0, 0, QUICK.null_draws, QUICK.alpha, came=tuple(kinds))


def trial(number: int, condition: Condition, k: int) -> Answer:
    """One star of a condition, with the time it took of a core."""
    kind, begin = CYCLE[k % len(CYCLE)], time.process_time()
    seed = np.random.SeedSequence([20, number, k])
    answer = run_trial(plan_of(condition), (0, kind, seed))
    answer |= {"kind": kind, "seconds": round(time.process_time() - begin, 2)}
    return dict(json.loads(json.dumps(answer, default=lambda x: x.tolist())))


def run(folder: Path, stars: int, minutes: float) -> None:
    """Compute stars, always of the condition that has had the least time."""
    spent = {}
    done = {}
    for name in CONDITIONS:
        known = known_answers(file_of(folder, name))
        spent[name], done[name] = sum(a["seconds"] for a in known), len(known)
    begin = time.process_time()
    while time.process_time() - begin < 60.0 * minutes:
        open_ones = [name for name in CONDITIONS if done[name] < stars]
        if not open_ones:
            return
        name = min(open_ones, key=lambda n: spent[n])
        number = list(CONDITIONS).index(name)
        done[name] += 1
        found = answers(
            file_of(folder, name), done[name], partial(trial, number, CONDITIONS[name]), SCRIPT
        )
        spent[name] += found[-1]["seconds"]


def file_of(folder: Path, name: str) -> Path:
    return folder / f"{list(CONDITIONS).index(name):02d}.jsonl"


def counted(found: list[Answer]) -> Validation:
    """The checks of some answers."""
    return tally(plan_of(kinds=(a["kind"] for a in found)), 20, found)


def covered(validation: Validation, quantity: int) -> str:
    """How many of the 68 and 95 % intervals hold the truth."""
    known = validation.covered[validation.of_kind(*RANGES), quantity]
    return ", ".join(f"{count:.0f}" for count in known.sum(axis=0))


def row_of(name: str, found: list[Answer]) -> str:
    """A line of the table: what was counted, and which checks fail."""
    validation = counted(found)
    alone, known = validation.of_kind("alone"), validation.of_kind(*RANGES)
    below = (int((validation.false_alarm_probability[alone] < p).sum()) for p in FALSE_ALARMS)
    second = validation.second[validation.of_kind("bright")]
    failing = [c.name for c in validation.checks if not c.passed]
    cells = (
        name,
        len(alone),
        ", ".join(str(n) for n in below),
        int((validation.statement[alone] == 0).sum()),
        len(known),
        *(covered(validation, k) for k in range(len(COVERED))),
        f"{validation.found[known].sum():.0f} ({validation.expected[known].sum():.1f})",
        f"{int((second < 0.05).sum())} of {len(second)}",
        f"{int((validation.statement >= 2).sum())} of {len(found)}",
        f"**{'; '.join(failing)}**" if failing else "none",
    )
    return f"| {' | '.join(str(cell) for cell in cells)} |"


HEAD = (
    "condition",
    "stars alone",
    "below 0.01, 0.05, 0.2",
    "called a companion",
    "with companion",
    "in 68, 95 % of separation",
    "of position angle",
    "of magnitude difference",
    "found (expected)",
    "second one below 0.05",
    "model refused or data inconsistent",
    "checks that fail",
)


def lines_of(everything: dict[str, list[Answer]]) -> list[str]:
    """The table, with the checks of all conditions together below it."""
    rows = [row_of(name, found) for name, found in everything.items()]
    whole = counted([a for name, found in everything.items() if name != OTHER for a in found])
    for name, drawing in validation_pictures(whole).items():
        save(drawing, DOCS / "static" / f"validation_{name}.png")
    return [
        f"| {' | '.join(HEAD)} |",
        "|---" * len(HEAD) + "|",
        *rows,
        "",
        "All conditions but the last together:",
        "",
        "| check | stars | measured | expected | error | p | |",
        "|---|---|---|---|---|---|---|",
        *(check_row(c) for c in whole.checks),
        "",
        *(f"![{name.replace('_', ' ')}](static/validation_{name}.png)" for name in PICTURES),
    ]


def check_row(c: Check) -> str:
    numbers = " | ".join(
        "–" if not np.isfinite(x) else f"{x:.3f}" for x in (c.measured, c.expected, c.error)
    )
    outcome = "holds" if c.passed else "**fails**"
    if not np.isfinite(c.measured):
        outcome = "too few"
    return f"| {c.name} | {c.n} | {numbers} | {c.p_value:.2g} | {outcome} |"


def main(arguments: Any) -> None:
    folder = arguments.folder
    if not arguments.table:
        run(folder, FULL, np.inf if arguments.full else arguments.minutes)
    found = {name: known_answers(file_of(folder, name)) for name in CONDITIONS}
    kept = {name: a for name, a in found.items() if a}
    every = [answer for found in kept.values() for answer in found]
    put_table("validation.md", lines_of(kept), f"table: {SCRIPT}", every)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=DOCS / "static" / "validation")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--table", action="store_true")
    main(parser.parse_args())

"""How often each verdict is given of simulated objects: a table of `public_verdicts.md`.

    python docs/verdict_confusion.py 80 FOLDER

takes 80 data sets of each kind; the answers are kept in ``FOLDER``, and the next run, of as many or
more, goes on from them (0: the table of what is there). The objects are those of
`tests/detection/test_verdict.py`, whose visibilities come from formulas of their own; NIRISS
coverage, α = 0.01, 2000 null searches.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import j0

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "detection")]

from helpers import niriss  # noqa: E402
from pages import put_table  # noqa: E402
from test_verdict import KINDS, Visibility, observed, points, searched, star  # noqa: E402
from trials import Answer, answers, known_answers  # noqa: E402

from amibayes.data.observables import Observables, join  # noqa: E402

PAGE, SCRIPT = "public_verdicts.md", "docs/verdict_confusion.py"
MARK = f"table: {SCRIPT}"
STATEMENTS = ("companion", "no companion", "model rejected", "inconsistent data")

SEED = 78
"""Of data sets on which no rule of the verdict was chosen: those were drawn from 77."""

Make = Callable[[np.random.Generator], Observables]


def crescent(rng: np.random.Generator) -> Visibility:
    """A thin ring about the star, one side brighter."""
    radius, flux, side = rng.uniform(100.0, 200.0), rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.6)

    def visibility(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        whole = j0(2.0 * np.pi * radius * np.hypot(u, v))
        return (1.0 + flux * whole * (1.0 + 1j * side * np.sin(2.0 * np.pi * u * radius))) / (
            1.0 + flux
        )

    return visibility


def moving(rng: np.random.Generator) -> Observables:
    """A companion that turns by half a radian between two files."""
    rho, angle, contrast = (
        rng.uniform(100.0, 250.0),
        rng.uniform(0.0, 6.28),
        rng.uniform(0.02, 0.12),
    )
    parts = []
    for name, turned in (("a", angle), ("b", angle + 0.5)):
        place = float(rho * np.sin(turned)), float(rho * np.cos(turned)), contrast
        data = observed(niriss(), points(place), rng)
        parts.append(replace(data, setups=(replace(data.setups[0], source=name),)))
    return join(parts)


def vis2_times(factor: Callable[[np.random.Generator, int], np.ndarray], source: Make) -> Make:
    """The data of an object, their V² multiplied."""

    def make(rng: np.random.Generator) -> Observables:
        data = source(rng)
        value = data.vis2.value * factor(rng, data.n_vis2)
        return replace(data, vis2=replace(data.vis2, value=value))

    return make


def phases_wrong(rng: np.random.Generator) -> Observables:
    """A star whose closure phases err by a degree, which their errors do not say."""
    data = observed(niriss(), star, rng)
    value = data.closure_phase.value + np.radians(rng.standard_normal(data.n_closure_phases))
    return replace(data, closure_phase=replace(data.closure_phase, value=value))


def of(kind: Callable[[np.random.Generator], Visibility]) -> Make:
    """Make data of an object that is drawn at random."""
    return lambda rng: observed(niriss(), kind(rng), rng)


def gains(rng: np.random.Generator, n: int) -> np.ndarray:
    """3 % of every baseline."""
    return 1.0 + 0.03 * rng.standard_normal(n)


def no_calibration(_: np.random.Generator, n: int) -> np.ndarray:
    """A transfer function of 0.8 that nobody has divided out."""
    return np.full(n, 0.8)


OBJECTS: dict[str, Make] = {
    **{name: of(kind) for name, kind in KINDS.items()},
    "crescent": of(crescent),
    "star, V² wrong by 3 %": vis2_times(gains, of(KINDS["star"])),
    "binary, V² wrong by 3 %": vis2_times(gains, of(KINDS["binary"])),
    "star, V² not calibrated (0.8)": vis2_times(no_calibration, of(KINDS["star"])),
    "binary, V² not calibrated (0.8)": vis2_times(no_calibration, of(KINDS["binary"])),
    "star, closure phases wrong by 1°": phases_wrong,
    "moving binary, two dates": moving,
}


def answer(number: int, make: Make, k: int) -> Answer:
    """Search one data set, and keep what the verdict was made of."""
    rng = np.random.default_rng([SEED, number, k])
    result, verdict, _ = searched(make(rng), rng)
    return asdict(verdict) | {
        "separation_mas": result.companion.separation_mas,
        "contrast": result.companion.contrast,
        "diameter_mas": result.nuisance("diameter_mas"),
        "delta_chi2": result.delta_chi2,
    }


def row_of(name: str, found: list[Answer]) -> str:
    """A line of the table: how often each verdict is given, and how often with a note."""
    count = Counter(a["statement"] for a in found)
    warned = sum(bool(a["note"]) for a in found)
    cells = (count["companion"] - warned, warned, *(count[s] for s in STATEMENTS[1:]))
    return f"| {name} | {len(found)} | {' | '.join(str(c or '') for c in cells)} |"


HEAD = ("object", "cases", "companion", "companion, with a note", *STATEMENTS[1:])


def main(n: int, folder: Path) -> None:
    """Write the table, of the answers that are there for n = 0."""
    rows, every = [f"| {' | '.join(HEAD)} |", "|---" * len(HEAD) + "|"], list[Answer]()
    for number, (name, make) in enumerate(OBJECTS.items()):
        path = folder / f"{number:02d}.jsonl"
        ask = partial(answer, number, make)
        found = answers(path, n, ask, SCRIPT) if n else known_answers(path)
        rows.append(row_of(name, found))
        every += found
        print(rows[-1], flush=True)
    put_table(PAGE, rows, MARK, every)


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))

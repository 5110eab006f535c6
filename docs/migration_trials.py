"""Single stars and binaries with and without charge migration, and the tables of them.

    python docs/migration_trials.py [--minutes 25] [--only star binary]

Trials of `benchmarks.charge_migration` are added to ``docs/static/migration_trials.jsonl``, one
line each, round after round over 1e7, 1e8 and 1e9 photons and calibrators of the same, half and
a quarter of the target's brightness, until so many minutes of CPU time are used up; the tables of
`howto/charge_migration.md` are then written anew from all lines. Run again it goes on.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pages import put_table
from trials import keep_answer, known_answers

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from amibayes import Observables, analytic_limit, significance, statistic_of
from amibayes.detection.tails import clopper_pearson
from amibayes.simulation.observe import ramp_path
from benchmarks.charge_migration import MOVING, PLAIN, calibrated, n_integrations, visit
from benchmarks.statements import errors_of, searched

FILE = Path(__file__).with_name("static") / "migration_trials.jsonl"
PAGE, SCRIPT = "howto/charge_migration.md", "docs/migration_trials.py"

PHOTONS, RATIOS = (1e7, 1e8, 1e9), (1.0, 0.5, 0.25)
"""Of the target; and of a calibrator's brightness to the target's."""

WAYS = {
    "none": (PLAIN, False, "off"),
    "left in": (MOVING, False, "off"),
    "from ramps": (MOVING, True, "fit"),
    "from slopes": (MOVING, False, "fit"),
}
"""Detector, whether its ramps are given, and what is done about migration."""

KINDS = ("star", "binary")
NULL_DRAWS, LIMIT_MAS = 500, 200.0
ALPHAS = (0.05, 0.01)


def drawn(kind: str, seed: int) -> np.ndarray | None:
    """East, north (mas) and contrast of a companion: 0.001 to 0.1, 100 to 400 mas."""
    if kind == "star":
        return None
    rng = np.random.default_rng(5000 + seed)
    radius, angle = rng.uniform(100.0, 400.0), rng.uniform(0.0, 2.0 * np.pi)
    return np.array([radius * np.sin(angle), radius * np.cos(angle), 10.0 ** rng.uniform(-3, -1)])


def trial(kind: str, photons: float, ratio: float, seed: int) -> dict[str, Any]:
    """Simulate one visit with and without migration, and search it in every way."""
    truth = drawn(kind, seed)
    found = {}
    for detector in (PLAIN, MOVING):
        with tempfile.TemporaryDirectory() as name:
            start = seed + (9000 if kind == "binary" else 0)
            slopes = visit(Path(name), detector, start, n_integrations(photons), ratio, truth)
            for way, (own, from_ramps, migration) in WAYS.items():
                if own is detector:
                    given = [ramp_path(p) for p in slopes] if from_ramps else slopes
                    data = calibrated(given, migration)
                    found[way] = single(data, seed) if truth is None else errors_of(data, truth)
    return {"kind": kind, "photons": photons, "ratio": ratio, "seed": seed, "ways": found}


def single(data: Observables, seed: int) -> dict[str, float]:
    """False-alarm probabilities with errors as stated and with fitted noise; limit; misfit."""
    found = searched(data)
    p = [
        significance(statistic_of(result, stated_errors=s), NULL_DRAWS, np.random.default_rng(seed))
        for result, s in ((found.stated, True), (found.noisy, False))
    ]
    limit = analytic_limit(found.noisy, "absil", separation_mas=[LIMIT_MAS])
    return {
        "stated": float(p[0].probability),
        "fitted": float(p[1].probability),
        "chi2": found.stated.chi2_single / data.n_independent,
        "limit_mag": float(limit.delta_mag[0]),
    }


def missing(kinds: list[str], photons: list[float]) -> Iterator[tuple[str, float, float, int]]:
    """Trials that are not there, seed by seed: all cells keep nearly the same number."""
    there = {(t["kind"], t["photons"], t["ratio"], t["seed"]) for t in known_answers(FILE)}
    for seed in itertools.count():
        for key in itertools.product(kinds, photons, RATIOS, (seed,)):
            if key not in there:
                yield key


def run(minutes: float, kinds: list[str], photons: list[float]) -> None:
    """Add trials while there is time."""
    for key in missing(kinds, photons):
        if time.process_time() > 60.0 * minutes:
            return
        before = time.process_time()
        keep_answer(FILE, trial(*key), SCRIPT)
        print(*key, f"{time.process_time() - before:.1f} s", flush=True)


def share(hits: np.ndarray) -> str:
    """Number of hits of all, and the 95 % interval of their share."""
    low, high = clopper_pearson(int(hits.sum()), len(hits))
    return f"{int(hits.sum())} of {len(hits)} ({low:.2f} to {high:.2f})"


def cell(
    lines: list[dict[str, Any]], kind: str, way: str, **chosen: float
) -> dict[str, np.ndarray]:
    """Columns of the trials of a kind, way and cell."""
    kept = [
        t["ways"][way]
        for t in lines
        if t["kind"] == kind and all(t[key] == value for key, value in chosen.items())
    ]
    return {key: np.array([t[key] for t in kept]) for key in (kept[0] if kept else ())}


def null_table(lines: list[dict[str, Any]]) -> list[str]:
    """False alarms of single stars, cell by cell and all together."""
    columns = [f"p < {a:g}, {k}" for k in ("stated", "fitted") for a in ALPHAS]
    rows = [
        f"| photons | calibrators | migration | {' | '.join(columns)} | χ²/n of a point |",
        f"|{'---|' * (4 + len(columns))}",
    ]
    cells: list[dict[str, float]] = [
        {"photons": p, "ratio": r} for p, r in itertools.product(PHOTONS, RATIOS)
    ]
    for chosen in (*cells, {}):
        for way in WAYS:
            got = cell(lines, "star", way, **chosen)
            if not got:
                continue
            place = f"{chosen['photons']:.0e} | {chosen['ratio']:g}" if chosen else "all | all"
            counts = [share(got[k] < a) for k in ("stated", "fitted") for a in ALPHAS]
            rows.append(
                f"| {place} | {way} | {' | '.join(counts)} | {np.median(got['chi2']):.2f} |"
            )
    return rows


def binary_table(lines: list[dict[str, Any]]) -> list[str]:
    """Contrasts and positions of companions that were found, all cells of a ratio together."""
    rows = [
        "| calibrators | migration | found | contrast: median bias (%) | median pull | rms pull | "
        "within 1σ | within 2σ | rms pull of position |",
        f"|{'---|' * 9}",
    ]
    for ratio, way in itertools.product(RATIOS, WAYS):
        got = cell(lines, "binary", way, ratio=ratio)
        if not got:
            continue
        near = got["near"].astype(bool)
        pull, place = got["contrast"][near], np.stack([got["east"], got["north"]])[:, near]
        rows.append(
            f"| {ratio:g} | {way} | {near.sum()} of {len(near)} | "
            f"{100 * np.median(got['bias'][near]):+.2f} | {np.median(pull):+.2f} | "
            f"{rms(pull):.2f} | {(abs(pull) < 1).mean():.2f} | {(abs(pull) < 2).mean():.2f} | "
            f"{rms(place):.2f} |"
        )
    return rows


def limit_table(lines: list[dict[str, Any]]) -> list[str]:
    """Limits at one separation, and what the correction gains, by photons and ratio."""
    rows = [
        "| photons | calibrators | none | left in | from ramps | from slopes | gained, ramps | "
        "gained, slopes |",
        f"|{'---|' * 8}",
    ]
    for photons, ratio in itertools.product(PHOTONS, RATIOS):
        got = [cell(lines, "star", w, photons=photons, ratio=ratio) for w in WAYS]
        if not all(got):
            continue
        limit = np.array([g["limit_mag"] for g in got])
        gains = [limit[k] - limit[1] for k in (2, 3)]
        cells = [f"{m:.2f}" for m in np.median(limit, axis=1)]
        cells += [f"{g.mean():+.2f} ± {g.std() / np.sqrt(max(len(g) - 1, 1)):.2f}" for g in gains]
        rows.append(f"| {photons:.0e} | {ratio:g} | {' | '.join(cells)} |")
    return rows


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


TABLES = {"nulls": null_table, "binaries": binary_table, "limits": limit_table}


def main() -> int:
    """Add trials, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=0.0, help="CPU time for more trials")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--photons", nargs="+", type=float, default=list(PHOTONS))
    parser.add_argument("--no-tables", action="store_true", help="trials only")
    arguments = parser.parse_args()
    run(arguments.minutes, arguments.only, arguments.photons)
    if arguments.no_tables:
        return 0
    for name, table in TABLES.items():
        lines = table(known_answers(FILE))
        if len(lines) > len(("head", "rule")):
            put_table(PAGE, lines, f"{name}: {SCRIPT}", known_answers(FILE))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The jwst package beside amibayes on simulated visits: the tables of `jwst_pipeline.md`.

    python docs/jwst_pipeline.py --peers FOLDER [--minutes 10] [--only stars binaries routes]
        [--keep VISITS [--again]]
    python docs/jwst_pipeline.py --data DATA_FOLDER

FOLDER keeps the environment of jwst, which is installed from PyPI the first time, and VISITS the
files of every visit: with ``--again`` these are stated anew, without jwst. Visits are
added to ``docs/static/jwst_trials.jsonl``, one line each, until so many minutes have passed; the
tables are then made from all lines. DATA_FOLDER holds ``jwst/sima-*`` and ``cubes/niriss_f480m_*``:
what is stated of these, by each route.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pages import put_table
from trials import forget_answers, keep_answer, known_answers

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "oifits")]

from amibayes import calibrate  # noqa: E402
from amibayes.extraction.reading import ImageOptions, of_one_visit, read_observations  # noqa: E402
from amibayes.units import offset  # noqa: E402
from benchmarks.jwst_pipeline import LIMIT_MAS, ROUTES, Visit, make, stated  # noqa: E402
from benchmarks.statements import searched  # noqa: E402

FILE = Path(__file__).with_name("static") / "jwst_trials.jsonl"
PAGE, SCRIPT = "jwst_pipeline.md", "docs/jwst_pipeline.py"

SEPARATION_MAS, ANGLE_DEG, CONTRAST = 150.0, 40.0, 0.01

KINDS: dict[str, tuple[int, float, bool]] = {
    "stars": (6, 7.0, False),
    "binaries": (6, 7.0, False),
    "routes": (20, 0.0, True),
}
"""Integrations, jitter (mas), and whether fringe models are kept, of a kind of visits."""

LABELS = {
    "calints": "amibayes, from `calints`",
    "amimulti-oi": "jwst, `amimulti-oi`, read by amibayes",
    "ami-oi": "jwst, `ami-oi` and `psf-ami-oi`, read by amibayes",
    "aminorm-oi": "jwst, `aminorm-oi`, read by amibayes",
    "as delivered": "jwst, `aminorm-oi` as delivered",
}


def visit(kind: str, seed: int) -> Visit:
    """A visit of a kind; companions stand anywhere at 100 to 400 mas for the routes' pulls."""
    n, jitter, _ = KINDS[kind]
    if kind == "stars":
        return Visit(None, seed, n, jitter)
    radius, angle, contrast = SEPARATION_MAS, ANGLE_DEG, CONTRAST
    if kind == "routes":
        rng = np.random.default_rng(700 + seed)
        radius, angle = rng.uniform(100.0, 400.0), rng.uniform(0.0, 360.0)
        contrast = 10.0 ** rng.uniform(-2.0, -1.0)
    return Visit(np.array([*offset(radius, angle), contrast]), seed, n, jitter)


def trials(kind: str) -> list[dict[str, Any]]:
    """Visits of a kind that are there."""
    return [t for t in known_answers(FILE) if t["kind"] == kind]


def run(
    environments: Path, folder: Path, minutes: float, kinds: list[str], most: int, again: bool
) -> None:
    """Add visits, the kinds in turn, while there is time; ``again`` states all of them anew."""
    start = time.monotonic()
    for seed in range(most):
        for kind in kinds:
            if time.monotonic() - start > 60.0 * minutes:
                return
            if not again and any(t["seed"] == seed for t in trials(kind)):
                continue
            one, place = visit(kind, seed), folder / f"{kind}-{seed}"
            seconds = make(one, place, environments, KINDS[kind][2])
            ways, ours = stated(one, place)
            forget_answers(FILE, lambda t, k=kind, s=seed: (t["kind"], t["seed"]) == (k, s))
            done = {"seconds": {"amibayes": ours, **seconds}, "ways": ways}
            keep_answer(FILE, {"kind": kind, "seed": seed, **done}, SCRIPT)
            print(kind, seed, done["seconds"], flush=True)


def measured(
    kind: str, ways: Iterable[str] = ROUTES
) -> Iterator[tuple[str, str, dict[str, np.ndarray]]]:
    """Label, name and numbers of every route that visits of a kind have gone."""
    there = trials(kind)
    for way in ways:
        got = [t["ways"][way] for t in there if way in t["ways"]]
        if got:
            yield LABELS[way], way, {key: np.array([g[key] for g in got]) for key in got[0]}


def star_table() -> list[str]:
    """V² and closure phases of single stars against 1 and 0."""
    rows = [
        "| route | visits | V²: rms error | stated | bias | closure phase: rms error (deg) "
        "| stated (deg) | bias (deg) |",
        f"|{'---|' * 8}",
    ]
    for label, _, got in measured("stars", LABELS):
        cells = [
            f"{figure:.2g}"
            for name, truth in (("vis2", 1.0), ("closure", 0.0))
            for figure in _errors(got, name, truth)
        ]
        rows.append(f"| {label} | {len(got['vis2'])} | {' | '.join(cells)} |")
    return rows


def _errors(got: dict[str, np.ndarray], name: str, truth: float) -> tuple[float, float, float]:
    """Rms error, stated error, and mean error over all visits and numbers."""
    unit = "" if name == "vis2" else "_deg"
    off = got[f"{name}{unit}"] - truth
    # The bias that is common to all baselines; closure phases have none, but their rms mean has.
    mean = off.mean() if name == "vis2" else np.sqrt((off.mean(axis=0) ** 2).mean())
    return rms(off), rms(got[f"{name}_error{unit}"]), float(mean)


def limit_table() -> list[str]:
    """Contrast limits of single stars, and the time."""
    marks = " | ".join(f"limit at {mas:g} mas (mag)" for mas in LIMIT_MAS)
    rows = [f"| route | {marks} | CPU seconds for an integration |", f"|{'---|' * 5}"]
    seconds = [t["seconds"] for t in trials("stars")]
    n = 2 * KINDS["stars"][0]
    for label, way, got in measured("stars"):
        name = "amibayes" if way == "calints" else "analyze"
        each = np.median([s[name] for s in seconds]) / n
        cells = [f"{mag:.2f}" for mag in np.median(got["limit_mag"], axis=0)]
        rows.append(f"| {label} | {' | '.join(cells)} | {each:.2g} |")
    return rows


def binary_table() -> list[str]:
    """What is stated of one companion, visit after visit, against the truth."""
    rows = [
        "| route | visits | separation (mas) | position angle (deg) | contrast (%) | "
        "errors of one visit |",
        f"|{'---|' * 6}",
        f"| truth | | {SEPARATION_MAS:g} | {ANGLE_DEG:g} | {100 * CONTRAST:g} | |",
    ]
    for label, _, got in measured("binaries"):
        names = (("separation_mas", 1.0), ("position_angle_deg", 1.0), ("contrast_stated", 100.0))
        cells = [mean_and_error(scale * got[name]) for name, scale in names]
        stated = [
            f"{np.median(got[name]) * scale:.2g}"
            for name, scale in (
                ("separation_error_mas", 1.0),
                ("position_angle_error_deg", 1.0),
                ("contrast_error", 100.0),
            )
        ]
        n = len(got["near"])
        rows.append(f"| {label} | {n} | {' | '.join(cells)} | {', '.join(stated)} |")
    return rows


def pull_table() -> list[str]:
    """Pulls of position and contrast over many small visits."""
    rows = [
        "| route | found | rms pull: east | north | contrast | mean pull: contrast | within 1σ, 2σ "
        "(all three) | χ²/n of the truth: V², closure phases | median errors: separation (mas), "
        "angle (deg), contrast (%) |",
        f"|{'---|' * 9}",
    ]
    for label, _, got in measured("routes"):
        near = got["near"].astype(bool)
        pulls = np.stack([got[name][near] for name in ("east", "north", "contrast")])
        n = near.sum()
        each = " | ".join(f"{rms(p):.2f} ± {rms(p) / np.sqrt(2 * n):.2f}" for p in pulls)
        misfit = (
            f"{got[f'chi2_{kind}'].mean():.2f} ± {np.sqrt(2.0 / (count * len(near))):.2f}"
            for kind, count in (("vis2", 21), ("cp", 15))
        )
        stated = (
            f"{scale * np.median(got[name][near]):.2g}"
            for name, scale in (
                ("separation_error_mas", 1.0),
                ("position_angle_error_deg", 1.0),
                ("contrast_error", 100.0),
            )
        )
        rows.append(
            f"| {label} | {n} of {len(near)} | {each} | {pulls[2].mean():+.2f} ± "
            f"{rms(pulls[2]) / np.sqrt(n):.2f} | {(abs(pulls) < 1).mean():.2f}, "
            f"{(abs(pulls) < 2).mean():.2f} | {', '.join(misfit)} | {', '.join(stated)} |"
        )
    return rows


def mean_and_error(values: np.ndarray) -> str:
    """Mean, and what its scatter makes it uncertain by."""
    if len(values) < 2:
        return f"{values.mean():.4g}"
    error = values.std(ddof=1) / np.sqrt(len(values))
    return f"{values.mean():.4g} ± {error:.2g}"


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def public_table(data: Path) -> list[str]:
    """What is stated of the F480M cubes made by ami_sim and of their genuine products."""
    rows = [
        "| route | separation (mas) | position angle (deg) | contrast (%) |",
        "|---|---|---|---|",
    ]
    jwst, cubes = data / "jwst", data / "cubes"
    for way in ROUTES:
        if way == "calints":
            paths = [cubes / f"niriss_f480m_{name}.fits" for name in ("target", "calibrator")]
            images = of_one_visit(paths, ImageOptions(header=CUBES))
            target, other = (read_observations([path], images)[0] for path in paths)
            found = calibrate([target], [other], method="weighted").observables
        elif way == "aminorm-oi":
            (found,) = read_observations([jwst / "sima_aminorm-oi.fits"])
        else:
            names = PRODUCTS[way]
            target, other = (read_observations([jwst / name])[0] for name in names)
            found = calibrate([target], [other], method="weighted").observables
        c = searched(found).noisy.companion
        rows.append(
            f"| {LABELS[way]} | {c.separation_mas:.1f} ± {c.separation_error_mas:.1f} | "
            f"{c.position_angle_deg:.2f} ± {c.position_angle_error_deg:.2f} | "
            f"{100 * c.contrast:.3f} ± {100 * c.contrast_error:.3f} |"
        )
    return rows


def error_table(draws: int) -> list[str]:
    """Quoted over true errors of products that tests make with the pipeline's mistakes."""
    import test_products

    rows = ["| product | V²: quoted over true error | closure phase |", "|---|---|---|"]
    for kind in test_products.KINDS:
        with tempfile.TemporaryDirectory() as name:
            found = test_products.quoted_over_true(
                kind, Path(name) / "a.fits", np.random.default_rng(5), draws
            )
        rows.append(f"| `{kind}` | {found[0]:.3f} | {found[1]:.3f} |")
    return rows


CUBES = {"instrument": "niriss", "filter": "F480M"}

PRODUCTS = {
    "amimulti-oi": ("sima-target_amimulti-oi.fits", "sima-calibrator_amimulti-oi.fits"),
    "ami-oi": ("sima-target_a3001_ami-oi.fits", "sima-calibrator_a3001_psf-ami-oi.fits"),
}

TABLES = {
    "stars": star_table,
    "limits": limit_table,
    "binaries": binary_table,
    "pulls": pull_table,
}


def main() -> int:
    """Add visits, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peers", type=Path, metavar="FOLDER")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="of the visits' files")
    parser.add_argument("--again", action="store_true", help="state visits that are kept anew")
    parser.add_argument("--minutes", type=float, default=0.0, help="time for more visits")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--most", type=int, default=50, help="visits of a kind")
    parser.add_argument("--data", type=Path, metavar="DATA_FOLDER")
    parser.add_argument("--draws", type=int, help="of repaired products, for their errors")
    arguments = parser.parse_args()
    if arguments.peers:
        with tempfile.TemporaryDirectory() as other:
            run(
                arguments.peers.resolve(),
                arguments.keep or Path(other),
                arguments.minutes,
                arguments.only,
                arguments.most,
                arguments.again,
            )
    tables = {name: table() for name, table in TABLES.items()}
    if arguments.data:
        tables["public"] = public_table(arguments.data)
    if arguments.draws:
        tables["errors"] = error_table(arguments.draws)
    for name, lines in tables.items():
        # What is recorded is of the script: all of its tables are as old as the answers.
        put_table(PAGE, lines, f"{name}: {SCRIPT}", known_answers(FILE))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What the comparison of models of the sky says of every public file of `oifits/`.

    python docs/public_models.py DATA_FOLDER [--pictures FOLDER] [--only WORD]

runs ``--models star,companion,disc,ring,crescent`` on the files of `public_verdicts.CASES` that
are not in ``docs/static/public_models.jsonl`` yet (delete its lines to do them anew), writes the
table of `howto/companion_or_disc.md`, and fails where a statement is wrong of an object that is
known.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from pages import put_table
from public_verdicts import CASES as FILES
from public_verdicts import PublicCase
from trials import Answer, keep_answer, known_answers

from amibayes.comparison.compare import ModelComparison
from amibayes.comparison.summary import derived
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.report_types import SearchReport
from amibayes.pipeline.search import search_companion
from amibayes.plots.models import (
    model_images,
    model_odds,
    model_residuals,
    model_visibilities,
)

KEPT = Path(__file__).with_name("static") / "public_models.jsonl"
PAGE, SCRIPT = "howto/companion_or_disc.md", "docs/public_models.py"
MARK = f"public: {SCRIPT}"
MODELS = ("star", "companion", "disc", "ring", "crescent")
WRONG = {
    "companion": ("star", "disc", "ring", "crescent", "extended light"),
    "no companion": ("companion",),
}
"""What must not be stated, by the right verdict of the main job."""

PICTURES = {
    "images": model_images,
    "odds": model_odds,
    "residuals": model_residuals,
    "visibilities": model_visibilities,
}


def compared(case: PublicCase, folder: Path) -> SearchReport:
    """Compare models of the data of a case, without posterior, limits and null draws."""
    options = SearchOptions(
        posterior=False, limits=False, null_draws=0, models=MODELS,
        **case.options,  # type: ignore[arg-type]
    )  # fmt: skip
    return search_companion([folder / "oifits" / f for f in case.files], options=options)


def answer(case: PublicCase, folder: Path, pictures: Path | None) -> Answer:
    """What is said of one case."""
    begin = time.process_time()
    report = compared(case, folder)
    found = report.models
    assert found is not None
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        for name, draw in PICTURES.items():
            draw(found).savefig(pictures / f"{case.name.replace(' ', '_')}_{name}.png", dpi=70)
    verdict = found.verdict
    return {
        "name": case.name,
        "statement": verdict.statement,
        "because": verdict.because,
        "degenerate": verdict.degenerate,
        "p_confused": verdict.p_confused,
        "best": found.best.name,
        "theta": best_of(found),
        "p_fit": found.best.p_fit,
        "log_z": {m.name: round(m.log_z, 2) for m in found.models},
        "log_z_error": {m.name: round(m.log_z_error, 2) for m in found.models},
        "noise": [found.noise.vis2, float(np.degrees(found.noise.closure_phase_rad))],
        "draws": found.confusion.n_draws if found.confusion else 0,
        "cpu_s": round(time.process_time() - begin, 1),
    }


def best_of(found: ModelComparison) -> dict[str, float]:
    """Parameters of the most probable model, with what is derived from them."""
    theta = found.best.theta[None]
    return {name: float(value[0]) for name, (value,) in derived(found.best, theta).items()}


def row(case: PublicCase, kept: Answer) -> str:
    """Make a line of the table."""
    best = kept["log_z"][kept["best"]]
    odds = ", ".join(f"{n} {z - best:+.3g}" for n, z in kept["log_z"].items() if n != kept["best"])
    warning = "" if kept["p_fit"] > 1e-3 else f"; does not fit (p {kept['p_fit']:.1g})"
    small = "; below λ/2B" if kept["degenerate"] else ""
    confused = f"{100 * kept['p_confused']:.0f} %" if np.isfinite(kept["p_confused"]) else "–"
    return (
        f"| {case.name} | {case.known} | {kept['statement']}{small}{warning} | {kept['best']} | "
        f"{odds} | {confused} | {kept['cpu_s']:.0f} |"
    )


HEAD = (
    "| data | object | statement | most probable | ln Z of the others, less its own | confused | "
    "CPU, s |",
    "|---|---|---|---|---|---|---|",
)


def is_wrong(case: PublicCase, kept: Answer) -> bool:
    """Whether what is stated cannot be, without a warning that the model does not fit."""
    refused = [s for right in case.right for s in WRONG.get(right, ())]
    return len(case.right) == 1 and kept["statement"] in refused and kept["p_fit"] > 1e-3


def main() -> int:
    """Do what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--only", help="cases whose name holds this")
    arguments = parser.parse_args()
    for case in FILES:
        done = {a["name"] for a in known_answers(KEPT)}
        if case.name not in done and (arguments.only or "") in case.name:
            keep_answer(KEPT, answer(case, arguments.data, arguments.pictures), SCRIPT)
            print(row(case, known_answers(KEPT)[-1]), flush=True)
    kept = {a["name"]: a for a in known_answers(KEPT)}
    there = [case for case in FILES if case.name in kept]
    rows = [row(case, kept[case.name]) for case in there]
    put_table(PAGE, [*HEAD, *rows], MARK, list(kept.values()))
    wrong = [case.name for case in there if is_wrong(case, kept[case.name])]
    print(f"wrong: {', '.join(wrong)}" if wrong else "nothing wrong is stated")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

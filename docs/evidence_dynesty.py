"""Evidences of models of the sky beside those of dynesty, on the data sets of the confusion study.

    python docs/evidence_dynesty.py [--cases 10] [--minutes 20]

Every model of a case is integrated by importance sampling, as ``--models`` does, and by nested
sampling of the same likelihood and prior: four runs with 500 live points each, since one run's own
error can be several times too small where a posterior has many modes. Cases are added to
``docs/static/evidence_dynesty.jsonl`` until so many minutes of CPU time are used up, and the table
of `howto/companion_or_disc.md` is written anew from all lines. Run again it goes on.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import confusion_study as study
import numpy as np
from pages import put_table
from trials import Answer, keep_answer, known_answers

from amibayes.comparison.confusion import HOPELESS
from amibayes.comparison.integral import integrate
from amibayes.posterior.sampler import draw_posterior

CASES = Path(__file__).with_name("static") / "evidence_dynesty.jsonl"
NESTED_RUNS = 4
EXCLUDED = "any, odds below 1e-6"
PAGE, SCRIPT = "howto/companion_or_disc.md", "docs/evidence_dynesty.py"


def case(k: int) -> Answer:
    """ln Z of each model by both methods: value, error and CPU time in seconds."""
    truth, data, _, rng = study.of_case(k)
    answer: Answer = {"case": k, "truth": truth, "models": {}}
    models = study.compared(data, rng, 0).models
    answer["best"] = max(one.log_z for one in models)
    for one in models:
        model = one.fit.model
        if model.n_dim == 0:
            continue
        begin = time.process_time()
        values = model.likelihood.observables.data
        alone = integrate(model, values, one.fit.cube, one.fit.chi2, rng).diagnostics
        between = time.process_time()
        runs = [
            draw_posterior(model.likelihood, model.prior, rng, "nested").diagnostics
            for _ in range(NESTED_RUNS)
        ]
        answer["models"][one.name] = [
            alone["log_z"], alone["log_z_error"], between - begin,
            [(run["log_z"], run["log_z_error"]) for run in runs], time.process_time() - between,
        ]  # fmt: skip
    return answer


def table(cases: Sequence[Answer]) -> list[str]:
    """Differences of ln Z, in units of both errors together, and CPU time."""
    columns = (
        "model", "data sets", "mean difference", "rms difference / error", "largest / error",
        "error here", "error of four dynesty runs", "their scatter / stated", "CPU here, s",
        "CPU of a dynesty run, s",
    )  # fmt: skip
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    each: dict[str, list[list[float]]] = {name: [] for name in (*study.MODELS, EXCLUDED)}
    for one in cases:
        for name, (own, error, own_s, runs, nested_s) in one["models"].items():
            nested, stated = np.array(runs).T
            scatter, stated_error = nested.std(ddof=1), np.sqrt((stated**2).mean())
            mean_error = max(scatter, stated_error) / np.sqrt(len(nested))
            kind = name if own > one["best"] - HOPELESS else EXCLUDED
            each[kind].append([
                own - nested.mean(), error, mean_error, scatter**2 / stated_error**2,
                own_s, nested_s / len(nested),
            ])  # fmt: skip
    for name, rows in each.items():
        if not rows:
            continue
        difference, error, nested_error, ratio, own_s, nested_s = np.array(rows).T
        size = difference / np.hypot(error, nested_error)
        cells = (
            name, str(len(rows)),
            f"{difference.mean():+.2f} ± {difference.std() / np.sqrt(len(rows)):.2f}",
            f"{np.sqrt((size**2).mean()):.2f}", f"{np.abs(size).max():.1f}",
            *(f"{np.median(x):.2g}" for x in (error, nested_error)),
            f"{np.sqrt(ratio.mean()):.2g}", *(f"{np.median(x):.2g}" for x in (own_s, nested_s)),
        )  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> int:
    """Add cases, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10, help="no more than these")
    parser.add_argument("--minutes", type=float, default=0.0, help="CPU time for more cases")
    arguments = parser.parse_args()
    for k in range(len(known_answers(CASES)), arguments.cases):
        if time.process_time() > 60.0 * arguments.minutes:
            break
        keep_answer(CASES, case(k), SCRIPT)
    cases = known_answers(CASES)
    put_table(PAGE, table(cases), f"dynesty: {SCRIPT}", cases)
    return 0


if __name__ == "__main__":
    sys.exit(main())

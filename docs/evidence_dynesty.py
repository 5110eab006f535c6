"""Evidences of models of the sky beside those of dynesty, on the data sets of the confusion study.

    python docs/evidence_dynesty.py [--cases 10] [--minutes 20]

Every model of a case is integrated by importance sampling, as ``--models`` does, and by nested
sampling with 500 live points of the same likelihood and prior. Cases are added to
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

from amibayes.comparison.integral import integrate
from amibayes.posterior.sampler import draw_posterior

CASES = Path(__file__).with_name("static") / "evidence_dynesty.jsonl"
PAGE, SCRIPT = "howto/companion_or_disc.md", "docs/evidence_dynesty.py"


def case(k: int) -> Answer:
    """ln Z of each model by both methods: value, error and CPU time in seconds."""
    truth, data, _, rng = study.of_case(k)
    answer: Answer = {"case": k, "truth": truth, "models": {}}
    for one in study.compared(data, rng, 0).models:
        model = one.fit.model
        if model.n_dim == 0:
            continue
        begin = time.process_time()
        values = model.likelihood.observables.data
        alone = integrate(model, values, one.fit.cube, one.fit.chi2, rng).diagnostics
        between = time.process_time()
        nested = draw_posterior(model.likelihood, model.prior, rng, "nested").diagnostics
        answer["models"][one.name] = [
            alone["log_z"], alone["log_z_error"], between - begin,
            nested["log_z"], nested["log_z_error"], time.process_time() - between,
        ]  # fmt: skip
    return answer


def table(cases: Sequence[Answer]) -> list[str]:
    """Differences of ln Z, in units of both errors together, and CPU time."""
    columns = (
        "model", "data sets", "mean difference", "rms difference / error", "largest / error",
        "error here", "error of dynesty", "CPU here, s", "CPU of dynesty, s",
    )  # fmt: skip
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for name in study.MODELS:
        found = np.array([c["models"][name] for c in cases if name in c["models"]])
        if not len(found):
            continue
        own, own_error, own_s, other, other_error, other_s = found.T
        difference = own - other
        size = difference / np.hypot(own_error, other_error)
        cells = (
            name, str(len(found)),
            f"{difference.mean():+.2f} ± {difference.std() / np.sqrt(len(found)):.2f}",
            f"{np.sqrt((size**2).mean()):.2f}", f"{np.abs(size).max():.1f}",
            *(f"{np.median(x):.3g}" for x in (own_error, other_error, own_s, other_s)),
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
        keep_answer(CASES, case(k))
    put_table(PAGE, table(known_answers(CASES)), f"dynesty: {SCRIPT}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

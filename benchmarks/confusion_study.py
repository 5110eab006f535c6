"""How often companions, rings and crescents are confused, on simulated NIRISS data.

    python benchmarks/confusion_study.py --cases 60 --draws 8 --out study.json

Every case draws a sky (none, companion, ring, crescent, or ring with a companion), simulates
F480M data of 0.3 % in V² and 0.1° in closure phase, and goes through the search and the
comparison as ``amibayes search --models`` does. What is printed:

- the confusion matrix measured over the cases, beside the one stated: the mean, over the cases of
  each truth, of what each case's own simulated data sets say of its true model;
- coverage of the 68 % intervals of every parameter where its model was fitted to its own truth;
- CPU time.

1000 cases with 40 draws take about ten hours on one core. Cases do not depend on each other: a
study grows, run by run, in the file of ``--out``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from amibayes.comparison.compare import ModelComparison, NoiseSetting, compare_sky_models
from amibayes.comparison.hypotheses import Hypothesis
from amibayes.comparison.summary import intervals
from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.instrument import load_instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.field import noise_prior, search_field
from amibayes.pipeline.options import SearchOptions
from amibayes.posterior.priors import default_prior

TRUTHS = ("star", "companion", "ring", "crescent", "ring+companion")
MODELS = TRUTHS
VIS2_ERROR, CLOSURE_ERROR_DEG = 0.003, 0.1
CONTRAST = (0.003, 0.05)
SEPARATION_MAS = (75.0, 350.0)
DIAMETER_MAS = (80.0, 450.0)
MAX_INCLINATION_DEG = 70.0


def sheet() -> Observables:
    """NIRISS through F480M, without noise."""
    niriss = load_instrument("niriss", "F480M")
    return point_source(
        niriss.mask.holes_m,
        np.array([4.817e-6]),
        0.302e-6,
        vis2_error=VIS2_ERROR,
        closure_error_rad=np.radians(CLOSURE_ERROR_DEG),
    )


def drawn(truth: str, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a sky, by name."""
    rho, angle = rng.uniform(*SEPARATION_MAS), rng.uniform(0.0, 2.0 * np.pi)
    found = {"east_mas": rho * np.sin(angle), "north_mas": rho * np.cos(angle)}
    found["contrast"] = float(np.exp(rng.uniform(*np.log(CONTRAST))))
    for name in ("ring", "crescent"):
        found |= {
            f"{name}_flux": float(np.exp(rng.uniform(*np.log(CONTRAST)))),
            f"{name}_diameter_mas": float(np.exp(rng.uniform(*np.log(DIAMETER_MAS)))),
            f"{name}_axis_ratio": rng.uniform(np.cos(np.radians(MAX_INCLINATION_DEG)), 1.0),
            f"{name}_position_angle_deg": rng.uniform(0.0, 180.0),
            f"{name}_width": rng.uniform(0.0, 0.5),
        }
    found |= {"crescent_modulation": rng.uniform(0.3, 1.0)}
    found |= {"crescent_bright_angle_deg": rng.uniform(0.0, 360.0)}
    return found


def simulated(truth: str, rng: np.random.Generator) -> tuple[Observables, dict[str, float]]:
    """Data of a sky with noise, and its parameters."""
    clean = sheet()
    model = Hypothesis(truth).model(BinaryModel())
    likelihood = Likelihood(clean, model)
    values = drawn(truth, rng)
    theta = {n: values[n] for n in likelihood.parameters.names}
    data = likelihood.predict([list(theta.values())])[:, 0]
    data = data + clean.covariance.draw(rng, 1)[:, 0]
    vis2, closure = np.split(data, [len(clean.vis2)])
    return (
        replace(
            clean,
            vis2=replace(clean.vis2, value=vis2),
            closure_phase=replace(clean.closure_phase, value=closure),
        ),
        theta,
    )


def compared(data: Observables, rng: np.random.Generator, draws: int) -> ModelComparison:
    """Compare as ``amibayes search --models`` does."""
    options = SearchOptions(separation_mas=(60.0, 400.0))
    found = search_field(data, options)
    grid = found.result.grid
    prior = default_prior(found.result.likelihood, grid.inner_mas, grid.outer_mas)
    noise = NoiseSetting(found.noise, noise_prior(data, options))
    return compare_sky_models(
        found.result,
        prior,
        rng,
        models=MODELS,
        stated=data,
        noise=noise,
        confusion_draws=draws,
    )


def case(k: int, draws: int) -> dict[str, object]:
    """One sky: what it was, what was stated, and how its parameters came out."""
    rng = np.random.default_rng([20261122, k])
    truth, begin = TRUTHS[k % len(TRUTHS)], time.process_time()
    data, theta = simulated(truth, rng)
    found = compared(data, rng, draws)
    mine = next(m for m in found.models if m.name == truth)
    inside = {}
    if mine.draws.n_effective > 50.0:
        known = intervals(mine)
        for name, value in theta.items():
            turn = 180.0 if name.endswith("position_angle_deg") else 360.0
            if name.endswith("_deg"):
                value = known[name].median + (value - known[name].median + turn / 2) % turn
                value -= turn / 2
            inside[name] = bool(known[name].lower <= value <= known[name].upper)
    stated = []
    if found.confusion is not None:
        stated = found.confusion.taken_for()[1][MODELS.index(truth)].tolist()
    return {
        "truth": truth,
        "theta": theta,
        "verdict": found.verdict.statement,
        "best": found.best.name,
        "probability": dict(zip(MODELS, found.probability.tolist(), strict=True)),
        "p_fit": mine.p_fit,
        "stated": stated,
        "inside": inside,
        "cpu_s": time.process_time() - begin,
    }


def report(cases: list[dict[str, object]]) -> list[str]:
    """The tables of all cases."""
    columns = [*MODELS, "extended light", "both", "undecided"]
    lines = ["measured: truth | " + " | ".join(columns)]
    for truth in TRUTHS:
        mine = [c for c in cases if c["truth"] == truth]
        share = [sum(c["verdict"] == n for c in mine) for n in columns]
        lines.append(f"{truth} ({len(mine)}) | " + " | ".join(str(s) for s in share))
    lines.append("stated: truth | " + " | ".join((*MODELS, "extended light", "undecided")))
    for truth in TRUTHS:
        # Cases that other versions kept may have other columns.
        every = [c["stated"] for c in cases if c["truth"] == truth]
        mine = np.array([s for s in every if s and len(s) == len(every[-1])])
        if len(mine):
            lines.append(f"{truth} | " + " | ".join(f"{x:.2f}" for x in mine.mean(axis=0)))
    inside: dict[str, list[bool]] = defaultdict(list)
    for c in cases:
        for name, held in dict(c["inside"]).items():  # type: ignore[call-overload]
            inside[name].append(held)
    total = [held for each in inside.values() for held in each]
    lines.append("coverage of 68 % intervals:")
    lines += [f"  {n}: {np.mean(v):.2f} of {len(v)}" for n, v in inside.items()]
    lines.append(f"  all: {np.mean(total):.3f} of {len(total)}")
    lines.append(f"CPU: {np.mean([c['cpu_s'] for c in cases]):.1f} s a case")  # type: ignore[misc]
    return lines


def main() -> int:
    """Run the cases and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--out", type=Path, help="kept cases: those that are there are not redone")
    parser.add_argument("--minutes", type=float, default=np.inf, help="of CPU, then no new case")
    arguments = parser.parse_args()
    cases, begin = [], time.process_time()
    if arguments.out and arguments.out.exists():
        cases = json.loads(arguments.out.read_text())
    for k in range(len(cases), arguments.cases):
        if time.process_time() - begin > 60.0 * arguments.minutes:
            break
        cases.append(case(k, arguments.draws))
        if arguments.out:
            arguments.out.write_text(json.dumps(cases))
    print("\n".join(report(cases)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

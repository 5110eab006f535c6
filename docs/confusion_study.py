"""How often companions, rings and crescents are confused, on simulated NIRISS data.

    python docs/confusion_study.py [--minutes 45]

Every case draws a sky (a star alone, with a companion, a ring, a crescent, or a ring and a
companion), simulates F480M data of 0.3 % in V² and 0.1° in closure phase, and goes through the
search and the comparison as ``amibayes search --models`` does. Cases are added to
``docs/static/confusion_study.jsonl`` until so many minutes of CPU time are used up, each drawn
from its own number, and the tables of `howto/companion_or_disc.md` are written anew from all
lines. Run again it goes on.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pages import put_table
from trials import Answer, keep_answer, known_answers

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from amibayes.comparison.best_fits import NoiseSetting
from amibayes.comparison.compare import Compared, ModelComparison, compare_sky_models
from amibayes.comparison.hypotheses import FAMILIES, Hypothesis
from amibayes.comparison.summary import derived
from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.instrument import load_instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.field import noise_prior, search_field
from amibayes.pipeline.options import SearchOptions
from amibayes.posterior.priors import default_prior

CASES = Path(__file__).with_name("static") / "confusion_study.jsonl"
PAGE, SCRIPT = "howto/companion_or_disc.md", "docs/confusion_study.py"

MODELS = ("star", "companion", "ring", "crescent", "ring+companion")
"""Truths, in turn, and what is compared."""

COLUMNS = (*MODELS, "extended light", "undecided")
VIS2_ERROR, CLOSURE_ERROR_DEG = 0.003, 0.1
CONTRAST = (0.003, 0.05)
SEPARATION_MAS = (75.0, 350.0)
DIAMETER_MAS = (80.0, 450.0)
MAX_INCLINATION_DEG = 70.0
CONFUSION_DRAWS = 8
"""Simulated data sets of each model in every case, where the command takes 40."""

LEAST_EFFECTIVE = 50.0
"""Draws that count below which no rank is taken from a posterior."""


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


def drawn(rng: np.random.Generator) -> dict[str, float]:
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
    likelihood = Likelihood(clean, Hypothesis(truth).model(BinaryModel()))
    values = drawn(rng)
    theta = {n: values[n] for n in likelihood.parameters.names}
    data = likelihood.predict([list(theta.values())])[:, 0]
    data = data + clean.covariance.draw(rng, 1)[:, 0]
    vis2, closure = np.split(data, [len(clean.vis2)])
    values2 = replace(clean.vis2, value=vis2)
    return replace(
        clean, vis2=values2, closure_phase=replace(clean.closure_phase, value=closure)
    ), theta


def compared(data: Observables, rng: np.random.Generator, draws: int) -> ModelComparison:
    """Compare as ``amibayes search --models`` does."""
    options = SearchOptions(separation_mas=(60.0, 400.0))
    found = search_field(data, options)
    grid = found.result.grid
    prior = default_prior(found.result.likelihood, grid.inner_mas, grid.outer_mas)
    noise = NoiseSetting(found.noise, noise_prior(data, options))
    return compare_sky_models(
        found.result, prior, rng,
        models=MODELS, stated=data, noise=noise, confusion_draws=draws,
    )  # fmt: skip


def of_case(k: int) -> tuple[str, Observables, dict[str, float], np.random.Generator]:
    """Truth, data and parameters of a case, and where further randomness comes from."""
    rng = np.random.default_rng([20261122, k])
    truth = MODELS[k % len(MODELS)]
    return truth, *simulated(truth, rng), rng


def case(k: int) -> Answer:
    """One sky: what it was, what was stated, and how its parameters came out."""
    begin = time.process_time()
    truth, data, theta, rng = of_case(k)
    found = compared(data, rng, CONFUSION_DRAWS)
    mine = next(m for m in found.models if m.name == truth)
    stated = {}
    if found.confusion is not None:
        names, share = found.confusion.taken_for()
        stated = dict(zip(names, share[MODELS.index(truth)].tolist(), strict=True))
    return {
        "case": k,
        "truth": truth,
        "theta": theta,
        "verdict": found.verdict.statement,
        "degenerate": found.verdict.degenerate,
        "log_z": {m.name: round(m.log_z, 3) for m in found.models},
        "log_z_error": {m.name: round(m.log_z_error, 3) for m in found.models},
        "p_fit": mine.p_fit,
        "stated": stated,
        "ranks": ranks(mine, theta),
        "cpu_s": round(time.process_time() - begin, 2),
    }


def ranks(model: Compared, theta: dict[str, float]) -> dict[str, float]:
    """Share of the posterior below each true parameter; angles count from opposite their mean."""
    if not theta or model.draws.n_effective < LEAST_EFFECTIVE:
        return {}
    # The search may have given the star a diameter, whose true value of 0 is at its edge.
    at, weight = np.array([[theta.get(name, 0.0) for name in model.names]]), model.draws.weights
    found = {}
    known = derived(model, at, model.draws.samples)
    for name, (true, values) in known.items():
        if name in model.names and name not in theta:
            continue
        turn = 180.0 if name.endswith("_position_angle_deg") else 360.0
        if "deg" in name and "inclination" not in name:
            mean = np.angle(weight @ np.exp(2j * np.pi * values / turn)) * turn / (2.0 * np.pi)
            values, true = ((x - mean + 0.5 * turn) % turn for x in (values, true))
        found[name] = round(float(weight @ (values < true[0])), 4)
    return found


def measured_table(cases: Sequence[Answer]) -> list[str]:
    """How often each truth was taken for what."""
    columns = ("cases", *COLUMNS, "incomplete", "wrong")
    lines = [f"| truth | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
    for truth in (*MODELS, "all"):
        mine = [c for c in cases if truth in ("all", c["truth"])]
        counts = [sum(c["verdict"] == n for c in mine) for n in COLUMNS]
        counts += [sum(f(c) for c in mine) for f in (is_incomplete, is_wrong)]
        cells = [str(len(mine)), *(str(n or "") for n in counts)]
        lines.append(f"| {truth} | {' | '.join(cells)} |")
    return lines


def is_right(answer: Answer) -> bool:
    """Whether the truth is stated, or the kind of models that it is of."""
    one = Hypothesis(answer["truth"])
    kind = FAMILIES[one.family]
    return answer["verdict"] in (answer["truth"], kind if kind == "extended light" else "")


def is_incomplete(answer: Answer) -> bool:
    """Whether a part of the truth is stated: a star, the ring without its brighter side."""
    verdict, truth = answer["verdict"], Hypothesis(answer["truth"])
    if verdict == "extended light":
        return truth.family == "both"
    return verdict in MODELS and Hypothesis(verdict).within(truth)


def is_wrong(answer: Answer) -> bool:
    """Whether something is stated that is not on the sky."""
    undecided = answer["verdict"] == "undecided"
    return not (undecided or is_right(answer) or is_incomplete(answer))


def stated_table(cases: Sequence[Answer]) -> list[str]:
    """Shares that were measured, and those that the cases' own simulations stated on the mean."""
    lines = [f"| truth | | {' | '.join(COLUMNS)} |", "|---" * (2 + len(COLUMNS)) + "|"]
    for truth in MODELS:
        mine = [c for c in cases if c["truth"] == truth and c["stated"]]
        for label, shares in (
            ("measured", [[c["verdict"] == n for n in COLUMNS] for c in mine]),
            ("stated", [[c["stated"].get(n, 0.0) for n in COLUMNS] for c in mine]),
        ):
            mean = np.mean(shares, axis=0)
            error = np.std(shares, axis=0) / np.sqrt(len(mine))
            cells = [f"{m:.2f} ± {e:.2f}" if m else "" for m, e in zip(mean, error, strict=True)]
            lines.append(f"| {truth} | {label} | {' | '.join(cells)} |")
    return lines


def coverage_table(cases: Sequence[Answer]) -> list[str]:
    """Shares of true parameters inside the central 68 and 95 % intervals."""
    found: dict[str, list[float]] = defaultdict(list)
    for c in cases:
        for name, rank in c["ranks"].items():
            found[name].append(rank)
            found["all"].append(rank)
    lines = ["| parameter | fits | in 68 % | in 95 % |", "|---|---|---|---|"]
    for name, values in sorted(found.items(), key=lambda pair: (pair[0] == "all", pair[0])):
        cells = []
        for level in (0.68, 0.95):
            inside = np.abs(np.array(values) - 0.5) < 0.5 * level
            error = np.sqrt(level * (1.0 - level) / len(values))
            cells.append(f"{inside.mean():.2f} ± {error:.2f}")
        lines.append(f"| {name} | {len(values)} | {' | '.join(cells)} |")
    return lines


def cost_table(cases: Sequence[Answer]) -> list[str]:
    """CPU time of a case: search, fits, evidences, and those of the simulated data sets."""
    each = np.array([c["cpu_s"] for c in cases])
    low, mid, high = np.quantile(each, [0.05, 0.5, 0.95])
    n = CONFUSION_DRAWS * len(MODELS)
    return [
        "| five models, simulated data sets | median, s | 5 % to 95 %, s |",
        "|---|---|---|",
        f"| {n} | {mid:.1f} | {low:.1f} to {high:.1f} |",
    ]


def main() -> int:
    """Add cases, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000, help="no more than these")
    parser.add_argument("--minutes", type=float, default=0.0, help="CPU time for more cases")
    parser.add_argument("--no-tables", action="store_true", help="cases only")
    arguments = parser.parse_args()
    for k in range(len(known_answers(CASES)), arguments.cases):
        if time.process_time() > 60.0 * arguments.minutes:
            break
        keep_answer(CASES, case(k), SCRIPT)
    if not arguments.no_tables:
        write_tables(known_answers(CASES))
    return 0


def write_tables(cases: Sequence[Answer]) -> None:
    """Put all tables into the page."""
    tables = {
        "measured": measured_table(cases),
        "stated": stated_table(cases),
        "coverage": coverage_table(cases),
        "cost": cost_table(cases),
    }
    for name, lines in tables.items():
        put_table(PAGE, lines, f"{name}: {SCRIPT}", cases)


if __name__ == "__main__":
    sys.exit(main())

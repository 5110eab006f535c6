"""Surveys of simulated stars: stated and realised rates, frequency coverage, cost, a cost model.

    python -m benchmarks.survey_study simulate FOLDER --targets 200 --companions 10
    python -m benchmarks.survey_study study --surveys 20 --targets 50 --companions 5
    python -m benchmarks.survey_study cost --targets 40 > docs/howto/survey_cost.md

`simulate` writes NIRISS files and their table, at the level of V² and closure phases. `study`
searches whole surveys and counts false discoveries and covered frequencies. `cost` measures what
a target costs and what a dask scheduler does with a task, and says what 10⁵ targets cost.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import contextlib
import io
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from amibayes.cli import main as amibayes
from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.instrument import load_instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.oifits import write_oifits

FIELD = (70.0, 400.0)
"""Separations that are searched and that companions are drawn from, mas."""

DEPTHS = (2.0, 7.0)
"""Magnitude differences of companions."""

QUICK = ("--no-posterior", "--no-pictures", "--separation", f"{FIELD[0]:g}:{FIELD[1]:g}", "--quiet")


@dataclass(frozen=True)
class Star:
    """A simulated target: its data, and the companion that it has."""

    name: str
    data: Observables
    separation_mas: float | None = None
    delta_mag: float | None = None


def sheet() -> Observables:
    """NIRISS through F480M: V² to 0.5 %, closure phases to 0.3°."""
    holes = load_instrument("niriss", "F480M").mask.holes_m
    return point_source(
        holes, 4.817e-6, 0.302e-6, vis2_error=0.005, closure_error_rad=np.radians(0.3)
    )


def simulated(n: int, n_companions: int, rng: np.random.Generator) -> list[Star]:
    """Simulate a survey; stars with companions come first."""
    empty = sheet()
    likelihood = Likelihood(empty)
    stars = []
    for k in range(n):
        theta, place = [0.0, 0.0, 0.0], (None, None)
        if k < n_companions:
            rho = float(np.exp(rng.uniform(*np.log(FIELD))))
            mag, angle = float(rng.uniform(*DEPTHS)), rng.uniform(0.0, 2.0 * np.pi)
            theta = [rho * np.sin(angle), rho * np.cos(angle), 10.0 ** (-0.4 * mag)]
            place = (rho, mag)
        data = likelihood.predict([theta])[:, 0] + empty.covariance.draw(rng, 1)[:, 0]
        vis2, closure = np.split(data, [len(empty.vis2)])
        one = replace(
            empty,
            vis2=replace(empty.vis2, value=vis2),
            closure_phase=replace(empty.closure_phase, value=closure),
        )
        stars.append(Star(f"star{k:05d}", one, *place))
    return stars


def write(folder: Path, stars: list[Star], rng: np.random.Generator) -> Path:
    """Write the files of a survey and its table, with distances."""
    folder.mkdir(parents=True, exist_ok=True)
    for star in stars:
        write_oifits(folder / f"{star.name}.oifits", star.data, overwrite=True)
    table = Table(
        {
            "target": [f"{star.name}.oifits" for star in stars],
            "distance_pc": rng.uniform(15.0, 60.0, len(stars)).round(2),
        }
    )
    table.write(folder / "targets.ecsv", overwrite=True)
    return folder / "targets.ecsv"


def search(table: Path, out: Path, *words: object) -> dict[str, Any]:
    """Search a survey with the command, and give ``survey.json``."""
    command = ["search", "--batch", table, "--out", out, "--overwrite", *QUICK, *words]
    with contextlib.redirect_stdout(io.StringIO()):
        status = amibayes([str(word) for word in command])
    if status:
        raise SystemExit(status)
    content: dict[str, Any] = json.loads((out / "survey.json").read_text())
    return content


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("part", choices=("simulate",))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--targets", type=int, default=50)
    parser.add_argument("--companions", type=int, default=5)
    parser.add_argument("--surveys", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    write(arguments.folder, simulated(arguments.targets, arguments.companions, rng), rng)


if __name__ == "__main__":
    main()

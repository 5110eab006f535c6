"""What a library of calibrators gains over the nearest ones, on visits whose response drifts.

    python -m benchmarks.calibrator_library --visits 20

NIRISS through F480M at the level of V² and closure phases: two modes, V² that loses coherence with
the square of the baseline (2 % rms at the longest) and a closing pattern of closure phases (0.7°
rms per baseline), with correlation times of 20 days, and a scatter of 0.3 errors between stars. 40
calibrators in 120 days. Each row calibrates the same single stars. Columns: rms of what is left of
V² and closure phase; its χ² per datum; the error of a companion's contrast, median over the field;
the rms of the contrast fitted there in its errors (1 is right; more is a false companion);
and CPU time.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from drifting_visits import Drift, visits

from amibayes.calibration import calibrate
from amibayes.data.observables import Observables
from amibayes.likelihood.likelihood import Likelihood

STEP = 1e-4
"""Contrast of the templates: small enough that the response is linear."""


def templates(rng: np.random.Generator, sheet: Observables, n: int = 200) -> np.ndarray:
    """Change of the data by a companion of contrast 1 at random places of the field, (m, n)."""
    likelihood = Likelihood(sheet)
    rho, angle = np.exp(rng.uniform(np.log(70), np.log(400), n)), rng.uniform(0, 2 * np.pi, n)
    theta = np.stack([rho * np.sin(angle), rho * np.cos(angle), np.full(n, STEP)], axis=1)
    nothing = theta * [1.0, 1.0, 0.0]
    return (likelihood.predict(theta) - likelihood.predict(nothing)) / STEP


def measured(out: Observables, rng: np.random.Generator) -> tuple[float, ...]:
    """Numbers of one calibrated single star."""
    n = out.n_vis2
    residual = out.data - np.repeat([1.0, 0.0], [n, out.n_closure_phases])
    white = out.covariance.whiten(residual[:, None])
    shape = out.covariance.whiten(templates(rng, out))
    fisher = (shape**2).sum(axis=0)
    fitted = (shape * white).sum(axis=0) / np.sqrt(fisher)
    chi2 = float((white**2).sum()) / out.n_independent
    rms = [float(np.mean(part**2)) for part in (residual[:n], residual[n:])]
    return (*rms, chi2, float(np.median(fisher**-0.5)), float(np.mean(fitted**2)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--visits", type=int, default=20)
    number = parser.parse_args().visits
    rng = np.random.default_rng(1)
    rows: dict[str, list[tuple[float, ...]]] = {}
    for _ in range(number):
        mjd = np.append(60000.0 + np.sort(rng.uniform(0.0, 120.0, 40)), 60060.0)
        *library, target = visits(Drift(), mjd, rng)
        by_date = sorted(library, key=lambda o: abs(o.vis2.mjd[0] - 60060.0))
        used = {
            "3 nearest, weighted": ("weighted", by_date[:3]),
            "3 nearest, hierarchical": ("hierarchical", by_date[:3]),
            "all 40, hierarchical": ("hierarchical", library),
            "library of 40, population": ("population", library),
        }
        for name, (method, stars) in used.items():
            begin = time.process_time()
            out = calibrate(target, stars, method=method, clip=None, rng=np.random.default_rng(1))
            took = time.process_time() - begin
            numbers = measured(out.observables, np.random.default_rng(2))
            rows.setdefault(name, []).append((*numbers, took))
    print(
        "| calibrators | V² left | closure phase left | χ² | contrast error | fitted/error | CPU |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, numbers in rows.items():
        vis2, closure, chi2, sigma, pull, took = np.mean(numbers, axis=0)
        print(
            f"| {name} | {np.sqrt(vis2):.4f} | {np.degrees(np.sqrt(closure)):.2f}° | {chi2:.2f} | "
            f"{sigma:.2e} | {np.sqrt(pull):.2f} | {took:.1f} s |"
        )


if __name__ == "__main__":
    main()

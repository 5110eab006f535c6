"""How fast the search is: the grid per position and datum, its stages, the whole command.

    python benchmarks/search.py [FILE]

Without a file, data of AX Cir's size are simulated: 50 exposures of 4 telescopes in 3
channels, 900 V² and 600 closure phases, a field of 50 mas.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from amibayes import Likelihood, join, point_source, read_oifits, write_oifits
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.optimise import fit_single
from amibayes.companion_search.search import search
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.observables import Observables
from amibayes.detection.statistic import make_statistic
from amibayes.likelihood.likelihood import single_likelihood
from amibayes.models.binary import BinaryModel

FIELD = (0.7, 50.0)
POSITIONS = 40_000
DRAWS = 10_000


def simulated(n_exposures: int = 50) -> Observables:
    """Exposures that the sky's rotation spreads over the (u, v) plane."""
    rng = np.random.default_rng(1)
    parts = []
    for k in range(n_exposures):
        turn = np.radians(1.5 * k)
        rotate = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        stations = np.array([[0.0, 0.0], [50.0, 10.0], [20.0, 70.0], [-30.0, 60.0]]) @ rotate
        sheet = point_source(
            stations,
            [1.61e-6, 1.69e-6, 1.77e-6],
            0.09e-6,
            vis2_error=0.025,
            closure_error_rad=0.03,
            mjd=60000.0 + 0.01 * k,
        )
        parts.append(sheet)
    data = join(parts)
    model = Likelihood(data, BinaryModel(diameter_mas=0.8)).predict([[6.2, -28.5, 0.009]])[:, 0]
    model += data.covariance.draw(rng, 1)[:, 0]
    return data.with_data(model)


def cpu(function, *arguments, repeat: int = 3):
    """Least CPU time of a few calls, and the last result."""
    times = []
    for _ in range(repeat):
        begin = time.process_time()
        result = function(*arguments)
        times.append(time.process_time() - begin)
    return min(times), result


def gemm_seconds(flops: float) -> float:
    """Time the machine's single-precision product needs for as many operations."""
    a = np.ones((1024, 1024), dtype=np.float32)
    seconds, _ = cpu(np.matmul, a, a, repeat=10)
    return seconds * flops / (2 * 1024**3)


def command(path: Path) -> float:
    """Wall time of the whole command, without null draws, posterior and limits."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "amibayes", "search", str(path), "--out", folder, "--quiet"]
        words += ["--separation", "0.7:50", "--null-draws", "0", "--no-posterior", "--no-limits"]
        begin = time.perf_counter()
        subprocess.run(words, check=True)
        return time.perf_counter() - begin


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.oifits"
        if len(sys.argv) > 1:
            path = Path(sys.argv[1])
        else:
            write_oifits(path, simulated())
        likelihood = Likelihood(read_oifits(path), BinaryModel(diameter_mas="free"))
        n_data = len(likelihood.observables.data)
        single, _ = fit_single(likelihood)
        step = np.sqrt(np.pi * (FIELD[1] ** 2 - FIELD[0] ** 2) / POSITIONS)
        grid = make_grid(*FIELD, step)
        residuals = single_likelihood(likelihood).residuals(single)[:, 0]
        seconds, _ = cpu(lambda: TemplateBank(likelihood, grid, single).scan(residuals))
        print(f"grid      {len(grid)} positions × {n_data} data, templates included: "
              f"{seconds / len(grid) / n_data * 1e9:.1f} ns each")  # fmt: skip
        seconds, result = cpu(search, likelihood, FIELD)
        print(f"search    {seconds:.2f} s CPU: {len(result.grid)} positions, refinement, check")
        test = make_statistic(likelihood, result.grid, single, stated_errors=True)
        bank, rng = test.bank, np.random.default_rng(1)
        seconds, _ = cpu(test.draw_null, DRAWS, rng, repeat=1)
        # Mirror positions share their products: one multiply-add per datum and pair.
        floor = gemm_seconds(2.0 * (len(result.grid) / 2) * bank.n_data * DRAWS)
        print(f"null      {DRAWS} searches in {seconds:.1f} s CPU, "
              f"{100 * floor / seconds:.0f} % of it the matrix products' own time")  # fmt: skip
        print(f"command   {command(path):.2f} s from start to end of the process")
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import amibayes.cli"], check=True)
    both = time.perf_counter() - begin
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", "pass"], check=True)
    print(f"import    amibayes.cli {both - (time.perf_counter() - begin):.3f} s")


if __name__ == "__main__":
    main()

"""How fast images are simulated, beside the random numbers that they are made of.

The paper's largest run: F380M, 9590 integrations of 7 groups, into a file.

    python benchmarks/simulation.py [N_INTEGRATIONS]
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from amibayes.parallel import open_executor
from amibayes.simulation.observe import PreparedExposure, write_exposure
from amibayes.simulation.program import read_program
from amibayes.support.atomic_files import sha256

SCENE = """
[star]
spectrum = "G2V"
[[companion]]
separation_mas = 150.0
position_angle_deg = 20.0
delta_mag = 20.0
[instrument]
filter = "F380M"
[exposure]
count_rate = 1999651.0
n_groups = 7
n_integrations = {n}
"""


def megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def draws_alone_s(prepared: PreparedExposure, n: int) -> tuple[float, float]:
    """Seconds of one core for the Poisson and normal numbers of n integrations."""
    detector = prepared.observation.detector
    light = prepared.recorder.light(prepared.pointings.jitter_px[:32]) * detector.frame_time_s
    rng = np.random.default_rng(1)
    start = time.perf_counter()
    for _ in range(21):
        rng.poisson(light)
    poisson = time.perf_counter() - start
    buffer = np.empty((8, *light.shape))
    start = time.perf_counter()
    for _ in range(3):
        rng.standard_normal(out=buffer)
    normal = time.perf_counter() - start
    return poisson / 21 * 7 * n / 32, normal / 3 * n / 32


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 9590
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.toml"
        scene.write_text(SCENE.format(n=n))
        before, contents = megabytes(), []
        for workers in (1, 2):
            start = time.perf_counter()
            _, prepared = next(read_program(scene).prepared_exposures(seed=1))
            path = Path(folder) / f"{workers}.fits"
            with open_executor(workers) as executor:
                write_exposure(path, prepared, executor)
            took = time.perf_counter() - start
            beyond = megabytes() - before
            poisson, normal = draws_alone_s(prepared, n)
            contents.append(sha256(path))
            print(
                f"{workers} workers: {took:.1f} s, {n / took:.0f} integrations/s, "
                f"{took / poisson:.2f} times the Poisson draws alone ({poisson:.1f} s of one core)"
            )
            if workers == 1:
                print(f"random numbers: {100 * (poisson + normal) / took:.0f} % of the time")
                print(f"memory beyond the interpreter: {beyond:.0f} MB")
    print("same bytes:", contents[0] == contents[1])


if __name__ == "__main__":
    main()

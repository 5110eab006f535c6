"""Integrations per second of every method: an 80 × 80 cube of 1000, one thread, CPU time.

python benchmarks/extraction.py
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from amibayes.extraction import METHODS, ExtractOptions, extract_all
from amibayes.extraction.extract import make_bench
from amibayes.extraction.frames import measure
from amibayes.extraction.source import Held
from amibayes.instrument import load_instrument
from amibayes.scene import Scene
from amibayes.simulation import Exposure, simulate

N = 1000


def main() -> None:
    instrument = load_instrument("niriss", "F480M")
    cube = simulate(
        Scene(), instrument, Exposure(19, 50), np.random.default_rng(1), count_rate_e_s=1e6
    )
    many = replace(
        cube,
        images=np.tile(cube.images, (N // 50, 1, 1)),
        error=np.tile(cube.error, (N // 50, 1, 1)),
        dq=np.tile(cube.dq, (N // 50, 1, 1)),
        mjd=None,
    )
    for method in METHODS:
        options = ExtractOptions(method=method)
        start = time.process_time()
        extract_all(many, options)
        whole = time.process_time() - start
        bench = make_bench(Held(many), options)
        start = time.process_time()
        measure(bench, Held(many), 0)
        part = time.process_time() - start
        print(f"{method:8} whole {N / whole:7.0f}/s   clean + measure {N / part:7.0f}/s")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()

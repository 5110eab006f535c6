"""How fast injection and recovery are: trials per minute, against a refit per trial, on workers.

    python benchmarks/limits.py [TRIALS]

NIRISS through F480M: 21 V² and 35 closure phases, 36 independent data, a search of 10⁴
positions in every trial. Without an argument 100 000 trials are run, on one process, on two,
and on two dask workers; all give the same answer, bit by bit.

A refit per trial is what CANDID's injection does: the data with a companion are fitted again,
here with the package's own model and analytic gradients, in the same run.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from amibayes import Likelihood, TemplateBank, load_instrument, open_executor, point_source
from amibayes.inference.bank import make_grid
from amibayes.inference.recovery import TRIALS_AT_ONCE, recover
from amibayes.inference.refine import Box, refine
from amibayes.inference.search import resolution_mas, search
from amibayes.observables import Observables
from amibayes.parallel import Executor
from amibayes.units import FloatArray, offset

FIELD_MAS = (50.0, 400.0)
POSITIONS = 10_000
TRIALS = 100_000
REFITS = 40
REPEATS = 4
EMPTY = 100
THRESHOLD = 20.0
"""Gain in χ² that counts; its value does not change the work."""


def sheet() -> Observables:
    """A single star, noiseless, with the errors of an exposure."""
    niriss = load_instrument("niriss", "F480M")
    return point_source(
        niriss.mask.holes_m,
        niriss.bandpass.pivot_m,
        niriss.bandpass.effective_width_m,
        vis2_error=0.005,
        closure_error_rad=np.radians(0.3),
    )


def companions(n: int) -> FloatArray:
    """Faint companions all over the field, (n, 3): east, north, contrast."""
    rng = np.random.default_rng(1)
    east, north = offset(rng.uniform(*FIELD_MAS, n), rng.uniform(0.0, 360.0, n))
    return np.column_stack([east, north, 10.0 ** rng.uniform(-3.3, -2.0, n)])


@contextmanager
def dask_workers(n: int) -> Iterator[Executor]:
    """A scheduler and so many worker processes on this machine."""
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=n, threads_per_worker=1, dashboard_address=None) as cluster,
        open_executor(scheduler=cluster.scheduler_address) as executor,
    ):
        yield executor


def timed(work, executor: Executor, n: int) -> tuple[float, FloatArray]:
    """Least wall time of a few runs of a job whose workers are up already."""
    work(companions(2 * 2048), executor)
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        found = work(companions(n), executor)
        times.append(time.perf_counter() - begin)
    return min(times), found


def overhead_s(executor: Executor) -> float:
    """Time that a piece costs beside its work: what is left to lose where cores are idle."""
    begin = time.perf_counter()
    for _ in executor.map(abs, range(EMPTY)):
        pass
    return (time.perf_counter() - begin) / EMPTY


def refits_per_second(likelihood: Likelihood) -> float:
    """One trial: a data set with a companion and noise, fitted from the true position."""
    fringe = resolution_mas(likelihood)
    box = Box(*FIELD_MAS, fringe)
    rng = np.random.default_rng(2)
    seconds = 0.0
    for theta in companions(REFITS):
        fresh = Likelihood(with_companion(likelihood, theta, rng))
        begin = time.perf_counter()
        refine(fresh, theta, box, 0.0)
        seconds += time.perf_counter() - begin
    return REFITS / seconds


def with_companion(
    likelihood: Likelihood, theta: FloatArray, rng: np.random.Generator
) -> Observables:
    """Data of a companion, with noise."""
    blank = likelihood.observables
    data = likelihood.predict(theta)[:, 0] + blank.covariance.draw(rng, 1)[:, 0]
    vis2, closure = np.split(data, [blank.n_vis2])
    return replace(
        blank,
        vis2=replace(blank.vis2, value=vis2),
        closure_phase=replace(blank.closure_phase, value=closure),
    )


def main() -> None:
    likelihood = Likelihood(sheet())
    single = search(likelihood, FIELD_MAS).single_theta
    step = np.sqrt(np.pi * (FIELD_MAS[1] ** 2 - FIELD_MAS[0] ** 2) / POSITIONS)
    bank = TemplateBank(likelihood, make_grid(*FIELD_MAS, float(step)), single)
    print(f"{bank.n_data} independent data, {len(bank)} positions")

    def work(theta: FloatArray, executor: Executor) -> FloatArray:
        rng = np.random.default_rng(3)
        found = recover(likelihood, bank, single, theta, THRESHOLD, rng, executor=executor)
        return found.located

    n = int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS
    with open_executor(1) as executor:
        alone, expected = timed(work, executor, n)
    piece = alone * TRIALS_AT_ONCE / n
    print(f"1 process       {n} trials in {alone:.1f} s, {n / alone:.0f} trials/s, "
          f"{expected.mean():.3f} recovered")  # fmt: skip
    for name, opened in (("2 processes", open_executor(2)), ("2 dask workers", dask_workers(2))):
        with opened as executor:
            seconds, found = timed(work, executor, n)
            lost = overhead_s(executor)
        assert np.array_equal(found, expected)
        print(f"{name:15} {n} trials in {seconds:.1f} s, {n / seconds:.0f} trials/s, "
              f"efficiency {alone / seconds / 2:.0%}; {1e3 * lost:.1f} ms lost per piece of "
              f"{1e3 * piece:.0f} ms")  # fmt: skip
    rate = refits_per_second(likelihood)
    print(f"refit per trial {rate:.0f} trials/s, which then have not searched the field: "
          f"the bank is {n / alone / rate:.0f} times faster on one process")  # fmt: skip


if __name__ == "__main__":
    main()

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
from dataclasses import dataclass

import numpy as np

from amibayes import Likelihood, load_instrument, open_executor, point_source
from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.optimise import refine
from amibayes.companion_search.search import search
from amibayes.data.observables import Observables
from amibayes.detection.statistic import BankStatistic, make_statistic
from amibayes.limits.aliases import nearer_aliases
from amibayes.limits.injection import TRIALS_AT_ONCE, recover
from amibayes.models.parameters import Box
from amibayes.parallel import Executor
from amibayes.units import BoolArray, FloatArray, offset

FIELD_MAS = (50.0, 400.0)
POSITIONS = 10_000
TRIALS = 100_000
REFITS = 40
REPEATS = 3
RINGS, ANGLES = 24, 100
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


def rings() -> FloatArray:
    """Places on rings, as those of `detection_limit`, (n_rings, n_angles, 2)."""
    rho = np.linspace(*FIELD_MAS, RINGS)[:, None]
    return np.stack(offset(rho, np.linspace(0.0, 360.0, ANGLES, endpoint=False)), axis=-1)


def companions(n: int) -> FloatArray:
    """Faint companions all over the rings, (n, 3): east, north, contrast."""
    places = rings().reshape(-1, 2)
    contrast = 10.0 ** np.random.default_rng(1).uniform(-3.3, -2.0, n)
    return np.column_stack([places[np.arange(n) % len(places)], contrast])


@contextmanager
def dask_workers(n: int) -> Iterator[Executor]:
    """A scheduler and so many worker processes on this machine."""
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=n, threads_per_worker=1, dashboard_address=None) as cluster,
        open_executor(scheduler=cluster.scheduler_address) as executor,
    ):
        yield executor


@dataclass(frozen=True)
class Work:
    """The job: aliases of all places, once, and the trials."""

    test: BankStatistic

    def __call__(self, n: int, executor: Executor) -> BoolArray:
        fringe = resolution_mas(self.test.likelihood)
        places = rings().reshape(-1, 2)
        nearer = nearer_aliases(self.test.bank, places, fringe, executor=executor)
        found = recover(
            self.test,
            companions(n),
            THRESHOLD,
            np.random.default_rng(3),
            nearer=nearer[np.arange(n) % len(nearer)],
            executor=executor,
        )
        return found.located


def timed(work: Work, executor: Executor, n: int) -> tuple[float, BoolArray]:
    """Least wall time of a few runs of a job whose workers are up already."""
    work(2 * TRIALS_AT_ONCE, executor)
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        found = work(n, executor)
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
    return blank.with_data(data)


def main() -> None:
    likelihood = Likelihood(sheet())
    single = search(likelihood, FIELD_MAS).single_theta
    step = np.sqrt(np.pi * (FIELD_MAS[1] ** 2 - FIELD_MAS[0] ** 2) / POSITIONS)
    grid = make_grid(*FIELD_MAS, float(step))
    test = make_statistic(likelihood, grid, single, stated_errors=True)
    print(f"{test.bank.n_data} independent data, {len(grid)} positions")

    work = Work(test)
    n = int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS
    with open_executor(1) as executor:
        alone, expected = timed(work, executor, n)
        begin = time.process_time()
        work(n, executor)
        cpu = time.process_time() - begin
    piece = alone * TRIALS_AT_ONCE / n
    print(f"1 process       {n} trials in {alone:.1f} s, {n / alone:.0f} trials/s, "
          f"{cpu:.1f} s CPU, {expected.mean():.3f} recovered", flush=True)  # fmt: skip
    for name, opened in (("2 processes", open_executor(2)), ("2 dask workers", dask_workers(2))):
        with opened as executor:
            seconds, found = timed(work, executor, n)
            lost = overhead_s(executor)
        assert np.array_equal(found, expected)
        print(f"{name:15} {n} trials in {seconds:.1f} s, {n / seconds:.0f} trials/s, "
              f"efficiency {alone / seconds / 2:.0%}; {1e3 * lost:.1f} ms lost per piece of "
              f"{1e3 * piece:.0f} ms", flush=True)  # fmt: skip
    rate = refits_per_second(likelihood)
    print(f"refit per trial {rate:.0f} trials/s, which then have not searched the field: "
          f"the bank is {n / alone / rate:.0f} times faster on one process")  # fmt: skip


if __name__ == "__main__":
    main()

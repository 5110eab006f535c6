"""The same job list on one core, on all, or on a cluster, without losing work.

A job is a function and a list of pieces that is fixed before anything runs. Every
piece carries its own random seed and is computed with one BLAS thread, so a result is
the same to the last bit for any number of workers, and after any interruption.
"""

from amibayes.parallel.apart import run_apart
from amibayes.parallel.cluster import DaskExecutor, MPIExecutor
from amibayes.parallel.forked import CAN_FORK, Beside, ForkExecutor, at_hand
from amibayes.parallel.job import (
    Executor,
    SerialExecutor,
    child_seeds,
    open_executor,
    run_job,
    slices,
    spawn,
)
from amibayes.parallel.journal import Journal, Journals
from amibayes.parallel.processes import ProcessExecutor
from amibayes.parallel.progress import Progress, StageBars, progress_bar, stage_bars

__all__ = [
    "CAN_FORK",
    "Beside",
    "DaskExecutor",
    "Executor",
    "ForkExecutor",
    "Journal",
    "Journals",
    "MPIExecutor",
    "ProcessExecutor",
    "Progress",
    "SerialExecutor",
    "StageBars",
    "at_hand",
    "child_seeds",
    "open_executor",
    "progress_bar",
    "run_apart",
    "run_job",
    "slices",
    "spawn",
    "stage_bars",
]

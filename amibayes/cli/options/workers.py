"""Options on where the work is done."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from amibayes.cli.options.common import positive_integer

if TYPE_CHECKING:
    from amibayes.parallel import Executor


def add_parallel_options(parser: argparse.ArgumentParser, *, of_one: bool = False) -> None:
    """Add ``--workers`` and ``--scheduler``: where the work is done, not what comes out.

    With ``of_one`` a run of one target takes the cores at hand unless told otherwise.
    """
    group = parser.add_argument_group("where the work is done").add_mutually_exclusive_group()
    unasked = "the cores at hand, up to 4, on Linux; else 1, as with --batch" if of_one else "1"
    group.add_argument(
        "--workers",
        type=positive_integer,
        default=None if of_one else 1,
        metavar="N",
        help=f"processes on this machine (default: {unasked}); the result does not depend on it",
    )
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="a dask scheduler, tcp://host:port, or mpi for the ranks of this run",
    )


def executor_of(arguments: argparse.Namespace) -> AbstractContextManager[Executor]:
    """Open the workers that ``--workers`` or ``--scheduler`` ask for."""
    from amibayes.parallel import open_executor

    return open_executor(arguments.workers or 1, arguments.scheduler)


def executor_of_one(arguments: argparse.Namespace) -> AbstractContextManager[Executor]:
    """Open the same for one target, whose jobs take seconds: by default the cores at hand."""
    from amibayes.parallel import at_hand, open_executor

    return open_executor(arguments.workers or at_hand(), arguments.scheduler, forked=True)

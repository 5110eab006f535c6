"""``amibayes doctor``: what this installation has."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from amibayes.cli.options import common

if TYPE_CHECKING:
    from amibayes.support.environment import Checkup

EXAMPLES = """examples:
  amibayes doctor
  amibayes doctor --json > doctor.json

exit status: 0 all is well, 4 a package is missing or too old
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``doctor``."""
    parser.epilog = EXAMPLES
    common.add_speech_options(parser.add_argument_group("output"))


def run(arguments: argparse.Namespace) -> int:
    """Inspect, time, and print what was found."""
    common.configure_logging(arguments)
    from amibayes.support.environment import checkup

    found = checkup()
    common.finish(arguments, found.as_json(), lambda: _summary(found))
    return 4 if found.faults else 0


def _summary(found: Checkup) -> list[str]:
    from amibayes import __version__

    memory = f"{found.memory_bytes / 2**30:.1f} GiB" if found.memory_bytes else "unknown"
    packages = [f"{p.name} {p.version or 'MISSING'}" for p in found.packages]
    half = (len(packages) + 1) // 2
    extras = [f"{p.name} {p.version or 'not installed'}" for p in found.extras]
    one, all_ = found.gemm_gflops
    return [
        f"amibayes    {__version__}, Python {found.python}, {found.system}",
        f"machine     {found.cores} cores, memory {memory}",
        f"packages    {', '.join(packages[:half])},",
        f"            {', '.join(packages[half:])}",
        f"extras      {', '.join(extras)}",
        *(f"library     {_library(entry)}" for entry in found.libraries),
        f"gemm        {one:.1f} GFLOP/s on one thread, {all_:.1f} on all",
        *(f"FAULT       {fault}" for fault in found.faults),
        *([] if found.faults else ["all is well"]),
    ]


def _library(entry: dict[str, object]) -> str:
    words = [str(entry[k]) for k in ("internal_api", "version", "architecture") if k in entry]
    return f"{' '.join(words)}, {entry.get('num_threads', '?')} threads"

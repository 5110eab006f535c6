"""Measure everything in one run and print ratios.

    python -m benchmarks --peers FOLDER [--only PART …] \\
        | python docs/pages.py benchmarks.md "ratios: benchmarks/__main__.py"

FOLDER keeps the environments of AMICAL, virgil, fouriever and PMOIRED, which are installed
from PyPI the first time; one that cannot be had is reported so. All numbers are CPU time
of one thread.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from amibayes import BinaryModel
from benchmarks import ours, peers
from benchmarks.data import write_all
from benchmarks.extraction import AMICAL

WORDS = {
    "extraction_per_integration": "extraction, per integration of 80 × 80 pixels",
    "null_search_per_position": "null draw searched, per position",
    "search_per_position": "search of the data, per position",
    "log_probability": "one evaluation of the likelihood",
    "posterior_draw": "one independent draw of the posterior",
    "whole": "the whole command: search, chance, posterior, limits, pictures, page",
}


@dataclass(frozen=True)
class Ratio:
    """One thing that amibayes and a peer both do."""

    what: str
    data: str
    ours_s: float
    peer: str
    peer_s: float

    @property
    def row(self) -> str:
        """As a row of a table."""
        return (
            f"| {WORDS[self.what]} | {self.data} | {self.peer} | {self.peer_s:.2g} s | "
            f"{self.ours_s:.2g} s | {self.peer_s / self.ours_s:.3g} |"
        )


def peer_named(name: str) -> peers.Peer:
    """One of the peers."""
    return next(peer for peer in peers.PEERS if peer.name == name)


def compare(
    name: str, data: str, mine: dict[str, float], arguments: list[str], folder: Path
) -> list[str]:
    """Rows of a table: everything that a peer measured and we did too."""
    return rows(name, data, mine, folder, lambda p: peers.measure(p, folder, *arguments))


def rows(
    name: str,
    data: str,
    mine: dict[str, float],
    folder: Path,
    measure: Callable[[peers.Peer], dict[str, float]],
) -> list[str]:
    """Rows of a table, or one that says why there are none."""
    peer = peer_named(name)
    try:
        theirs = measure(peer)
        label = f"{name} {peers.version_of(peer, folder)}"
    except peers.MissingPeerError as missing:
        return [f"| – | {data} | {name} | not measured: {missing} | | |"]
    return [
        Ratio(what, data, mine[what], label, seconds).row
        for what, seconds in theirs.items()
        if what in mine
    ]


def extraction(paths: dict[str, Path], folder: Path) -> list[str]:
    """AMICAL, and one FFT of every image."""
    mine = ours.extraction(paths["cube"])

    def amical(peer: peers.Peer) -> dict[str, float]:
        rate = peers.run(peer, folder, "-c", AMICAL, str(paths["cube"]), "fft", "0").split()[0]
        return {"extraction_per_integration": 1.0 / float(rate)}

    found = rows("amical", "NIRISS cube", mine, folder, amical)
    share = f"{mine['extraction_over_fft']:.0f} times the FFTs of its images"
    return [*found, f"| limit of the machine: extraction takes | NIRISS cube | | | | {share} |"]


def snapshot(paths: dict[str, Path], folder: Path) -> list[str]:
    """virgil and fouriever on few data, products of matrices and random numbers."""
    mine = ours.searches(paths["niriss"], (50.0, 400.0), BinaryModel())
    path, data = str(paths["niriss"]), "NIRISS snapshot"
    return [
        *compare("virgil", data, mine, [path, "draws"], folder),
        *compare("fouriever", data, mine, [path], folder),
        *limits(data, mine),
    ]


def vlti(paths: dict[str, Path], folder: Path) -> list[str]:
    """PMOIRED on many data."""
    mine = ours.searches(paths["vlti"], (0.7, 50.0), BinaryModel(diameter_mas="free"))
    data = "VLTI, 10 exposures"
    return [*compare("pmoired", data, mine, [str(paths["vlti"])], folder), *limits(data, mine)]


def command(paths: dict[str, Path], folder: Path) -> list[str]:
    """virgil's pipeline against the command, each with all of its stages."""
    mine = {"whole": ours.whole(paths["niriss"])}
    path, run = str(paths["niriss"]), str(paths["niriss"].parent / "run")
    return compare("virgil", "NIRISS snapshot", mine, [path, "pipeline", run], folder)


def limits(data: str, mine: dict[str, float]) -> list[str]:
    """What the machine itself needs of the time of null draws."""
    shares = {"matrix products": "null_share_gemm", "random numbers": "null_share_random"}
    return [
        f"| limit of the machine: {what} in null draws | {data} | | | | "
        f"{100 * mine[key]:.0f} % of the time |"
        for what, key in shares.items()
    ]


PARTS = {"extraction": extraction, "snapshot": snapshot, "vlti": vlti, "command": command}

HEAD = ["| what | data | program | its CPU time | amibayes | ratio |", "|---|---|---|---|---|---|"]


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description="Ratios of CPU time, all from one run.")
    parser.add_argument("--peers", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts")
    arguments = parser.parse_args()
    print("\n".join(HEAD), flush=True)
    with tempfile.TemporaryDirectory() as work, threadpool_limits(1):
        paths = write_all(Path(work))
        for part in arguments.only:
            print("\n".join(PARTS[part](paths, arguments.peers.resolve())), flush=True)


if __name__ == "__main__":
    main()

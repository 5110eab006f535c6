"""Measure everything in one run and print ratios.

    python -m benchmarks --peers FOLDER [--out TABLE.md]

FOLDER keeps the environments of AMICAL, virgil, fouriever and PMOIRED, which are installed
from PyPI the first time; one that cannot be had is reported so. All numbers are CPU time
of one thread.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from amibayes import BinaryModel
from benchmarks import ours, peers
from benchmarks.data import write_all

VLTI_FIELD, NIRISS_FIELD = (0.7, 50.0), (50.0, 400.0)

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


def compare(
    name: str, data: str, mine: dict[str, float], arguments: list[str], folder: Path
) -> list[str]:
    """Rows of a table: everything that a peer measured and we did too."""
    peer = next(p for p in peers.PEERS if p.name == name)
    try:
        theirs = peers.measure(peer, folder, *arguments)
        label = f"{name} {peers.version_of(peer, folder)}"
    except peers.MissingPeerError as missing:
        return [f"| – | {data} | {name} | not measured: {missing} | | |"]
    return [
        Ratio(what, data, mine[what], label, seconds).row
        for what, seconds in theirs.items()
        if what in mine
    ]


def table(folder: Path, work: Path) -> list[str]:
    """Measure; return the lines of a table and of the machine's own limits."""
    paths = write_all(work)
    images = ours.extraction(paths["cube"])
    snapshot = ours.searches(paths["niriss"], NIRISS_FIELD, BinaryModel())
    vlti = ours.searches(paths["vlti"], VLTI_FIELD, BinaryModel(diameter_mas="free"))
    whole = {"whole": ours.whole(paths["niriss"])}
    niriss, vlti_file = str(paths["niriss"]), str(paths["vlti"])
    rows = [
        *compare("amical", "NIRISS cube", images, [str(paths["cube"])], folder),
        *compare("virgil", "NIRISS snapshot", snapshot, [niriss, "draws"], folder),
        *compare("fouriever", "NIRISS snapshot", snapshot, [niriss], folder),
        *compare("pmoired", "VLTI, 10 exposures", vlti, [vlti_file], folder),
        *compare(
            "virgil", "NIRISS snapshot", whole, [niriss, "pipeline", str(work / "run")], folder
        ),
    ]
    return [
        "| what | data | program | its CPU time | amibayes | ratio |",
        "|---|---|---|---|---|---|",
        *rows,
        "",
        "| limit of the machine | share |",
        "|---|---|",
        *(
            f"| {what}, {data} | {100 * mine[key]:.0f} % |"
            for data, mine in (("NIRISS", snapshot), ("VLTI", vlti))
            for what, key in (
                ("matrix products in the time of null draws", "null_share_gemm"),
                ("random numbers in the time of null draws", "null_share_random"),
            )
        ),
        f"| extraction over one FFT of every image | {images['extraction_over_fft']:.1f} times |",
    ]


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description="Ratios of CPU time, all from one run.")
    parser.add_argument("--peers", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--out", type=Path, metavar="TABLE.md", help="write the table there too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as work, threadpool_limits(1):
        lines = table(arguments.peers.resolve(), Path(work))
    print("\n".join(lines))
    if arguments.out:
        arguments.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""amibayes, PMOIRED and CANDID on the same files, in one run: a table of `published_results.md`.

    python docs/published_peers.py DATA_FOLDER PEERS_FOLDER

DATA_FOLDER is that of `published_results.py`; PEERS_FOLDER keeps environments of the other
programs, which are installed from PyPI the first time. All fit two discs to V² and closure phases
with independent errors, in the same field.
"""

from __future__ import annotations

import json
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pages import put_table  # noqa: E402
from published_results import (  # noqa: E402
    BINARY_DISCS,
    PAGE,
    Numbers,
    _text,
    fitted_companion,
    iota_peg,
    model,
    o_leo,
)

from amibayes import Observables, __version__, read_oifits, write_oifits  # noqa: E402
from benchmarks import peers  # noqa: E402

MARK = "table: docs/published_peers.py"

QUANTITIES = (
    "east (mas)",
    "north (mas)",
    "flux ratio (%)",
    "diameter (mas)",
    "companion's diameter (mas)",
)


@dataclass(frozen=True)
class Binary:
    """Public data of a binary, and where it is looked for.

    Parameters
    ----------
    name : str
    data : callable
        Takes the folder of data.
    field : (inner, outer)
        mas.
    step_mas : float
        Of the grid at which fits of the other programs begin: CANDID's default is √2 λ/B_max.
    published : str
        Flux ratio.
    """

    name: str
    data: Callable[[Path], Observables]
    field: tuple[float, float]
    step_mas: float
    published: str


BINARIES = (
    Binary("ι Peg, MIRC, 4 telescopes", iota_peg, (9.0, 12.0), 1.4, "22–26 %"),
    Binary("o Leo, GRAVITY, 20220302", lambda d: o_leo(d, "20220302"), (3.0, 6.0), 1.2, "25.4 %"),
)

STARS = "1.0", "0.5"
"""Diameters, mas, at which fits of the other programs begin."""


@dataclass(frozen=True)
class Fitted:
    """What a program found, and its CPU time."""

    program: str
    found: Numbers
    cpu_s: float

    def row(self, binary: Binary) -> str:
        """A line of the table."""
        values = [_text(self.found[q]) for q in QUANTITIES]
        chi2 = f"{self.found['reduced χ²'][0]:.3g}"
        cells = [binary.name, self.program, *values, chi2, f"{self.cpu_s:.1f}"]
        return f"| {' | '.join(cells)} |"


def ours(path: Path, binary: Binary) -> Fitted:
    """The search, in the time that reading the file and the search take."""
    begin = time.process_time()
    data = read_oifits(path, closure_covariance="diagonal")
    result, found = fitted_companion(data, model(**BINARY_DISCS), binary.field)
    seconds = time.process_time() - begin
    chi2 = {"reduced χ²": (result.chi2_binary / result.ndof, 0.0)}
    return Fitted(f"amibayes {__version__}", found | chi2, seconds)


def theirs(peer: peers.Peer, folder: Path, path: Path, binary: Binary) -> Fitted:
    """Fits of another program from a grid of places."""
    job = peers.JOBS / f"binary_with_{peer.name}.py"
    numbers = [f"{x:g}" for x in (*binary.field, binary.step_mas)]
    output = peers.run(peer, folder, str(job), str(path), *numbers, *STARS)
    content = json.loads(output.splitlines()[-1])
    found = {name: (float(v), float(e)) for name, (v, e) in content["found"].items()}
    version = content.get("version") or peers.version_of(peer, folder)
    return Fitted(f"{peer.name} {version}", found, content["cpu_s"])


def table(data: Path, folder: Path) -> Iterator[str]:
    """The lines of the table."""
    yield f"| data | program | {' | '.join(QUANTITIES)} | reduced χ² | CPU (s) |"
    yield "|---" * (len(QUANTITIES) + 4) + "|"
    programs = [p for p in peers.PEERS if (peers.JOBS / f"binary_with_{p.name}.py").exists()]
    with tempfile.TemporaryDirectory() as scratch:
        for k, binary in enumerate(BINARIES):
            path = Path(scratch) / f"{k}.oifits"
            write_oifits(path, binary.data(data))
            yield ours(path, binary).row(binary)
            for peer in programs:
                try:
                    yield theirs(peer, folder, path, binary).row(binary)
                except peers.MissingPeerError as missing:
                    yield f"| {binary.name} | {peer.name} | {missing} |"


def main(data: Path, folder: Path) -> None:
    """Write the table into the page."""
    lines = []
    for line in table(data, folder):
        print(line, file=sys.stderr, flush=True)
        lines.append(line)
    put_table(PAGE, lines, MARK)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]).resolve())

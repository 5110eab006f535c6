"""Integrations per second of every method, one thread, CPU time, beside AMICAL's.

    python -m benchmarks.extraction CUBE.fits [--amical PYTHON] [--frames 1000] \\
        | python docs/pages.py benchmarks.md "extraction: benchmarks/extraction.py"

CUBE.fits is a cube of NIRISS F480M, tiled to ``--frames`` integrations. PYTHON is an
interpreter that has AMICAL (the extra ``bench``); both read the same tiled file, clean it
and extract V² and closure phases. ``first`` is the first call in a process, which makes the
fringe model; ``whole`` is a later one, set-up, response and covariance included; ``each`` is
what an integration costs once the set-up is paid.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.io import fits
from threadpoolctl import threadpool_limits

from amibayes.extraction import METHODS, ExtractOptions, extract_all

HEADER = {"instrument": "niriss", "filter": "F480M"}
REPEATS = 3

AMICAL = """
import contextlib, io, sys, time, warnings
warnings.filterwarnings("ignore")
import amical
from threadpoolctl import threadpool_limits
path, peak, multi = sys.argv[1:]
best = 1e9
with threadpool_limits(1), contextlib.redirect_stdout(io.StringIO()):
    for _ in range(3):
        start = time.process_time()
        clean = amical.select_clean_data(
            path, isz=69, r1=32, dr=2, apod=True, window=65, clip=False, display=False)
        amical.extract_bs(
            clean, path, targetname="x", maskname="g7", instrum="NIRISS", filtname="F480M",
            peakmethod=peak, bs_multi_tri=multi == "1", fw_splodge=0.7, verbose=False,
            display=False)
        best = min(best, time.process_time() - start)
print(len(clean) / best, getattr(amical, "__version__", "?"))
"""


def tiled(cube: Path, n: int, folder: Path) -> Path:
    images = np.asarray(fits.getdata(cube), dtype=np.float32)
    header = fits.Header({"INSTRUME": "NIRISS", "FILTER": "F480M"})
    path = folder / f"tiled_{n}.fits"
    fits.writeto(path, images[np.arange(n) % len(images)], header)
    return path


def seconds(path: Path, method: str) -> list[float]:
    found = []
    for _ in range(REPEATS):
        start = time.process_time()
        extract_all(path, ExtractOptions(method=method), **HEADER)  # type: ignore[arg-type]
        found.append(time.process_time() - start)
    return found


def own(whole: Path, half: Path, n: int) -> None:
    """Print a row for every method."""
    for method in METHODS:
        first, *later = seconds(whole, method)
        slope = (min(later) - min(seconds(half, method))) / (n - n // 2)
        print(
            f"| `{method}` | {n / first:.0f} | {n / min(later):.0f} | {1.0 / slope:.0f} |",
            flush=True,
        )


def amical(python: str, path: Path) -> None:
    """Print a row for every method of AMICAL's."""
    for peak, multi in (("unique", "0"), ("gauss", "0"), ("fft", "0"), ("fft", "1")):
        command = [python, "-c", AMICAL, str(path), peak, multi]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        rate, version = done.stdout.split()
        label = f"`{peak}`{', many triangles' if multi == '1' else ''}"
        print(f"| AMICAL {version}, {label} | | {float(rate):.0f} | |", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cube", type=Path)
    parser.add_argument("--amical", metavar="PYTHON")
    parser.add_argument("--frames", type=int, default=1000)
    given = parser.parse_args()
    print("| method | at the start of a process | later | each, past the set-up |")
    print("|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        whole, half = (
            tiled(given.cube, n, Path(folder)) for n in (given.frames, given.frames // 2)
        )
        own(whole, half, given.frames)
        if given.amical:
            amical(given.amical, whole)
    return 0


if __name__ == "__main__":
    sys.exit(main())

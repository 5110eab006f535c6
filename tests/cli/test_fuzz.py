"""Damaged files: one line and an exit status, never a traceback, a hang, or a silent NaN.

Every case runs the command itself with ``--debug``, so that an exception that is not one of
the package's own is seen. A worker has 10 s of processor time per case and 2 GB of memory.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import multiprocessing
import queue
import resource
import signal
import sys
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from mutations import mutate

from amibayes.cli import main
from amibayes.cube import write_cube
from amibayes.errors import AmibayesError
from amibayes.instrument import load_instrument
from amibayes.scene.sources import Scene
from amibayes.simulation import Exposure, simulate

SECONDS = 10
MEMORY = 2 << 30

SMALL_SCENE = """\
name = "small"
[star]
magnitude = 6.0
filter = "F380M"
spectrum = "G2V"
diameter_mas = 0.0
[[companion]]
separation_mas = 150.0
position_angle_deg = 20.0
delta_mag = 5.0
[instrument]
filter = "F430M"
[exposure]
n_groups = 5
n_integrations = 3
n_pixels = 48
n_wavelengths = 2
[detector]
preset = "realistic"
full_well_e = 72000.0
[wavefront]
piston_nm = 10.0
[[calibrator]]
name = "calibrator_1"
[calibrator.star]
magnitude = 6.2
filter = "F380M"
"""

QUICK = ["--null-draws", "0", "--no-posterior", "--no-limits"]


@dataclass(frozen=True)
class Case:
    """One damaged file and the command that has to bear it."""

    number: int
    command: str
    arguments: tuple[str, ...]
    original: Path

    def words(self, damaged: Path, out: Path) -> list[str]:
        own = [str(damaged) if word == "FILE" else word for word in self.arguments]
        return [self.command, *own, "--out", str(out), "--overwrite", "--quiet", "--debug"]


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("originals")
    cube = simulate(
        Scene(),
        load_instrument("niriss", "F430M"),
        Exposure(5, 3, n_pixels=48),
        np.random.default_rng(1),
        count_rate_e_s=1e6,
    )
    write_cube(folder / "cube_calints.fits", cube)
    (folder / "scene.toml").write_text(SMALL_SCENE)
    return {
        "oifits": ROOT / "examples" / "data" / "target.oifits",
        "calibrator": ROOT / "examples" / "data" / "cal1.oifits",
        "cube": folder / "cube_calints.fits",
        "scene": folder / "scene.toml",
    }


def commands(originals: dict[str, Path]) -> list[tuple[str, tuple[str, ...], Path]]:
    target, calibrator = originals["oifits"], originals["calibrator"]
    return [
        ("search", ("FILE", *QUICK), target),
        ("calibrate", (str(target), "--cal", "FILE"), calibrator),
        ("audit", ("FILE",), target),
        ("calibrate", ("FILE", "--cal", str(calibrator)), target),
        ("export", ("FILE", "--to", "squeeze"), target),
        ("extract", ("FILE",), originals["cube"]),
        ("simulate", ("FILE",), originals["scene"]),
    ]


def make_cases(originals: dict[str, Path], n: int) -> list[Case]:
    kinds = commands(originals)
    return [Case(k, *kinds[k % len(kinds)]) for k in range(n)]


def run_case(case: Case, folder: Path) -> str | None:
    """Run one case; give what went wrong, or None."""
    rng = np.random.default_rng([2026, case.number])
    how, content = mutate(case.original, rng)
    damaged = folder / f"damaged{case.original.suffix}"
    damaged.write_bytes(content)
    out = folder / "out"
    said = f"case {case.number}: {case.command} after {how}"
    signal.signal(signal.SIGPROF, _too_long)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        status, errors = _status(case.words(damaged, out))
    except Exception:  # noqa: BLE001 - whatever it is, it is the finding
        return f"{said}: {traceback.format_exc(limit=-6)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    if status not in (0, 1, 2, 3, 4):
        return f"{said}: status {status}"
    if status in (2, 3, 4) and len(errors.strip().splitlines()) != 1:
        return f"{said}: status {status} with {errors!r}"
    silent = _silent_nan(out / "result.json") if status == 0 and case.command == "search" else None
    return silent and f"{said}: {silent}"


def _too_long(number: int, frame: object) -> None:
    raise TimeoutError(f"longer than {SECONDS} s")


def _status(words: list[str]) -> tuple[int, str]:
    """Exit status and what would stand on standard error."""
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        try:
            return main(words), errors.getvalue()
        except AmibayesError as error:
            return error.exit_status, str(error)
        except SystemExit as leaving:
            return int(leaving.code or 0), errors.getvalue()


def _silent_nan(path: Path) -> str | None:
    """A fit that is no number, in a run that says it was done."""
    fit = json.loads(path.read_text())["fit"]
    for name in ("separation_mas", "contrast", "chi2_binary", "chi2_single"):
        value = fit[name]
        if value is None or not math.isfinite(value):
            return f"{name} is {value}"
    return None


def _work(cases: list[Case], folder: Path, results: multiprocessing.Queue) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    sys.stderr = io.StringIO()
    for case in cases:
        results.put((case.number, run_case(case, folder)))
    results.put((-1, None))


def failures(cases: list[Case], folder: Path) -> list[str]:
    """Run the cases in a process of their own; a worker that dies is a failure too."""
    context = multiprocessing.get_context("fork")
    results: multiprocessing.Queue = context.Queue()
    worker = context.Process(target=_work, args=(cases, folder, results))
    worker.start()
    found: list[str] = []
    last = -1
    while True:
        try:
            number, fault = results.get(timeout=12 * SECONDS)
        except queue.Empty:
            worker.kill()
            return [*found, f"the worker died or hung after case {last}"]
        if number < 0:
            worker.join()
            return found
        last = number
        if fault:
            found.append(fault)


N_DEFAULT = 14
"""Cases of the default suite."""


def test_damaged_files(originals, tmp_path) -> None:
    assert failures(make_cases(originals, N_DEFAULT), tmp_path) == []


FOUND = (96, 152, 639, 716, 819, 1619)
"""What once failed: extensions of no known kind in a cube, numbers of correlations that fill the
memory, baselines of 1e300 m, and a column whose format is no word."""


def test_damage_that_once_did_harm(originals, tmp_path) -> None:
    cases = make_cases(originals, 1 + max(FOUND))
    assert failures([cases[k] for k in FOUND], tmp_path) == []


@pytest.mark.parametrize(
    ("first", "last"),
    [
        pytest.param(N_DEFAULT, 200, marks=pytest.mark.slow),
        pytest.param(200, 3000, marks=pytest.mark.release),
    ],
)
def test_many_damaged_files(first: int, last: int, originals, tmp_path) -> None:
    assert failures(make_cases(originals, last)[first:], tmp_path) == []

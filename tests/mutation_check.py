"""Change the numerical packages in one small place at a time; the nearest tests should notice.

    python tests/mutation_check.py WORK map                  # which test runs which line, once
    python tests/mutation_check.py WORK run [--count 200]    # 200 changes; goes on where it stopped
    python tests/mutation_check.py WORK again TEST …         # the survivors, with tests of today
    python tests/mutation_check.py WORK same KEY REASON      # no behaviour differs: by hand
    python tests/mutation_check.py WORK table

WORK holds a copy of the checkout, the map and the record. The nearest tests of a change are those
that run its line, those of the package's own folder first and the fastest of them first, up to
`BUDGET` seconds of a processor; a change that they all pass survives. Run by hand: the map takes
half an hour of a processor, 200 changes take another half.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest
from mutants import Mutant, mutants_of, mutated

ROOT = Path(__file__).resolve().parent.parent
NUMERICAL = (
    *("calibration", "companion_search", "comparison", "cube", "data", "detection", "extraction"),
    *("imaging", "kpfits", "likelihood", "limits", "models", "oifits", "optics", "posterior"),
    *("ramps", "scene", "simulation", "survey"),
)
OTHERS = ("cli", "instrument", "parallel", "pipeline", "plots", "report", "support", "validation")
"""Folders of tests that run these packages too."""

BUDGET = 25.0
"""Seconds of a processor that the nearest tests of one change may take, unchanged."""

LIBRARIES = (
    *("numpy", "scipy.stats", "scipy.optimize", "scipy.linalg", "scipy.sparse", "scipy.special"),
    *("scipy.interpolate", "scipy.ndimage", "astropy.io.fits", "astropy.table", "astropy.time"),
    *("astropy.coordinates", "threadpoolctl", "arviz", "matplotlib.pyplot"),
)

PATIENCE = 3.0
"""A change that makes its tests this many times slower, and half a minute, counts as noticed."""


NOTICED_BY = "noticed_by"
"""A file of a copy of the checkout."""


# As a plugin of pytest, under `coverage run`: which test runs which line, and how long it takes.

_failed: set[str] = set()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    import coverage

    running = coverage.Coverage.current()
    if running is not None:
        running.switch_context(item.nodeid)
    start = time.process_time()
    try:
        return (yield)
    finally:
        seconds = np.inf if item.nodeid in _failed else time.process_time() - start
        with open(os.environ["TEST_SECONDS"], "a", encoding="utf-8") as stream:
            stream.write(json.dumps([item.nodeid, seconds]) + "\n")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.outcome != "passed":
        _failed.add(report.nodeid)


class Work:
    """The folder of a check: copies of the checkout, the map, the record."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.record = folder, folder / "record.jsonl"
        self.copy, self.seconds, self.cover = (folder / n for n in ("0", "seconds", "coverage"))

    def copied(self, name: str) -> Path:
        """A copy of the checkout, made on the first call."""
        to = self.folder / name / "checkout"
        if not to.is_dir():
            # Every copy is one of the first, so that all hold the same code.
            source = ROOT if name == "0" else self.copied("0")
            skipped = shutil.ignore_patterns(".git", ".venv*", "_build", ".*_cache", "__pycache__")
            shutil.copytree(source, to, ignore=skipped)
            (to.parent / "shared").symlink_to(ROOT.parent / "shared")
        return to

    def entries(self, *, last: bool = True) -> dict[str, dict]:
        """What was tried, the last word on each, or the first."""
        if not self.record.is_file():
            return {}
        lines = self.record.read_text(encoding="utf-8").splitlines()
        return {entry["key"]: entry for entry in map(json.loads, lines[:: 1 if last else -1])}

    def write(self, entry: dict) -> None:
        with self.record.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(entry) + "\n")
        print(
            f"{entry['outcome']:9} {entry['key']:50} {entry['kind']:12} "
            f"{entry['before']}  →  {entry['after']}",
            flush=True,
        )


def make_map(work: Work) -> None:
    """Run the default suite under coverage, without what looks at the code and not at numbers."""
    folder = work.copied("0")
    command = [
        *(sys.executable, "-m", "coverage", "run", "--rcfile=/dev/null", "--source=amibayes"),
        *(f"--data-file={work.cover}", "-m", "pytest", "-q", "-p", "no:cacheprovider"),
        *("-p", "mutation_check", *(f"tests/{name}" for name in NUMERICAL + OTHERS)),
    ]
    environment = _environment(folder) | {"TEST_SECONDS": str(work.seconds)}
    subprocess.run(command, cwd=folder, env=environment, check=False)


def _environment(folder: Path) -> dict[str, str]:
    paths = os.pathsep.join([str(folder), str(folder / "tests"), os.environ.get("PYTHONPATH", "")])
    return os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


class Nearest:
    """Which tests run a line, and how long they take."""

    def __init__(self, work: Work) -> None:
        import coverage

        self.data = coverage.CoverageData(str(work.cover))
        self.data.read()
        lines = work.seconds.read_text(encoding="utf-8").splitlines()
        self.seconds = {name: s for name, s in map(json.loads, lines) if np.isfinite(s)}
        self.root = work.copied("0")

    def tests(self, mutant: Mutant) -> list[str]:
        """Those of a change, within the budget; of code that runs on import, those of its file."""
        by_line = self.data.contexts_by_lineno(str(self.root / mutant.path))
        first, last = mutant.lines
        found = {t for line, tests in by_line.items() if first <= line <= last for t in tests}
        package = f"tests/{mutant.path.parts[1]}/"
        order = sorted(
            found & self.seconds.keys(), key=lambda t: (not t.startswith(package), self.seconds[t])
        )
        total = np.cumsum([self.seconds[t] for t in order])
        return [t for k, t in enumerate(order) if k == 0 or total[k] <= BUDGET]


class Noticed:
    """A plugin of pytest that writes which test fails, into a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.path.write_text(report.nodeid, encoding="utf-8")


def passes(folder: Path, tests: list[str], seconds: float) -> bool:
    """Whether the tests pass in a copy of the checkout, in a time of a processor.

    They run in a fork of this process, which has loaded the libraries: half the time if short.
    """
    limit = int(PATIENCE * seconds + 30.0)
    child = multiprocessing.get_context("fork").Process(target=_child, args=(folder, tests, limit))
    child.start()
    child.join(10 * limit)  # for those that wait and do not work
    if child.is_alive():
        child.kill()
        child.join()
    return child.exitcode == 0


def _child(folder: Path, tests: list[str], limit: int) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    os.setpgrp()
    os.chdir(folder)
    os.environ.update(_environment(folder))
    sys.path[:0] = [str(folder), str(folder / "tests")]
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
        options = ["-q", "-x", "-p", "no:cacheprovider"]
        os._exit(int(pytest.main([*options, *tests], [Noticed(folder / NOTICED_BY)])))


def _load_libraries() -> None:
    for name in LIBRARIES:
        importlib.import_module(name)


def tried(
    work: Work, mutant: Mutant, tests: list[str], seconds: float, folders: SimpleQueue[Path]
) -> None:
    """Make one change in a free copy of the checkout, run the tests, record what they did."""
    folder = folders.get()
    target = folder / mutant.path
    original = target.read_text(encoding="utf-8")
    start, by = time.monotonic(), ""
    (folder / NOTICED_BY).unlink(missing_ok=True)
    try:
        target.write_text(mutated(original, mutant.number), encoding="utf-8")
        alive = not tests or passes(folder, tests, seconds)
        if (folder / NOTICED_BY).is_file():
            by = (folder / NOTICED_BY).read_text(encoding="utf-8")
    finally:
        target.write_text(original, encoding="utf-8")
        folders.put(folder)
    work.write(
        {
            **{"key": _key(mutant), "kind": mutant.kind, "before": mutant.before},
            **{"after": mutant.after, "outcome": "survived" if alive else "killed"},
            **{"tests": len(tests), "seconds": round(time.monotonic() - start, 1), "by": by},
        }
    )


def _key(mutant: Mutant) -> str:
    return f"{mutant.path}:{mutant.line}:{mutant.number}"


def every_mutant(work: Work) -> dict[str, Mutant]:
    """All changes of the numerical packages, by their keys."""
    root = work.copied("0")
    paths = sorted(p for name in NUMERICAL for p in (root / "amibayes" / name).rglob("*.py"))
    return {_key(m): m for path in paths for m in mutants_of(path, root)}


def run(work: Work, count: int, seed: int, workers: int) -> None:
    """Try changes drawn at random, those that were not tried yet."""
    every = every_mutant(work)
    names, rng = list(every), np.random.default_rng(seed)
    drawn = [names[k] for k in rng.permutation(len(names))[:count]]
    nearest, done = Nearest(work), work.entries()
    jobs = [(every[k], nearest.tests(every[k])) for k in drawn if k not in done]
    _try_all(work, [(m, t, sum(nearest.seconds[n] for n in t)) for m, t in jobs], workers)


def again(work: Work, tests: list[str], workers: int) -> None:
    """Try the survivors with tests of the checkout as it is now."""
    alive = [key for key, entry in work.entries().items() if entry["outcome"] == "survived"]
    every = every_mutant(work)
    for k in range(workers):
        shutil.copytree(ROOT / "tests", work.copied(str(k)) / "tests", dirs_exist_ok=True)
    _try_all(work, [(every[key], tests, 10.0 * BUDGET) for key in alive], workers)


def _try_all(work: Work, jobs: list[tuple[Mutant, list[str], float]], workers: int) -> None:
    _load_libraries()
    folders: SimpleQueue[Path] = SimpleQueue()
    for k in range(workers):
        folders.put(work.copied(str(k)))
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda job: tried(work, *job, folders), jobs))


KINDS_OF_END = {"killed": "noticed", "same": "no behaviour differs", "survived": "not noticed"}


def table(work: Work) -> None:
    """Print outcomes by kind of change, at first and now, and what no test notices."""
    counts: dict[str, Counter] = defaultdict(Counter)
    first = work.entries(last=False)
    for key, entry in work.entries().items():
        for kind in ("all", entry["kind"]):
            counts[kind].update(["tried", entry["outcome"]])
            counts[kind]["at first"] += first[key]["outcome"] == "killed"
    print("| change | tried | noticed at first | " + " | ".join(KINDS_OF_END.values()) + " |")
    print("|---" * (3 + len(KINDS_OF_END)) + "|")
    for kind, row in sorted(counts.items(), key=lambda item: -item[1]["tried"]):
        shown = (row[name] for name in ("tried", "at first", *KINDS_OF_END))
        print(f"| {kind} | " + " | ".join(map(str, shown)) + " |")
    for entry in (e for e in work.entries().values() if e["outcome"] != "killed"):
        change = f"{entry['before']} → {entry['after']}"
        print(entry["outcome"], entry["key"], change, entry.get("reason", ""))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=lambda name: Work(Path(name).resolve()))
    parser.add_argument("what", choices=("map", "run", "again", "same", "table"))
    parser.add_argument("words", nargs="*")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    work = options.work
    if options.what == "map":
        make_map(work)
    elif options.what == "run":
        run(work, options.count, options.seed, options.workers)
    elif options.what == "again":
        again(work, options.words, options.workers)
    elif options.what == "same":
        key, reason = options.words
        work.write({**work.entries()[key], "outcome": "same", "reason": reason})
    else:
        table(work)


if __name__ == "__main__":
    main()

"""Surveys of simulated stars: stated and realised rates, frequency coverage, cost, a cost model.

    python -m benchmarks.survey_study simulate FOLDER --targets 200 --companions 10
    python -m benchmarks.survey_study study FILE --surveys 20 --targets 50 --share 0.05 --spread 0.7
    python -m benchmarks.survey_study table FILE | python docs/pages.py howto/survey.md \\
        "study: benchmarks/survey_study.py"
    python -m benchmarks.survey_study cost --targets 40 | python docs/pages.py howto/survey.md \\
        "cost: benchmarks/survey_study.py"

    python -m benchmarks.survey_study peer FOLDER | python docs/pages.py howto/survey.md \\
        "peer: benchmarks/survey_study.py"
    python -m benchmarks.survey_study ways FILE --targets 1000 --companions 50
    python -m benchmarks.survey_study ways_table FILE | python docs/pages.py howto/survey.md \\
        "ways: benchmarks/survey_study.py"

`simulate` writes NIRISS files and their table, at the level of V² and closure phases. `study`
searches whole surveys and adds a line of JSON for each to FILE, of which `table` counts false
discoveries and covered frequencies. `cost` measures what a target costs and what a dask scheduler
does with a task, and says what 10⁵ targets cost.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import contextlib
import io
import json
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from scipy import stats

from amibayes.cli import main as amibayes
from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.instrument import load_instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.logistic import fit_logistic
from amibayes.oifits import write_oifits
from amibayes.survey.completeness import DetectionProbability
from amibayes.survey.false_alarms import false_alarms
from amibayes.survey.rows import Outcome
from benchmarks.peers import PEERS, measure, version_of
from benchmarks.survey_ways import ways, ways_table

FIELD = (70.0, 400.0)
"""Separations that are searched and that companions are drawn from, mas."""

DEPTHS = (0.0, 8.0)
"""Magnitude differences of companions: past what can be seen, so that a survey's box is inside."""

QUICK = ("--no-posterior", "--no-pictures", "--separation", f"{FIELD[0]:g}:{FIELD[1]:g}", "--quiet")


@dataclass(frozen=True)
class Star:
    """A simulated target: its data, and the companion that it has."""

    name: str
    data: Observables
    separation_mas: float | None = None
    delta_mag: float | None = None


def sheet(factor: float = 1.0) -> Observables:
    """NIRISS through F480M: V² to 0.5 %, closure phases to 0.3°, times a factor."""
    holes = load_instrument("niriss", "F480M").mask.holes_m
    errors = 0.005 * factor, np.radians(0.3) * factor
    return point_source(
        holes, 4.817e-6, 0.302e-6, vis2_error=errors[0], closure_error_rad=errors[1]
    )


def simulated(
    n: int,
    n_companions: int,
    rng: np.random.Generator,
    spread: float = 0.0,
    larger: float = 1.0,
) -> list[Star]:
    """Simulate a survey; stars with companions come first.

    Errors of a star are those of `sheet` times a factor, ln of which is within ``spread`` of 0;
    its data scatter by ``larger`` times that.
    """
    stars = []
    for k in range(n):
        empty = sheet(float(np.exp(rng.uniform(-spread, spread)) if spread else 1.0))
        likelihood = Likelihood(empty)
        theta, place = [0.0, 0.0, 0.0], (None, None)
        if k < n_companions:
            rho = float(np.exp(rng.uniform(*np.log(FIELD))))
            mag, angle = float(rng.uniform(*DEPTHS)), rng.uniform(0.0, 2.0 * np.pi)
            theta = [rho * np.sin(angle), rho * np.cos(angle), 10.0 ** (-0.4 * mag)]
            place = (rho, mag)
        noise = larger * empty.covariance.draw(rng, 1)[:, 0]
        data = likelihood.predict([theta])[:, 0] + noise
        one = empty.with_data(data)
        stars.append(Star(f"star{k:05d}", one, *place))
    return stars


def write(folder: Path, stars: list[Star], rng: np.random.Generator) -> Path:
    """Write the files of a survey and its table, with distances."""
    folder.mkdir(parents=True, exist_ok=True)
    for star in stars:
        write_oifits(folder / f"{star.name}.oifits", star.data, overwrite=True)
    table = Table(
        {
            "target": [f"{star.name}.oifits" for star in stars],
            "distance_pc": rng.uniform(15.0, 60.0, len(stars)).round(2),
        }
    )
    table.write(folder / "targets.ecsv", overwrite=True)
    return folder / "targets.ecsv"


def search(table: Path, out: Path, *words: object) -> dict[str, Any]:
    """Search a survey with the command, and give ``survey.json``."""
    command = ["search", "--batch", table, "--out", out, "--overwrite", *QUICK, *words]
    with contextlib.redirect_stdout(io.StringIO()):
        status = amibayes([str(word) for word in command])
    if status:
        raise SystemExit(status)
    content: dict[str, Any] = json.loads((out / "survey.json").read_text())
    return content


def study(
    path: Path, surveys: int, targets: int, share: float, seed: int, spread: float, *, limits: bool
) -> None:
    """Search whole surveys of stars of which a share has companions; add a line for each."""
    for k in range(surveys):
        rng = np.random.default_rng([seed, k])
        stars = simulated(targets, int(rng.binomial(targets, share)), rng, spread)
        begin = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            table = write(Path(folder), stars, rng)
            words = () if limits else ("--no-limits",)
            content = search(table, Path(folder) / "out", "--seed", 1000 * seed + k, *words)
        single = {star.name: star.delta_mag is None for star in stars}
        p = [(single[e["name"]], e["false_alarm_probability"]) for e in content["targets"]]
        line = {
            "targets": targets, "share": share, "spread": spread, "seed": [seed, k],
            "cpu_s": round(time.process_time() - begin, 2),
            "nulls": [value for alone, value in p if alone],
            "companions": [value for alone, value in p if not alone],
            "frequency": content["companion_frequency"],
        }  # fmt: skip
        with path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")


def tables(path: Path) -> list[str]:
    """Tables of what came of `study`: of all surveys, and of those with limits."""
    tried = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    alike = {
        "equal errors": [t for t in tried if not t["spread"] and not t["frequency"]],
        "errors of their own": [t for t in tried if t["spread"] and not t["frequency"]],
    }
    alike |= {"both": [t for part in alike.values() for t in part]}
    columns = {name: _rates(part) for name, part in alike.items() if part}
    rows = [
        f"| {name} | " + " | ".join(column[name] for column in columns.values()) + " |"
        for name in next(iter(columns.values()))
    ]
    head = "| | " + " | ".join(columns) + " |"
    covered = _frequencies([t for t in tried if t["frequency"]])
    return [head, "|---" * (1 + len(columns)) + "|", *rows, "", "| | |", "|---|---|", *covered]


def _rates(tried: list[dict[str, Any]]) -> dict[str, str]:
    """What is listed at a stated false-discovery rate, survey by survey and all together."""
    every = [_listed(t["nulls"], t["companions"]) for t in tried]
    nulls = np.concatenate([t["nulls"] for t in tried])
    false, found = _listed(nulls, np.concatenate([t["companions"] for t in tried]))
    rate = np.array([n / max(n + right, 1) for n, right in every])
    n, n_targets = len(nulls), sum(t["targets"] for t in tried)
    cpu = sum(t["cpu_s"] for t in tried)
    return {
        "surveys, stars, companions": f"{len(tried)}, {n_targets}, "
        f"{sum(len(t['companions']) for t in tried)}",
        "false discoveries at a stated rate of 0.05": _mean(rate),
        "listed by the single surveys: with companions, without": f"{sum(e[1] for e in every)}, "
        f"{sum(e[0] for e in every)}",
        "… all as one survey": f"{found}, {false}",
        **{
            f"stars without: p ≤ {alpha}": f"{(nulls <= alpha).mean():.4f} ± "
            f"{np.sqrt(alpha * (1 - alpha) / n):.4f}"
            for alpha in (0.001, 0.01, 0.05, 0.2)
        },
        f"uniformity of their p below {TO_COMPARE} (Kolmogorov and Smirnov)": (
            f"{_uniform(nulls):.2f}"
        ),
        "CPU of a target, with its share of the survey's files": f"{cpu / n_targets:.2f} s",
    }


def _uniform(probability: np.ndarray) -> float:
    """Of two in a hundred stars no position fits better than none: their p is 1."""
    below = probability[probability < TO_COMPARE] / TO_COMPARE
    return float(stats.kstest(below, "uniform").pvalue)


TO_COMPARE = 0.9


def _listed(nulls: Any, companions: Any) -> tuple[int, int]:
    """Stars without and with companions that are listed at `FDR_LEVEL`."""
    found = false_alarms(np.concatenate([nulls, companions])).discovered
    return int(found[: len(nulls)].sum()), int(found[len(nulls) :].sum())


def _frequencies(tried: list[dict[str, Any]]) -> list[str]:
    """How often the interval of the frequency holds the truth."""
    if not tried:
        return []
    span = DEPTHS[1] - DEPTHS[0]
    truth = [t["share"] * (t["frequency"]["delta_mag"][1] - DEPTHS[0]) / span for t in tried]
    bounds = {level: [t["frequency"][f"interval_{level}"] for t in tried] for level in (68, 95)}
    inside = {
        level: sum(low <= f <= high for f, (low, high) in zip(truth, each, strict=True))
        for level, each in bounds.items()
    }
    medians = np.array([t["frequency"]["median"] for t in tried])
    return [
        f"| surveys with limits, stars | {len(tried)}, {sum(t['targets'] for t in tried)} |",
        f"| true frequency inside of the interval | {inside[68]} of {len(tried)} (68 %), "
        f"{inside[95]} of {len(tried)} (95 %) |",
        f"| mean of the medians of the frequency | {_mean(medians)}; truth {np.mean(truth):.3f} |",
    ]


def _mean(values: np.ndarray) -> str:
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return f"{values.mean():.3f} ± {error:.3f}"


def _cpu() -> float:
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in usage)


def _timed(words: list[object]) -> tuple[float, float, float]:
    """CPU s, wall s and peak memory in MB of a command in a process of its own."""
    before, begin, peak = _cpu(), time.perf_counter(), 0.0
    command = [sys.executable, "-m", "amibayes", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while process.poll() is None:
        peak = max(peak, _memory(process.pid))
        time.sleep(0.2)
    return _cpu() - before, time.perf_counter() - begin, peak


def _memory(pid: int) -> float:
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    return next(
        (float(x.split()[1]) / 1e3 for x in text.splitlines() if x.startswith("VmRSS")), 0.0
    )


def cost(targets: int, seed: int) -> str:
    """Measure what targets cost, and what a scheduler does with a task; model 10⁵ targets."""
    rows, per = [], {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        lists = _lists(folder, targets, np.random.default_rng(seed))
        for name, (which, words) in PARTS.items():
            base = ["search", "--overwrite", "--quiet", *words, "--batch"]
            start = _timed([*base, folder / f"few_{which}.ecsv", "--out", folder / "few"])
            full = _timed([*base, lists[which], "--out", folder / "whole"])
            per[name] = (full[0] - start[0]) / (targets - 2)
            set_up = start[0] - 2 * per[name]
            rows.append(f"| {name} | {per[name]:.2f} s | {set_up:.1f} s | {full[2]:.0f} MB |")
        efficiency = _efficiency(lists["equal"], folder / "w", targets, next(iter(per.values())))
    heads = ["| a target of NIRISS, V² and closure phases | CPU | set-up, first target | memory |",
             "|---|---|---|---|"]  # fmt: skip
    return "\n".join([*heads, *rows, "", efficiency, *_model(per)])


def _lists(folder: Path, targets: int, rng: np.random.Generator) -> dict[str, Path]:
    """Tables of targets: of equal errors; of their own, too small by `TOO_SMALL`, calibrated too.

    And the first two targets of each beside them.
    """
    sky, found = simulated(targets, targets // 10, rng), {}
    own = simulated(targets, targets // 10, rng, 0.7, TOO_SMALL)
    calibrators = [replace(s, name=f"cal{k}") for k, s in enumerate(simulated(3, 0, rng, 0.7))]
    write(folder / "calibrators", calibrators, rng)
    for name, stars in {"equal": sky, "own": own, "calibrated": own}.items():
        found[name] = write(folder / name, stars, rng)
        table = Table.read(found[name])
        table["target"] = [f"{name}/{file}" for file in table["target"]]
        if name == "calibrated":
            table["cal"] = ["calibrators/cal*.oifits"] * targets
        table.write(folder / f"{name}.ecsv")
        table[:2].write(folder / f"few_{name}.ecsv")
    return {name: folder / f"{name}.ecsv" for name in found}


TOO_SMALL = 1.5
"""Scatter of the data, in units of the stated errors, where a search has to find that out."""


def _efficiency(table: Path, out: Path, targets: int, each: float) -> str:
    """CPU and wall time with one process and with two, and what that makes of 300 targets."""
    base = ["search", "--overwrite", "--quiet", *BARE, "--batch", table, "--out", out, "--workers"]
    (one, wall, _), (two, wall_two, _) = (_timed([*base, n]) for n in (1, 2))
    set_up, workers = one - targets * each, two - one
    alone, together = set_up + 300 * each, set_up + 0.5 * workers + 150 * each
    return (
        f"{targets} targets took one process {one:.1f} s of CPU and {wall:.1f} s, two processes "
        f"{two:.1f} s of CPU and {wall_two:.1f} s, on a machine with a load of "
        f"{os.getloadavg()[0]:.1f} for {os.cpu_count()} cores. By CPU time 300 targets on two "
        f"idle cores have an efficiency of {alone / together / 2:.0%}."
    )


def _model(per: dict[str, float]) -> list[str]:
    """Cost of 10⁵ targets on 1000 workers, from measured pieces."""
    from amibayes.cli.options.batch import TASKS

    rate, request, answer = _scheduler()
    scheduled = TASKS / rate  # ten targets a task
    return [
        f"A dask scheduler with one worker does {rate:.0f} tasks a second; a target is {request} "
        f"bytes of request and {answer} of answer.",
        "",
        "| 10⁵ targets on 1000 workers | computing | scheduler | the longer of both |",
        "|---|---|---|---|",
        *(
            f"| {name} | {100 * t:.0f} s | {scheduled:.0f} s | {max(100 * t, scheduled):.0f} s |"
            for name, t in per.items()
        ),
    ]


NARROW = ("--separation", f"{FIELD[0]:g}:{FIELD[1]:g}")
BARE = ("--no-posterior", "--no-limits", "--no-pictures", *NARROW)

PARTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "search, significance": ("equal", BARE),
    "… of errors of their own, too small by a third, in the default field": ("own", BARE[:3]),
    "… with the same three calibrators": ("calibrated", BARE[:3]),
    "search, significance, limits": ("equal", ("--no-posterior", "--no-pictures", *NARROW)),
    "… and posterior": ("equal", ("--no-pictures", *NARROW)),
    "search, significance, pictures": ("equal", ("--no-posterior", "--no-limits", *NARROW)),
}
"""What is measured: the table, and words of the command."""


def peer(folder: Path, seed: int) -> str:
    """Cost of one target's row of the table with virgil, and here; ``folder`` has its environment.

    Its pipeline for binaries, from the file of V² and closure phases: null draws, posterior and
    limits; here the command with all of its stages, and those of a survey's row.
    """
    virgil = next(one for one in PEERS if one.name == "virgil")
    with tempfile.TemporaryDirectory() as made:
        star = Path(made) / "star00000.oifits"
        write(Path(made), simulated(1, 1, np.random.default_rng(seed)), np.random.default_rng(seed))
        theirs = measure(virgil, folder, str(star), "pipeline", str(Path(made) / "v"))["whole"]
        whole = _timed(["search", star, "--out", Path(made) / "a", "--quiet", *NARROW])[0]
        bare = _timed(["search", star, "--out", Path(made) / "b", "--quiet", *BARE])[0]
    return "\n".join(
        [
            "| one NIRISS target alone, with the start of the program | CPU |",
            "|---|---|",
            f"| virgil {version_of(virgil, folder)}, `virgil-pipeline binary` | {theirs:.0f} s |",
            f"| amibayes, search to posterior, limits and pictures | {whole:.0f} s |",
            f"| amibayes, search and significance | {bare:.1f} s |",
        ]
    )


def _ways(path: Path, targets: int, companions: int, seed: int) -> None:
    """One survey in every way of `WAYS`, in a folder beside a file of what came of it."""
    folder, rng = path.with_suffix(f".{targets}"), np.random.default_rng(seed)
    table = folder / "targets.ecsv"
    if not table.exists():
        write(folder, simulated(targets, companions, rng), rng)
    ways(table, folder, targets, path, BARE)


def _nothing(piece: Any) -> Any:
    return piece[1]


def _scheduler() -> tuple[float, int, int]:
    """Tasks per second of a dask scheduler, and bytes of a target's request and answer."""
    from amibayes.cli.main import build_parser
    from amibayes.cli.options.batch import Job
    from amibayes.parallel import DaskExecutor

    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from dask_cluster import end, free_port, start_dask, start_worker

    arguments = build_parser("search").parse_args(["search", "star00001.oifits"])
    arguments.words = ["search", "star00001.oifits"]
    job = Job("star00001", arguments)
    levels, counts = np.log(np.geomspace(1e-3, 1e-1, 14)), np.arange(14.0)
    rings = tuple(fit_logistic(levels, counts, np.full(14, 14.0)) for _ in range(16))
    row: dict[str, Any] = {f"number_{k}": 0.1 * k for k in range(25)}
    row["limits"] = {"separation_mas": [1.0] * 16, "delta_mag": [1.0] * 16}
    detection = DetectionProbability(np.arange(16.0), rings)
    answer = Outcome("star00001", "done", row=row, detection=detection)
    port = str(free_port())
    words = ("--host", "127.0.0.1", "--port", port, "--no-dashboard")
    processes = [start_dask("dask_scheduler", *words)]
    processes.append(start_worker(f"tcp://127.0.0.1:{port}"))
    try:
        executor = DaskExecutor(f"tcp://127.0.0.1:{port}")
        list(executor.map(_nothing, [(job, answer)] * 20))
        begin = time.perf_counter()
        list(executor.map(_nothing, [(job, answer)] * 1000))
        took = time.perf_counter() - begin
        executor.close()
    finally:
        for process in processes:
            end(process)
    return 1000 / took, len(pickle.dumps(job)), len(pickle.dumps(answer))


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "part", choices=("simulate", "study", "table", "cost", "peer", "ways", "ways_table")
    )
    parser.add_argument("path", nargs="?", type=Path)
    parser.add_argument("--targets", type=int, default=24)
    parser.add_argument("--companions", type=int, default=5)
    parser.add_argument("--share", type=float, default=0.3)
    parser.add_argument("--surveys", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--spread", type=float, default=0.0)
    parser.add_argument("--limits", action="store_true")
    arguments = parser.parse_args()
    if arguments.part == "cost":
        print(cost(arguments.targets, arguments.seed))
    elif arguments.part == "study":
        numbers = arguments.surveys, arguments.targets, arguments.share, arguments.seed
        study(arguments.path, *numbers, arguments.spread, limits=arguments.limits)
    elif arguments.part == "table":
        print("\n".join(tables(arguments.path)))
    elif arguments.part == "peer":
        print(peer(arguments.path, arguments.seed))
    elif arguments.part == "ways":
        _ways(arguments.path, arguments.targets, arguments.companions, arguments.seed)
    elif arguments.part == "ways_table":
        print("\n".join(ways_table(arguments.path)))
    else:
        rng = np.random.default_rng(arguments.seed)
        write(arguments.path, simulated(arguments.targets, arguments.companions, rng), rng)


if __name__ == "__main__":
    main()

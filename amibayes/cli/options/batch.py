"""``--batch TABLE``: a command over many targets, one folder each and one summary."""

from __future__ import annotations

import argparse
import copy
import importlib
import logging
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING, Any, NoReturn

from amibayes.cli.options import common, workers
from amibayes.errors import AmibayesError, DataError, UsageError, fault_of
from amibayes.support.atomic_files import output_locks
from amibayes.support.interrupts import ending
from amibayes.support.shared_results import sharing

if TYPE_CHECKING:
    from amibayes.pipeline.batch import SurveyTarget
    from amibayes.survey.rows import Outcome

NOT_OF_A_ROW = {
    "--batch", "--cal", "--debug", "--help", "--json", "--out", "--overwrite", "--quiet",
    "--cal-pool", "--resume", "--scheduler", "--verbose", "--workers",
}  # fmt: skip
"""Options of the whole run, which no row can set for itself."""

SOME_FAILED = 4

TASKS = 10_000
"""A table of more targets than twice that is handed out several targets at a time: a scheduler does
some hundred tasks in a second, and a thousand workers would wait for it."""

CALIBRATORS_OF_POOL = 4  # three tell their scatter, and one more may be dropped

WRITE_EVERY_S, WRITE_SHARE = 20.0, 0.02
"""While targets are done the survey's table is written this often, and in at most this share of
the time: the targets' own results are what ``--resume`` goes by."""


def add_inputs(parser: argparse.ArgumentParser) -> None:
    """Add targets, ``--batch`` in their place, and ``--cal``."""
    parser.add_argument(
        "targets", nargs="*", metavar="TARGET", help="OIFITS file(s) or image cube(s)"
    )
    parser.add_argument(
        "--batch",
        metavar="TABLE",
        help="do this for every row of a table (ECSV, CSV) instead: column target, and if "
        "wanted cal, name and any option such as diameter; exit status 4 if some target failed",
    )
    parser.add_argument(
        "--cal", nargs="+", default=[], metavar="CAL", help="calibrators, any order"
    )
    parser.add_argument(
        "--cal-pool",
        metavar="TABLE",
        help="with --batch: choose calibrators for rows without cal out of a table of them, those "
        "nearest in date (mjd), magnitude and spectral_type",
    )
    parser.add_argument(
        "--cal-number",
        type=common.positive_integer,
        default=CALIBRATORS_OF_POOL,
        metavar="N",
        help="how many are chosen out of the pool (default: %(default)s)",
    )


def refuse_none(arguments: argparse.Namespace) -> None:
    """Refuse a command without targets, and a pool without a table.

    Raises
    ------
    UsageError
    """
    if not arguments.targets:
        raise UsageError("no target given", remedy="name at least one file, or --batch TABLE")
    if arguments.cal_pool is not None and not getattr(arguments, "in_batch", False):
        raise UsageError("needs a table of targets", source="--cal-pool", remedy="give --batch")


@dataclass(frozen=True)
class Job:
    """One row: its folder's name, and the words of the command as if given for it alone."""

    name: str
    arguments: argparse.Namespace | None
    error: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    chosen: str = ""

    def with_calibrators(self) -> Job:
        """Choose calibrators out of the pool, where the row has none of its own.

        Raises
        ------
        DataError
        """
        own = self.arguments
        if own is None or own.cal_pool is None or own.cal:
            return self
        from amibayes.pipeline.calibrator_pool import nearest, read_pool, star_of

        target = star_of(own.targets, dict(self.facts))
        found = nearest(read_pool(own.cal_pool), target, own.cal_number)
        changed = copy.copy(own)
        changed.cal = [file for chosen in found for file in chosen.star.files]
        place = 1 + len(own.targets)
        changed.words = [*own.words[:place], "--cal", *changed.cal, *own.words[place:]]
        return replace(self, arguments=changed, chosen="; ".join(c.words() for c in found))

    @property
    def command(self) -> Any:
        """The module of the command."""
        assert self.arguments is not None
        return importlib.import_module(f"amibayes.cli.{self.arguments.command}")

    @property
    def result(self) -> Path:
        """File of the result, which is written last."""
        assert self.arguments is not None
        return Path(self.arguments.out) / str(self.command.RESULT)

    def request(self) -> str:
        """Digest of the options and of the files' content; empty where a file is missing."""
        if self.arguments is None:
            return ""
        try:
            return str(self.command.request(self.arguments))
        except AmibayesError:  # reported when its turn comes
            return ""


def run_batch(arguments: argparse.Namespace) -> int:
    """Do the command for every row of the table.

    Returns
    -------
    int
        0 where all targets were done, 4 where some failed.
    """
    from amibayes.pipeline.batch import read_targets
    from amibayes.report.survey import survey_lines

    if arguments.targets:
        raise UsageError(
            "takes the place of targets", source="--batch", remedy="put them into the table"
        )
    jobs = [_job(arguments, row) for row in read_targets(arguments.batch)]
    survey = _Survey(arguments, jobs, _folder(arguments, jobs))
    with survey.interruptible():
        for k, outcome in _carry_out(arguments, jobs):
            survey.record(k, outcome)
        content = survey.finish()
    common.finish(arguments, content, lambda: survey_lines(content, survey.folder))
    return SOME_FAILED if content["n_failed"] else 0


class _Survey:
    """What has come of the targets so far, and the files that tell of it."""

    def __init__(self, arguments: argparse.Namespace, jobs: list[Job], folder: Path) -> None:
        from amibayes.survey.rows import Outcome

        self._arguments, self.folder = arguments, folder
        self._outcomes = [Outcome(j.name, "pending", facts=j.facts) for j in jobs]
        self._due = 0.0
        self._write()

    def record(self, index: int, outcome: Outcome) -> None:
        """Take in what came of a target; the files follow as often as they cost little."""
        if outcome.error:
            print(f"amibayes: {outcome.name}: {outcome.error}", file=sys.stderr)
        self._outcomes[index] = outcome
        if time.monotonic() >= self._due:
            self._write()

    def finish(self) -> dict[str, Any]:
        """Write everything, with the statistics of all targets together."""
        from amibayes.report.survey import PAGE_NAME
        from amibayes.report.survey_page import write_survey_page

        content = self._write(whole=True)
        drawn = _pictures(content, self.folder)
        link = "report.html" if self._arguments.command == "search" else "limits.json"
        write_survey_page(self.folder / PAGE_NAME, content, drawn, link)
        return content

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Write what there is, and name it, where the run is interrupted."""
        try:
            yield
        except KeyboardInterrupt:
            self._write()
            n = sum(o.status == "done" for o in self._outcomes)
            raise KeyboardInterrupt(
                f"{n} of {len(self._outcomes)} targets are done in {self.folder}, and of the "
                "others every finished stage is kept"
            ) from None
        except BaseException:
            self._write()
            raise

    def _write(self, *, whole: bool = False) -> dict[str, Any]:
        from amibayes.report.survey import write_survey
        from amibayes.survey.together import survey_json

        begin = time.monotonic()
        command, seed = self._arguments.command, self._arguments.seed
        content = survey_json(command, seed, self._outcomes, whole=whole)
        write_survey(content, self.folder)
        took = time.monotonic() - begin
        self._due = begin + took + max(WRITE_EVERY_S, took / WRITE_SHARE)
        return content


def _pictures(content: dict[str, Any], folder: Path) -> list[str]:
    """Draw the survey's pictures in the process that draws those of its targets."""
    from amibayes.parallel import run_apart
    from amibayes.plots.survey import save_survey_pictures

    drawn: list[str] = run_apart(save_survey_pictures, content, folder)
    return drawn


def _folder(arguments: argparse.Namespace, jobs: list[Job]) -> Path:
    from amibayes.report.survey import JSON_NAME, PAGE_NAME, TABLE_NAME
    from amibayes.support.atomic_files import output_folder

    result = importlib.import_module(f"amibayes.cli.{arguments.command}").RESULT
    names = [JSON_NAME, TABLE_NAME, PAGE_NAME, *(f"{job.name}/{result}" for job in jobs)]
    overwrite = arguments.overwrite or arguments.resume
    return output_folder(arguments.out, names, overwrite=overwrite)


class _RowParser(argparse.ArgumentParser):
    """Parses the options of a row; a fault is the table's."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(message)


def _job(arguments: argparse.Namespace, row: SurveyTarget) -> Job:
    """Make the arguments of a row: the command line's, the row's own, its files.

    Raises
    ------
    UsageError
        Where a column is no option, or a cell not what the option takes.
    """
    own = copy.copy(arguments)
    own.out = str(Path(arguments.out) / row.name)
    own.batch, own.workers, own.scheduler = None, 1, None
    own.quiet, own.json, own.in_batch = True, False, True
    facts = row.facts
    try:
        words = _set_options(own, row)
    except UsageError as error:
        raise UsageError(
            f"target {row.name}: {error.what}", source=arguments.batch, remedy=error.remedy
        ) from None
    try:
        own.targets = row.files(row.target)
        own.cal = row.files(row.cal) if row.cal else arguments.cal
    except DataError as error:
        return Job(row.name, None, error.command_line, facts)
    given = common.without(arguments.words[1:], common.OF_THE_RUN | {"--cal": sys.maxsize})
    files = [*own.targets, *(["--cal", *own.cal] if own.cal else [])]
    own.words = [own.command, *files, *given, *words]
    return Job(row.name, own, facts=facts)


@cache
def _row_parser(command: str) -> _RowParser:
    parser = _RowParser(add_help=False, allow_abbrev=False)
    importlib.import_module(f"amibayes.cli.{command}").add_arguments(parser)
    return parser


def _set_options(own: argparse.Namespace, row: SurveyTarget) -> list[str]:
    """Set the options of a row; give them as on the command line."""
    parser = _row_parser(own.command)
    options = {**row.options, **row.facts}
    known = parser._option_string_actions
    for fact in row.facts:  # what the command does not ask for is the survey's own
        if "--" + fact.replace("_", "-") not in known:
            del options[fact]
    words = [word for column, value in options.items() for word in _words(parser, column, value)]
    targets = own.targets
    parser.parse_args(words, namespace=own)
    own.targets = targets
    return words


def _words(parser: argparse.ArgumentParser, column: str, value: object) -> Iterator[str]:
    """Write a cell as on the command line."""
    flags = parser._option_string_actions
    flag = "--" + column.replace("_", "-")
    if flag not in flags or flag in NOT_OF_A_ROW:
        import difflib

        allowed = [f[2:].replace("-", "_") for f in flags if f not in NOT_OF_A_ROW]
        near = difflib.get_close_matches(
            column, [*allowed, "target", "cal", "name", "distance_pc"], n=1
        )
        hint = f"did you mean '{near[0]}'?" if near else "columns are target, cal, name, options"
        raise UsageError(f"column '{column}' is no option of a target", remedy=hint)
    if flags[flag].nargs != 0:
        yield f"{flag}={value}"
        return
    if str(value).lower() not in ("true", "false"):
        raise UsageError(f"column '{column}' holds {value!r}", remedy="write true or false")
    no = "--no-" + column.replace("_", "-")
    if str(value).lower() == "true":
        yield flag
    elif no in flags[flag].option_strings:
        yield no


def _carry_out(arguments: argparse.Namespace, jobs: list[Job]) -> Iterator[tuple[int, Outcome]]:
    """Do the targets; give the number of each and what came of it."""
    from amibayes.parallel import run_job, slices
    from amibayes.survey.rows import Outcome

    size = max(len(jobs) // TASKS, 1)
    parts = slices(len(jobs), size)
    alone: list[int] = []

    def lost(index: int, error: AmibayesError) -> Outcome:
        job = jobs[alone[index] if alone else index]
        return Outcome(job.name, "failed", error.command_line, facts=job.facts)

    with (
        workers.executor_of(arguments) as executor,
        common.progress_of(arguments, "targets", unit="target", scale=size) as progress,
    ):
        pieces = [jobs[part] for part in parts]
        alone_already = (lambda k, error: [lost(k, error)]) if size == 1 else (lambda *_: None)
        done = run_job(_several, pieces, executor, progress=progress, lost=alone_already)
        for part, outcomes in zip(parts, done, strict=True):
            if outcomes is None:
                alone += range(part.start, part.stop)
            else:
                yield from zip(range(part.start, part.stop), outcomes, strict=True)
        # One target of these ends its worker; which, only each of them by itself can tell.
        yield from zip(
            alone, run_job(_one, [jobs[k] for k in alone], executor, lost=lost), strict=True
        )


def _several(jobs: list[Job]) -> list[Outcome]:
    return [_one(job) for job in jobs]


def _one(job: Job) -> Outcome:
    """Do one target, unless ``--resume`` finds it done."""
    from amibayes.support.request import answers, read_answer
    from amibayes.survey.rows import Outcome, detection_of, row_of

    try:
        job = job.with_calibrators()
    except AmibayesError as error:
        return Outcome(job.name, "failed", error.command_line, facts=job.facts)
    if job.arguments is None:
        return Outcome(job.name, "failed", job.error, facts=job.facts)
    key = job.request()
    content = answers(job.result, key) if job.arguments.resume else None
    if content is None and (fault := _performed(job)):
        return Outcome(job.name, "failed", fault, key, facts=job.facts, chosen=job.chosen)
    # Killed just after its result, it has a journal still.
    rmtree(job.result.parent / job.command.JOURNAL, ignore_errors=True)
    content = content or read_answer(job.result) or {}
    row, detection = row_of(content), detection_of(content)
    return Outcome(job.name, "done", "", key, row, job.facts, detection, job.chosen)


def _performed(job: Job) -> str:
    """Do one target; give in one line what went wrong, or nothing."""
    assert job.arguments is not None
    common.configure_logging(job.arguments)
    try:
        with ending(), output_locks(), sharing():
            job.command.perform(job.arguments)
    except Exception as error:
        # One target's failure must not end the others; --debug shows it whole.
        logging.getLogger("amibayes").debug("%s failed", job.name, exc_info=True)
        return fault_of(error, "run it alone with --debug")
    return ""

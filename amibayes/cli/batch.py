"""``--batch TABLE``: a command over many targets, one folder each and one summary."""

from __future__ import annotations

import argparse
import copy
import importlib
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from amibayes.cli import common
from amibayes.errors import AmibayesError, DataError, UsageError
from amibayes.support.atomic_files import output_locks

if TYPE_CHECKING:
    from amibayes.pipeline.batch import SurveyTarget
    from amibayes.report.survey import Outcome, Status

NOT_OF_A_ROW = {
    "--batch", "--cal", "--debug", "--help", "--json", "--out", "--overwrite", "--quiet",
    "--resume", "--scheduler", "--verbose", "--workers",
}  # fmt: skip
"""Options of the whole run, which no row can set for itself."""

SOME_FAILED = 4


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


def refuse_none(arguments: argparse.Namespace) -> None:
    """Refuse a command without targets.

    Raises
    ------
    UsageError
    """
    if not arguments.targets:
        raise UsageError("no target given", remedy="name at least one file, or --batch TABLE")


@dataclass(frozen=True)
class Job:
    """One row: its folder's name, and the words of the command as if given for it alone."""

    name: str
    arguments: argparse.Namespace | None
    error: str = ""

    def request(self) -> str:
        """Digest of the options and of the files' content; empty where a file is missing."""
        if self.arguments is None:
            return ""
        command = importlib.import_module(f"amibayes.cli.{self.arguments.command}")
        try:
            return str(command.request(self.arguments))
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
    from amibayes.report.survey import summary_lines, write_picture

    if arguments.targets:
        raise UsageError(
            "takes the place of targets", source="--batch", remedy="put them into the table"
        )
    rows = read_targets(arguments.batch)
    jobs = [_job(arguments, row) for row in rows]
    folder = _folder(arguments, jobs)
    outcomes = _finished_or_pending(arguments, jobs, folder)
    content = _written(arguments, outcomes, folder)
    for k, outcome in _carry_out(arguments, jobs, outcomes):
        outcomes[k] = outcome
        content = _written(arguments, outcomes, folder)
    write_picture(outcomes, folder)
    common.finish(arguments, content, lambda: summary_lines(content, folder))
    return SOME_FAILED if content["n_failed"] else 0


def _written(
    arguments: argparse.Namespace, outcomes: list[Outcome], folder: Path
) -> dict[str, Any]:
    from amibayes.report.survey import summary_json, write_summary

    content = summary_json(arguments.command, arguments.seed, outcomes)
    write_summary(content, folder)
    return content


def _folder(arguments: argparse.Namespace, jobs: list[Job]) -> Path:
    from amibayes.report.survey import JSON_NAME, PICTURE_NAME, TABLE_NAME
    from amibayes.support.atomic_files import output_folder

    names = [JSON_NAME, TABLE_NAME, PICTURE_NAME]
    names += [f"{job.name}/{_result_name(arguments.command)}" for job in jobs]
    overwrite = arguments.overwrite or arguments.resume
    return output_folder(arguments.out, names, overwrite=overwrite)


def _result_name(command: str) -> str:
    return str(importlib.import_module(f"amibayes.cli.{command}").RESULT)


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
    own.quiet, own.json = True, False
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
        return Job(row.name, None, error.command_line)
    given = common.without(arguments.words[1:], common.OF_THE_RUN | {"--cal": sys.maxsize})
    files = [*own.targets, *(["--cal", *own.cal] if own.cal else [])]
    own.words = [own.command, *files, *given, *words]
    return Job(row.name, own)


def _set_options(own: argparse.Namespace, row: SurveyTarget) -> list[str]:
    """Set the options of a row; give them as on the command line."""
    parser = _RowParser(add_help=False, allow_abbrev=False)
    importlib.import_module(f"amibayes.cli.{own.command}").add_arguments(parser)
    words = [
        word for column, value in row.options.items() for word in _words(parser, column, value)
    ]
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
        near = difflib.get_close_matches(column, [*allowed, "target", "cal", "name"], n=1)
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


def _finished_or_pending(
    arguments: argparse.Namespace, jobs: list[Job], folder: Path
) -> list[Outcome]:
    """Outcomes before anything is done: with ``--resume``, the jobs that are finished."""
    from amibayes.report.survey import Outcome
    from amibayes.support.request import answers

    outcomes = []
    for job in jobs:
        path, key = folder / job.name / _result_name(arguments.command), job.request()
        content = answers(path, key) if arguments.resume else None
        status: Status = "pending" if content is None else "done"
        outcomes.append(Outcome(job.name, status, "", key, content))
    return outcomes


def _carry_out(
    arguments: argparse.Namespace, jobs: list[Job], outcomes: list[Outcome]
) -> Iterator[tuple[int, Outcome]]:
    """Do what is not done yet; give the number of each target and what came of it."""
    from amibayes.parallel import run_job

    todo = [k for k, outcome in enumerate(outcomes) if outcome.status != "done"]
    keys = [outcome.key for outcome in outcomes]
    with (
        common.executor_of(arguments) as executor,
        common.progress_of(arguments, "targets", unit="target") as progress,
    ):
        work = partial(_one, arguments.command)
        errors = run_job(work, [jobs[k] for k in todo], executor, progress=progress)
        for k, error in zip(todo, errors, strict=True):
            yield k, _outcome(arguments, jobs[k], keys[k], error)


def _outcome(arguments: argparse.Namespace, job: Job, key: str, error: str) -> Outcome:
    from amibayes.report.survey import Outcome
    from amibayes.support.request import read_answer

    if error:
        print(f"amibayes: {job.name}: {error}", file=sys.stderr)
        return Outcome(job.name, "failed", error, key)
    path = Path(arguments.out) / job.name / _result_name(arguments.command)
    return Outcome(job.name, "done", "", key, read_answer(path))


def _one(command: str, job: Job) -> str:
    """Do one target; give in one line what went wrong, or nothing."""
    if job.arguments is None:
        return job.error
    common.configure_logging(job.arguments)
    try:
        with output_locks():
            importlib.import_module(f"amibayes.cli.{command}").perform(job.arguments)
    except AmibayesError as error:
        return error.command_line
    except MemoryError as error:
        return f"not enough memory: {error} (ask for less)"
    except Exception as error:
        # One target's failure must not end the others; --debug shows it whole.
        logging.getLogger("amibayes").debug("%s failed", job.name, exc_info=True)
        text = " ".join(str(error).split())
        return f"{type(error).__name__}: {text} (a fault of amibayes: run it alone with --debug)"
    return ""

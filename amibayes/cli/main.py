"""``amibayes COMMAND``: find the command, run it, turn errors into one line."""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import re
import sys
import time
from collections.abc import Sequence
from typing import NoReturn

from amibayes import __version__
from amibayes.errors import AmibayesError, fault_of
from amibayes.support.interrupts import ending, polite_end

COMMANDS = {
    "search": "find a companion in a target's data, with calibrators",
    "limits": "measure what companions a target's data would have shown",
    "calibrate": "divide the instrument out of a target's data with calibrators",
    "vet": "keep or drop each calibrator, with the numbers",
    "extract": "measure V² and closure phases in image cubes",
    "image": "reconstruct an image from a target's data, for looking",
    "audit": "list what is wrong or doubtful in OIFITS files",
    "export": "write one merged file for a program of image reconstruction",
    "simulate": "make the images that the telescope would record of a scene",
    "validate": "check coverage and error rates on simulated exposures",
    "plan": "groups, integrations and time of an exposure, and what it lets one see",
    "demo": "simulate, extract, calibrate and search in under a minute, with a report to open",
    "doctor": "list what this installation has: versions, libraries, cores, speed",
    "completion": "print what makes a shell complete commands and options",
}
"""Command name → one line of help; the module of the same name holds the command."""

EXAMPLES = """examples:
  amibayes demo
  amibayes search target.oifits --cal cal*.oifits
  amibayes search --help
"""


class Parser(argparse.ArgumentParser):
    """An argument parser that suggests what may have been meant."""

    def error(self, message: str) -> NoReturn:
        """Print one line and leave with exit status 2."""
        self.exit(2, f"{self.prog}: {message}{self._suggestion(message)}\n")

    def _suggestion(self, message: str) -> str:
        known = [*self._option_string_actions, *COMMANDS]
        for child in command_parsers(self).values():
            known += list(child._option_string_actions)
        if choice := re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message):
            wrong = [choice[1]]
            known = [word.strip("' ") for word in choice[2].split(",")]
        else:
            wrong = message.removeprefix("unrecognized arguments: ").split()
            wrong = wrong if message.startswith("unrecognized arguments: ") else []
        for word in (w.split("=")[0] for w in wrong):
            if word not in known and (close := difflib.get_close_matches(word, known, n=1)):
                return f" (did you mean {close[0]}?)"
        return " (see --help)"


class Help(argparse.RawDescriptionHelpFormatter):
    """Help with a column that the names of commands, which are indented, fit into."""

    def add_argument(self, action: argparse.Action) -> None:
        """Make room for an action's name."""
        super().add_argument(action)
        if isinstance(action, argparse._SubParsersAction):
            self._action_max_length += self._indent_increment


def build_parser(*filled: str | None) -> Parser:
    """Build the parser of all commands; only those named get their arguments."""
    parser = Parser(
        prog="amibayes",
        description="Bayesian inference for aperture masking interferometry.",
        epilog=EXAMPLES,
        formatter_class=Help,
    )
    parser.add_argument("--version", action="version", version=f"amibayes {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        child = commands.add_parser(
            name,
            help=summary,
            description=summary,
            formatter_class=Help,
            allow_abbrev=False,
        )
        if name in filled:
            importlib.import_module(f"amibayes.cli.{name}").add_arguments(child)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status (0, 2, 3 or 4; audit's 1)."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        with polite_end(), ending():
            status = run_command(words)
            sys.stdout.flush()
        return status
    except BrokenPipeError:
        _abandon_output()
        return 0
    except KeyboardInterrupt as stop:
        kept = f": {stop}" if str(stop) else ""
        print(f"amibayes: interrupted{kept}{_way_on(words)}", file=sys.stderr)
        return 4
    except Exception as error:
        if "--debug" in words:
            raise
        return _report(error)


def run_command(words: list[str]) -> int:
    """Run one command and give its exit status; its errors are the caller's.

    Parameters
    ----------
    words : list of str
        The command and its arguments.
    """
    from amibayes.parallel.memory import keep_memory
    from amibayes.support.atomic_files import output_locks

    keep_memory()
    command = next((word for word in words if word in COMMANDS), None)
    arguments = build_parser(command).parse_args(words, argparse.Namespace(words=words))
    run = importlib.import_module(f"amibayes.cli.{arguments.command}").run
    begin = time.perf_counter()
    with output_locks():
        status = int(run(arguments))
    if getattr(arguments, "verbose", False):
        took = time.perf_counter() - begin
        print(f"amibayes: {command} took {took:.1f} s", file=sys.stderr)
    return status


def _report(error: Exception) -> int:
    """Print in one line what went wrong; give the exit status."""
    if isinstance(error, OSError):
        _abandon_output()
    text = fault_of(error, "please report it with what --debug shows")
    print(f"amibayes: {text}", file=sys.stderr)
    return error.exit_status if isinstance(error, AmibayesError) else 4


def _way_on(words: list[str]) -> str:
    """Give the option that goes on, where the command has it."""
    command = next((word for word in words if word in COMMANDS), None)
    if command is None or "--resume" not in _options_of(build_parser(command), command):
        return ""
    return " (run again with --resume to go on)"


def _options_of(parser: argparse.ArgumentParser, command: str) -> list[str]:
    return list(command_parsers(parser)[command]._option_string_actions)


def command_parsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Give the parser of every command by its name."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _abandon_output() -> None:
    """Forget what cannot be printed, or Python would fail over it once more at the end."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # standard output is no file, and has no such fault
        return

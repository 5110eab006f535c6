"""``amibayes COMMAND``: find the command, run it, turn errors into one line."""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from amibayes import __version__
from amibayes.errors import AmibayesError

COMMANDS = {
    "search": "find a companion in a target's data, with calibrators",
    "limits": "say what companions a target's data would have shown",
    "calibrate": "divide the instrument out of a target's data with calibrators",
    "vet": "say which calibrators may be believed, and why",
    "extract": "measure V² and closure phases in image cubes",
    "audit": "say what is wrong or doubtful in OIFITS files",
    "export": "write one merged file for a program of image reconstruction",
    "simulate": "make the images that the telescope would record of a scene",
    "validate": "check on simulated exposures that the numbers mean what they say",
    "plan": "groups, integrations and time of an exposure, and what it lets one see",
}
"""Command name → one line of help; the module of the same name holds the command."""


class Parser(argparse.ArgumentParser):
    """An argument parser that suggests what may have been meant."""

    def error(self, message: str) -> NoReturn:
        """Print one line and leave with exit status 2."""
        self.exit(2, f"{self.prog}: {message}{self._suggestion(message)}\n")

    def _suggestion(self, message: str) -> str:
        known = [*self._option_string_actions, *COMMANDS]
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                known += [o for p in action.choices.values() for o in p._option_string_actions]
        doubtful = ("unrecognized arguments", "argument COMMAND")
        words = message.split() if message.startswith(doubtful) else []
        for word in (w.strip("'\"").split("=")[0] for w in words[2:]):
            if word not in known and (close := difflib.get_close_matches(word, known, n=1)):
                return f" (did you mean {close[0]}?)"
        return " (see --help)"


def build_parser(command: str | None) -> Parser:
    """Build the parser of all commands; only the arguments of ``command`` are filled in."""
    parser = Parser(prog="amibayes", description="Bayesian inference for aperture masking.")
    parser.add_argument("--version", action="version", version=f"amibayes {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        child = commands.add_parser(
            name,
            help=summary,
            description=summary,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        if name == command:
            importlib.import_module(f"amibayes.cli.{name}").add_arguments(child)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status (0, 2, 3 or 4)."""
    words = list(sys.argv[1:] if argv is None else argv)
    command = next((word for word in words if word in COMMANDS), None)
    arguments = build_parser(command).parse_args(words, argparse.Namespace(words=words))
    try:
        run = importlib.import_module(f"amibayes.cli.{arguments.command}").run
        return int(run(arguments))
    except AmibayesError as error:
        if getattr(arguments, "debug", False):
            raise
        print(f"amibayes: {error}", file=sys.stderr)
        return error.exit_status
    except MemoryError as error:
        if getattr(arguments, "debug", False):
            raise
        print(f"amibayes: not enough memory: {error} (ask for less)", file=sys.stderr)
        return 4
    except KeyboardInterrupt:
        print("amibayes: interrupted (run again with --resume to go on)", file=sys.stderr)
        return 4
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0

"""The few errors that amibayes raises on purpose.

Every message is one line that names the thing at fault, what is wrong with it
and what the user can do. The command line prints the line and exits with
``exit_status``; a traceback never reaches the user unless asked for.
"""

from __future__ import annotations

import re

OPTION = re.compile(r"(?<![\w-])--([a-z][a-z-]+)( [A-Z]+\b)?")
"""An option of the command line in a message, and the word for its value."""

ARGUMENTS = {
    "cal": "calibrators",
    "merge-epochs": "merge_epochs_days",
    "pixel-scale": "pixel_scale_rad",
    "position-angle": "position_angle_deg",
    "separation": "separation_mas",
}
"""Options whose arguments in Python have other names than with - for _."""


def _argument(option: re.Match[str]) -> str:
    """Name in Python of what an option sets."""
    name = ARGUMENTS.get(option[1], option[1].replace("-", "_"))
    return f"{name}={option[2].strip()}" if option[2] else name


class AmibayesError(Exception):
    """Anything that amibayes reports to its user.

    Parameters
    ----------
    what : str
        What is wrong, in one clause.
    source : str or path-like, optional
        The file (or option) at fault.
    remedy : str, optional
        What the user can do about it.
    """

    exit_status = 4

    def __str__(self) -> str:
        """One line, with arguments by their names in Python."""
        return OPTION.sub(_argument, self.command_line)

    @property
    def command_line(self) -> str:
        """The same line with arguments by their options on the command line."""
        return str(self.args[0])

    def __init__(self, what: str, *, source: object = None, remedy: str = "") -> None:
        self.what = what
        self.source = None if source is None else str(source)
        self.remedy = remedy
        prefix = f"{self.source}: " if self.source else ""
        suffix = f" ({remedy})" if remedy else ""
        super().__init__(" ".join(f"{prefix}{what}{suffix}".split()))


class UsageError(AmibayesError):
    """The request itself is wrong: options, file names, an output in the way."""

    exit_status = 2


class DataError(AmibayesError):
    """A file that cannot be read, or data that cannot carry the analysis."""

    exit_status = 3


class RunError(AmibayesError):
    """A run that started well and could not finish."""

    exit_status = 4


def fault_of(error: Exception, remedy: str) -> str:
    """Say in one line what went wrong.

    Parameters
    ----------
    error : Exception
    remedy : str
        For errors that no input should bring about.
    """
    if isinstance(error, AmibayesError):
        text = error.command_line
    elif isinstance(error, MemoryError):
        text = f"not enough memory: {error} (ask for less)"
    elif isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        text = f"{where}{error.strerror or error} (--debug shows where)"
    else:
        text = f"unexpected {type(error).__name__}: {error} (a fault of amibayes: {remedy})"
    return " ".join(text.split())

"""The few errors that amibayes raises on purpose.

Every message is one line that names the thing at fault, what is wrong with it
and what the user can do. The command line prints the line and exits with
``exit_status``; a traceback never reaches the user unless asked for.
"""

from __future__ import annotations


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

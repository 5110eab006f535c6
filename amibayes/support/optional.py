"""Packages that only some functions need."""

from __future__ import annotations

import importlib
from typing import Any

from amibayes.errors import UsageError


def optional_package(name: str, message: str, extra: str) -> Any:
    """Import a package that may be absent.

    Parameters
    ----------
    name : str
    message : str
        What needs it.
    extra : str
        Extra of amibayes that installs it.

    Raises
    ------
    UsageError
        Where it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UsageError(message, remedy=f"pip install 'amibayes[{extra}]'") from error

"""The command line: arguments and printing, nothing else.

Each command is a module with ``add_arguments(parser)`` and ``run(arguments) -> int``;
it is imported only when asked for, so that the command starts fast.
"""

from amibayes.cli.main import main

__all__ = ["main"]

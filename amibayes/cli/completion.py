"""``amibayes completion``: what makes a shell complete commands, options and choices.

The scripts are made by shtab from the parsers themselves, so that they know every option.
"""

from __future__ import annotations

import argparse

SHELLS = ("bash", "fish", "zsh")

EXAMPLES = """examples:
  amibayes completion bash > ~/.local/share/bash-completion/completions/amibayes
  amibayes completion zsh > ~/.zfunc/_amibayes
  amibayes completion fish > ~/.config/fish/completions/amibayes.fish
"""

FILES = ("TARGET", "CAL", "CUBE", "FILE", "TABLE", "SCENE.toml", "LIST|TABLE")
FOLDERS = ("DIR",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``completion``."""
    parser.epilog = EXAMPLES
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help="bash, zsh or fish")


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

    print(shtab.complete(whole_parser(), arguments.shell))
    return 0


def whole_parser() -> argparse.ArgumentParser:
    """Build the parser with the arguments of every command, and what completes each."""
    import shtab

    from amibayes.cli.main import COMMANDS, build_parser, command_parsers

    parser = build_parser(*COMMANDS)
    for child in command_parsers(parser).values():
        for action in child._actions:
            if action.metavar in FILES:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
            elif action.metavar in FOLDERS:
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    return parser

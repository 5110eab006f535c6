"""Make what the pages include: pictures, the tutorial's output, the reference of commands.

python docs/generate.py [FOLDER]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

SCRIPTS = {"tutorial": "tutorial.py", "gallery": "gallery.py", "statistics": "figures.py"}
"""Folder of pictures → the script that fills it."""

STRICT = ("-W", "error", "-W", "ignore::FutureWarning:arviz")
"""Warnings are errors, but for ArviZ's own, once a day, where it is installed."""


def everything(folder: Path) -> None:
    """Write the commands' reference, and run the scripts whose pictures are out of date."""
    commands(folder / "cli")
    for name, script in SCRIPTS.items():
        stamp = folder / name / "done"
        if not stamp.exists() or stamp.stat().st_mtime < newest(DOCS / script):
            run(DOCS / script, folder / name)
            stamp.touch()


def newest(script: Path) -> float:
    """Time of the newest file that a script's pictures depend on."""
    sources = [script, *(ROOT / "amibayes").rglob("*.py"), *DOCS.glob("*.toml")]
    return max(path.stat().st_mtime for path in sources)


def run(script: Path, folder: Path) -> None:
    """Run a script in a process of its own, as a reader would, with warnings as errors."""
    folder.mkdir(parents=True, exist_ok=True)
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    subprocess.run(
        [sys.executable, *STRICT, str(script), str(folder)],
        check=True,
        env={**os.environ, "PYTHONPATH": path, "MPLBACKEND": "agg"},
        stdout=subprocess.DEVNULL,
    )


def commands(folder: Path) -> None:
    """Write one page for each command, from its parser."""
    from amibayes.cli.main import COMMANDS, build_parser

    folder.mkdir(parents=True, exist_ok=True)
    for name in COMMANDS:
        text = page(child(build_parser(name), name), name, COMMANDS[name])
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def child(parser: argparse.ArgumentParser, name: str) -> argparse.ArgumentParser:
    """Find the parser of one command."""
    action = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return action.choices[name]


def page(parser: argparse.ArgumentParser, name: str, summary: str) -> str:
    """Describe a command in Markdown: usage, its options group by group, examples."""
    parser.formatter_class = lambda prog: argparse.RawDescriptionHelpFormatter(prog, width=78)
    lines = [f"# amibayes {name}", "", f"{summary[0].upper()}{summary[1:]}.", ""]
    lines += ["```text", parser.format_usage().rstrip(), "```", ""]
    for group in parser._action_groups:
        options = [a for a in group._group_actions if a.help != argparse.SUPPRESS]
        if options:
            lines += [f"## {(group.title or '').capitalize()}", ""]
            lines += [group.description, ""] if group.description else []
            lines += [line for action in options for line in described(parser, action)]
    if parser.epilog:
        lines += ["## Examples and notes", "", "```text", parser.epilog.rstrip(), "```", ""]
    return "\n".join(lines)


def described(parser: argparse.ArgumentParser, action: argparse.Action) -> list[str]:
    """Describe one option as an entry of a definition list."""
    formatter = parser._get_formatter()
    term = formatter._format_action_invocation(action)
    text = formatter._expand_help(action) if action.help else ""
    return [f"`` {term} ``", f": {text or 'see above'}", ""]


if __name__ == "__main__":
    everything(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "_generated")

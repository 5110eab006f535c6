"""``amibayes completion``: what makes a shell complete commands, options and choices.

The scripts are made from the parsers themselves, so that they know every option there is.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

Kind = Literal["none", "value", "file", "folder", "choice"]

EXAMPLES = """examples:
  amibayes completion bash > ~/.local/share/bash-completion/completions/amibayes
  amibayes completion zsh > ~/.zfunc/_amibayes
  amibayes completion fish > ~/.config/fish/completions/amibayes.fish
"""

FILES = ("TARGET", "CAL", "CUBE", "FILE", "TABLE", "SCENE.toml", "LIST|TABLE")
FOLDERS = ("DIR",)


@dataclass(frozen=True)
class Option:
    """What an option is called, says and takes."""

    flags: tuple[str, ...]
    help: str
    kind: Kind
    choices: tuple[str, ...] = ()
    metavar: str = ""


@dataclass(frozen=True)
class Command:
    """What a command is called, says and takes."""

    name: str
    help: str
    options: tuple[Option, ...]
    positional: Option


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``completion``."""
    parser.epilog = EXAMPLES
    parser.add_argument("shell", choices=sorted(SCRIPTS), metavar="SHELL", help="bash, zsh or fish")


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    print(SCRIPTS[arguments.shell](known_commands()), end="")
    return 0


def known_commands() -> list[Command]:
    """Read every command and option off the parsers."""
    from amibayes.cli.main import COMMANDS, build_parser, command_parsers

    found = []
    for name, summary in COMMANDS.items():
        parser = command_parsers(build_parser(name))[name]
        positional = Option((), "", "none")
        options = []
        for action in parser._actions:
            if action.option_strings:
                options.append(_option(parser, action))
            else:
                positional = _option(parser, action)
        found.append(Command(name, summary, tuple(options), positional))
    return found


def _option(parser: argparse.ArgumentParser, action: argparse.Action) -> Option:
    metavar = str(action.metavar or action.dest.upper())
    said = parser._get_formatter()._expand_help(action) if action.help else ""
    flags, choices = tuple(action.option_strings), tuple(str(c) for c in action.choices or ())
    return Option(flags, " ".join(said.split()), _kind(action, metavar), choices, metavar)


def _kind(action: argparse.Action, metavar: str) -> Kind:
    if action.nargs == 0:
        return "none"
    if action.choices:
        return "choice"
    if metavar in FOLDERS:
        return "folder"
    return "file" if metavar in FILES else "value"


def bash(commands: list[Command]) -> str:
    """Make the script for bash (3.2 and later)."""
    names = "|".join(c.name for c in commands)
    values, flags, files = [], [], []
    for c in commands:
        values += [_bash_value(c, o) for o in c.options if o.kind != "none"]
        words = " ".join(flag for o in c.options for flag in o.flags)
        flags.append(f'        {c.name}) _amibayes_words "{words}" ;;')
        if c.positional.kind == "choice":
            files.append(f'        {c.name}) _amibayes_words "{" ".join(c.positional.choices)}" ;;')
    return BASH.format(
        names=names,
        words=" ".join([*(c.name for c in commands), "--help", "--version"]),
        values="\n".join(values),
        flags="\n".join(flags),
        files="\n".join([*files, "        *) _amibayes_paths -f ;;"]),
    )


def _bash_value(command: Command, option: Option) -> str:
    after = "|".join(f"{command.name}:{flag}" for flag in option.flags)
    does = {
        "choice": f'_amibayes_words "{" ".join(option.choices)}"',
        "file": "_amibayes_paths -f",
        "folder": "_amibayes_paths -d",
    }.get(option.kind, ":")
    return f"        {after}) {does}; return ;;"


BASH = """# Completion of amibayes for bash.
_amibayes_words() {{ COMPREPLY=($(compgen -W "$1" -- "$cur")); }}
_amibayes_paths() {{ local IFS=$'\\n'; COMPREPLY=($(compgen "$1" -- "$cur")); }}
_amibayes() {{
    local cur=${{COMP_WORDS[COMP_CWORD]}} prev=${{COMP_WORDS[COMP_CWORD-1]}} command= word
    COMPREPLY=()
    for word in "${{COMP_WORDS[@]:1:COMP_CWORD-1}}"; do
        case $word in {names}) command=$word; break ;; esac
    done
    if [[ -z $command ]]; then
        _amibayes_words "{words}"
        return
    fi
    case $command:$prev in
{values}
    esac
    if [[ $cur == -* ]]; then
        case $command in
{flags}
        esac
        return
    fi
    case $command in
{files}
    esac
}}
complete -o filenames -F _amibayes amibayes
"""


def zsh(commands: list[Command]) -> str:
    """Make the script for zsh."""
    names = " \\\n        ".join(_quoted(f"{c.name}:{c.help}") for c in commands)
    cases = []
    for c in commands:
        specs = [_zsh_spec(flag, o) for o in c.options for flag in o.flags]
        specs.append(_quoted(f"*:{c.positional.metavar.lower()}:{_zsh_action(c.positional)}"))
        lines = " \\\n                ".join(specs)
        cases.append(f"        {c.name})\n            _arguments -s \\\n                {lines} ;;")
    return ZSH.format(names=names, cases="\n".join(cases))


def _zsh_spec(flag: str, option: Option) -> str:
    said = option.help.replace("[", "(").replace("]", ")")
    value = "" if option.kind == "none" else f":{option.metavar.replace(':', ' ')}:"
    return _quoted(f"*{flag}[{said}]{value}{_zsh_action(option) if value else ''}")


def _zsh_action(option: Option) -> str:
    by_kind = {"file": "_files", "folder": "_files -/", "choice": f"({' '.join(option.choices)})"}
    return by_kind.get(option.kind, " ")


ZSH = """#compdef amibayes
# Completion of amibayes for zsh.
_amibayes() {{
    local -a commands
    commands=(
        {names}
    )
    if (( CURRENT == 2 )); then
        _describe command commands
        return
    fi
    local command=$words[2]
    shift words
    (( CURRENT-- ))
    case $command in
{cases}
    esac
}}
if [[ $funcstack[1] == _amibayes ]]; then _amibayes "$@"; else compdef _amibayes amibayes; fi
"""


def fish(commands: list[Command]) -> str:
    """Make the script for fish."""
    lines = ["# Completion of amibayes for fish.", "complete -c amibayes -f"]
    for c in commands:
        said = _fish_quoted(c.help)
        lines.append(f"complete -c amibayes -n __fish_use_subcommand -a {c.name} -d {said}")
        seen = f"complete -c amibayes -n '__fish_seen_subcommand_from {c.name}'"
        for o in c.options:
            flags = " ".join(
                f"-l {f[2:]}" if f.startswith("--") else f"-s {f[1:]}" for f in o.flags
            )
            lines.append(f"{seen} {flags}{_fish_value(o)} -d {_fish_quoted(o.help)}")
        if c.positional.kind != "none":
            value = _fish_value(c.positional).replace(" -r -F", " -F").replace(" -x", "")
            lines.append(f"{seen}{value}")
    return "\n".join(lines) + "\n"


def _fish_value(option: Option) -> str:
    return {
        "none": "",
        "value": " -x",
        "file": " -r -F",
        "folder": " -x -a '(__fish_complete_directories)'",
        "choice": f" -x -a '{' '.join(option.choices)}'",
    }[option.kind]


def _quoted(text: str) -> str:
    """Quote for sh, bash and zsh."""
    return "'" + text.replace("'", "'\\''") + "'"


def _fish_quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


SCRIPTS: dict[str, Callable[[list[Command]], str]] = {"bash": bash, "fish": fish, "zsh": zsh}

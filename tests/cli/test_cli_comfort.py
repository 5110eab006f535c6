"""Help, suggestions, completion, doctor and demo."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import shlex
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from commands import run

from amibayes.cli.completion import whole_parser
from amibayes.cli.main import COMMANDS, EXAMPLES, build_parser, command_parsers
from amibayes.support.environment import EXTRAS, Checkup, Package, requirements
from amibayes.support.options import CalibrationMethod, choices

ROOT = Path(__file__).resolve().parents[2]


def examples_of(command: str) -> list[str]:
    epilog = command_parsers(build_parser(command))[command].epilog or ""
    return [line.strip() for line in epilog.splitlines() if line.strip().startswith("amibayes ")]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_examples_that_parse(command: str, capsys) -> None:
    assert run(command, "--help") == 0
    said = capsys.readouterr().out
    assert "examples:" in said
    examples = examples_of(command)
    assert examples
    for line in examples:
        words = shlex.split(line.split(" > ")[0])[1:]
        assert build_parser(command).parse_args(words).command == command, line


def test_the_program_itself_has_help_with_examples(capsys) -> None:
    assert run("--help") == 0
    said = capsys.readouterr().out
    assert EXAMPLES.strip() in said
    assert all(command in said for command in COMMANDS)


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["serch", "x"], "search"),
        (["calibarte", "x"], "calibrate"),
        (["demmo"], "demo"),
        (["search", "x", "--calibration", "wieghted"], "weighted"),
        (["search", "x", "--null-drwas", "3"], "--null-draws"),
        (["search", "x", "--null-drwas=3"], "--null-draws"),
        (["search", "x", "--no-posteriors"], "--no-posterior"),
        (["vet", "x", "--sepration", "1:2"], "--separation"),
        (["audit", "x", "--fixx"], "--fix"),
        (["simulate", "--exampel"], "--example"),
    ],
)
def test_mistyped_words_are_guessed(words: list[str], meant: str, capsys) -> None:
    assert run(*words) == 2
    captured = capsys.readouterr()
    assert f"(did you mean {meant}?)" in captured.err
    assert captured.err.count("\n") == 1


def test_every_command_stands_beside_what_it_does(capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    column = {line.index(s[:12]) for n, s in COMMANDS.items() for line in lines
              if line.startswith(f"    {n} ")}  # fmt: skip
    assert len(column) == 1
    assert sum(line.strip().split(" ")[0] in COMMANDS for line in lines) >= len(COMMANDS)


def completed(script: Path, line: str, folder: Path) -> set[str]:
    """What bash offers for the last word of a line."""
    words = line.split(" ")
    told = f"""
        source {script}
        COMP_WORDS=({" ".join(shlex.quote(w) for w in words)})
        COMP_CWORD={len(words) - 1}
        _shtab_amibayes
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(
        ["bash", "-c", told], capture_output=True, text=True, cwd=folder, check=True, timeout=20
    )
    assert done.stderr == ""
    return set(done.stdout.split("\n")) - {""}


@pytest.fixture
def script(tmp_path: Path, capsys) -> Path:
    assert run("completion", "bash") == 0
    path = tmp_path / "amibayes.bash"
    path.write_text(capsys.readouterr().out)
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes(script: Path, tmp_path: Path) -> None:
    files = tmp_path / "files"
    (files / "out").mkdir(parents=True)
    (files / "a star.oifits").touch()
    assert completed(script, "amibayes ", files) == set(COMMANDS)
    assert completed(script, "amibayes ca", files) == {"calibrate"}
    assert completed(script, "amibayes search --null", files) == {"--null-draws"}
    methods = completed(script, "amibayes search x --calibration ", files)
    assert methods == set(choices(CalibrationMethod))
    assert completed(script, "amibayes search x --out ", files) == {"out"}
    assert completed(script, "amibayes search x --seed ", files) == set()
    assert completed(script, "amibayes search ", files) == {"out", "a star.oifits"}
    assert completed(script, "amibayes search x --cal a", files) == {"a star.oifits"}
    assert completed(script, "amibayes completion ", files) == {"bash", "fish", "zsh"}
    for command, parser in command_parsers(whole_parser()).items():
        options = set(parser._option_string_actions)
        assert completed(script, f"amibayes {command} -", files) == options


def typed_in_zsh(line: str, home: Path, awaited: str | None = None) -> str:
    """What a person sees who types a line into zsh and presses Tab."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(home / "files")
        surroundings = {"HOME": str(home), "ZDOTDIR": str(home), "TERM": "dumb", "COLUMNS": "160",
                        "LINES": "50", "PATH": os.environ["PATH"]}  # fmt: skip
        os.execvpe("zsh", ["zsh", "-i"], surroundings)
    try:
        _seen(terminal, "READY> ")
        os.write(terminal, f"{line}\t".encode())
        return _seen(terminal, awaited)
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(terminal)


def _seen(terminal: int, awaited: str | None) -> str:
    """Read until some text comes, or, without it, until the screen has been quiet for a second."""
    seen, deadline = "", time.monotonic() + 20.0
    while time.monotonic() < deadline and (awaited is None or awaited not in seen):
        if select.select([terminal], [], [], 1.0 if seen else 20.0)[0]:
            seen += os.read(terminal, 65536).decode()
        elif awaited is None:
            break
    return seen


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_completes_as_one_types(tmp_path: Path, capsys) -> None:
    assert run("completion", "zsh") == 0
    functions, files = tmp_path / "functions", tmp_path / "files"
    functions.mkdir()
    (files / "out").mkdir(parents=True)
    (files / "a star.oifits").touch()
    (functions / "_amibayes").write_text(capsys.readouterr().out)
    (tmp_path / ".zshrc").write_text(
        f"fpath=({functions} $fpath)\nautoload -Uz compinit && compinit -u -d {tmp_path}/dump\n"
        "unsetopt beep\nPS1='READY> '\n"
    )
    for line, rest in [
        ("amibayes ca", "librate "),
        ("amibayes search --null-d", "raws "),
        ("amibayes search x --calibration w", "eighted "),
        ("amibayes search x --out o", "ut/"),
        ("amibayes search a", "\\ star.oifits "),
    ]:
        assert typed_in_zsh(line, tmp_path, line + rest).endswith(line + rest)
    offered = typed_in_zsh("amibayes ", tmp_path)
    assert all(re.search(rf"^{command} +-- ", offered, re.MULTILINE) for command in COMMANDS)
    assert COMMANDS["doctor"] in offered


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_fish_completes(tmp_path: Path, capsys) -> None:
    assert run("completion", "fish") == 0
    path = tmp_path / "amibayes.fish"
    path.write_text(capsys.readouterr().out)

    def offered(line: str) -> set[str]:
        told = f"source {path}; complete -C {shlex.quote(line)}"
        done = subprocess.run(
            ["fish", "--no-config", "-c", told], capture_output=True, text=True, check=True,
            timeout=30, cwd=tmp_path, env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
        )  # fmt: skip
        return {entry.split("\t")[0] for entry in done.stdout.splitlines()}

    assert set(COMMANDS) <= offered("amibayes ")
    assert offered("amibayes search --null-d") == {"--null-draws"}
    assert offered("amibayes search x --calibration ") == set(choices(CalibrationMethod))
    assert "amibayes.fish" in offered("amibayes search ami")


def test_doctor_says_what_there_is(capsys) -> None:
    assert run("doctor", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["faults"] == []
    assert found["cores"] >= 1
    assert {p["name"] for p in found["packages"]} >= {"numpy", "scipy", "astropy"}
    offered = {p["name"] for p in found["extras"]}
    assert offered <= set(EXTRAS)
    assert offered >= {"cluster", "evidence", "arviz", "mpi"}
    assert min(found["gemm_gflops"]) > 0.1
    assert run("doctor") == 0
    lines = capsys.readouterr().out.strip().split("\n")
    assert lines[-1] == "all is well"
    assert len(lines) <= 20
    assert any(line.startswith("gemm") for line in lines)


def test_doctor_reads_the_needs_off_the_installation(monkeypatch) -> None:
    lines = ["numpy>=2.0", "dynesty>=2.1; extra == 'evidence'", "sphinx>=8.1; extra == 'docs'"]
    monkeypatch.setattr("importlib.metadata.requires", lambda name: lines)
    found = requirements()
    assert [str(r.specifier) for r in found[""]] == [">=2.0"]
    assert [r.name for r in found["evidence"]] == ["dynesty"]


def test_a_missing_or_old_package_is_a_fault() -> None:
    packages = (
        Package("numpy", "1.26.4", ">=2.0"),
        Package("nlopt", "", ">=2.7.1"),
        Package("scipy", "1.14.0rc1", ">=1.13"),
        Package("h5py", "3.10", ">=3.9.1"),
    )
    found = Checkup("3.11", "Linux", 1, 0, packages, (), (), (1.0, 1.0))
    assert [fault.split()[0] for fault in found.faults] == ["numpy", "nlopt"]


@pytest.mark.slow
def test_demo_runs_the_loop_and_finds_the_truth(tmp_path: Path, capsys) -> None:
    out = tmp_path / "demo"
    assert run("demo", "--out", str(out), "--json") == 0
    content = json.loads(capsys.readouterr().out)
    assert content == json.loads((out / "demo.json").read_text())
    assert content["detected"] is True
    assert content["statement"] == "companion"
    assert [step["command"].split()[1] for step in content["steps"]] == [
        "simulate", "extract", "search",
    ]  # fmt: skip
    compared = content["compared"]
    assert compared["separation_mas"]["truth"] == pytest.approx(150.0)
    assert compared["position_angle_deg"]["truth"] == pytest.approx(20.0)
    assert compared["delta_mag"]["truth"] == pytest.approx(5.0)
    # One fixed seed: 4σ would be a fault, were every error right.
    assert all(abs(c["sigma"]) < 4.0 for c in compared.values())
    page = Path(content["report"]).read_text()
    assert "Companion detected" in page
    assert run("demo", "--out", str(out)) == 2


def test_verbose_tells_every_stage_and_its_seconds(target: Path, tmp_path: Path, capsys) -> None:
    words = ("search", target, "--separation", "60:300", "--null-draws", 0, "--no-posterior")
    assert run(*words, "--out", tmp_path / "out", "--verbose") == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "amibayes: read"
    assert re.fullmatch(r"amibayes: read: \d+\.\d s", lines[1])
    assert lines[2] == "amibayes: search"
    assert re.fullmatch(r"amibayes: search took \d+\.\d s", lines[-1])

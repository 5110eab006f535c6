"""The command as tests run it: here, or in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from amibayes.cli import main

ROOT = Path(__file__).resolve().parents[1]


def run(*words: object) -> int:
    """Run a command here; argparse's own exit counts as one."""
    try:
        return main([str(word) for word in words])
    except SystemExit as stop:
        return int(stop.code or 0)


def start(*words: object, **options: object) -> subprocess.Popen[bytes]:
    """Start a module of Python in a process of its own, with the tests' modules in reach."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests"), *sys.path])
    environment = os.environ | {"PYTHONPATH": path}
    command = [sys.executable, "-m", *map(str, words)]
    if os.name == "posix":
        options.setdefault("preexec_fn", heed_interruptions)
    return subprocess.Popen(command, env=environment, **options)  # type: ignore[call-overload]


def heed_interruptions() -> None:
    """What is started behind a shell's & ignores Ctrl-C, and so would its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False

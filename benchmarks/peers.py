"""Other programs, each in an environment of its own, and what they need for a job.

A job is a script of the folder ``peer_jobs`` that the peer's own Python runs. It prints lines
``name seconds`` of CPU time.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

JOBS = Path(__file__).resolve().parent / "peer_jobs"


@dataclass(frozen=True)
class Peer:
    """A program on PyPI."""

    name: str
    requirement: str
    also: tuple[str, ...] = ()


PEERS = (
    Peer("amical", "amical", ("threadpoolctl",)),
    Peer("virgil", "virgil-astro[pipeline]==0.4.1"),
    Peer("fouriever", "fouriever"),
    Peer("pmoired", "pmoired==26.10.1"),
    # CANDID is not on PyPI; AMICAL up to 1.6 bundles it.
    Peer("candid", "amical==1.6.0"),
    Peer("jwst", "jwst==3.0.0"),
)


class MissingPeerError(Exception):
    """A peer that could not be installed, or could not do the job."""


def python_of(peer: Peer, folder: Path) -> Path:
    """Install a peer below a folder, unless it is there, and return its interpreter."""
    home = folder / peer.name
    python = home / "bin" / "python"
    if not (home / "installed").exists():
        commands = [
            [sys.executable, "-m", "venv", str(home)],
            [str(python), "-m", "pip", "install", "-q", peer.requirement, *peer.also],
        ]
        for command in commands:
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
                raise MissingPeerError(f"{peer.requirement} cannot be installed: {reason}")
        (home / "installed").touch()
    return python


def version_of(peer: Peer, folder: Path) -> str:
    """The version that is installed."""
    package = peer.requirement.split("[")[0].split("=")[0]
    code = f"import importlib.metadata as m; print(m.version({package!r}))"
    words = [str(python_of(peer, folder)), "-c", code]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def measure(peer: Peer, folder: Path, *arguments: str) -> dict[str, float]:
    """Run a peer's job and return its CPU seconds by name; see `run`."""
    output = run(peer, folder, str(JOBS / f"with_{peer.name}.py"), *arguments)
    lines = [line.split() for line in output.splitlines() if line.startswith("cpu_s ")]
    return {name: float(seconds) for _, name, seconds in lines}


def run(peer: Peer, folder: Path, *arguments: str, timeout_s: float = 900) -> str:
    """Run a peer's Python and return what it prints.

    Raises
    ------
    MissingPeerError
        Where it is not to be had, or fails.
    """
    python = python_of(peer, folder)
    command = [str(python), *arguments]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    environment |= {"OMP_NUM_THREADS": "1", "MPLBACKEND": "agg", "JAX_PLATFORMS": "cpu"}
    environment["PATH"] = f"{python.parent}{os.pathsep}{environment['PATH']}"
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=timeout_s
        )
    except subprocess.TimeoutExpired:
        raise MissingPeerError(f"{peer.name} was not done after {timeout_s:.0f} s") from None
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise MissingPeerError(f"{peer.name} failed: {reason}")
    return done.stdout

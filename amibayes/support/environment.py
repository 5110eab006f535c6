"""What an installation has, for a report of a fault or a slow run."""

from __future__ import annotations

import os
import platform
import re
import time
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Any

import numpy as np
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from threadpoolctl import threadpool_info, threadpool_limits

from amibayes import __version__
from amibayes.errors import RunError

EXTRAS = ("cluster", "evidence", "arviz", "xarray", "mpi")
"""Extras that users need; the others are for work on amibayes itself. Each brings one package."""

GEMM_SIZE = 1024


@dataclass(frozen=True)
class Package:
    """A package: the version that is installed (empty: none), and those that will do."""

    name: str
    version: str
    needed: str = ""

    @property
    def fit(self) -> bool:
        """Whether it is there, and of a version that will do."""
        wanted = SpecifierSet(self.needed)
        return bool(self.version) and wanted.contains(self.version, prereleases=True)


@dataclass(frozen=True)
class Checkup:
    """What `checkup` found.

    Parameters
    ----------
    python, system : str
    cores : int
        That this process may use.
    memory_bytes : int
        Of the machine; 0 where it cannot be known.
    packages, extras : tuple of Package
    libraries : tuple of dict
        Numerical libraries with their threads, as threadpoolctl sees them.
    gemm_gflops : (float, float)
        Rate of a float64 matrix product on one thread, and on all that BLAS takes.
    """

    python: str
    system: str
    cores: int
    memory_bytes: int
    packages: tuple[Package, ...]
    extras: tuple[Package, ...]
    libraries: tuple[dict[str, Any], ...]
    gemm_gflops: tuple[float, float]

    @property
    def faults(self) -> tuple[str, ...]:
        """What keeps amibayes from working."""
        return tuple(
            f"{p.name} {p.version or 'is missing'}: {p.needed or 'it'} is needed"
            for p in self.packages
            if not p.fit
        )

    def as_json(self) -> dict[str, Any]:
        """Everything in plain types."""
        return {"amibayes": __version__, **asdict(self), "faults": list(self.faults)}


def checkup(seconds: float = 1.0) -> Checkup:
    """Inspect this installation and time a matrix product.

    Parameters
    ----------
    seconds : float
        To spend on timing.
    """
    needed = requirements()
    return Checkup(
        platform.python_version(),
        f"{platform.system()} {platform.release()} {platform.machine()}",
        _cores(),
        _memory_bytes(),
        tuple(Package(r.name, _version(r.name), str(r.specifier)) for r in needed[""]),
        tuple(
            Package(extra, _version(needed[extra][0].name)) for extra in EXTRAS if extra in needed
        ),
        tuple(_library(entry) for entry in threadpool_info()),
        (_gemm_gflops(0.5 * seconds, 1), _gemm_gflops(0.5 * seconds, None)),
    )


def requirements() -> dict[str, list[Requirement]]:
    """Give the packages that amibayes needs, as installed, by extra (``""``: always).

    Raises
    ------
    RunError
        Where amibayes runs without having been installed, so that nothing states its needs.
    """
    try:
        lines = metadata.requires("amibayes") or []
    except metadata.PackageNotFoundError:
        raise RunError(
            "runs without being installed: what it needs is not known",
            source="amibayes",
            remedy="pip install amibayes",
        ) from None
    found: dict[str, list[Requirement]] = {"": []}
    for requirement in map(Requirement, lines):
        extra = re.search(r"extra == ['\"]([\w-]+)", str(requirement.marker or ""))
        found.setdefault(extra[1] if extra else "", []).append(requirement)
    return found


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory_bytes() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 0


def _library(entry: dict[str, Any]) -> dict[str, Any]:
    kept = ("internal_api", "version", "num_threads", "architecture", "threading_layer")
    return {key: entry[key] for key in kept if entry.get(key) is not None}


def _gemm_gflops(seconds: float, threads: int | None) -> float:
    """Rate of a product of square matrices, the best of what fits into the time."""
    a = np.random.default_rng(0).normal(size=(GEMM_SIZE, GEMM_SIZE))
    out, best = np.empty_like(a), np.inf
    with threadpool_limits(threads):
        np.matmul(a, a, out=out)
        end = time.perf_counter() + seconds
        while (begin := time.perf_counter()) < end:
            np.matmul(a, a, out=out)
            best = min(best, time.perf_counter() - begin)
    return float(2.0 * GEMM_SIZE**3 / best / 1e9)

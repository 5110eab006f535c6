"""What is wrong or doubtful in a KPFITS file, why it matters and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from amibayes.data.closure import kernel_basis
from amibayes.kpfits.file import KernelFile, open_kpfits
from amibayes.kpfits.observables import orientations
from amibayes.oifits.audit.finding import Finding
from amibayes.units import MAS

STANDARD = ("APERTURE", "UV-PLANE", "KER-MAT", "BLM-MAT", "KP-DATA", "KP-SIGM", "CWAVEL", "DETPA")
"""HDUs that the format wants (Kammerer et al. 2023), whether or not they are needed here."""

UNLIKELY = 1e-4
"""Probability of the frames' scatter below which errors are called wrong."""

LEAK = 0.01
"""Share of the phases of a pupil that may be let through: rounded matrices leave less."""

EDGE = 0.9
"""Share of a companion's light that a window may leave at the edge of the field."""


@dataclass(frozen=True, eq=False)
class KernelAudit:
    """A KPFITS file and what was found in it."""

    file: KernelFile
    findings: tuple[Finding, ...]

    @property
    def path(self) -> str:
        """The file."""
        return self.file.path

    @property
    def format(self) -> str:
        """What the file is, as the summary names it."""
        return "KPFITS"

    def as_json(self) -> dict[str, object]:
        """As `audit.json` holds it."""
        return {
            "path": self.path,
            "oifits_version": None,
            "tables": list(self.file.names),
            "not_used": [],
            "findings": [f.as_json() for f in self.findings],
        }


def audit_kpfits(path: str | Path) -> KernelAudit:
    """Look for what is wrong or doubtful in a KPFITS file.

    Raises
    ------
    DataError
        Where it cannot be read at all.
    """
    file = open_kpfits(path)
    found = [f for check in CHECKS for f in check(file)]
    return KernelAudit(file, tuple(sorted(found, key=lambda f: f.severity != "error")))


def _standard(file: KernelFile) -> Iterator[Finding]:
    missing = [name for name in STANDARD if name not in file.names]
    if missing:
        yield Finding(
            "warning", "kp-missing", "file", f"no {', '.join(missing)}",
            "other programs need all HDUs of KPFITS", "write it again with them",
        )  # fmt: skip


def _orientation(file: KernelFile) -> Iterator[Finding]:
    if not file.oriented:
        yield Finding(
            "error", "kp-orientation", "DETPA", "no position angle of the detector",
            "position angles on the sky are those of the detector", "add DETPA, degrees",
        )  # fmt: skip


def _covariance(file: KernelFile) -> Iterator[Finding]:
    if not file.has_covariance:
        yield Finding(
            "warning", "kp-correlations", "KP-COV", "no covariance",
            "kernel phases of one image are correlated, and taken as independent errors of what is "
            "found come out wrong", "add KP-COV",
        )  # fmt: skip
    basis = kernel_basis(file.matrix)
    inner = np.einsum("kr,fwkl,ls->fwrs", basis, file.covariance, basis, optimize=True)
    value = np.linalg.eigvalsh(inner)
    if (value[..., 0] <= 1e-12 * value[..., -1]).any():
        yield Finding(
            "error", "kp-singular", "KP-COV", "a covariance that is not positive definite",
            "some kernel phases would have no error at all", "write KP-COV or KP-SIGM anew",
        )  # fmt: skip
    if file.errors is not None:
        ratio = file.errors / np.sqrt(np.einsum("fwkk->fwk", file.covariance))
        typical = float(np.median(ratio))
        if abs(typical - 1.0) > 0.05:
            yield Finding(
                "warning", "kp-errors-differ", "KP-SIGM",
                f"errors {typical:.3g} times those of the covariance",
                "programs that use one or the other find different errors",
                "make them one; the covariance is used",
            )  # fmt: skip


def _kernel(file: KernelFile) -> Iterator[Finding]:
    n, rank = len(file.matrix), kernel_basis(file.matrix).shape[1]
    if rank < n:
        yield Finding(
            "warning", "kp-rank", "KER-MAT", f"{n} kernel phases of which {rank} are independent",
            "taken as independent they count more than once", "nothing: the others are left out",
        )  # fmt: skip
    leak = _leak(file)
    if leak is not None and leak > LEAK:
        yield Finding(
            "error", "kp-leak", "KER-MAT",
            f"lets {100.0 * leak:.2g} % of the phases of the pupil through",
            "aberrations are then taken for the star", "compute it from BLM-MAT and RED anew",
        )  # fmt: skip


def _leak(file: KernelFile) -> float | None:
    """Share of phases of the pupil that the kernel phases let through; None where not known.

    BLM-MAT is summed over redundant baselines in some files and averaged in others: the smaller.
    """
    if file.baselines is None or file.redundancy is None:
        return None
    redundancy = np.maximum(np.abs(file.redundancy), 1e-300)
    found = []
    for transfer in (file.baselines, file.baselines / redundancy[:, None]):
        whole = float(np.linalg.norm(file.matrix)) * float(np.linalg.norm(transfer, 2))
        found.append(float(np.linalg.norm(file.matrix @ transfer) / max(whole, 1e-300)))
    return min(found)


def _scatter(file: KernelFile) -> Iterator[Finding]:
    """Frames against their stated errors."""
    basis, total, degrees = kernel_basis(file.matrix), 0.0, 0
    for frames in orientations(file):
        for k in range(len(file.wavelength_m)):
            value = file.value[frames, k] @ basis
            spread = basis.T @ file.covariance[frames, k].mean(axis=0) @ basis
            rest = value - value.mean(axis=0)
            total += float((rest * np.linalg.lstsq(spread, rest.T, rcond=None)[0].T).sum())
            degrees += (len(frames) - 1) * basis.shape[1]
    if not degrees:
        return
    ratio = np.sqrt(total / degrees)
    tail = min(chi2.sf(total, degrees), chi2.cdf(total, degrees))
    if tail < UNLIKELY and abs(ratio - 1.0) > 0.05:
        yield Finding(
            "warning" if ratio < 1.0 else "error", "kp-scatter", "KP-COV",
            f"frames scatter {ratio:.3g} times as much as their errors",
            "limits and false-alarm probabilities rest on the errors",
            "nothing: their scatter is used where there are enough frames",
        )  # fmt: skip


def _window(file: KernelFile) -> Iterator[Finding]:
    """A window that dims what it has off the axis."""
    radius, scale = file.header.get("WRAD"), file.header.get("PSCALE")
    if not isinstance(radius, int | float) or not isinstance(scale, int | float) or radius <= 0:
        return
    shortest = float(np.hypot(file.u_m, file.v_m).min())
    edge = float(file.wavelength_m.max() / shortest / MAS)
    left = float(np.exp(-((edge / (radius * scale)) ** 4)))
    if left < EDGE:
        yield Finding(
            "warning", "kp-window", "file",
            f"a window of {radius:g} pixels leaves {100.0 * left:.2g} % at {edge:.0f} mas",
            "contrasts far out come out too faint", "look within half its radius, or widen it",
        )  # fmt: skip


def _band(file: KernelFile) -> Iterator[Finding]:
    if not (file.band_m > 0.0).all():
        yield Finding(
            "warning", "kp-bandwidth", "CWAVEL", "no width of the band",
            "it is not known how far the field reaches", "add BWIDTH, metres",
        )  # fmt: skip


CHECKS = (_orientation, _covariance, _kernel, _scatter, _window, _band, _standard)

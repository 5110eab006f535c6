"""What is wrong or doubtful in an OIFITS file, why it matters and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from amibayes.data.observables import Observables
from amibayes.errors import DataError
from amibayes.oifits.audit import geometry, jwst, noise, packages, scale, structure, values
from amibayes.oifits.audit.finding import Finding, Severity
from amibayes.oifits.audit.repair import repair
from amibayes.oifits.products import product_of
from amibayes.oifits.reader import observables_of
from amibayes.oifits.setups import names_of_targets
from amibayes.oifits.tables import OIFits, open_oifits

__all__ = ["Audit", "Finding", "Severity", "audit", "errors_in", "repair"]

FILE_CHECKS = (
    *structure.CHECKS,
    *values.CHECKS,
    *scale.CHECKS,
    *geometry.CHECKS,
    *noise.CHECKS,
)
DATA_CHECKS = (*geometry.DATA_CHECKS, *scale.DATA_CHECKS, *noise.DATA_CHECKS)


@dataclass(frozen=True, eq=False)
class Audit:
    """A file and what was found in it.

    Parameters
    ----------
    oifits : OIFits
    findings : tuple of Finding
        Errors first.
    """

    oifits: OIFits
    findings: tuple[Finding, ...]

    @property
    def path(self) -> str:
        """The file."""
        return self.oifits.path

    @property
    def format(self) -> str:
        """What the file is, as the summary names it."""
        return f"OIFITS {self.oifits.version}"

    def as_json(self) -> dict[str, object]:
        """As `audit.json` holds it."""
        return {
            "path": self.oifits.path,
            "oifits_version": self.oifits.version,
            "tables": [f"{t.name} {t.extver}" for t in self.oifits.tables],
            "not_used": [f"{t.name} {t.extver}" for t in self.oifits.unused],
            "findings": [f.as_json() for f in self.findings],
        }


def audit(path: str | Path | OIFits) -> Audit:
    """Look for what is wrong or doubtful in an OIFITS file.

    Parameters
    ----------
    path : path or OIFits

    Returns
    -------
    Audit
        Also for a file that has neither V² nor closure phases.

    Raises
    ------
    DataError
        Where the file cannot be read at all.
    """
    oifits = path if isinstance(path, OIFits) else open_oifits(path)
    product = product_of(oifits)
    # A product has the errors of its package for certain; elsewhere numbers have to tell.
    own = packages.CHECKS if product is None else ()
    found = [finding for check in (*FILE_CHECKS, *own) for finding in check(oifits)]
    if product is not None:
        found = _of_product(found, jwst.findings_of(product))
    names = names_of_targets(oifits)
    found += list(noise.unusable(oifits, names))
    parts = [p for p in (_part(oifits, name) for name in names) if p is not None]
    found += [finding for check in DATA_CHECKS for finding in check(oifits, parts)]
    return Audit(oifits, tuple(sorted(found, key=lambda f: f.severity != "error")))


ALSO_WARNED_OF = ("phase-in-radians",)
"""Likely faults that spoil an analysis: a search warns of them beside the errors."""


def errors_in(oifits: OIFits, observables: Observables) -> tuple[str, ...]:
    """What an audit calls an error, and `ALSO_WARNED_OF`, one line a kind, of data read already.

    Parameters
    ----------
    oifits : OIFits
    observables : Observables
        What was read of it.
    """
    found = [finding for check in (*FILE_CHECKS, *packages.CHECKS) for finding in check(oifits)]
    checks = (*geometry.DATA_CHECKS, *scale.DATA_CHECKS)
    found += [f for check in checks for f in check(oifits, [observables])]
    groups: dict[str, list[Finding]] = {}
    for finding in found:
        if finding.severity == "error" or finding.code in ALSO_WARNED_OF:
            groups.setdefault(finding.code, []).append(finding)
    return tuple(_line(group) for group in groups.values())


def _line(group: list[Finding]) -> str:
    first, more = group[0], f" (and {len(group) - 1} more like it)" if len(group) > 1 else ""
    return f"{first.where}: {first.what}{more}: {first.why} (amibayes audit)"


def _of_product(general: list[Finding], own: list[Finding]) -> list[Finding]:
    """Findings of a product; a copy fixes all or, where it cannot be written, nothing."""
    fixable = any(f.certain for f in own)
    return own + [replace(f, certain=f.certain and fixable) for f in general]


def _part(oifits: OIFits, name: str) -> Observables | None:
    """The data of a target with independent errors; None where they cannot be read."""
    try:
        return observables_of(oifits, target=name, closure_covariance="diagonal")
    except DataError:
        return None

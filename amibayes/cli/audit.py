"""``amibayes audit``: what is wrong or doubtful in an OIFITS or KPFITS file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from amibayes.cli.options import common
from amibayes.errors import UsageError
from amibayes.support.terminal import MAX_LINES, shortened

if TYPE_CHECKING:
    from amibayes.kpfits.audit import KernelAudit
    from amibayes.oifits.audit import Audit, Finding

    AnyAudit = Audit | KernelAudit

RESULT = "audit.json"

Rank = Literal["file", "error", "warning"]
RANKS = get_args(Rank)
"""Lines of the summary, those that are kept longest first."""

EXAMPLES = """examples:
  amibayes audit target.oifits
  amibayes audit *.oifits --fix --out audited

exit status: 0 nothing found, 1 findings, 3 a file that cannot be read
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``audit``."""
    parser.epilog = EXAMPLES
    parser.add_argument("files", nargs="+", metavar="FILE", help="OIFITS or KPFITS file(s)")
    parser.add_argument(
        "--fix",
        action="store_true",
        help="write a corrected copy of each file, where the remedy is certain",
    )
    common.add_output_options(parser, "audit")


def run(arguments: argparse.Namespace) -> int:
    """Audit the files; the exit status says whether anything was found."""
    common.configure_logging(arguments)
    common.refuse_repeated(arguments.files)
    from amibayes import __version__
    from amibayes.support.atomic_files import output_folder, write_json

    audits = [_audited(path) for path in arguments.files]
    copies = _copies(arguments, audits)
    folder = output_folder(arguments.out, [RESULT, *copies.values()], overwrite=arguments.overwrite)
    fixed = _fix(audits, copies, folder)
    content = {
        "amibayes": __version__,
        "n_findings": sum(len(a.findings) for a in audits),
        "files": [
            a.as_json()
            | {
                "fixed": [f.code for f in done],
                "copy": str(folder / copies[a.path]) if done else None,
            }
            for a, done in zip(audits, fixed, strict=True)
        ],
    }
    write_json(folder / RESULT, content)
    common.finish(arguments, content, lambda: _summary(audits, fixed, copies, folder))
    return int(any(a.findings for a in audits))


def _audited(path: str) -> AnyAudit:
    """Audit a file by what it holds."""
    from amibayes.extraction.reading import contents_of
    from amibayes.kpfits import is_kpfits
    from amibayes.kpfits.audit import audit_kpfits
    from amibayes.oifits.audit import audit

    return audit_kpfits(path) if is_kpfits(contents_of(path).names) else audit(path)


def _copies(arguments: argparse.Namespace, audits: Sequence[AnyAudit]) -> dict[str, str]:
    """Name of the corrected copy of each file that has something certain to correct.

    Raises
    ------
    UsageError
        Where two files of one name would get the same copy.
    """
    if not arguments.fix:
        return {}
    paths = [a.path for a in audits if any(f.certain for f in a.findings)]
    names = {path: Path(path).name for path in paths}
    if len(set(names.values())) < len(names):
        raise UsageError(
            "two files have the same name", source="--fix", remedy="audit them one by one"
        )
    return names


def _fix(audits: Sequence[AnyAudit], copies: dict[str, str], folder: Path) -> list[list[Finding]]:
    from amibayes.oifits.audit import Audit, repair

    out: list[list[Finding]] = []
    for a in audits:
        name = copies.get(a.path)
        target = folder / name if name else None
        if target is not None and target.resolve() == Path(a.path).resolve():
            raise UsageError(
                "would be written over itself", source=target, remedy="choose another --out"
            )
        out.append(
            repair(a.oifits, list(a.findings), target) if target and isinstance(a, Audit) else []
        )
    return out


def _summary(
    audits: Sequence[AnyAudit], fixed: list[list[Finding]], copies: dict[str, str], folder: Path
) -> list[str]:
    """At most 20 lines: what was found, each kind once for a file; the rest is in the JSON."""
    lines: list[tuple[Rank, str]] = []
    for a, done in zip(audits, fixed, strict=True):
        found = _counted(a.findings)
        if done:
            found += f", {len(done)} corrected in {folder / copies[a.path]}"
        lines.append(("file", f"{a.path}: {a.format}, {found}"))
        lines += [(group[0].severity, _line(group)) for group in _alike(a.findings)]
    return shortened(_gravest_first(lines), [f"explained in {folder / RESULT}"])


def _counted(findings: Sequence[Finding]) -> str:
    """Say how many findings there are, and how many of them are errors."""
    if not findings:
        return "nothing found"
    from amibayes.oifits.audit.finding import count

    errors = sum(f.severity == "error" for f in findings)
    text = count(len(findings), "finding")
    return f"{text} ({count(errors, 'error')})" if errors else text


def _gravest_first(lines: Sequence[tuple[Rank, str]]) -> list[str]:
    """Put those at the end for which there is no room: warnings first of all, files last."""
    room = MAX_LINES - 2  # a line that counts the others, and the last one
    if len(lines) <= room + 1:
        return [text for _, text in lines]
    by_weight = sorted(range(len(lines)), key=lambda i: RANKS.index(lines[i][0]))
    order = sorted(by_weight[:room]) + by_weight[room:]
    return [lines[i][1] for i in order]


def _alike(findings: tuple[Finding, ...]) -> list[list[Finding]]:
    """Findings of one kind together."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.code, finding.remedy), []).append(finding)
    return list(groups.values())


def _line(group: list[Finding]) -> str:
    first = group[0]
    more = f" and {len(group) - 1} more" if len(group) > 1 else ""
    return f"  {first.severity:7} {first.where}{more}: {first.what} ({first.remedy})"

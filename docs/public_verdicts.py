"""The verdict of the main job, with no option, on every public file of `oifits/`.

    python docs/public_verdicts.py DATA_FOLDER

writes the table of `public_verdicts.md` anew, and fails where a verdict is none of those that are
right. DATA_FOLDER holds ``oifits/axcir_pionier.oifits`` and the other third-party files, which are
not part of this project.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pages import put_table

from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.report_types import SearchReport
from amibayes.pipeline.search import search_companion

PAGE, MARK = "public_verdicts.md", "table: docs/public_verdicts.py"


@dataclass(frozen=True)
class PublicCase:
    """Public data, and what is known of their object.

    Parameters
    ----------
    name : str
    files : tuple of str
        In the folder ``oifits``.
    known : str
        What the object is.
    right : tuple of str
        Statements that are right.
    place_mas : (east, north), optional
        Of its companion.
    options : dict
        Of `SearchOptions`, other than the defaults.
    """

    name: str
    files: tuple[str, ...]
    known: str
    right: tuple[str, ...]
    place_mas: tuple[float, float] | None = None
    options: dict[str, object] = field(default_factory=dict)


ALPHA_CEN = tuple(f"alphacen_pionier_{k}.fits" for k in (1, 2, 3))
SINGLE, BINARY = ("no companion",), ("companion",)

CASES = (
    PublicCase("α Cen A, first file", ALPHA_CEN[:1], "single", SINGLE),
    PublicCase("α Cen A, second file", ALPHA_CEN[1:2], "single", SINGLE),
    PublicCase("α Cen A, third file", ALPHA_CEN[2:], "single", SINGLE),
    PublicCase("α Cen A, together", ALPHA_CEN, "single", SINGLE),
    PublicCase("Canopus, MATISSE", ("canopus_matisse.fits",), "single", SINGLE),
    PublicCase("Arcturus, IOTA", ("arcturus_iota.fits",), "single", SINGLE),
    PublicCase("α Col, AMBER", ("alphacol_amber.fits",), "single Be star", SINGLE),
    PublicCase(
        "AX Cir, PIONIER", ("axcir_pionier.oifits",), "binary", BINARY, (6.24, -28.51)
    ),
    PublicCase(
        "AX Cir, file with covariances", ("axcir_pionier_cov.oifits",), "binary", BINARY,
        (6.24, -28.51),
    ),
    PublicCase(
        "AX Cir, closure phases alone", ("axcir_pionier.oifits",),
        "binary; these data alone do not tell where", BINARY, options={"observables": ("cp",)},
    ),
    PublicCase(
        "ι Peg, MIRC", ("iotapeg_mirc4t.oifits",), "binary", BINARY, (-0.784, 10.285)
    ),
    PublicCase(
        "o Leo, 2022-03-02", ("oleo_gravity_20220302.fits",), "binary", BINARY, (1.222, 4.260),

    ),
    PublicCase(
        "o Leo, 2022-03-25", ("oleo_gravity_20220325.fits",), "binary", BINARY, (-2.096, -3.246),

    ),
    PublicCase(
        "NIRISS F430M, simulated", ("niriss_f430m_amical.oifits",), "binary", BINARY,
        (107.3, 101.5),
    ),
    PublicCase(
        "SPHERE SAM, stations unknown", ("uvonly_sam.oifits",), "binary", BINARY, (-33.4, -53.4)
    ),
    PublicCase(
        "Imaging contest 2008", ("contest2008_binary.oifits",), "binary of discs", BINARY,

    ),
    PublicCase(
        "Imaging contest 2004", ("beauty2004.fits",), "an image, no binary of discs",
        ("model rejected", "inconsistent data"),
    ),
    PublicCase(
        "GRAVITY, single field", ("gravity_singlesci.fits",), "unknown",
        ("companion", "no companion", "model rejected", "inconsistent data"),
    ),
    PublicCase(
        "AMBER-like, not calibrated", ("created_v2.fits",), "V² of thousands",
        ("model rejected",),
    ),
)  # fmt: skip


def searched(case: PublicCase, folder: Path) -> SearchReport:
    """Search the data of a case as the main job does, without posterior and limits."""
    options = SearchOptions(posterior=False, limits=False, **case.options)  # type: ignore[arg-type]
    return search_companion([folder / "oifits" / f for f in case.files], options=options)


def faults(case: PublicCase, report: SearchReport) -> list[str]:
    """Say what is wrong with the answer; nothing where it is right."""
    statement = report.verdict.statement if report.verdict else "none"
    found = [] if statement in case.right else [f"{case.name}: {statement}, not {case.right}"]
    c = report.result.companion
    if case.place_mas is not None:
        off = float(np.hypot(c.east_mas - case.place_mas[0], c.north_mas - case.place_mas[1]))
        if off > 0.02 * float(np.hypot(*case.place_mas)) + 0.1:
            found.append(f"{case.name}: {off:.2f} mas from its companion")
    return found


def row(case: PublicCase, report: SearchReport) -> str:
    """Make a line of the table."""
    c, tested, verdict = report.result.companion, report.significance, report.verdict
    low, high = tested.interval if tested else (np.nan, np.nan)
    p = f"below {high:.2g}" if low == 0.0 else f"{low:.2g} to {high:.2g}"
    place = "–"
    if verdict and verdict.statement == "companion":
        place = (
            f"E {c.east_mas:.3g} ± {c.east_error_mas:.1g}, N {c.north_mas:.3g} ± "
            f"{c.north_error_mas:.1g} mas, {100 * c.contrast:.3g} ± {100 * c.contrast_error:.1g} %"
        )
        others = len(report.result.rivals)
        if others:
            place += f"; {others} other position{'s' if others > 1 else ''} within Δχ² 9"
    star = report.star_alone.get("diameter_mas")
    single = verdict is not None and verdict.statement == "no companion"
    size = f"{star[0]:.3g} ± {star[1]:.1g}" if star and single else "–"
    statement = verdict.statement if verdict else "–"
    return f"| {case.name} | {case.known} | {statement} | {p} | {place} | {size} |"


HEAD = (
    "| data | object | verdict | false-alarm probability (95 %) | companion | star alone (mas) |",
    "|---|---|---|---|---|---|",
)


def main(folder: Path) -> int:
    """Write the table; the exit status says whether every verdict is right."""
    rows, wrong = list(HEAD), list[str]()
    for case in CASES:
        report = searched(case, folder)
        rows.append(row(case, report))
        wrong += faults(case, report)
        print(rows[-1], flush=True)
    put_table(PAGE, rows, MARK)
    print("\n".join(wrong) or "every verdict is right")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

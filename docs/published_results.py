"""Fit the public data sets with every choice that published analyses made, as a table.

    python docs/published_results.py DATA_FOLDER

DATA_FOLDER holds ``oifits/axcir_pionier.oifits`` and the other third-party files, which are
not part of this project.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from amibayes import BinaryModel, Likelihood, Observables, read_oifits, search
from amibayes.data.observables import Measurements

FREE = BinaryModel(diameter_mas="free")
UNSMEARED = BinaryModel(diameter_mas="free", smearing=False)


def widened(data: Observables, factor: float) -> Observables:
    """The same data with channels wider by a factor."""

    def wide(m: Measurements) -> Measurements:
        return replace(m, band_m=m.band_m * factor)

    return replace(data, vis2=wide(data.vis2), closure_phase=wide(data.closure_phase))


def row(label: str, data: Observables, model: BinaryModel, field: tuple[float, float]) -> str:
    result = search(Likelihood(data, model), field)
    c = result.companion
    return (
        f"| {label} | {c.east_mas:.2f} ± {c.east_error_mas:.2f} "
        f"| {c.north_mas:.2f} ± {c.north_error_mas:.2f} "
        f"| {100 * c.contrast:.3f} ± {100 * c.contrast_error:.3f} "
        f"| {result.nuisance('diameter_mas'):.3f} "
        f"| {result.chi2_single / result.ndof:.3f} → {result.chi2_binary / result.ndof:.3f} |"
    )


HEAD = (
    "| {} | east (mas) | north (mas) | flux ratio (%) | diameter (mas) | reduced χ² |\n"
    "|---|---|---|---|---|---|"
)


def ax_cir(folder: Path) -> list[str]:
    path = folder / "oifits" / "axcir_pionier.oifits"
    habit = read_oifits(path, closure_covariance="diagonal")
    field = (0.7, 50.0)
    return [
        HEAD.format("AX Cir: model and data"),
        row("diagonal errors, no smearing", habit, UNSMEARED, field),
        row("diagonal errors, smearing (top hat of EFF_BAND)", habit, FREE, field),
        row("diagonal errors, channels √2 wider", widened(habit, 2**0.5), FREE, field),
        row("diagonal errors, channels 2.5 times wider", widened(habit, 2.5), FREE, field),
        row("**default**: closures correlated, smearing", read_oifits(path), FREE, field),
        row("V² only", habit.only(("vis2",)), FREE, field),
        row("closure phases only", habit.only(("cp",)), BinaryModel(), field),
        row(
            "file with V2COV, CPCOV",
            read_oifits(folder / "oifits" / "axcir_pionier_cov.oifits"),
            FREE,
            field,
        ),
    ]


def niriss(folder: Path) -> list[str]:
    path = folder / "oifits" / "niriss_f430m_amical.oifits"
    habit, default = read_oifits(path, closure_covariance="diagonal"), read_oifits(path)
    field = (50.0, 400.0)
    plain = BinaryModel(smearing=False)
    return [
        HEAD.format("NIRISS F430M: model and data"),
        row("closure phases, diagonal, no smearing", habit.only(("cp",)), plain, field),
        row("closure phases, correlated", default.only(("cp",)), BinaryModel(), field),
        row("V² and closure phases, diagonal", habit, BinaryModel(), field),
        row("**default**: V² and closure phases, correlated", default, BinaryModel(), field),
    ]


if __name__ == "__main__":
    print("\n".join([*ax_cir(Path(sys.argv[1])), "", *niriss(Path(sys.argv[1]))]))

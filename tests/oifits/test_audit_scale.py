"""Units that a file states wrongly, told by its other numbers; public files are silent."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from oi_builders import HandMade

from amibayes.oifits import open_oifits, read_oifits
from amibayes.oifits.audit import audit, errors_in
from amibayes.oifits.audit.scale import _ends_at_pi

CODES = {"phase-in-radians", "amplitude-for-vis2", "uv-scale", "uv-length"}
UV = {"OI_VIS2": ("UCOORD", "VCOORD"), "OI_T3": ("U1COORD", "V1COORD", "U2COORD", "V2COORD")}


def made(**changes: str) -> HandMade:
    """Four telescopes at 30 m or so, T3AMP of V², closure phases that are noise of their errors."""
    rng = np.random.default_rng(5)
    file = HandMade(rng)
    file.put("OI_T3", "T3PHI", rng.normal(size=(4, 3)) * file.phase_error_deg)
    place = {tuple(b): i for i, b in enumerate(file.baselines.tolist())}
    sides = [[place[a, b], place[b, c], place[a, c]] for a, b, c in file.triangles.tolist()]
    amplitude = np.sqrt(file.vis2[np.array(sides)].prod(axis=1))
    file.put("OI_T3", "T3AMP", amplitude * rng.normal(1.0, 0.02, (4, 3)))
    file.put("OI_T3", "T3AMPERR", 0.02 * amplitude)
    for name in ("OI_WAVELENGTH", "OI_VIS2", "OI_T3"):
        file.keywords[name]["INSNAME"] = changes.get("insname", "I")
    return file


def scaled(file: HandMade, factor: float, columns: dict[str, tuple[str, ...]]) -> HandMade:
    for name, every in columns.items():
        for column in every:
            file.put(name, column, np.asarray(file.tables[name][column][1]) * factor)
    return file


def without_positions(file: HandMade) -> HandMade:
    return scaled(file, 0.0, {"OI_ARRAY": ("STAXYZ",)})


def amplitudes(file: HandMade) -> HandMade:
    file.put("OI_VIS2", "VIS2DATA", np.sqrt(file.vis2))
    return file


WRONG: dict[str, tuple[Callable[[], HandMade], str, str]] = {
    "radians beside degrees": (
        lambda: scaled(made(), np.pi / 180, {"OI_T3": ("T3PHI",)}),
        "phase-in-radians",
        "scatter by 0.01",
    ),
    "amplitudes": (lambda: amplitudes(made()), "amplitude-for-vis2", "equals T3AMP of its tri"),
    "megawavelengths": (lambda: scaled(made(), 1 / 1.65, UV), "uv-scale", "in micron: Mλ"),
    "centimetres": (lambda: scaled(made(), 100.0, UV), "uv-scale", "(centimetres)"),
    "no positions": (
        lambda: scaled(without_positions(made(insname="PIONIER_H")), 0.01, UV),
        "uv-scale",
        "those of PIONIER 4 to 205 m",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_unit_is_one_line_of_the_audit_and_of_a_search(name: str, tmp_path: Path) -> None:
    make, code, words = WRONG[name]
    path = make().write(tmp_path / "a.fits")
    (finding,) = [f for f in audit(path).findings if f.code in CODES]
    assert finding.code == code
    assert words in finding.what
    said = errors_in(open_oifits(path), read_oifits(path))
    assert sum(finding.what in line for line in said) == 1


def test_right_units_are_silent(tmp_path: Path) -> None:
    for k, file in enumerate((made(), without_positions(made(insname="PIONIER_H")))):
        path = file.write(tmp_path / f"{k}.fits")
        assert CODES.isdisjoint(f.code for f in audit(path).findings)


@pytest.mark.parametrize("factor", [0.97, 1.0, 1.03])
def test_the_common_factor_of_a_turned_and_foreshortened_array(
    factor: float, tmp_path: Path
) -> None:
    """Positions in other axes, seen at 40° of altitude: the larger singular value is still 1."""
    rng = np.random.default_rng(6)
    file = made()
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    file.put("OI_ARRAY", "STAXYZ", np.c_[file.xy, np.zeros(4)] @ turn)
    flat = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]]).T
    seen = factor * flat @ np.diag([1.0, np.sin(np.radians(40.0))]) @ flat.T
    for name, columns in (
        ("OI_VIS2", ("UCOORD", "VCOORD")),
        ("OI_T3", ("U1COORD", "V1COORD")),
        ("OI_T3", ("U2COORD", "V2COORD")),
    ):
        uv = np.column_stack([file.tables[name][c][1] for c in columns]) @ seen
        for column, values in zip(columns, uv.T, strict=True):
            file.put(name, column, values)
    found = [f for f in audit(file.write(tmp_path / "a.fits")).findings if f.code in CODES]
    assert [f.what for f in found] == (
        [] if factor == 1.0 else [f"(u, v) are {factor:g} times those of the station positions"]
    )


def test_phases_that_pile_up_at_pi_are_those_of_a_circle() -> None:
    """A star with few closure phases past a null, in radians; and small ones in degrees."""
    rng = np.random.default_rng(1)
    pile = np.pi - np.abs(rng.normal(0.0, 0.02, 6))
    assert _ends_at_pi(np.r_[np.abs(rng.normal(0.0, 0.02, 100)), pile])
    for _ in range(200):
        degrees = np.abs(rng.normal(0.0, rng.uniform(0.8, 1.5), 100))
        assert not _ends_at_pi(degrees[degrees < np.pi])


def test_wavelengths_in_micron_are_named(tmp_path: Path) -> None:
    file = scaled(made(), 1e6, {"OI_WAVELENGTH": ("EFF_WAVE", "EFF_BAND")})
    found = [f for f in audit(file.write(tmp_path / "a.fits")).findings if f.code == "wavelength"]
    assert len(found) == 2
    assert all("look like micron" in f.remedy for f in found)


def test_public_files_are_silent(data: Path) -> None:
    """The one that is told has stations that are nowhere near its (u, v)."""
    for path in sorted((*(data / "oifits").glob("*fits"), *(data / "jwst").glob("*.fits"))):
        told = {f.code for f in audit(path).findings} & CODES
        assert told == ({"uv-length"} if path.name == "created_v2.fits" else set()), path.name

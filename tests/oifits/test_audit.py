"""The audit: silent on our own files, and each mistake found where it was made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from oi_builders import HandMade, MaskFile, diagonal, table

from amibayes.data.closure import closure_matrix
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.errors import DataError
from amibayes.oifits import observables_of, open_oifits, read_oifits, write_oifits
from amibayes.oifits.audit import audit, errors_in, repair
from amibayes.oifits.audit.repair import REMEDIES
from amibayes.oifits.audit.structure import array_centre

DEGREE = np.pi / 180


def star(
    rng: np.random.Generator,
    *,
    n: int = 7,
    channels: int = 1,
    kind: str = "assumed",
    mjd: float = 6e4,
    scatter: float = 1.0,
    sigma: float = 0.01,
) -> Observables:
    """A source with closure phases that close, noise of the stated covariance."""
    stations = rng.uniform(-3, 3, (n, 2))
    waves = np.linspace(4.3e-6, 4.8e-6, channels)
    sheet = point_source(
        stations,
        waves,
        np.full(channels, 1e-7),
        vis2_error=sigma,
        closure_error_rad=sigma,
        covariance="assumed",
        mjd=mjd,
    )
    matrix = closure_matrix(sheet.closure_phase.stations[::channels])[0]
    truth = np.repeat(matrix @ rng.normal(size=matrix.shape[1]) * 0.05, channels)
    noise = scatter * sheet.covariance.draw(rng, 1)[:, 0]
    n_vis2 = len(sheet.vis2)
    made = replace(
        sheet,
        vis2=replace(sheet.vis2, value=0.8 + noise[:n_vis2]),
        closure_phase=replace(sheet.closure_phase, value=truth + noise[n_vis2:]),
        covariance_kind=kind if kind != "diagonal" else "assumed",  # type: ignore[arg-type]
        n_integrations=69 if kind == "estimated" else None,
    )
    return diagonal(made) if kind == "diagonal" else made


def codes(path: Path) -> set[str]:
    return {f.code for f in audit(path).findings}


@pytest.mark.parametrize("kind", ["assumed", "given", "estimated"])
@pytest.mark.parametrize("n", [3, 4, 7])
@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 11), marks=pytest.mark.slow)])
def test_no_alarm_on_our_own_files(
    n: int, kind: str, seeds: range, rng: np.random.Generator, tmp_path: Path
) -> None:
    for seed in seeds:
        made = star(rng, n=n, channels=1 + seed % 3, kind=kind, mjd=6e4 + seed / 7)
        path = tmp_path / "a.fits"
        write_oifits(path, made, overwrite=True)
        assert audit(path).findings == ()


def test_no_alarm_on_several_exposures(rng: np.random.Generator, tmp_path: Path) -> None:
    one = star(rng, n=5)
    parts = []
    for k in range(12):
        noise = one.covariance.draw(rng, 1)[:, 0]
        parts.append(
            replace(
                one,
                vis2=replace(one.vis2, value=0.8 + noise[:10], mjd=one.vis2.mjd + k / 50),
                closure_phase=replace(
                    one.closure_phase, value=noise[10:], mjd=one.closure_phase.mjd + k / 50
                ),
            )
        )
    write_oifits(tmp_path / "a.fits", join(parts))
    assert audit(tmp_path / "a.fits").findings == ()
    wild = [replace(p, covariance=scaled(p, 0.2)) for p in parts]
    write_oifits(tmp_path / "b.fits", join(wild))
    found = audit(tmp_path / "b.fits").findings
    assert {f.code for f in found} == {"errors-too-small"}
    assert len(found) == 2
    ratio = float(found[0].what.split("scatter ")[1].split(" ")[0])
    # 110 degrees of freedom: 7 %; 5 standard errors.
    assert ratio == pytest.approx(5.0, rel=0.35)


def scaled(observables: Observables, factor: float) -> Any:
    from amibayes.data.covariance import Block, BlockCovariance

    blocks = [Block(b.index, b.matrix * factor**2, b.basis) for b in observables.covariance.blocks]
    return BlockCovariance(observables.covariance.size, blocks)


def test_closures_given_as_independent(rng: np.random.Generator, tmp_path: Path) -> None:
    write_oifits(tmp_path / "a.fits", star(rng, kind="diagonal"))
    (finding,) = audit(tmp_path / "a.fits").findings
    assert finding.code == "closures-as-independent"
    assert "35 closure phases of which 15 are independent" in finding.what
    assert "1.53" in finding.why


Change = Callable[[fits.HDUList], None]


@cache
def clean(**options: Any) -> bytes:
    """One of our clean files."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.fits"
        write_oifits(path, star(np.random.default_rng(20201211), **options))
        return path.read_bytes()


def changed(path: Path, change: Change, **options: Any) -> Path:
    """One of our clean files with something done to it."""
    path.write_bytes(clean(**options))
    with fits.open(path, memmap=False) as hdus:
        change(hdus)
        hdus.writeto(path.with_name("changed.fits"), overwrite=True)
    return path.with_name("changed.fits")


def set_column(name: str, column: str, rows: Any, value: Any) -> Change:
    def change(hdus: fits.HDUList) -> None:
        hdus[name].data[column][rows] = value

    return change


def scale_column(name: str, factor: float, *columns: str) -> Change:
    def change(hdus: fits.HDUList) -> None:
        for column in columns:
            hdus[name].data[column] *= factor

    return change


def delete(name: str) -> Change:
    def change(hdus: fits.HDUList) -> None:
        del hdus[name]

    return change


def keyword(name: int | str, key: str, value: Any) -> Change:
    def change(hdus: fits.HDUList) -> None:
        hdus[name].header[key] = value

    return change


def unit(name: str, column: str, text: str | None) -> Change:
    def change(hdus: fits.HDUList) -> None:
        hdus[name].columns[column].unit = text

    return change


def in_radians(hdus: fits.HDUList) -> None:
    scale_column("OI_T3", DEGREE, "T3PHI", "T3PHIERR")(hdus)
    for column in ("T3PHI", "T3PHIERR"):
        hdus["OI_T3"].columns[column].unit = "rad"


def swap_stations(hdus: fits.HDUList) -> None:
    stations = hdus["OI_T3"].data["STA_INDEX"]
    stations[4] = stations[4][[1, 0, 2]]


def swap_sides(hdus: fits.HDUList) -> None:
    data = hdus["OI_T3"].data
    data["U1COORD"], data["U2COORD"] = data["U2COORD"].copy(), data["U1COORD"].copy()


def duplicate(hdus: fits.HDUList) -> None:
    copy = hdus["OI_WAVELENGTH"].copy()
    copy.header["EXTVER"] = 2
    hdus.append(copy)


CASES: dict[str, tuple[Change, set[str]]] = {
    "no target": (delete("OI_TARGET"), {"table-missing"}),
    "no array": (delete("OI_ARRAY"), {"table-missing", "reference"}),
    "no wavelengths": (delete("OI_WAVELENGTH"), {"table-missing", "reference"}),
    "no correlations": (delete("OI_CORR"), {"reference"}),
    "no observer": (keyword(0, "OBSERVER", ""), {"primary-keyword"}),
    "content": (keyword(0, "CONTENT", "OIFITS3"), {"primary-keyword"}),
    "no date": (keyword("OI_VIS2", "DATE-OBS", ""), {"table-keyword"}),
    "revision": (keyword("OI_T3", "OI_REVN", 1), {"revision"}),
    "wrong night": (keyword("OI_VIS2", "DATE-OBS", "1999-01-01"), {"date"}),
    "no night": (keyword("OI_VIS2", "DATE-OBS", "yesterday"), {"date"}),
    "spelling": (unit("OI_VIS2", "UCOORD", "METERS"), {"unit-spelling"}),
    "no unit": (unit("OI_T3", "T3PHI", None), {"unit-spelling"}),
    "radians": (in_radians, {"unit"}),
    "kilometres": (unit("OI_VIS2", "UCOORD", "km"), {"unit", "uv-stations", "uv-scale"}),
    "target": (set_column("OI_VIS2", "TARGET_ID", 3, 9), {"reference"}),
    "station": (set_column("OI_VIS2", "STA_INDEX", 3, [1, 9]), {"reference"}),
    "instrument": (keyword("OI_VIS2", "INSNAME", "X"), {"reference"}),
    "repeated": (duplicate, {"repeated"}),
    "target 0": (
        lambda h: (
            [
                set_column(n, "TARGET_ID", slice(None), 0)(h)
                for n in ("OI_TARGET", "OI_VIS2", "OI_T3")
            ]
            and None
        ),
        {"number-below-one"},
    ),
    "nan": (set_column("OI_VIS2", "VIS2DATA", 3, np.nan), {"unusable-unflagged"}),
    "zero error": (set_column("OI_VIS2", "VIS2ERR", 3, 0.0), {"unusable-unflagged"}),
    "negative error": (set_column("OI_T3", "T3PHIERR", 3, -1.0), {"unusable-unflagged"}),
    "all flagged": (set_column("OI_T3", "FLAG", slice(None), True), {"all-flagged"}),
    "V2 above 1": (set_column("OI_VIS2", "VIS2DATA", 3, 1.2), {"vis2-above-one"}),
    "V2 below 0": (set_column("OI_VIS2", "VIS2DATA", 3, -0.2), {"vis2-negative"}),
    "two turns": (set_column("OI_T3", "T3PHI", 3, 800.0), {"phase-range", "non-closing"}),
    "said degrees": (
        scale_column("OI_T3", DEGREE, "T3PHI", "T3PHIERR"),
        {"phase-in-radians"},
    ),
    "microns": (scale_column("OI_WAVELENGTH", 1e6, "EFF_WAVE"), {"wavelength"}),
    "no width": (set_column("OI_WAVELENGTH", "EFF_BAND", 0, 0.0), {"wavelength"}),
    "long": (set_column("OI_VIS2", "INT_TIME", 3, 1e6), {"integration-time"}),
    "station twice": (set_column("OI_T3", "STA_INDEX", 3, [1, 1, 2]), {"station-twice"}),
    "station order": (swap_stations, {"uv-stations", "non-closing"}),
    "sides": (swap_sides, {"uv-stations"}),
    "turned phase": (
        lambda h: h["OI_T3"].data["T3PHI"].__setitem__(4, h["OI_T3"].data["T3PHI"][4] + 20),
        {"non-closing"},
    ),
    "off the Earth": (keyword("OI_ARRAY", "FRAME", "GEOCENTRIC"), {"array-centre"}),
    "no number": (
        lambda h: (
            [keyword("OI_ARRAY", *k)(h) for k in (("FRAME", "GEOCENTRIC"), ("ARRAYX", "X"))]
            and None
        ),
        {"array-centre"},
    ),
    "correlation 2": (set_column("OI_CORR", "CORR", 3, 2.0), {"correlations"}),
    "correlation index": (keyword("OI_CORR", "NDATA", 5), {"correlations"}),
    "correlation order": (
        lambda h: (
            [set_column("OI_CORR", c, 3, i)(h) for c, i in (("IINDX", 56), ("JINDX", 1))] and None
        ),
        {"correlations"},
    ),
    "not a matrix": (
        lambda h: h["OI_CORR"].data["CORR"].__setitem__(slice(None), 0.999),
        {"correlations"},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_each_mistake_is_found(name: str, tmp_path: Path) -> None:
    change, expected = CASES[name]
    found = audit(changed(tmp_path / "a.fits", change, sigma=1e-3))
    assert {f.code for f in found.findings} == expected
    for finding in found.findings:
        assert finding.what
        assert finding.why
        assert finding.remedy
        assert not finding.certain or finding.code in REMEDIES


@pytest.mark.parametrize(
    ("degrees", "told"), [(360.0, False), (-360.0, False), (361.0, True), (-361.0, True)]
)
def test_a_whole_turn_is_the_most_that_a_phase_may_be(
    degrees: float, told: bool, tmp_path: Path
) -> None:
    path = changed(tmp_path / "a.fits", set_column("OI_T3", "T3PHI", 3, degrees))
    assert ("phase-range" in codes(path)) == told


def test_trailing_bytes(rng: np.random.Generator, tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    write_oifits(path, star(rng))
    path.write_bytes(path.read_bytes() + b"\0" * 99)
    assert codes(path) == {"trailing-bytes"}


def test_turned_triangle_is_named(tmp_path: Path) -> None:
    def turn(hdus: fits.HDUList) -> None:
        hdus["OI_T3"].data["T3PHI"][4] *= -1

    path = changed(tmp_path / "a.fits", turn, sigma=1e-3)
    (finding,) = audit(path).findings
    assert finding.code == "non-closing"
    stations = open_oifits(path).named("OI_T3")[0].columns["STA_INDEX"][4]
    assert "with " + "-".join(f"H{i}" for i in stations) + " turned round" in finding.what


def test_phases_that_fill_a_circle_of_radians(rng: np.random.Generator, tmp_path: Path) -> None:
    def wild(hdus: fits.HDUList) -> None:
        data = hdus["OI_T3"].data
        data["T3PHI"] = rng.uniform(-np.pi, np.pi, data["T3PHI"].shape)
        data["T3PHI"][0] = 3.1

    assert "phase-in-radians" in codes(changed(tmp_path / "a.fits", wild))


def jwst_like(hdus: fits.HDUList, n: int, *, normalized: bool = False) -> None:
    """OI_VIS, errors and pistons as the `ami` steps write them."""
    vis2 = hdus["OI_VIS2"]
    amplitude = np.sqrt(vis2.data["VIS2DATA"])
    sigma = vis2.data["VIS2ERR"] / (2 * amplitude)
    vis2.data["VIS2ERR"] /= np.sqrt(n)
    same = {
        c: (vis2.columns[c].format, vis2.data[c].copy(), vis2.columns[c].unit or "")
        for c in ("TARGET_ID", "TIME", "MJD", "INT_TIME", "UCOORD", "VCOORD", "STA_INDEX", "FLAG")
    }
    vis = table(
        "OI_VIS",
        same
        | {
            "VISAMP": ("1D", amplitude, ""),
            "VISAMPERR": ("1D", sigma, ""),
            "VISPHI": ("1D", 0 * sigma, "deg"),
            "VISPHIERR": ("1D", np.degrees(sigma), "deg"),
        },
        OI_REVN=2,
        INSNAME=vis2.header["INSNAME"],
        ARRNAME=vis2.header["ARRNAME"],
        DATE_OBS=vis2.header["DATE-OBS"],
    )
    hdus.append(vis)
    if normalized:
        array = hdus["OI_ARRAY"]
        columns = fits.ColDefs(
            [
                fits.Column(c, "1D", array=np.zeros(len(array.data)))
                for c in ("PISTON_T", "PISTON_C")
            ]
        )
        index = hdus.index_of("OI_ARRAY")
        hdus[index] = fits.BinTableHDU.from_columns(array.columns + columns, header=array.header)


@pytest.mark.parametrize("n", [1, 2, 69])
def test_vis2_errors_divided_twice(n: int, tmp_path: Path) -> None:
    path = changed(tmp_path / "a.fits", lambda h: jwst_like(h, n))
    found = audit(path)
    assert {f.code for f in found.findings} == ({"vis2-error-divided-twice"} if n > 1 else set())
    if n > 1:
        repair(found.oifits, list(found.findings), tmp_path / "b.fits")
        fixed = observables_of(open_oifits(tmp_path / "b.fits"))
        np.testing.assert_allclose(fixed.errors[0], 0.01, rtol=1e-6)
        assert audit(tmp_path / "b.fits").findings == ()


@pytest.mark.parametrize("factor", [0.05, 1.0, 20.0])
def test_exchanged_errors(factor: float, rng: np.random.Generator, tmp_path: Path) -> None:
    """Target 0.9 ± 0.001 over calibrator 0.8 ± 0.004, propagated rightly and exchanged.

    A factor that all errors of amplitudes share, and what 1 % of rounding leaves, say nothing.
    """
    target, calibrator = rng.uniform(0.5, 1.0, 21), rng.uniform(0.5, 1.0, 21)
    e_t, e_c = 0.001, 0.004

    def write(hdus: fits.HDUList, *, wrong: bool) -> None:
        jwst_like(hdus, 1, normalized=True)
        value = target / calibrator
        right = value * np.hypot(e_t / target, e_c / calibrator)
        exchanged = value * np.hypot(e_c / target, e_t / calibrator)
        hdus["OI_VIS2"].data["VIS2DATA"] = value
        hdus["OI_VIS2"].data["VIS2ERR"] = exchanged if wrong else right
        hdus["OI_VIS"].data["VISAMP"] = np.sqrt(value)
        rounded = factor * rng.uniform(0.995, 1.005, 21)
        hdus["OI_VIS"].data["VISAMPERR"] = rounded * right / (2 * np.sqrt(value))

    for wrong in (True, False):
        path = changed(tmp_path / "a.fits", lambda h, w=wrong: write(h, wrong=w), kind="diagonal")
        assert ("exchanged-errors" in codes(path)) == wrong


@pytest.mark.parametrize("flagged", [False, True])
def test_phase_errors_that_were_not_divided(
    rng: np.random.Generator, tmp_path: Path, *, flagged: bool
) -> None:
    """Noise alike along and across the bispectrum of N = 69 integrations."""
    amplitude = rng.uniform(0.2, 0.9, 35)
    estimates = rng.chisquare(68, (2, 35)) / 68
    along, across = 0.004 * np.sqrt(estimates)

    def write(hdus: fits.HDUList, *, wrong: bool) -> None:
        data = hdus["OI_T3"].data
        data["T3AMP"], data["T3AMPERR"] = amplitude, along
        data["T3PHIERR"] = np.degrees(across / (1 if wrong else amplitude))
        if flagged:  # says nothing, whatever it holds
            data["FLAG"][:20] = True
            data["T3PHIERR"][:20] *= 50.0 if wrong else amplitude[:20]
            data["T3AMP"][20], data["T3AMPERR"][21], data["T3PHIERR"][22] = 0.0, 0.0, 0.0

    for wrong in (True, False):
        path = changed(tmp_path / "a.fits", lambda h, w=wrong: write(h, wrong=w), kind="diagonal")
        assert ("phase-error-times-amplitude" in codes(path)) == wrong


def test_repair_mends_what_is_certain_and_nothing_else(tmp_path: Path) -> None:
    def spoil(hdus: fits.HDUList) -> None:
        in_radians(hdus)
        hdus["OI_VIS2"].data["VIS2DATA"][3] = np.nan
        hdus["OI_VIS2"].columns["UCOORD"].unit = "METERS"
        hdus[0].header["OBSERVER"] = ""
        hdus[0].header["DATE-OBS"] = ""

    path = changed(tmp_path / "a.fits", spoil)
    path.write_bytes(path.read_bytes() + b"\0" * 10)
    found = audit(path)
    fixed = repair(found.oifits, list(found.findings), tmp_path / "fixed.fits")
    assert {f.code for f in fixed} == {
        "trailing-bytes",
        "primary-keyword",
        "unit-spelling",
        "unit",
        "unusable-unflagged",
    }
    assert audit(tmp_path / "fixed.fits").findings == ()
    before, after = read_oifits(path), read_oifits(tmp_path / "fixed.fits")
    np.testing.assert_allclose(after.data, before.data, rtol=1e-13)
    np.testing.assert_array_equal(after.vis2.flag, before.vis2.flag)
    header = fits.getheader(tmp_path / "fixed.fits")
    assert (header["OBSERVER"], header["DATE-OBS"]) == ("UNKNOWN", "2023-02-25")


def test_a_version_1_file(rng: np.random.Generator, tmp_path: Path) -> None:
    made = HandMade(rng)
    path = made.write(tmp_path / "a.fits")
    found = {f.code for f in audit(path).findings}
    assert found == {
        "column-missing",
        "unit-spelling",
        "closures-as-independent",
        "table-keyword",
    }


def test_file_without_interferometry_is_audited(rng: np.random.Generator, tmp_path: Path) -> None:
    made = HandMade(rng)
    del made.tables["OI_VIS2"], made.tables["OI_T3"]
    assert "table-missing" in codes(made.write(tmp_path / "a.fits"))
    with pytest.raises(DataError):
        audit(tmp_path / "none.fits")


def test_public_files(data: Path) -> None:
    """The findings, each checked by hand against the files."""
    expected = {
        "axcir_pionier.oifits": {
            "array-centre",
            "unit-spelling",
            "integration-time",
            "closures-as-independent",
        },
        "axcir_pionier_cov.oifits": {"array-centre", "unit-spelling", "integration-time"},
        "beauty2004.fits": {"unit-spelling", "number-below-one", "date"},
        "contest2008_binary.oifits": {
            "array-centre",
            "unit-spelling",
            "number-below-one",
            "closures-as-independent",
        },
        "created_v2.fits": {"vis2-above-one", "phase-range", "uv-stations", "uv-length"},
        "gravity_singlesci.fits": {
            "unusable-unflagged",
            "vis2-negative",
            "closures-as-independent",
        },
        "niriss_f430m_amical.oifits": {
            "primary-keyword",
            "table-keyword",
            "unit-spelling",
            "closures-as-independent",
        },
        "testdata_opt.fits": set(),
    }
    for name, wanted in expected.items():
        assert codes(data / "oifits" / name) == wanted, name
    with pytest.raises(DataError, match="is cut short"):
        audit(data / "oifits" / "corrupted" / "truncated.fits")


@pytest.mark.parametrize(
    "spoilt", ["absent", "words", pytest.param("wide", marks=pytest.mark.slow)]
)
def test_any_column_may_be_anything(spoilt: str, tmp_path: Path) -> None:
    """Whichever column it is, the audit ends, with the column named or the file refused."""
    whole = HandMade(np.random.default_rng(1)).tables
    for name, column in [(t, c) for t, columns in whole.items() for c in columns]:
        made = HandMade(np.random.default_rng(1))
        form, values, _ = made.tables[name][column]
        if spoilt == "absent":
            del made.tables[name][column]
        elif spoilt == "wide":
            made.put(name, column, np.ones((len(values), 5)), form="5D")
        elif form.endswith("A"):
            continue
        else:
            made.put(name, column, ["x"] * len(values), form="4A", unit="")
        path = made.write(tmp_path / f"{name}_{column}.fits")
        try:
            said = [f"{f.where} {f.what}" for f in audit(open_oifits(path)).findings]
        except DataError as refused:
            said = [f"{column} {refused}"] if str(path) in str(refused) else []
        assert any(column in text for text in said), (name, column)


def test_numbers_of_stations_are_unique(tmp_path: Path) -> None:
    twice = changed(tmp_path / "a.fits", set_column("OI_ARRAY", "STA_INDEX", 1, 1))
    (finding,) = [f for f in audit(twice).findings if f.code == "repeated"]
    assert "STA_INDEX in OI_ARRAY" in finding.what


@pytest.mark.parametrize(("minutes", "told"), [(10.0, False), (2000.0, True)])
def test_integration_times_are_read_in_their_unit(
    minutes: float, told: bool, tmp_path: Path
) -> None:
    """2000 minutes are longer than a night, 2000 s are not."""

    def in_minutes(hdus: fits.HDUList) -> None:
        hdus["OI_VIS2"].columns["INT_TIME"].unit = "min"
        hdus["OI_VIS2"].data["INT_TIME"] = minutes

    found = codes(changed(tmp_path / "a.fits", in_minutes))
    assert ("integration-time" in found) == told


@pytest.mark.parametrize("vis2", [0.1, 0.8])
def test_errors_in_radians_are_told_at_any_vis2(vis2: float, tmp_path: Path) -> None:
    """σ(CP) = √3 σ(V²)/2V², as given by three independent baselines of equal V²."""
    right = np.sqrt(3.0) * 1e-3 / (2.0 * vis2)

    def with_errors(sigma: float) -> Change:
        def change(hdus: fits.HDUList) -> None:
            hdus["OI_VIS2"].data["VIS2DATA"], hdus["OI_VIS2"].data["VIS2ERR"] = vis2, 1e-3
            hdus["OI_T3"].data["T3PHIERR"] = sigma
            hdus["OI_T3"].data["T3PHI"] *= DEGREE

        return change

    for sigma, told in ((right, True), (np.degrees(right), False)):
        path = changed(tmp_path / "a.fits", with_errors(sigma), kind="diagonal")
        assert ("phase-in-radians" in codes(path)) == told
        said = errors_in(open_oifits(path), read_oifits(path))
        assert any("look like radians" in line for line in said) == told


def reformatted(name: str, column: str, form: str) -> Change:
    """Give a column another format, a multiple of its first number where that is longer."""

    def change(hdus: fits.HDUList) -> None:
        old = hdus[name]
        values = {c.name: old.data[c.name] for c in old.columns}
        if form[0].isdigit() and form[-1] != "A":
            values[column] = np.tile(
                values[column].reshape(len(old.data), -1)[:, :1], int(form[:-1])
            )
        columns = [
            fits.Column(c.name, form if c.name == column else c.format, c.unit,
                        array=values[c.name])
            for c in old.columns
        ]  # fmt: skip
        new = fits.BinTableHDU.from_columns(columns)
        kept = ("EXTNAME", "OI_REVN", "INSNAME", "ARRNAME", "DATE-OBS")
        new.header.update({key: old.header[key] for key in kept if key in old.header})
        hdus[hdus.index_of(name)] = new

    return change


@pytest.mark.parametrize(
    ("table", "column", "form", "told"),
    [
        ("OI_VIS2", "UCOORD", "E", True),
        ("OI_VIS2", "VIS2DATA", "2D", True),
        ("OI_VIS2", "STA_INDEX", "3I", True),
        ("OI_VIS2", "STA_INDEX", "2I", False),
        ("OI_TARGET", "TARGET", "40A", False),
    ],
)
def test_columns_of_another_format_are_told(
    table: str, column: str, form: str, told: bool, tmp_path: Path
) -> None:
    """The standard: doubles, a number for each channel, two stations, texts of any length."""
    path = changed(tmp_path / "a.fits", reformatted(table, column, form))
    formats = [f for f in audit(path).findings if f.code == "column-format"]
    assert [column in f.what for f in formats] == [True] * told


def test_tables_without_flags_are_looked_at(tmp_path: Path) -> None:
    def without(hdus: fits.HDUList) -> None:
        hdus["OI_VIS2"].columns.del_col("FLAG")
        hdus["OI_VIS2"].data["VIS2DATA"][3] = 1.4

    found = codes(changed(tmp_path / "a.fits", without, sigma=1e-3))
    assert {"vis2-above-one", "column-missing"} <= found


def test_unknown_stations_are_no_station_twice(tmp_path: Path) -> None:
    """Zeros say that stations are not known; they are made of (u, v) then."""
    zeros = set_column("OI_VIS2", "STA_INDEX", slice(None), 0)
    assert "station-twice" not in codes(changed(tmp_path / "a.fits", zeros))


def test_correlations_of_the_datum_before_the_first(tmp_path: Path) -> None:
    path = changed(tmp_path / "a.fits", set_column("OI_CORR", "IINDX", 3, 0))
    assert any("indices outside" in f.what for f in audit(path).findings)


@pytest.mark.parametrize("column", ["STAXYZ", "DIAMETER"])
@pytest.mark.parametrize("damage", ["gone", "text", "zero"])
def test_arrays_without_positions_or_sizes_are_read(
    column: str, damage: str, tmp_path: Path
) -> None:
    def change(hdus: fits.HDUList) -> None:
        if damage == "zero":
            hdus["OI_ARRAY"].data[column] = 0.0
            return
        old = hdus["OI_ARRAY"]
        kept = [c for c in old.columns if c.name != column]
        kept += [fits.Column(column, "4A", array=["much"] * 7)] if damage == "text" else []
        new = fits.BinTableHDU.from_columns(fits.ColDefs(kept))
        new.header.update({key: old.header[key] for key in ("EXTNAME", "OI_REVN", "ARRNAME")})
        hdus[hdus.index_of("OI_ARRAY")] = new

    path = changed(tmp_path / "a.fits", change)
    found, whole = read_oifits(path), read_oifits(tmp_path / "a.fits")
    np.testing.assert_array_equal(found.vis2.u_m, whole.vis2.u_m)
    assert len(found.vis2) == 21


def test_errors_are_told_before_warnings(rng: np.random.Generator, tmp_path: Path) -> None:
    made = MaskFile(rng)
    made.change("OI_T3", lambda x: 1e-3 * x, "T3PHIERR")
    made.tables["OI_ARRAY"].pop("DIAMETER")
    made.put("OI_VIS2", "VIS2DATA", made.tables["OI_VIS2"]["VIS2DATA"][1] * 5.0)
    severities = [f.severity for f in audit(made.write(tmp_path / "a.fits")).findings]
    assert len(set(severities)) > 1
    n = severities.count("error")
    assert n > 0
    assert severities[:n] == ["error"] * n


@pytest.mark.parametrize(
    ("frame", "km", "wrong"),
    [
        ("GEOCENTRIC", 6290.0, True),
        ("GEOCENTRIC", 6357.0, False),
        ("GEOCENTRIC", 6384.0, False),
        ("GEOCENTRIC", 6510.0, True),
        ("SKY", 0.0, False),
    ],
)
def test_the_centre_of_an_array_is_on_the_earth(frame: str, km: float, *, wrong: bool) -> None:
    """Poles, equator and mountains are; a hundred kilometres above them nothing observes."""
    centre = 1e3 * km * np.array([0.48, -0.6, 0.64])
    keywords = {"FRAME": frame, **dict(zip(("ARRAYX", "ARRAYY", "ARRAYZ"), centre, strict=True))}
    table = SimpleNamespace(keyword=keywords.get, label="OI_ARRAY", header=keywords)
    found = list(array_centre(SimpleNamespace(named=lambda _: [table])))  # type: ignore[arg-type]
    assert len(found) == wrong
    for finding in found:
        assert f"{km:.0f} km" in finding.what

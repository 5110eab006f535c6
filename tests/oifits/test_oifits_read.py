"""Reading OIFITS: files made by hand whose truth is known, odd files, broken files."""

from __future__ import annotations

import gzip
import tracemalloc
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units
from astropy.io import fits
from astropy.time import Time
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oi_builders import HandMade, table

from amibayes.data.point_source import point_source
from amibayes.errors import DataError
from amibayes.oifits import observables_of, open_oifits, read_oifits
from amibayes.oifits.columns import _in_metres
from amibayes.oifits.correlations import shared_baseline_sign
from amibayes.oifits.rows import times_of
from amibayes.oifits.scales import ANGLE, FREQUENCY, LENGTH, TIME, scale_of
from amibayes.oifits.setups import array_table, wavelength_table
from amibayes.oifits.stated import _integrations
from amibayes.oifits.uv_stations import _corners

DEGREE = np.pi / 180


@pytest.fixture
def made(rng: np.random.Generator) -> HandMade:
    return HandMade(rng)


def test_reads_what_is_in_the_file(made: HandMade, tmp_path: Path) -> None:
    data = read_oifits(made.write(tmp_path / "a.fits"))
    np.testing.assert_array_equal(data.vis2.value, made.vis2.ravel())
    np.testing.assert_allclose(data.closure_phase.value, made.phase_deg.ravel() * DEGREE)
    vis2_error, phase_error = data.errors
    np.testing.assert_allclose(vis2_error, made.vis2_error.ravel())
    # The ridge reproduces errors to 1e-3 where baselines can.
    assert phase_error.shape == (12,)
    np.testing.assert_array_equal(data.vis2.stations[::3] + 1, made.baselines)
    np.testing.assert_array_equal(data.closure_phase.stations[::3] + 1, made.triangles)
    np.testing.assert_array_equal(data.vis2.channel, np.tile([0, 1, 2], 6))
    np.testing.assert_allclose(data.vis2.wavelength_m[:3], made.wavelength_m, rtol=1e-7)
    np.testing.assert_array_equal(data.vis2.u_m[::3, 0], made.tables["OI_VIS2"]["UCOORD"][1])
    setup = data.setups[0]
    assert (setup.target, setup.insname, setup.arrname) == ("alf Test", "I", "X")
    assert setup.stations == ("A", "B", "C", "D")
    assert (setup.right_ascension_deg, setup.declination_deg) == (10.0, -20.0)
    assert data.covariance_kind == "assumed"
    assert data.n_independent == 18 + 9
    assert data.notes == ()


def test_closure_phase_follows_the_first_two_baselines(made: HandMade, tmp_path: Path) -> None:
    m = read_oifits(made.write(tmp_path / "a.fits")).closure_phase
    uv = {tuple(b): made.xy[b[1] - 1] - made.xy[b[0] - 1] for b in made.baselines}
    for i in range(len(m)):
        a, b, c = m.stations[i] + 1
        np.testing.assert_allclose((m.u_m[i, 0], m.v_m[i, 0]), uv[a, b])
        np.testing.assert_allclose((m.u_m[i, 1], m.v_m[i, 1]), uv[b, c])


def test_diagonal_takes_errors_as_they_are(made: HandMade, tmp_path: Path) -> None:
    data = read_oifits(made.write(tmp_path / "a.fits"), closure_covariance="diagonal")
    assert data.covariance.independent
    np.testing.assert_allclose(data.errors[1], made.phase_error_deg.ravel() * DEGREE)
    assert data.n_independent == 30


@pytest.mark.parametrize(
    ("unit", "scale"), [("", 1.0), ("DEGREES", 1.0), ("rad", DEGREE), ("mrad", 1e3 * DEGREE)]
)
def test_phase_units_are_honoured(made: HandMade, tmp_path: Path, unit: str, scale: float) -> None:
    truth = made.phase_deg * DEGREE
    made.put("OI_T3", "T3PHI", made.phase_deg * scale, unit=unit)
    made.put("OI_T3", "T3PHIERR", made.phase_error_deg * scale, unit=unit)
    data = read_oifits(made.write(tmp_path / "a.fits"), closure_covariance="diagonal")
    np.testing.assert_allclose(data.closure_phase.value, truth.ravel())
    np.testing.assert_allclose(data.errors[1], made.phase_error_deg.ravel() * DEGREE)


def test_error_unit_follows_the_phase_where_it_has_none(made: HandMade, tmp_path: Path) -> None:
    made.put("OI_T3", "T3PHI", made.phase_deg * DEGREE, unit="rad")
    made.put("OI_T3", "T3PHIERR", made.phase_error_deg * DEGREE, unit="")
    data = read_oifits(made.write(tmp_path / "a.fits"), closure_covariance="diagonal")
    np.testing.assert_allclose(data.errors[1], made.phase_error_deg.ravel() * DEGREE)


def test_unknown_unit_is_read_as_the_standard_and_noted(made: HandMade, tmp_path: Path) -> None:
    made.put("OI_T3", "T3PHI", made.phase_deg, unit="furlong")
    data = read_oifits(made.write(tmp_path / "a.fits"))
    np.testing.assert_allclose(data.closure_phase.value, made.phase_deg.ravel() * DEGREE)
    assert any("furlong" in note for note in data.notes)


@pytest.mark.parametrize(("unit", "scale"), [("micron", 1e6), ("nm", 1e9), ("Angstrom", 1e10)])
def test_wavelength_units_are_honoured(
    made: HandMade, tmp_path: Path, unit: str, scale: float
) -> None:
    made.put("OI_WAVELENGTH", "EFF_WAVE", made.wavelength_m * scale, unit=unit)
    data = read_oifits(made.write(tmp_path / "a.fits"))
    np.testing.assert_allclose(data.setups[0].wavelength_m, made.wavelength_m, rtol=1e-6)


def test_wavelengths_in_microns_without_unit_are_refused(made: HandMade, tmp_path: Path) -> None:
    made.put("OI_WAVELENGTH", "EFF_WAVE", made.wavelength_m * 1e6)
    with pytest.raises(DataError, match="EFF_WAVE is no wavelength in metres"):
        read_oifits(made.write(tmp_path / "a.fits"))


def test_flags_and_unusable_numbers(made: HandMade, tmp_path: Path) -> None:
    flag = np.zeros((6, 3), bool)
    flag[0, 1] = True
    made.put("OI_VIS2", "FLAG", flag)
    made.vis2[1, 0] = np.nan
    for i, bad in enumerate([np.nan, 0.0, -1.0, np.inf, 1e20]):
        made.vis2_error[1 + i, 2] = bad
    made.phase_error_deg[0, 0] = 1e9
    made.phase_deg[1, 1] = 9.97e36
    data = read_oifits(made.write(tmp_path / "a.fits"))
    expected = flag.copy()
    expected[1:, 2] = expected[1, 0] = True
    np.testing.assert_array_equal(data.vis2.flag.reshape(6, 3), expected)
    phase = np.zeros((4, 3), bool)
    phase[0, 0] = phase[1, 1] = True
    np.testing.assert_array_equal(data.closure_phase.flag.reshape(4, 3), phase)
    assert any("1 without a usable value, 5 without a usable error" in note for note in data.notes)
    assert np.isfinite(data.data).all()


def test_triple_amplitude_never_flags_the_phase(made: HandMade, tmp_path: Path) -> None:
    assert np.isnan(made.tables["OI_T3"]["T3AMP"][1]).all()
    assert read_oifits(made.write(tmp_path / "a.fits")).n_closure_phases == 12
    del made.tables["OI_T3"]["T3AMP"], made.tables["OI_T3"]["T3AMPERR"]
    assert read_oifits(made.write(tmp_path / "b.fits")).n_closure_phases == 12


@pytest.mark.parametrize("missing", ["OI_TARGET", "OI_ARRAY", "STA_INDEX", "FLAG", "INT_TIME"])
def test_missing_optional_parts(made: HandMade, tmp_path: Path, missing: str) -> None:
    if missing == "STA_INDEX":
        del made.tables["OI_ARRAY"]["STA_INDEX"]
    elif missing in ("FLAG", "INT_TIME"):
        del made.tables["OI_VIS2"][missing], made.tables["OI_T3"][missing]
    else:
        del made.tables[missing]
    data = read_oifits(made.write(tmp_path / "a.fits"))
    assert data.n_vis2 == 18
    assert data.n_closure_phases == 12
    assert data.n_independent == 27
    assert len(data.setups[0].stations) == 4


def test_stations_that_the_array_does_not_list(made: HandMade, tmp_path: Path) -> None:
    short = made.tables["OI_ARRAY"]
    made.tables["OI_ARRAY"] = {n: (f, v[:2], u) for n, (f, v, u) in short.items()}
    data = read_oifits(made.write(tmp_path / "a.fits"))
    assert data.setups[0].stations == ("A", "B", "station 3", "station 4")
    assert data.n_independent == 27


def test_padding_and_case(made: HandMade, tmp_path: Path) -> None:
    made.put("OI_ARRAY", "STA_NAME", ["A\0\0", "B  ", " C", "D"])
    made.put("OI_TARGET", "TARGET", ["alf Test   \0"])
    made.keywords["OI_VIS2"]["INSNAME"] = "i  "
    made.tables["OI_VIS2"] = {n.lower(): v for n, v in made.tables["OI_VIS2"].items()}
    data = read_oifits(made.write(tmp_path / "a.fits"))
    assert data.setups[0].stations == ("A", "B", "C", "D")
    assert data.setups[0].target == "alf Test"
    assert data.n_vis2 == 18


def test_one_channel_as_scalar_column(made: HandMade, tmp_path: Path) -> None:
    for name, columns in made.tables.items():
        for key, (form, values, unit) in columns.items():
            if form in ("3D", "3L") and key != "STAXYZ":
                columns[key] = (f"1{form[1]}", np.asarray(values)[:, 0], unit)
            elif name == "OI_WAVELENGTH":
                columns[key] = (form, values[:1], unit)
    data = read_oifits(made.write(tmp_path / "a.fits"))
    np.testing.assert_array_equal(data.vis2.value, made.vis2[:, 0])


def test_version_1_clock(made: HandMade, tmp_path: Path) -> None:
    made.put("OI_VIS2", "MJD", np.full(6, 57000.0))
    made.put("OI_VIS2", "TIME", 100.0 * np.arange(6), unit="s")
    data = read_oifits(made.write(tmp_path / "a.fits"))
    np.testing.assert_allclose((data.vis2.mjd[::3] - 57000) * 86400, 100.0 * np.arange(6))
    made.put("OI_VIS2", "MJD", np.full(6, np.nan))
    again = read_oifits(made.write(tmp_path / "b.fits"))
    np.testing.assert_allclose((again.vis2.mjd[::3] - 57000) * 86400, 100.0 * np.arange(6))


def test_several_targets(made: HandMade, tmp_path: Path) -> None:
    made.tables["OI_TARGET"] = {
        "TARGET_ID": ("1I", [1, 7, 9], ""),
        "TARGET": ("16A", ["alf Test", "bet Test", "unseen"], ""),
    }
    assert read_oifits(made.write(tmp_path / "a.fits")).setups[0].target == "alf Test"
    made.put("OI_VIS2", "TARGET_ID", [1, 1, 1, 7, 7, 7])
    path = made.write(tmp_path / "b.fits")
    with pytest.raises(DataError, match=r"several targets: alf Test, bet Test \(choose"):
        read_oifits(path)
    chosen = read_oifits(path, target="BET test")
    np.testing.assert_array_equal(chosen.vis2.value, made.vis2[3:].ravel())
    assert chosen.n_closure_phases == 0
    np.testing.assert_array_equal(chosen.vis2.row[::3], [0, 1, 2])
    with pytest.raises(DataError, match=r"no data of target 'gamma'.*alf Test, bet Test"):
        read_oifits(path, target="gamma")


def test_several_instruments(made: HandMade, rng: np.random.Generator, tmp_path: Path) -> None:
    other = HandMade(rng)
    other.wavelength_m = np.array([2.1e-6, 2.2e-6, 2.3e-6])
    made.more += [
        table("OI_WAVELENGTH", other.tables["OI_WAVELENGTH"], INSNAME="J"),
        table("OI_VIS2", other.tables["OI_VIS2"], INSNAME="J", ARRNAME="X"),
    ]
    path = made.write(tmp_path / "a.fits")
    both = read_oifits(path)
    assert [s.insname for s in both.setups] == ["I", "J"]
    np.testing.assert_array_equal(
        both.vis2.value, np.concatenate([made.vis2.ravel(), other.vis2.ravel()])
    )
    one = read_oifits(path, insname="J")
    np.testing.assert_array_equal(one.vis2.value, other.vis2.ravel())
    with pytest.raises(DataError, match=r"no INSNAME 'K' \(it has I, J\)"):
        read_oifits(path, insname="K")


def test_the_name_of_a_combiner_is_that_of_both_its_polarisations(
    made: HandMade, tmp_path: Path, rng: np.random.Generator
) -> None:
    values = []
    for name in ("SC_P1", "SC_P2"):
        other = HandMade(rng)
        values.append(other.vis2.ravel())
        made.more += [
            table("OI_WAVELENGTH", other.tables["OI_WAVELENGTH"], INSNAME=name),
            table("OI_VIS2", other.tables["OI_VIS2"], INSNAME=name, ARRNAME="X"),
        ]
    path = made.write(tmp_path / "a.fits")
    both = read_oifits(path, insname="sc")
    np.testing.assert_array_equal(both.vis2.value, np.concatenate(values))
    one = read_oifits(path, insname="SC_P2")
    np.testing.assert_array_equal(one.vis2.value, values[1])


def test_tables_that_are_not_used_are_kept_and_named(made: HandMade, tmp_path: Path) -> None:
    flux = table("OI_FLUX", {"FLUX": ("3D", made.vis2, "Jy")}, EXTVER=4)
    made.more += [flux, fits.ImageHDU(np.arange(6.0).reshape(2, 3), name="EXTRA")]
    oifits = open_oifits(made.write(tmp_path / "a.fits"))
    assert [(t.name, t.extver) for t in oifits.unused] == [("OI_FLUX", 4), ("EXTRA", 1)]
    np.testing.assert_array_equal(oifits.named("OI_FLUX")[0].columns["FLUX"], made.vis2)
    np.testing.assert_array_equal(oifits.named("EXTRA")[0].image, np.arange(6.0).reshape(2, 3))
    assert "OI_FLUX 4, EXTRA 1 are not used" in observables_of(oifits).notes
    with pytest.raises(ValueError, match="read-only"):
        oifits.named("OI_FLUX")[0].columns["FLUX"][0] = 1.0


def test_tables_of_one_name_that_are_not_used_are_one_line(made: HandMade, tmp_path: Path) -> None:
    made.more += [table("OI_VIS", {"VISAMP": ("3D", made.vis2, "")}) for _ in range(3)]
    made.more += [table("OI_FLUX", {"FLUX": ("3D", made.vis2, "Jy")}, EXTVER=2)]
    notes = observables_of(open_oifits(made.write(tmp_path / "a.fits"))).notes
    assert [n for n in notes if "not used" in n] == ["OI_VIS 1 (3 tables), OI_FLUX 2 are not used"]


def test_correlations_of_oi_corr(made: HandMade, tmp_path: Path) -> None:
    # V² 1 with 2, V² 3 with closure phase 19, closure phases 19 with 22 (same channel).
    made.correlate([(1, 2, 0.5), (19, 3, -0.25), (19, 22, 0.3), (4, 4, 1.0)])
    data = read_oifits(made.write(tmp_path / "a.fits"))
    assert data.covariance_kind == "given"
    dense = data.covariance.dense()
    vis2, phase = made.vis2_error.ravel(), made.phase_error_deg.ravel() * DEGREE
    np.testing.assert_allclose(dense[0, 1], 0.5 * vis2[0] * vis2[1])
    np.testing.assert_allclose(dense[18, 2], -0.25 * phase[0] * vis2[2])
    np.testing.assert_allclose(dense[18, 21], 0.3 * phase[0] * phase[3])
    assert dense[3, 4] == 0
    assert data.n_independent == 27
    # Channels 1 and 2 have no correlation in the file: shared baselines are assumed there.
    assert np.count_nonzero(dense[19, 18:]) == 4
    np.testing.assert_allclose(np.diag(dense)[18:21:3], phase[:3:3] ** 2)


def test_a_correlation_with_the_billionth_datum_takes_no_memory(made, tmp_path: Path) -> None:
    """A damaged table of 9 GB would be asked for; the other pairs stand as they are."""
    made.correlate([(1, 2, 0.5), (3, 1_275_068_417, 0.2)])
    path = made.write(tmp_path / "a.fits")
    tracemalloc.start()
    dense = read_oifits(path).covariance.dense()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e7
    vis2 = made.vis2_error.ravel()
    np.testing.assert_allclose(dense[0, 1], 0.5 * vis2[0] * vis2[1])
    assert np.count_nonzero(dense[:18, :18]) == 18 + 2


def test_full_and_deficient_closure_matrix_have_kernel_rank(made: HandMade, tmp_path: Path) -> None:
    from amibayes.data.closure import closure_matrix

    matrix = closure_matrix(made.triangles - 1)[0]
    shared = matrix @ matrix.T / 3
    pairs = [
        (19 + 3 * i + c, 19 + 3 * j + c, shared[i, j])
        for c in range(3)
        for i in range(4)
        for j in range(i + 1, 4)
    ]
    made.correlate(pairs)
    data = read_oifits(made.write(tmp_path / "a.fits"))
    assert data.covariance.rank == 27
    draws = data.covariance.draw(np.random.default_rng(1), 3)
    assert np.isfinite(draws).all()


@pytest.mark.parametrize(
    ("pairs", "fault"),
    [
        ([(1, 2, 1.5)], "not between -1 and 1"),
        ([(1, 2, np.nan)], "not between -1 and 1"),
        ([(0, 2, 0.5)], "index below 1"),
        ([(1, 2, 0.5), (2, 1, 0.4)], "two values for one correlation"),
        ([(1, 2, 0.9), (1, 3, 0.9), (2, 3, -0.9)], "not positive definite"),
    ],
)
def test_bad_correlations(
    made: HandMade, tmp_path: Path, pairs: list[tuple[int, int, float]], fault: str
) -> None:
    made.correlate(pairs)
    path = made.write(tmp_path / "a.fits")
    with pytest.raises(DataError, match=rf"a\.fits: .*{fault}.*\(correct the correlations"):
        read_oifits(path)
    assert read_oifits(path, closure_covariance="diagonal").n_independent == 30


def test_missing_correlation_table(made: HandMade, tmp_path: Path) -> None:
    made.correlate([(1, 2, 0.5)])
    made.more.clear()
    with pytest.raises(DataError, match="no OI_CORR has that CORRNAME"):
        read_oifits(made.write(tmp_path / "a.fits"))
    # Of one kind of data alone it is missed as well.
    del made.tables["OI_T3"]["CORRINDX_T3PHI"]
    with pytest.raises(DataError, match="no OI_CORR has that CORRNAME"):
        read_oifits(made.write(tmp_path / "a.fits"))


@pytest.mark.parametrize("order", ["channels", "baselines"])
@pytest.mark.parametrize("degrees", [False, True])
def test_covariance_images(
    made: HandMade, rng: np.random.Generator, tmp_path: Path, order: str, degrees: bool
) -> None:
    def image(sigma: np.ndarray, name: str) -> tuple[np.ndarray, fits.ImageHDU]:
        n = sigma.size
        # Of low rank and off the constant, so that every pair is correlated a little.
        correlation = np.eye(n) + 0.3 * np.outer(*[np.linspace(0.2, 1, n)] * 2)
        correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
        truth = correlation * np.outer(sigma.ravel(), sigma.ravel())
        grid = np.arange(n).reshape(sigma.shape)
        written = (grid if order == "channels" else grid.T).ravel()
        hdu = fits.ImageHDU(truth[np.ix_(written, written)][None], name=name)
        hdu.header["INSNAME"] = "I"
        return truth, hdu

    vis2, first = image(made.vis2_error, "V2COV")
    phase, second = image(made.phase_error_deg * (1 if degrees else DEGREE), "CPCOV")
    made.more += [first, second]
    data = read_oifits(made.write(tmp_path / "a.fits"))
    assert data.covariance_kind == "given"
    np.testing.assert_allclose(data.covariance.dense()[:18, :18], vis2)
    scale = DEGREE**2 if degrees else 1
    np.testing.assert_allclose(data.covariance.dense()[18:, 18:], phase * scale)
    assert not data.covariance.dense()[:18, 18:].any()
    assert data.n_independent == 27


def test_covariance_image_that_fits_nothing(made: HandMade, tmp_path: Path) -> None:
    made.more.append(fits.ImageHDU(np.eye(18)[None], name="V2COV"))
    with pytest.raises(DataError, match=r"diagonal of V2COV .* does not fit the errors"):
        read_oifits(made.write(tmp_path / "a.fits"))
    made.more = [fits.ImageHDU(np.eye(5)[None], name="V2COV")]
    with pytest.raises(DataError, match="is for 5 data, the tables hold 18"):
        read_oifits(made.write(tmp_path / "b.fits"))


def test_gzip(made: HandMade, tmp_path: Path) -> None:
    raw = made.write(tmp_path / "a.fits").read_bytes()
    path = tmp_path / "a.fits.gz"
    path.write_bytes(gzip.compress(raw))
    assert read_oifits(path).n_vis2 == 18
    path.write_bytes(gzip.compress(raw)[:-500])
    with pytest.raises(DataError, match="compression is damaged"):
        read_oifits(path)


def test_files_that_are_no_oifits(made: HandMade, tmp_path: Path) -> None:
    image = tmp_path / "image.fits"
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(image)
    (tmp_path / "empty.fits").touch()
    (tmp_path / "text.fits").write_text("SIMPLE words\n" * 400)
    faults = {
        "none.fits": "does not exist",
        ".": "is a folder",
        "empty.fits": "is empty",
        "text.fits": "is not a FITS file",
        "image.fits": "holds no OIFITS table",
    }
    for name, fault in faults.items():
        with pytest.raises(DataError, match=fault) as caught:
            read_oifits(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_without_interferometry(made: HandMade, tmp_path: Path) -> None:
    del made.tables["OI_VIS2"], made.tables["OI_T3"]
    path = made.write(tmp_path / "a.fits")
    assert len(open_oifits(path).tables) == 3
    with pytest.raises(DataError, match="neither squared visibilities nor closure phases"):
        read_oifits(path)


def test_everything_flagged(made: HandMade, tmp_path: Path) -> None:
    made.put("OI_VIS2", "FLAG", np.ones((6, 3), bool))
    made.put("OI_T3", "FLAG", np.ones((4, 3), bool))
    path = made.write(tmp_path / "a.fits")
    for kind in ("assumed", "diagonal"):
        with pytest.raises(
            DataError, match=r"no usable V² or closure phase: OI_VIS2 .*in the file"
        ):
            read_oifits(path, closure_covariance=kind)


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("OI_VIS2", "VIS2DATA"),
        ("OI_VIS2", "VIS2ERR"),
        ("OI_VIS2", "UCOORD"),
        ("OI_T3", "T3PHI"),
        ("OI_T3", "V2COORD"),
        ("OI_WAVELENGTH", "EFF_WAVE"),
    ],
)
def test_missing_required_columns(made: HandMade, tmp_path: Path, name: str, column: str) -> None:
    del made.tables[name][column]
    with pytest.raises(DataError, match=f"{name} .*has no column {column}"):
        read_oifits(made.write(tmp_path / "a.fits"))


def test_shapes_that_do_not_fit(made: HandMade, tmp_path: Path) -> None:
    for name, column, form, width in (
        ("OI_VIS2", "VIS2ERR", "2D", 2),
        ("OI_VIS2", "FLAG", "2L", 2),
        ("OI_T3", "STA_INDEX", "2I", 2),
    ):
        kept = made.tables[name][column]
        made.put(name, column, np.ones((len(kept[1]), width), int), form=form)
        with pytest.raises(DataError, match=column):
            read_oifits(made.write(tmp_path / "a.fits"))
        made.tables[name][column] = kept
    made.tables["OI_WAVELENGTH"] = {
        n: (f, v[:2], u) for n, (f, v, u) in made.tables["OI_WAVELENGTH"].items()
    }
    with pytest.raises(
        DataError, match=r"has 3 channel\(s\) in a row, its OI_WAVELENGTH 'I' has 2"
    ):
        read_oifits(made.write(tmp_path / "a.fits"))
    del made.tables["OI_WAVELENGTH"]
    with pytest.raises(DataError, match="no OI_WAVELENGTH has that INSNAME"):
        read_oifits(made.write(tmp_path / "a.fits"))


def test_triangle_that_names_a_station_twice_is_flagged(made: HandMade, tmp_path: Path) -> None:
    triangles = made.triangles.copy()
    triangles[0] = [1, 2, 2]
    made.put("OI_T3", "STA_INDEX", triangles)
    assert read_oifits(made.write(tmp_path / "a.fits")).closure_phase.flag.sum() == 3


def test_cut_files_are_unreadable(made: HandMade, tmp_path: Path) -> None:
    raw = made.write(tmp_path / "a.fits").read_bytes()
    path = tmp_path / "cut.fits"
    whole = read_oifits(tmp_path / "a.fits")
    for end in [1000, 2880 + 500, len(raw) // 2, len(raw) - 2881, len(raw) - 3000, len(raw) - 1]:
        path.write_bytes(raw[:end])
        with pytest.raises(DataError, match=r"cut\.fits"):
            read_oifits(path)
    path.write_bytes(raw + b"\0" * 100)
    assert open_oifits(path).trailing_bytes == 100
    assert "100 bytes after the last table" in read_oifits(path).notes
    np.testing.assert_array_equal(read_oifits(path).data, whole.data)


@settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.data())
def test_damaged_bytes_give_an_error_or_data(tmp_path: Path, data: st.DataObject) -> None:
    good = tmp_path / "good.fits"
    if not good.exists():
        made = HandMade(np.random.default_rng(3))
        made.correlate([(1, 2, 0.5)])
        made.write(good)
    raw = bytearray(good.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "damaged.fits"
    path.write_bytes(raw)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        message = ""
        try:
            assert np.isfinite(read_oifits(path).data).all()
        except DataError as error:
            message = str(error)
    assert not message or "damaged.fits" in message
    assert "\n" not in message


@settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(order=st.permutations(range(4)), columns=st.permutations(range(3)))
def test_rows_and_stations_in_any_order(
    tmp_path: Path, order: list[int], columns: list[int]
) -> None:
    """Row order moves entries; station order turns sign and (u, v) as the closure demands."""
    made = HandMade(np.random.default_rng(5))
    plain = read_oifits(made.write(tmp_path / "plain.fits"))
    swapped = made.triangles[order][:, columns]
    parity = np.linalg.det(np.eye(3)[:, columns])
    t = swapped - 1
    uv1, uv2 = made.xy[t[:, 1]] - made.xy[t[:, 0]], made.xy[t[:, 2]] - made.xy[t[:, 1]]
    made.put("OI_T3", "STA_INDEX", swapped)
    made.put("OI_T3", "T3PHI", parity * made.phase_deg[order])
    made.put("OI_T3", "T3PHIERR", made.phase_error_deg[order])
    for name, values in (("U1COORD", uv1[:, 0]), ("V1COORD", uv1[:, 1])):
        made.put("OI_T3", name, values)
    for name, values in (("U2COORD", uv2[:, 0]), ("V2COORD", uv2[:, 1])):
        made.put("OI_T3", name, values)
    other = read_oifits(made.write(tmp_path / "other.fits"))
    where = (np.array(order)[:, None] * 3 + np.arange(3)).ravel()
    np.testing.assert_allclose(other.closure_phase.value, parity * plain.closure_phase.value[where])
    # The data are the same data: chi-squared of the whole does not change.
    np.testing.assert_allclose(
        (plain.covariance.whiten(plain.data) ** 2).sum(),
        (other.covariance.whiten(other.data) ** 2).sum(),
        rtol=1e-6,
    )


def test_public_files(data: Path) -> None:
    expected = {
        "axcir_pionier.oifits": (900, 600, 1350, "assumed"),
        "axcir_pionier_cov.oifits": (900, 600, 1350, "assumed"),
        "niriss_f430m_amical.oifits": (21, 35, 36, "assumed"),
        "contest2008_binary.oifits": (600, 800, 1000, "assumed"),
        "beauty2004.fits": (240, 160, 400, "assumed"),
        "testdata_opt.fits": (2, 1, 3, "assumed"),
    }
    for name, numbers in expected.items():
        found = read_oifits(data / "oifits" / name)
        assert (
            found.n_vis2,
            found.n_closure_phases,
            found.n_independent,
            found.covariance_kind,
        ) == numbers, name
    gravity = open_oifits(data / "oifits" / "gravity_singlesci.fits")
    assert observables_of(gravity, insname="SPECTRO_SC").n_vis2 == 1408
    assert [t.name for t in gravity.unused] == ["OI_VIS", "OI_FLUX", "OI_VIS", "OI_FLUX"]
    with pytest.raises(DataError, match="neither squared visibilities"):
        read_oifits(data / "oifits" / "midi_ngc5128.oifits")
    with pytest.raises(DataError, match=r"truncated\.fits: is cut short"):
        read_oifits(data / "oifits" / "corrupted" / "truncated.fits")


def test_correlations_of_a_public_file_that_contradict_its_triangles(data: Path) -> None:
    """Half of the exposures list their triangles in another order than their CPCOV assumes."""
    path = data / "oifits" / "axcir_pionier_cov.oifits"
    found = read_oifits(path)
    assert any("contradict" in note and "of 50 exposures" in note for note in found.notes)
    with fits.open(path) as hdus:
        diagonal = np.diagonal(hdus["CPCOV"].data, axis1=1, axis2=2).ravel()
    plain = read_oifits(path, closure_covariance="diagonal")
    np.testing.assert_allclose(plain.errors[1] ** 2, diagonal, rtol=1e-6)


def test_values_that_no_calibration_error_explains_are_flagged(
    made: HandMade, tmp_path: Path
) -> None:
    vis2, phase = made.vis2.copy(), made.phase_deg.copy()
    vis2[0, 0], vis2[1, 1], vis2[2, 2], vis2[0, 1], vis2[0, 2] = 1e8, -2e4, 9.0, -999.0, -0.5
    phase[0, 0], phase[1, 1] = 1e20, 350.0
    made.put("OI_VIS2", "VIS2DATA", vis2)
    made.put("OI_T3", "T3PHI", phase)
    data = read_oifits(made.write(tmp_path / "a.fits"))
    assert list(np.flatnonzero(data.vis2.flag)) == [0, 1, 4]
    assert list(np.flatnonzero(data.closure_phase.flag)) == [0]
    note = "values that cannot be used were flagged"
    assert f"OI_VIS2 (extension 4): {note}: 3 without a usable value" in data.notes
    assert f"OI_T3 (extension 5): {note}: 1 without a usable value" in data.notes


@pytest.mark.parametrize(
    ("band", "read", "said"),
    [
        ([-5e-8, 5e-8, 5e-8], [5e-8] * 3, "EFF_BAND is negative: its size is used"),
        ([1e8, 5e-8, np.nan], [0.0, 5e-8, 0.0], "EFF_BAND of 2 channel(s) is no width"),
        ([np.inf, -1.0, 0.0], [0.0] * 3, "EFF_BAND of 2 channel(s) is no width"),
    ],
)
def test_widths_that_are_none(band, read, said: str, made: HandMade, tmp_path: Path) -> None:
    made.put("OI_WAVELENGTH", "EFF_BAND", band)
    data = read_oifits(made.write(tmp_path / "a.fits"))
    np.testing.assert_allclose(data.setups[0].band_m, read, rtol=1e-6)
    assert sum(said in note for note in data.notes) == 1


def test_a_file_without_widths_says_so(made: HandMade, tmp_path: Path) -> None:
    del made.tables["OI_WAVELENGTH"]["EFF_BAND"]
    data = read_oifits(made.write(tmp_path / "a.fits"))
    np.testing.assert_array_equal(data.setups[0].band_m, 0.0)
    assert data.notes == (
        "OI_WAVELENGTH (extension 3) has no EFF_BAND: channels are taken as narrow",
    )


SPELLINGS = {"a": "angstrom", "mum": "um", "sec": "s"}


@pytest.mark.parametrize(("known", "si"), [(LENGTH, "m"), (ANGLE, "rad"), (TIME, "s")])
def test_units_are_worth_what_astropy_says(known: dict[str, float], si: str) -> None:
    for name, factor in known.items():
        spelled = SPELLINGS.get(name, name.replace("metre", "meter"))
        unit = units.Unit(spelled, parse_strict="silent")
        if isinstance(unit, units.UnrecognizedUnit):
            unit = units.Unit(spelled.removesuffix("s"))
        assert factor == pytest.approx(unit.to(si), rel=1e-14), name


@pytest.mark.parametrize("name", ["mas", "arcsec"])
def test_frequencies_are_the_inverse_of_angles(name: str) -> None:
    for form in ("{}-1", "{}^-1", "1/{}", "cycles/{}"):
        factor, _ = scale_of(form.format(name), FREQUENCY, "lambda")
        assert factor * ANGLE[name] == pytest.approx(1.0, rel=1e-12)
    assert ANGLE["arcsec"] == pytest.approx(units.arcsec.to(units.rad), rel=1e-12)


def test_correlations_that_are_no_square_matrices_are_refused(
    made: HandMade, tmp_path: Path
) -> None:
    """Of which as many rows as data are there, (exposures, data, fewer)."""
    made.more.append(fits.ImageHDU(np.zeros((1, 18, 5)), name="V2COV"))
    with pytest.raises(DataError, match="no stack of matrices"):
        read_oifits(made.write(tmp_path / "a.fits"))


def test_integrations_of_several_tables_are_the_fewest() -> None:
    """A covariance of fewer integrations is known less well."""
    headers = [{"AMIBAYES NINT": n} for n in (40, 12, 70)] + [{}]
    assert _integrations([SimpleNamespace(header=h) for h in headers]) == 12  # type: ignore[misc]


def test_sign_of_a_shared_baseline_is_that_of_its_direction() -> None:
    stations = [(0, 1, 2), (0, 1, 3), (1, 0, 4), (3, 4, 5), (2, 6, 0)]
    phases = point_source(
        np.random.default_rng(1).normal(size=(7, 2)), [2e-6], [1e-8], vis2_error=0.1,
        closure_error_rad=0.1,
    ).closure_phase.select(np.arange(5))  # fmt: skip
    phases = replace(phases, stations=np.array(stations))
    found = shared_baseline_sign(phases, np.array([0, 0, 0, 0]), np.array([1, 2, 3, 4]))
    # 2 → 0 closes the first triangle; the last one goes from 0 to 2.
    np.testing.assert_array_equal(found, [1.0, -1.0, 0.0, -1.0])


def test_rows_without_a_date_have_that_of_their_table(tmp_path: Path) -> None:
    """Its night, and the second of it at which they were taken; other rows keep their own."""
    made = HandMade(np.random.default_rng(3))
    mjd = 57000.5 + np.arange(6.0)
    given = mjd.copy()
    given[[1, 4]] = np.nan, 0.0
    made.put("OI_VIS2", "MJD", given)
    made.put("OI_VIS2", "TIME", 3600.0 * np.arange(6))
    found = read_oifits(made.write(tmp_path / "a.fits"))
    night = Time("2014-12-09").mjd
    mjd[[1, 4]] = night + np.array([1.0, 4.0]) / 24.0
    by_row = np.unique(np.stack([found.vis2.row, found.vis2.mjd], axis=1), axis=0)[:, 1]
    np.testing.assert_allclose(by_row, mjd, rtol=0.0, atol=1e-8)
    assert "MJD missing; taken from DATE-OBS and TIME" in " ".join(found.notes)


PER_RADIAN = {
    1.0: "lambda wavelength wavelengths rad-1 rad^-1 1/rad cycles/rad cycle/rad",
    1e3: "klambda kilolambda 1e3lambda",
    1e6: "mlambda megalambda 1e6lambda",
    1e9: "glambda gigalambda 1e9lambda",
}


def test_frequencies_are_numbers_of_wavelengths() -> None:
    for factor, names in PER_RADIAN.items():
        for name in names.split():
            assert scale_of(f" {name.title()} ", FREQUENCY, "lambda") == (factor, True)
    assert scale_of("", FREQUENCY, "klambda") == (1e3, True)
    assert scale_of("furlong", FREQUENCY, "klambda") == (1e3, False)


@pytest.mark.parametrize(
    ("unit", "u", "metres"),
    [("", 9e4, 9e4), ("m", 9e4, 9e4), ("km", 90.0, 9e4), ("furlong", 9e4, 9e4),
     ("", 1.3e5, 0.52), ("m", 1.3e5, 0.52), ("MLAMBDA", 0.13, 0.52), ("rad-1", 9e4, 0.36)],
)  # fmt: skip
def test_baselines_of_a_hundred_kilometres_are_numbers_of_wavelengths(
    unit: str, u: float, metres: float
) -> None:
    """Of light of 4 µm; one row that is wrong says nothing of the unit."""
    values = np.array([u, -u, u, 1e12 * u, np.nan])
    table = SimpleNamespace(units={"UCOORD": unit}, label="OI_VIS2")
    found, note = _in_metres(SimpleNamespace(path=""), table, "UCOORD", values, np.array([4e-6]))  # type: ignore[arg-type]
    np.testing.assert_allclose(found[:3], [metres, -metres, metres])
    assert ("in wavelengths" in note) == (metres < 1.0)
    assert ("read as m" in note) == (unit == "furlong")
    if metres < 1.0:
        with pytest.raises(DataError, match="there are 2 channels"):
            _in_metres(
                SimpleNamespace(path=""),
                table,
                "UCOORD",
                values,
                np.array([4e-6, 5e-6]),  # type: ignore[arg-type]
            )


def test_triangles_of_one_shape_get_their_places_one_after_the_other() -> None:
    """Three places on a line of telescopes; one of another shape has stations of its own."""
    places = np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0], [4.0, 0.0], [0.0, 7.0], [1.0, 7.0],
                       [3.0, 7.0]])  # fmt: skip
    step = np.array([[1.0, 0.0], [2.0, 0.0], [-3.0, 0.0]])
    other = np.array([[5.0, 1.0], [0.0, 2.0], [-5.0, -3.0]])
    stations = 10 + np.arange(7)
    found, total = _corners(np.array([step, step, other, step]), [places], [stations], 1e-3, 20)
    assert found.tolist() == [[10, 11, 12], [14, 15, 16], [20, 21, 22], [10, 11, 12]]
    assert total == 23


@pytest.mark.parametrize(
    ("asked", "there", "found"),
    [
        ("I", ("I",), 0),
        ("i  ", ("J", "I"), 1),
        (None, ("J",), 0),
        (None, ("J", "I"), None),
        ("K", ("J",), None),
        ("I", ("I", "I"), 0),
    ],
)
def test_wavelengths_are_those_of_the_instrument_that_is_named(
    asked: str | None, there: tuple[str, ...], found: int | None
) -> None:
    """A table that names none has those of the file, if there is one set of them."""

    class Table(SimpleNamespace):
        label, extver = "OI_VIS2", 1

        def keyword(self, _: str) -> str | None:
            return self.name

        def __len__(self) -> int:
            return 3

    tables = [Table(name=name) for name in there]
    oifits = SimpleNamespace(named=lambda _: tables, path="")
    if found is None:
        with pytest.raises(DataError, match="no OI_WAVELENGTH has that INSNAME"):
            wavelength_table(oifits, Table(name=asked), 3)  # type: ignore[arg-type]
    else:
        assert wavelength_table(oifits, Table(name=asked), 3) is tables[found]  # type: ignore[arg-type]


DAY = 57000.0
"""2014-12-09."""


@pytest.mark.parametrize(
    ("mjd", "seconds", "unit", "date", "expected", "words"),
    [
        ([DAY + 0.25, DAY + 0.5], [0.0, 60.0], "s", "2014-12-09", [0.25, 0.5], ""),
        ([DAY, DAY], [0.0, 864.0], "s", "2014-12-09", [0.0, 0.01], "MJD is a date"),
        ([DAY, DAY], [2.0, 2.5], "s", "", [2.0 / 86400, 2.5 / 86400], "MJD is a date"),
        ([DAY, DAY], [0.0, 14.4], "min", "", [0.0, 0.01], "MJD is a date"),
        ([DAY, DAY], [864.0, 864.0], "s", "2014-12-09", [0.0, 0.0], ""),
        ([DAY, DAY + 0.5], [0.0, 864.0], "s", "2014-12-09", [0.0, 0.5], ""),
        ([0.0, DAY + 0.5], [864.0, 1.0], "s", "2014-12-09", [0.01, 0.5], "MJD missing"),
        ([np.nan, DAY + 0.5], [864.0, 1.0], "s", "2014-12-09", [0.01, 0.5], "MJD missing"),
        (None, [864.0, 1728.0], "s", "2014-12-09", [0.01, 0.02], "MJD missing"),
        (None, [864.0, 1728.0], "s", "", [0.01 - DAY, 0.02 - DAY], "no date"),
        ([0.0, DAY + 0.5], [864.0, 1.0], "s", "", [0.01 - DAY, 0.5], "no date"),
    ],
)
def test_dates_are_of_mjd_or_of_the_clock_and_the_day(
    mjd: list[float] | None,
    seconds: list[float],
    unit: str,
    date: str,
    expected: list[float],
    words: str,
) -> None:
    """Days from `DAY`; without any date rows keep their order."""

    class Rows(SimpleNamespace):
        def __len__(self) -> int:
            return 2

    columns = {"TIME": np.array(seconds)} | ({} if mjd is None else {"MJD": np.array(mjd)})
    rows = Rows(columns=columns, units={"TIME": unit}, label="OI_T3", keyword=lambda _: date)
    found, note = times_of(rows)  # type: ignore[arg-type]
    np.testing.assert_allclose(found - DAY, expected, atol=1e-9)
    assert words in note
    assert bool(note) == bool(words)


@pytest.mark.parametrize(
    ("asked", "there", "found"),
    [("", ("X",), 0), ("", ("X", "Y"), None), ("", (), None), ("y ", ("X", "Y"), 1),
     ("Z", ("X",), None)],
)  # fmt: skip
def test_an_array_is_the_one_that_is_named_or_the_only_one(
    asked: str, there: tuple[str, ...], found: int | None
) -> None:
    arrays = [SimpleNamespace(keyword=lambda _, n=name: n) for name in there]
    oifits = SimpleNamespace(named=lambda _: arrays)
    array = array_table(oifits, SimpleNamespace(keyword=lambda _: asked))  # type: ignore[arg-type]
    assert array is (None if found is None else arrays[found])


def test_a_file_that_names_no_target_has_one(made: HandMade, tmp_path: Path) -> None:
    del made.tables["OI_TARGET"]
    for name in ("OI_VIS2", "OI_T3"):
        del made.tables[name]["TARGET_ID"]
    data = read_oifits(made.write(tmp_path / "a.fits"))
    assert {s.target for s in data.setups} == {"target 1"}
    assert data.n_vis2 == 18

"""Writing OIFITS 2: nothing is lost, and other programs can read it."""

from __future__ import annotations

import warnings
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from helpers import niriss
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oi_builders import diagonal, random_observables

from amibayes.data.assumed_covariance import covariance_of_errors
from amibayes.data.covariance import dense_covariance, diagonal_covariance
from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables, join
from amibayes.data.setup import Setup
from amibayes.errors import DataError, RunError, UsageError
from amibayes.oifits import read_oifits, write_oifits
from amibayes.oifits.layout import grids_of
from amibayes.oifits.off_axis import LATTICE, RESPONSE, with_response
from amibayes.oifits.tables import OWN_KEY

DEGREE = np.pi / 180


def assert_identical(a: Observables, b: Observables) -> None:
    for name in ("vis2", "closure_phase"):
        first, second = getattr(a, name), getattr(b, name)
        for field in fields(Measurements):
            np.testing.assert_array_equal(
                getattr(first, field.name), getattr(second, field.name), f"{name}.{field.name}"
            )
    assert len(a.setups) == len(b.setups)
    for one, other in zip(a.setups, b.setups, strict=True):
        for field in fields(one):
            if field.name != "source":
                np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
    np.testing.assert_array_equal(a.covariance.dense(), b.covariance.dense())
    assert a.covariance.rank == b.covariance.rank
    assert a.covariance_kind == b.covariance_kind
    assert a.n_integrations == b.n_integrations


def round_trip(observables: Observables, path: Path) -> Observables:
    write_oifits(path, observables, overwrite=True)
    back = read_oifits(path)
    assert_identical(observables, back)
    return back


@pytest.mark.parametrize("kind", ["given", "estimated", "assumed", "diagonal"])
def test_round_trip_is_identical(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    observables = random_observables(rng, kind=kind)
    back = round_trip(observables, tmp_path / "a.fits")
    x = rng.normal(size=(observables.covariance.size, 4))
    np.testing.assert_allclose(
        (observables.covariance.whiten(x) ** 2).sum(0), (back.covariance.whiten(x) ** 2).sum(0)
    )
    # And once more, from what was read.
    round_trip(back, tmp_path / "b.fits")


@pytest.mark.parametrize("kind", ["assumed", "diagonal"])
def test_channels_and_exposures(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    observables = random_observables(rng, n_stations=4, n_channels=5, n_exposures=3, kind=kind)
    round_trip(observables, tmp_path / "a.fits")


def flag_some(observables: Observables, rng: np.random.Generator) -> Observables:
    """Flag a third; the covariance follows. The flagged values are anything at all."""
    v, c = observables.vis2, observables.closure_phase
    keep_v, keep_c = rng.random(len(v)) < 0.7, rng.random(len(c)) < 0.7
    covariance = observables.select(keep_v, keep_c).covariance
    value = c.value.copy()
    value[~keep_c] = rng.choice([np.nan, 1e300, 0.0, -1.0], (~keep_c).sum())
    return replace(
        observables,
        vis2=replace(v, flag=~keep_v),
        closure_phase=replace(c, flag=~keep_c, value=value),
        covariance=covariance,
    )


@pytest.mark.parametrize("kind", ["given", "estimated", "assumed", "diagonal"])
def test_flags(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    round_trip(flag_some(random_observables(rng, kind=kind), rng), tmp_path / "a.fits")


def test_several_setups_of_one_name(rng: np.random.Generator, tmp_path: Path) -> None:
    parts = [
        random_observables(rng, kind="given"),
        random_observables(rng, kind="assumed", n_channels=2, n_exposures=2),
        random_observables(rng, kind="estimated", n_stations=5),
        diagonal(random_observables(rng, kind="given", n_stations=4)),
    ]
    parts = [replace(p, setups=(replace(p.setups[0], target="T"),)) for p in parts]
    for subset in (parts[:1], parts[:3], parts, parts[3:] + parts[:1]):
        whole = join(subset)
        back = round_trip(whole, tmp_path / "a.fits")
        assert [s.insname for s in back.setups] == ["NRM"] * len(subset)


def test_same_instrument_twice_stays_two_setups(rng: np.random.Generator, tmp_path: Path) -> None:
    one = random_observables(rng, kind="given")
    later = replace(one, vis2=replace(one.vis2, mjd=one.vis2.mjd + 1))
    round_trip(join([one, later]), tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits") as hdus:
        assert sum(h.name == "OI_WAVELENGTH" for h in hdus) == 1


def test_entries_out_of_order_and_rows_with_gaps(rng: np.random.Generator, tmp_path: Path) -> None:
    whole = random_observables(rng, n_stations=5, n_channels=3, kind="assumed")
    v = whole.vis2
    shuffled = rng.permutation(len(v))[: len(v) - 4]
    covariance = whole.covariance.select(
        np.concatenate([shuffled, len(v) + np.arange(len(whole.closure_phase))])
    )
    observables = replace(whole, vis2=v.select(shuffled), covariance=covariance)
    round_trip(observables, tmp_path / "a.fits")


def test_targets_are_told_apart(rng: np.random.Generator, tmp_path: Path) -> None:
    parts = [random_observables(rng, kind="given") for _ in range(2)]
    named = [
        replace(p, setups=(replace(p.setups[0], target=t),))
        for p, t in zip(parts, ("A", "B"), strict=True)
    ]
    write_oifits(tmp_path / "a.fits", join(named))
    with pytest.raises(DataError, match="several targets: A, B"):
        read_oifits(tmp_path / "a.fits")
    for part, name in zip(named, ("A", "B"), strict=True):
        assert_identical(part, read_oifits(tmp_path / "a.fits", target=name))


def test_stations_without_positions_and_from_zero(rng: np.random.Generator, tmp_path: Path) -> None:
    observables = random_observables(rng, kind="given")
    bare = replace(
        observables.setups[0],
        station_xyz_m=None,
        station_diameter_m=None,
        arrname="",
        target="",
        station_index=np.arange(7),
    )
    write_oifits(tmp_path / "a.fits", replace(observables, setups=(bare,)))
    back = read_oifits(tmp_path / "a.fits")
    assert back.setups[0].station_xyz_m is None
    assert back.setups[0].station_diameter_m is None
    assert back.setups[0].arrname == ""
    np.testing.assert_array_equal(back.vis2.stations, observables.vis2.stations)
    np.testing.assert_array_equal(back.covariance.dense(), observables.covariance.dense())


@settings(
    max_examples=10,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    phases=st.lists(
        st.floats(-1e4, 1e4).filter(lambda x: x == 0 or abs(x) > 1e-300), min_size=10, max_size=10
    ).filter(any),  # all of them 0 stand for none
    sigmas=st.lists(st.floats(1e-9, 3.0), min_size=20, max_size=20),
)
def test_every_double_comes_back(tmp_path: Path, phases: list[float], sigmas: list[float]) -> None:
    base = random_observables(np.random.default_rng(0), n_stations=5, kind="diagonal")
    closure = replace(base.closure_phase, value=np.array(phases))
    sigma = np.array(sigmas)
    for kind in ("diagonal", "assumed"):
        observables = replace(
            base,
            closure_phase=closure,
            covariance=covariance_of_errors(sigma[:10], closure, sigma[10:], kind),  # type: ignore[arg-type]
            covariance_kind=kind,
        )
        round_trip(observables, tmp_path / "a.fits")


def test_degrees_alone_could_not_hold_every_phase() -> None:
    """Why the remainders are kept: some doubles are the image of no double in degrees."""
    radians = np.linspace(0.1, 3.0, 1000)
    degrees = radians / DEGREE
    near = np.stack([np.nextafter(degrees, -np.inf), degrees, np.nextafter(degrees, np.inf)])
    assert np.any((near * DEGREE != radians).all(axis=0))


def test_asking_for_diagonal_overrules_the_file(rng: np.random.Generator, tmp_path: Path) -> None:
    observables = random_observables(rng, kind="given")
    write_oifits(tmp_path / "a.fits", observables)
    back = read_oifits(tmp_path / "a.fits", closure_covariance="diagonal")
    assert back.covariance.independent
    np.testing.assert_array_equal(back.covariance.variance, observables.covariance.variance)
    assert "correlations of the file set aside" in back.notes


def test_only_vis2_or_only_closures(rng: np.random.Generator, tmp_path: Path) -> None:
    observables = random_observables(rng, kind="given")
    for kind in ("vis2", "cp"):
        round_trip(observables.only([kind]), tmp_path / "a.fits")


def test_dense_vis2_without_basis(rng: np.random.Generator, tmp_path: Path) -> None:
    observables = random_observables(rng, kind="given").only(["vis2"])
    root = rng.normal(size=(21, 60)) * 0.01
    round_trip(
        replace(observables, covariance=dense_covariance(root @ root.T)), tmp_path / "a.fits"
    )


def test_existing_files_and_bad_folders(rng: np.random.Generator, tmp_path: Path) -> None:
    observables = random_observables(rng)
    path = tmp_path / "a.fits"
    write_oifits(path, observables)
    before = path.read_bytes()
    with pytest.raises(UsageError, match="is there already"):
        write_oifits(path, observables)
    assert path.read_bytes() == before
    with pytest.raises(RunError, match="cannot be written"):
        write_oifits(tmp_path / "none" / "a.fits", observables)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.fits"]


def test_names_in_other_alphabets_are_escaped(rng: np.random.Generator, tmp_path: Path) -> None:
    """FITS has printable ASCII alone; ä is U+00E4, ★ is U+2605."""
    data = random_observables(rng)
    names = {"target": "ä Orionis", "insname": "MÄSK_K", "arrname": "Ä★"}
    setups = tuple(replace(setup, **names) for setup in data.setups)
    header = {"HIERARCH AMIBAYES SOURCE1": "täräget\tone.fits", "OBSERVER": "a\\b"}
    write_oifits(tmp_path / "ä.fits", replace(data, setups=setups), header=header)
    back = read_oifits(tmp_path / "ä.fits")
    assert back.setups[0].target == "\\xe4 Orionis"
    assert back.setups[0].insname == "M\\xc4SK_K"
    assert back.setups[0].arrname == "\\xc4\\u2605"
    np.testing.assert_array_equal(back.data, data.data)
    written = fits.getheader(tmp_path / "ä.fits")
    assert written["AMIBAYES SOURCE1"] == "t\\xe4r\\xe4get\\tone.fits"
    assert written["OBSERVER"] == "a\\b"


def test_interrupted_writing_leaves_nothing(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fits.HDUList, "writeto", full)
    with pytest.raises(RunError, match="No space left"):
        write_oifits(tmp_path / "a.fits", random_observables(rng))
    assert not list(tmp_path.iterdir())


def test_same_data_give_the_same_bytes(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    observables = random_observables(rng)
    for name in ("a.fits", "b.fits"):
        write_oifits(tmp_path / name, observables)
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()
    assert fits.getheader(tmp_path / "a.fits")["DATE"] == "1970-01-02"


def test_inconsistent_containers_are_refused(rng: np.random.Generator, tmp_path: Path) -> None:
    good = random_observables(rng, n_channels=2, kind="assumed")
    for change, fault in (
        ({"mjd": good.vis2.mjd + np.arange(len(good.vis2))}, "mjd differs"),
        ({"wavelength_m": good.vis2.wavelength_m * 1.1}, "wavelength_m of OI_VIS2"),
        ({"row": np.zeros(len(good.vis2), dtype=np.intp)}, "same setup, row and channel"),
    ):
        with pytest.raises(ValueError, match=fault):
            write_oifits(tmp_path / "a.fits", replace(good, vis2=replace(good.vis2, **change)))


# The standard once more, from the published tables (Duvert et al. 2017) and not from the package.
PUBLISHED = {
    "OI_TARGET": (
        2,
        "",
        "TARGET_ID:I TARGET:A RAEP0:D DECEP0:D EQUINOX:E RA_ERR:D DEC_ERR:D SYSVEL:D VELTYP:A "
        "VELDEF:A PMRA:D PMDEC:D PMRA_ERR:D PMDEC_ERR:D PARALLAX:E PARA_ERR:E SPECTYP:A",
    ),
    "OI_ARRAY": (
        2,
        "ARRNAME FRAME ARRAYX ARRAYY ARRAYZ",
        "TEL_NAME:A STA_NAME:A STA_INDEX:I DIAMETER:E STAXYZ:3D FOV:D FOVTYPE:A",
    ),
    "OI_WAVELENGTH": (2, "INSNAME", "EFF_WAVE:E EFF_BAND:E"),
    "OI_VIS2": (
        2,
        "DATE-OBS ARRNAME INSNAME CORRNAME",
        "TARGET_ID:I TIME:D MJD:D INT_TIME:D VIS2DATA:WD VIS2ERR:WD CORRINDX_VIS2DATA:J "
        "UCOORD:D VCOORD:D STA_INDEX:2I FLAG:WL",
    ),
    "OI_T3": (
        2,
        "DATE-OBS ARRNAME INSNAME CORRNAME",
        "TARGET_ID:I TIME:D MJD:D INT_TIME:D T3AMP:WD T3AMPERR:WD T3PHI:WD T3PHIERR:WD "
        "CORRINDX_T3PHI:J U1COORD:D V1COORD:D U2COORD:D V2COORD:D STA_INDEX:3I FLAG:WL",
    ),
    "OI_CORR": (1, "CORRNAME NDATA", "IINDX:J JINDX:J CORR:D"),
}
UNITS = {
    "m": "EFF_WAVE EFF_BAND UCOORD VCOORD U1COORD V1COORD U2COORD V2COORD STAXYZ DIAMETER",
    "deg": "T3PHI T3PHIERR RAEP0 DECEP0",
    "s": "TIME INT_TIME",
    "day": "MJD",
    "deg/yr": "PMRA PMDEC",
}
PRIMARY = "ORIGIN DATE DATE-OBS CONTENT TELESCOP INSTRUME OBSERVER OBJECT INSMODE"


def test_conforms_to_the_published_standard(rng: np.random.Generator, tmp_path: Path) -> None:
    channels = 3
    path = tmp_path / "a.fits"
    write_oifits(path, random_observables(rng, n_channels=channels, kind="assumed"))
    with fits.open(path) as hdus:
        hdus.verify("exception")
        assert all(hdus[0].header[k] for k in PRIMARY.split())
        assert hdus[0].header["CONTENT"] == "OIFITS2"
        assert {h.name for h in hdus[1:]} == set(PUBLISHED)
        for hdu in hdus[1:]:
            revision, keywords, columns = PUBLISHED[hdu.name]
            assert hdu.header["OI_REVN"] == revision
            assert all(str(hdu.header[k]).strip() for k in keywords.split()), hdu.name
            for text in columns.split():
                name, form = text.split(":")
                column = hdu.columns[name]
                size = channels if "W" in form else int(form[:-1] or 1)
                letter, count = column.format[-1], int(column.format[:-1] or 1)
                assert letter == form[-1], name
                assert letter == "A" or count == size, name
                unit = next((u for u, names in UNITS.items() if name in names.split()), None)
                assert unit is None or column.unit == unit, name
            extra = set(hdu.columns.names) - {t.split(":")[0] for t in columns.split()}
            assert all(name.startswith("NS_") for name in extra)


def test_correlations_follow_the_published_definition(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """CORR σᵢσⱼ of plain columns in degrees is the covariance, without any column of ours."""
    observables = random_observables(rng, kind="given")
    write_oifits(tmp_path / "a.fits", observables)
    with fits.open(tmp_path / "a.fits") as hdus:
        vis2, t3, corr = (hdus[n] for n in ("OI_VIS2", "OI_T3", "OI_CORR"))
        sigma = np.concatenate([vis2.data["VIS2ERR"], t3.data["T3PHIERR"] * DEGREE])
        index = np.concatenate([vis2.data["CORRINDX_VIS2DATA"], t3.data["CORRINDX_T3PHI"]])
        np.testing.assert_array_equal(index, np.arange(1, 57))
        assert corr.header["NDATA"] == 56
        matrix = np.eye(56)
        i, j = corr.data["IINDX"] - 1, corr.data["JINDX"] - 1
        assert (i < j).all()
        matrix[i, j] = matrix[j, i] = corr.data["CORR"]
    np.testing.assert_allclose(
        matrix * np.outer(sigma, sigma), observables.covariance.dense(), rtol=1e-14
    )


def test_independent_reader(rng: np.random.Generator, tmp_path: Path) -> None:
    reader = pytest.importorskip("oifits")
    if not hasattr(reader, "oifits"):
        pytest.skip("another package of the name oifits is installed")
    first = random_observables(rng, kind="given")
    second = random_observables(rng, n_channels=3, kind="assumed")
    setup = replace(
        first.setups[0],
        insname="OTHER",
        wavelength_m=second.setups[0].wavelength_m,
        band_m=second.setups[0].band_m,
    )
    observables = join([first, replace(second, setups=(setup,))])
    path = tmp_path / "a.fits"
    write_oifits(path, observables)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = reader.open(str(path), quiet=True)
        assert found.isvalid()
        assert found.isconsistent()
        assert found.getoifitsver() == 2
    vis2 = np.concatenate([np.ma.getdata(row.vis2data) for row in found.vis2])
    np.testing.assert_array_equal(vis2, observables.vis2.value)
    phase = np.concatenate([np.ma.getdata(row.t3phi) for row in found.t3])
    np.testing.assert_allclose(phase * DEGREE, observables.closure_phase.value, rtol=1e-14)
    assert [len(w.eff_wave) for w in found.wavelength.values()] == [1, 3]
    stations = [[s.sta_name for s in row.station] for row in found.t3][:35]
    names = observables.setups[0].stations
    assert stations == [[names[i] for i in t] for t in observables.closure_phase.stations[:35]]
    (table,) = found.corr.values()
    assert len(table.corr) == np.count_nonzero(np.triu(observables.covariance.dense(), 1))


@pytest.mark.parametrize(
    "name",
    [
        "axcir_pionier.oifits",
        "axcir_pionier_cov.oifits",
        "niriss_f430m_amical.oifits",
        "testdata_opt.fits",
        "created_v2.fits",
        "gravity_singlesci.fits",
    ],
)
def test_public_files_round_trip(name: str, data: Path, tmp_path: Path) -> None:
    for kind in ("assumed", "diagonal"):
        observables = read_oifits(data / "oifits" / name, closure_covariance=kind)
        round_trip(observables, tmp_path / "a.fits")


def test_frame_of_the_stations_is_kept(rng: np.random.Generator, tmp_path: Path) -> None:
    """Geocentric coordinates stay geocentric; those of a mask are on the sky."""
    data = random_observables(rng)
    write_oifits(tmp_path / "sky.fits", data)
    assert fits.getheader(tmp_path / "sky.fits", "OI_ARRAY")["FRAME"] == "SKY"
    centre = (1942042.8, -5455305.9, -2654521.4)
    setup = replace(data.setups[0], array_frame="GEOCENTRIC", array_centre_m=centre)
    write_oifits(tmp_path / "a.fits", replace(data, setups=(setup,)))
    again = read_oifits(tmp_path / "a.fits")
    assert again.setups[0].array_frame == "GEOCENTRIC"
    assert again.setups[0].array_centre_m == centre


def test_entries_of_two_tables_of_one_file_stay_apart(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """A table that another program has copied into the file: both say the same places."""
    data = random_observables(rng, n_stations=5, kind="diagonal")
    order = rng.permutation(len(data.vis2))
    shuffled = replace(
        data,
        vis2=data.vis2.select(order),
        covariance=diagonal_covariance(
            np.concatenate([data.errors[0][order], data.errors[1]]) ** 2
        ),
    )
    write_oifits(tmp_path / "a.fits", shuffled)
    np.testing.assert_array_equal(read_oifits(tmp_path / "a.fits").vis2.value, shuffled.vis2.value)
    with fits.open(tmp_path / "a.fits") as hdus:
        again = hdus["OI_VIS2"].copy()
        again.data["VIS2DATA"] += 1.0
        hdus.append(again)
        hdus.writeto(tmp_path / "b.fits")
    first, second = np.split(read_oifits(tmp_path / "b.fits").vis2.value, 2)
    np.testing.assert_allclose(second, first + 1.0)
    np.testing.assert_allclose(np.sort(first), np.sort(data.vis2.value))


def test_rows_without_a_date_have_the_same_in_every_channel() -> None:
    """That no channel knows the date is no difference; stations and dates that differ are."""
    data = niriss(channels=3)
    unknown = [
        replace(m, mjd=np.full(len(m), np.nan), integration_s=np.full(len(m), np.nan))
        for m in (data.vis2, data.closure_phase)
    ]
    grids = grids_of(replace(data, vis2=unknown[0], closure_phase=unknown[1]))
    assert [len(g.first) for g in grids] == [21, 35]
    for name, fault in (("mjd", 60000.5), ("u_m", 3.0), ("stations", 5)):
        values = getattr(data.vis2, name).copy()
        values[1] = fault
        wrong = replace(data, vis2=replace(data.vis2, **{name: values}))
        with pytest.raises(ValueError, match=f"{name} differs between the channels"):
            grids_of(wrong)


def test_a_response_belongs_to_its_setup_and_is_of_single_samples_unless_told() -> None:
    """Opposite places of the lattice are conjugate, and so are the two orders of a pair."""
    setup, rng = niriss().setups[0], np.random.default_rng(5)
    half = rng.standard_normal((2, 41)) + 1j * rng.standard_normal((2, 41))
    index = np.array([[setup.station_index[0], setup.station_index[2]], [99, 100]])
    lattice = {f"{OWN_KEY} {key}": float(k) for k, key in enumerate(LATTICE)}

    def read(own: int, **header: object) -> Setup:
        table = SimpleNamespace(
            name=RESPONSE,
            header=lattice | {f"{OWN_KEY} {k}": v for k, v in ({"SETUP": 2} | header).items()},
            columns={"STA_INDEX": index, "COEFF": half},
        )
        return with_response(SimpleNamespace(tables=[table]), setup, own)  # type: ignore[arg-type]

    assert read(0) is read(1) is setup
    for header, single, method in (
        ({}, True, ""),
        ({"SINGLE": False, "METHOD": "fringes"}, False, "fringes"),
        ({"SINGLE": True}, True, ""),
    ):
        found = read(2, **header).response
        assert found is not None
        assert (found.single, found.method) == (single, method)
        image = found.coefficients[0, 2]
        np.testing.assert_allclose(image.ravel()[:41], half[0], rtol=1e-6)
        np.testing.assert_allclose(image[::-1, ::-1].conj().ravel()[:40], half[0, :40], rtol=1e-6)
        np.testing.assert_array_equal(found.coefficients[2, 0], image.conj())
        assert np.count_nonzero(found.coefficients) == 2 * 81

"""Files for image reconstruction: complete, plain, and readable by others."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.errors import DataError, UsageError
from amibayes.oifits import read_oifits
from amibayes.oifits.audit import audit
from amibayes.oifits.export import export, triple_amplitudes, write_export
from amibayes.units import MAS

STATIONS = np.array([(0.0, 0.0), (30.0, 10.0), (-20.0, 60.0), (80.0, -40.0)])


def epoch(rng: np.random.Generator, mjd: float = 6e4, name: str = "STAR") -> Observables:
    sheet = point_source(
        STATIONS, [1.6e-6, 1.7e-6], [5e-8] * 2, vis2_error=0.02, closure_error_rad=0.03, mjd=mjd
    )
    noise = sheet.covariance.draw(rng, 1)[:, 0]
    n = len(sheet.vis2)
    return replace(
        sheet,
        vis2=replace(sheet.vis2, value=rng.uniform(0.3, 0.9, n)),
        closure_phase=replace(sheet.closure_phase, value=7.0 + noise[n:]),
        setups=(replace(sheet.setups[0], target=name),),
    )


def with_flags(star: Observables) -> Observables:
    """A row of V² and one cell flagged and without number."""
    flag, value = star.vis2.flag.copy(), star.vis2.value.copy()
    flag[[0, 1, 4]], value[[0, 1, 4]] = True, np.nan
    keep = np.flatnonzero(np.r_[~flag, np.ones(len(star.closure_phase), bool)])
    return replace(
        star,
        vis2=replace(star.vis2, flag=flag, value=value),
        covariance=star.covariance.select(keep),
    )


@pytest.mark.parametrize("program", ["irbis", "squeeze", "mira"])
def test_a_plain_file(program: str, rng: np.random.Generator, tmp_path: Path) -> None:
    star = with_flags(epoch(rng))
    exported = export([star, epoch(rng, 60001.3)], program)  # type: ignore[arg-type]
    path = tmp_path / "a.oifits"
    write_export(path, exported)
    with fits.open(path) as hdus:
        names = [h.name for h in hdus[1:]]
        assert set(names) == {"OI_TARGET", "OI_ARRAY", "OI_WAVELENGTH", "OI_VIS2", "OI_T3"}
        assert len(hdus["OI_TARGET"].data) == 1
        for hdu in hdus[1:]:
            for column in hdu.columns.names:
                assert not column.startswith("NS_")
                if hdu.data[column].dtype.kind == "f":
                    assert np.isfinite(hdu.data[column]).all(), column
            assert not any(key.startswith("AMIBAYES") for key in hdu.header)
        assert (hdus[0].header.get("ESO PRO CATG") == "TARGET_CAL_INT") == (program == "irbis")
        assert hdus["OI_VIS2"].data["FLAG"].sum() == 1
        assert np.abs(hdus["OI_T3"].data["T3PHI"]).max() <= 180
    # What is exported is what was there, but for whole turns.
    back = read_oifits(path, closure_covariance="diagonal")
    np.testing.assert_array_equal(
        back.vis2.value[~back.vis2.flag][:9], star.vis2.value[~star.vis2.flag]
    )
    turns = (back.closure_phase.value[:8] - star.closure_phase.value) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    assert {f.code for f in audit(path).findings} <= {"closures-as-independent", "errors-too-small"}


def test_an_independent_reader_opens_it(rng: np.random.Generator, tmp_path: Path) -> None:
    reader = pytest.importorskip("oifits")
    if not hasattr(reader, "oifits"):
        pytest.skip("another package of the name oifits is installed")
    star = epoch(rng)
    later = replace(epoch(rng, 60002.0), setups=star.setups)
    for program in ("irbis", "squeeze", "mira"):
        path = tmp_path / f"{program}.oifits"
        write_export(path, export([star, later], program))  # type: ignore[arg-type]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = reader.open(str(path), quiet=True)
            assert found.isvalid()
        assert len(found.vis2) == 12
        assert len(found.t3) == 8
        assert {t.target for t in found.target} == {"STAR"}
        np.testing.assert_array_equal(
            np.concatenate([np.ma.getdata(v.vis2data) for v in found.vis2][:6]), star.vis2.value
        )


def test_triple_amplitudes_against_products(rng: np.random.Generator) -> None:
    star = epoch(rng)
    amplitude, error, apart = triple_amplitudes(star)
    pairs = star.vis2.stations[::2].tolist()
    vis2 = {tuple(p): star.vis2.value[2 * i : 2 * i + 2] for i, p in enumerate(pairs)}
    for i in range(0, 8, 2):
        a, b, c = star.closure_phase.stations[i].tolist()
        product = vis2[a, b] * vis2[b, c] * vis2[a, c]
        np.testing.assert_allclose(amplitude[i : i + 2], np.sqrt(product))
        relative = sum((0.02 / (2 * vis2[pair])) ** 2 for pair in ((a, b), (b, c), (a, c)))
        np.testing.assert_allclose(error[i : i + 2], np.sqrt(product * relative))
    assert apart == 0.0


def test_amplitude_that_vis2_cannot_give(rng: np.random.Generator) -> None:
    amplitude, error, _ = triple_amplitudes(with_flags(epoch(rng)))
    lost = error == 1e3
    # Baseline 0-1 (flagged) is in the first two triangles, 0-3 (first channel) in two.
    np.testing.assert_array_equal(
        lost.reshape(4, 2), [[True, True], [True, True], [True, False], [False, False]]
    )
    assert (amplitude[lost] == 1).all()


def test_suggested_image(rng: np.random.Generator) -> None:
    star = epoch(rng)
    frequency = np.hypot(star.vis2.u_m[:, 0], star.vis2.v_m[:, 0]) / star.vis2.wavelength_m
    for program in ("irbis", "squeeze", "mira"):
        found = export([star], program)  # type: ignore[arg-type]
        resolution = 1 / frequency.max() / MAS
        assert resolution / 5 < found.pixel_mas <= resolution / 4
        assert found.field_mas >= 2 / frequency.min() / MAS
        assert found.field_mas == pytest.approx(found.pixel_mas * found.n_pixels)
        assert found.wavelength_um == pytest.approx((1.575, 1.725))
    assert np.log2(export([star], "irbis").n_pixels) % 1 == 0


def test_commands(rng: np.random.Generator) -> None:
    star = epoch(rng)
    squeeze = export([star], "squeeze").command("my file.oifits")
    assert squeeze.startswith("squeeze 'my file.oifits' -s ")
    assert "-novis -not3amp" in squeeze
    mira = export([star], "mira").command("a.oifits")
    assert mira.startswith("ymira -pixelsize=")
    assert mira.endswith("a.oifits a-image.fits")
    irbis = export([star], "irbis")
    assert "--lambda_from=1.5750 --lambda_to=1.7250" in irbis.command("x/a.oifits")
    assert irbis.command("x/a.oifits").endswith("x/a.sof")
    assert irbis.set_of_frames("x/a.oifits") == "x/a.oifits TARGET_CAL_INT\n"


def test_names_are_made_one(rng: np.random.Generator) -> None:
    found = export([epoch(rng), epoch(rng, name="HD 1")], "mira")
    assert found.target == "STAR"
    assert "HD 1 written as STAR" in found.notes
    assert len(found.hdus["OI_TARGET"].data) == 1


def test_without_closure_phases(rng: np.random.Generator, tmp_path: Path) -> None:
    for kind, missing in (("vis2", "closure phases"), ("cp", "squared visibilities")):
        with pytest.raises(DataError, match=f"has no usable {missing}"):
            export([epoch(rng).only([kind])], "mira")
    write_export(tmp_path / "a.oifits", export([epoch(rng)], "mira"))
    with pytest.raises(UsageError, match="is there already"):
        write_export(tmp_path / "a.oifits", export([epoch(rng)], "mira"))


@pytest.mark.slow
def test_public_files(data: Path, tmp_path: Path) -> None:
    for name in ("axcir_pionier.oifits", "contest2008_binary.oifits", "gravity_singlesci.fits"):
        observables = read_oifits(data / "oifits" / name)
        for program in ("irbis", "squeeze", "mira"):
            path = tmp_path / f"{program}-{name}"
            write_export(path, export([observables], program))  # type: ignore[arg-type]
            back = read_oifits(path)
            assert back.n_vis2 == observables.n_vis2
            assert back.n_closure_phases == observables.n_closure_phases


def test_days_between_amplitudes_and_phases_are_the_most(rng: np.random.Generator) -> None:
    """One V² of the first baseline was taken a quarter of a day later than all the rest."""
    star = epoch(rng)
    mjd = star.vis2.mjd.copy()
    mjd[:2] += 0.25
    later = replace(star, vis2=replace(star.vis2, mjd=mjd))
    assert triple_amplitudes(later)[2] == pytest.approx(0.25)

"""Which reader a file gets, in which order observables come, and what is known of a response."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from jwst_products import binary, integrations, product, write_product
from oi_builders import MaskFile, random_observables

from amibayes.data.observables import Observables, join
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.errors import DataError
from amibayes.extraction.charge import CubeMigration
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.reading import (
    ImageOptions,
    _centred,
    charge_of,
    contents_of,
    first_file,
    format_of,
    of_one_visit,
    read_observations,
    residual_share,
    uncalibrated_images,
)
from amibayes.extraction.response import pipeline_response, seen_at_pointing
from amibayes.instrument import load_instrument
from amibayes.oifits.products import open_products, pointing_of
from amibayes.ramps.header import migration_cards
from amibayes.ramps.migration import Migration
from amibayes.scene.orientation import Orientation
from amibayes.units import MAS


def table(name: str, *columns: str) -> fits.BinTableHDU:
    made = [fits.Column(c, "D", array=np.ones(3)) for c in columns]
    return fits.BinTableHDU.from_columns(made, name=name)


FILES = {
    "image cube": [fits.PrimaryHDU(np.ones((2, 3)))],
    "JWST stage-3 product": [fits.PrimaryHDU(), table("OI_VIS2", "A"), table("OI_Q4", "B")],
    "fitted images": [
        fits.PrimaryHDU(header=fits.Header({"DATAMODL": "AmiLgFitModel"})),
        fits.ImageHDU(np.ones((2, 3)), name="CTRD"),
    ],
    "OIFITS": [fits.PrimaryHDU(np.ones((2, 3))), table("OI_VIS2", "VIS2DATA")],
}


@pytest.mark.parametrize("kind", FILES)
def test_a_file_is_read_as_what_it_holds(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    fits.HDUList(FILES[kind]).writeto(path)
    assert format_of(path).name == kind


def test_spectra_and_what_is_no_file_are_left_to_the_reader_of_oifits(tmp_path: Path) -> None:
    fits.PrimaryHDU(np.ones(5)).writeto(tmp_path / "spectrum.fits")
    (tmp_path / "text.fits").write_text("no FITS file")
    for name in ("spectrum.fits", "text.fits", "absent.fits"):
        assert format_of(tmp_path / name).name == "OIFITS"
    empty = contents_of(tmp_path / "absent.fits")
    assert (empty.header, empty.names, empty.shapes, empty.columns) == ({}, (), (), frozenset())


def test_contents_are_those_of_the_headers(tmp_path: Path) -> None:
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 3, 4)), name="sci"), table("x", "a", "B")]
    hdus[0].header["TARGNAME"] = "STAR"
    fits.HDUList(hdus).writeto(tmp_path / "a.fits")
    found = contents_of(tmp_path / "a.fits")
    assert found.header["TARGNAME"] == "STAR"
    assert found.names == ("PRIMARY", "SCI", "X")
    assert found.shapes == ((), (2, 3, 4), ())
    assert found.columns == {"A", "B"}


def test_fitted_images_are_refused_with_what_their_fits_leave(tmp_path: Path) -> None:
    path, image = tmp_path / "a.fits", np.full((2, 4, 5), 2.0)
    residual = np.zeros_like(image)
    residual[0, 0, :2], image[1, 3, 4] = (0.6, -0.8), np.nan
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(image, name="CTRD")]
    hdus[0].header["DATAMODL"] = "AmiLgFitModel"
    fits.HDUList(hdus).writeto(path)
    assert residual_share(str(path)) == ""
    fits.HDUList([*hdus, fits.ImageHDU(residual, name="RESID")]).writeto(path, overwrite=True)
    # A residual of norm 1 in 39 pixels of 2.
    share = 100.0 / np.sqrt(39 * 4.0)
    assert residual_share(str(path)) == f", whose fits leave {share:.1f} % of the image"
    message = rf"amilg, whose fits leave {share:.1f} % of the image\), no observables"
    with pytest.raises(DataError, match=message):
        read_observations(path)


def test_observables_come_in_the_order_of_their_files(tmp_path: Path) -> None:
    """Kinds are read together, and sorted again by the first file of each."""
    visibility = integrations(binary(0.1, 120.0, -80.0), 0.02, 9, np.random.default_rng(1))
    oifits = [
        MaskFile(np.random.default_rng(k), n_exposures=1).write(tmp_path / f"{k}.oifits")
        for k in range(2)
    ]
    made = write_product(tmp_path / "p.fits", "ami-oi", visibility)
    given = [oifits[0], made, oifits[1]]
    assert [o.source for o in read_observations(given)] == [str(p) for p in given]
    part = join([told("b.fits, c.fits"), told("d.fits")])
    for paths, place in (("ab", 2), (["c.fits"], 0), (["a", "d.fits", "b.fits"], 1)):
        assert first_file(part, list(paths)) == place


def told(source: str) -> Observables:
    data = random_observables(np.random.default_rng(3), n_stations=4, kind="diagonal")
    return replace(data, setups=tuple(replace(s, source=source) for s in data.setups))


def response(seed: int, n: int, pointing: tuple[float, float]) -> OffAxisResponse:
    """Of stations (n,), the same function of the place as a baseline the other way round."""
    rng, nodes = np.random.default_rng(seed), 7
    half = rng.normal(size=(2, n, n, nodes, nodes))
    whole = half[0] + 1j * half[1]
    whole = whole + whole.swapaxes(0, 1).conj() + 5.0
    return OffAxisResponse(whole, np.eye(2) / (30 * MAS), np.array(pointing) * MAS)


def test_what_the_star_lost_is_taken_out_of_its_own_setup() -> None:
    """Of two setups one has no response; flagged numbers stay as they are."""
    rng = np.random.default_rng(4)
    data = [random_observables(rng, n_stations=5, kind="diagonal") for _ in range(2)]
    flag = np.arange(len(data[1].vis2)) == 3
    data[1] = data[1].flagged(flag, np.zeros(len(data[1].closure_phase), bool))
    known = response(5, 5, (14.0, -11.0))
    setups = (replace(data[1].setups[0], response=known),)
    whole = join([data[0], replace(data[1], setups=setups)])
    done, used = _centred(whole), whole.unflagged()
    found = done.unflagged()
    np.testing.assert_array_equal(done.vis2.value[whole.vis2.flag], data[1].vis2.value[flag])
    star = seen_at_pointing(known)
    for k, value in enumerate(used.vis2.value):
        i, j = used.vis2.stations[k]
        lost = abs(star[i, j]) ** 2 if used.vis2.setup[k] else 1.0
        assert found.data[k] == pytest.approx(value / lost)
    for k, value in enumerate(used.closure_phase.value, used.n_vis2):
        a, b, c = used.closure_phase.stations[k - used.n_vis2]
        turn = np.angle(star[a, b] * star[b, c] * star[c, a])
        lost = turn if used.closure_phase.setup[k - used.n_vis2] else 0.0
        assert found.data[k] == pytest.approx(value - lost)


@pytest.mark.parametrize("side", [None, 40, 500])
def test_responses_of_products_are_of_their_images(side: int | None, tmp_path: Path) -> None:
    """As large as SUBSIZE1 says, but no larger than the instrument's usual images."""
    visibility = integrations(binary(0.1, 120.0, -80.0), 0.02, 9, np.random.default_rng(1))
    keywords = {} if side is None else {"SUBSIZE1": side}
    path = write_product(tmp_path / "a.fits", "ami-oi", visibility, **keywords)
    (found,) = read_observations(path)
    instrument = load_instrument("niriss", "F480M").as_built()
    size = 40 if side == 40 else instrument.n_pixels
    ours, stations = found.setups[0].response, found.setups[0].station_xyz_m
    assert ours is not None
    assert stations is not None
    turned = Orientation(np.radians(37.3 - 0.5669), -1)
    exact = pipeline_response(instrument, size, turned, stations[:, :2])
    assert exact is not None
    np.testing.assert_allclose(ours.coefficients, exact.coefficients, atol=1e-5)
    np.testing.assert_array_equal(ours.pointing, pointing_of(open_products([str(path)])[0]))
    assert any("light off the axis taken as let through" in note for note in found.notes)


def test_products_with_flagged_rows_are_read(tmp_path: Path) -> None:
    visibility = integrations(binary(0.1, 120.0, -80.0), 0.02, 9, np.random.default_rng(1))
    with product("ami-oi", visibility) as hdus:
        hdus.writeto(tmp_path / "a.fits")
        hdus["OI_VIS2"].data["FLAG"][3] = hdus["OI_T3"].data["FLAG"][5] = True
        hdus.writeto(tmp_path / "b.fits")
    (whole,), (part,) = (read_observations(tmp_path / name) for name in ("a.fits", "b.fits"))
    assert (part.n_vis2, part.n_closure_phases) == (20, 34)
    kept = np.delete(np.arange(56), [3, 26])
    np.testing.assert_allclose(part.data, whole.data[kept], rtol=1e-6)


def cube(path: Path, **header: object) -> Path:
    hdu = fits.PrimaryHDU(np.ones((2, 80, 80), np.float32))
    hdu.header.update({"INSTRUME": "NIRISS", "FILTER": "F480M", "PIXELSCL": 0.0656} | header)
    hdu.writeto(path)
    return path


def test_images_without_calibrators_are_named(tmp_path: Path) -> None:
    made = MaskFile(np.random.default_rng(1), n_exposures=1).write(tmp_path / "a.oifits")
    assert uncalibrated_images([made]) == ()
    images = [cube(tmp_path / f"{k}.fits") for k in range(2)]
    (said,) = uncalibrated_images([images[0], made, images[1]])
    assert said.startswith(f"{images[0]}, {images[1]}: not calibrated: ")
    with fits.open(made, mode="update") as hdus:
        hdus[0].header["HIERARCH AMIBAYES METHOD"] = "fringes"
    (said,) = uncalibrated_images([made])
    assert said.startswith(f"{made}: not calibrated: ")


def test_charge_is_that_of_the_first_cube_else_of_the_first_header(tmp_path: Path) -> None:
    paths = [tmp_path / f"{k}.fits" for k in range(3)]
    for path, value in zip(paths, (None, 3e-7, 5e-7), strict=True):
        hdu = fits.PrimaryHDU()
        if value is not None:
            for key, card in migration_cards(Migration.isotropic(value, 1e-8, "given")).items():
                hdu.header[key] = card
        hdu.writeto(path)
    found = charge_of(paths, ImageOptions())
    assert found is not None
    assert found.migration is not None
    assert found.migration.mean[0] == pytest.approx(3e-7)
    assert charge_of(paths[:1], ImageOptions()) is None
    first = CubeMigration(notes=("first",))
    assert charge_of(paths, ImageOptions(charges={"a": first, "b": CubeMigration()})) is first


def test_what_a_visit_shares_is_kept_by_path(tmp_path: Path) -> None:
    made = MaskFile(np.random.default_rng(1), n_exposures=1).write(tmp_path / "a.oifits")
    images = cube(tmp_path / "b.fits")
    options = ExtractOptions(charge_migration="off", geometry="stated")
    found = of_one_visit([made, images], ImageOptions(options, {"filter": "F430M"}))
    assert list(found.maps) == list(found.charges) == [str(images)]
    assert found.maps[str(images)] is None
    assert found.charges[str(images)].migration is None
    assert found.header == {"filter": "F430M"}

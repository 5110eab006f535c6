"""Numbers read from OIFITS files, and written to them, as they were recorded.

`pytest tests/oifits/test_recorded_oifits.py --force-regen` records them anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from jwst_products import as_oifits, binary, integrations, write_product
from oi_builders import HOLES_M, HandMade, MaskFile, random_observables
from recorded_numbers import checker
from scipy.sparse import diags_array

from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.data.shared_errors import SharedErrors
from amibayes.oifits import read_oifits, write_oifits
from amibayes.oifits.audit import audit, repair
from amibayes.oifits.audit.geometry import four_triangles
from amibayes.oifits.audit.packages import amplitude_ratio
from amibayes.oifits.dates import first_date, mjd_of_date
from amibayes.oifits.export import export, triple_amplitudes
from amibayes.oifits.products import open_products, pointing_of, product_of, read_product
from amibayes.oifits.products.integrations import averaged, series_of
from amibayes.oifits.products.mask_map import map_of
from amibayes.oifits.products.repairs import (
    band_width,
    relative_amplitude_error,
    repaired,
    vis2_error,
)

KINDS = ("ami-oi", "amimulti-oi", "aminorm-oi")


def numbers_in(hdus: fits.HDUList) -> dict[str, dict[str, np.ndarray]]:
    """Columns of all tables that hold numbers, but not what rounding leaves of them."""
    return {
        f"{k}.{hdu.name}": {
            name: np.asarray(hdu.data[name])
            for name in hdu.columns.names
            if hdu.data[name].dtype.kind in "biufc" and not name.endswith("_REST")
        }
        for k, hdu in enumerate(hdus)
        if isinstance(hdu, fits.BinTableHDU)
    }


def visibilities(seed: int, contrast: float = 0.1, n: int = 12) -> np.ndarray:
    return integrations(binary(contrast, 120.0, -80.0), 0.03, n, np.random.default_rng(seed))


@pytest.mark.parametrize("covariance", ["assumed", "diagonal"])
def test_a_plain_file_is_read_as_recorded(covariance: str, tmp_path: Path, num_regression) -> None:
    """Flags, errors that are none, correlations, and closure phases with those assumed."""
    made = HandMade(np.random.default_rng(1))
    made.vis2_error[2, 1] = 0.0
    made.phase_error_deg[1, 2] = np.nan
    flag = np.zeros((6, 3), bool)
    flag[4, :2] = True
    made.put("OI_VIS2", "FLAG", flag)
    made.put("OI_VIS2", "VIS2ERR", made.vis2_error)
    made.put("OI_T3", "T3PHIERR", made.phase_error_deg)
    if covariance == "assumed":
        made.correlate([(1, 2, 0.4), (4, 19, 0.2), (20, 23, -0.3), (10, 10, 1.0)])
    found = read_oifits(made.write(tmp_path / "a.oifits"), closure_covariance=covariance)
    checker(num_regression)(read=found, passed_over=("stations", "setup"))


def test_turning_masks_are_read_as_recorded(tmp_path: Path, num_regression) -> None:
    """Stations by their places, from (u, v) where the file has none, and what an audit finds."""
    made = MaskFile(np.random.default_rng(2), n_exposures=2)
    path = made.write(tmp_path / "a.oifits")
    file = read_oifits(path)
    for name in ("OI_VIS2", "OI_T3"):
        _, values, _ = made.tables[name]["STA_INDEX"]
        made.put(name, "STA_INDEX", np.zeros_like(values))
    without = read_oifits(made.write(tmp_path / "b.oifits"))
    found = four_triangles(file)
    checker(num_regression)(
        file=file,
        without=without,
        four=found,
        chi2=[[quads.chi2(turned) for turned in ((), ("H0",))] for quads in found],
        date=mjd_of_date("2017-05-17T03:00:00"),
    )


@pytest.mark.parametrize("kind", ["given", "estimated", "assumed", "diagonal"])
def test_what_is_written_is_that_recorded(kind: str, tmp_path: Path, num_regression) -> None:
    """All that observables can hold beside their values, in the file and back."""
    data = random_observables(np.random.default_rng(3), n_stations=5, kind=kind)
    variance = data.covariance.variance
    if kind in ("estimated", "assumed"):
        changes = np.sqrt(variance)[:, None] * np.random.default_rng(4).normal(
            size=(len(variance), 2)
        )
        if kind == "assumed":  # closure phases without the second error: it is not in the file
            changes[len(data.vis2) :, 1] = 0.0
        data = replace(
            data, freedom=Freedom(31.0, 17.0), scatter=diags_array(0.4 * variance).tocsr()
        ).with_shared_errors(SharedErrors(("charge x", "charge y"), changes))
    if kind == "diagonal":
        flag = np.zeros(len(data.vis2), bool)
        flag[2:4] = True
        data = data.flagged(flag, np.zeros(len(data.closure_phase), bool))
    path = tmp_path / "a.oifits"
    write_oifits(path, data)
    with fits.open(path) as hdus:
        written = numbers_in(hdus)
    checker(num_regression)(written=written, back=read_oifits(path), properties=False)


@pytest.mark.parametrize("program", ["irbis", "squeeze", "mira"])
def test_exports_are_those_recorded(program: str, num_regression) -> None:
    """Two epochs, bands of several channels, phases beyond a turn."""
    rng = np.random.default_rng(5)
    parts = [
        random_observables(rng, n_stations=4, n_channels=2, n_exposures=2, kind="assumed", name=n)
        for n in ("A", "B")
    ]
    vis2, closure = parts[1].vis2, parts[1].closure_phase
    parts[1] = replace(
        parts[1],
        vis2=replace(vis2, mjd=vis2.mjd + 3.0),
        closure_phase=replace(closure, mjd=closure.mjd + 3.0),
    )
    made = export(parts, program)
    checker(num_regression)(
        hdus=numbers_in(made.hdus),
        grid=(made.pixel_mas, made.field_mas, made.n_pixels, made.mjd_tolerance),
        band=made.wavelength_um,
        triple=triple_amplitudes(parts[0]),
    )


@pytest.mark.parametrize("kind", KINDS)
def test_products_are_read_as_recorded(kind: str, tmp_path: Path, num_regression) -> None:
    """Values, repaired errors, the map of the mask, the place of the star."""
    calibrator = visibilities(7, 0.0) if kind == "aminorm-oi" else None
    oifits = as_oifits(
        tmp_path / "a.fits", kind, visibilities(6), calibrator, affine=(1.002, 0.997, 1e-3, -2e-3)
    )
    product = product_of(oifits)
    assert product is not None
    fixed, repairs = repaired(product)
    found = map_of(product)
    checker(num_regression, 1e-4)(
        read=read_product(oifits),
        columns={t.label: t.columns for t in fixed.tables},
        band=band_width(product),
        map=None if found is None else (found.on_sky, found.angle_deg, found.error),
        pointing=pointing_of(product),
        vis2_error=vis2_error(product, product.table("OI_VIS2")),
        amplitude=relative_amplitude_error(product, product.table("OI_VIS")),
        series=series_of(product) if kind == "amimulti-oi" else None,
        repairs=len(repairs),
        ratio=amplitude_ratio(oifits, product.table("OI_T3")),
        setup=read_product(oifits).setups[0].station_xyz_m,
        properties=False,
    )


def test_integrations_of_products_are_averaged_as_recorded(tmp_path: Path, num_regression) -> None:
    """Two files of integrations of one exposure."""
    paths = [
        write_product(
            tmp_path / f"{k}.fits", "amimulti-oi", visibilities(8 + k),
            EXPSTART=60000.1 + 0.01 * k, EXPEND=60000.105 + 0.01 * k, EXPMID=60000.1025 + 0.01 * k,
        )
        for k in range(2)
    ]  # fmt: skip
    products = open_products(paths)
    checker(num_regression, 1e-4)(
        found=averaged(products), first=[series_of(p).mean for p in products],
        noise=[series_of(p).noise for p in products], mjd=len(first_date(np.array([6e4]))),
    )  # fmt: skip


Change = Callable[[MaskFile], None]

SPOILT: dict[str, Change] = {
    "radians": lambda f: f.change("OI_T3", np.radians, "T3PHI", "T3PHIERR"),
    "small errors": lambda f: f.change("OI_T3", lambda x: 1e-3 * x, "T3PHIERR"),
    "wavelengths": lambda f: f.change("OI_VIS2", lambda x: x / 2.1e-6, "UCOORD", "VCOORD"),
    "mirrored": lambda f: f.change("OI_VIS2", lambda x: -x, "UCOORD"),
    "long": lambda f: f.change("OI_VIS2", lambda x: 3.0 * x, "UCOORD", "VCOORD"),
    "bright": lambda f: f.change("OI_VIS2", lambda x: x + 0.4, "VIS2DATA"),
    "negative": lambda f: f.change("OI_VIS2", lambda x: x - 0.7, "VIS2DATA"),
    "dates": lambda f: f.change("OI_T3", lambda x: x + 300.0, "MJD"),
    "seconds": lambda f: f.change("OI_T3", lambda x: 1e6 * x, "INT_TIME"),
    "turns": lambda f: f.change("OI_T3", lambda x: 90.0 * x, "T3PHI"),
    "bands": lambda f: f.change("OI_WAVELENGTH", lambda x: 1e3 * x, "EFF_BAND"),
    "micrometres": lambda f: f.change("OI_WAVELENGTH", lambda x: 1e6 * x, "EFF_WAVE"),
    "no errors": lambda f: f.change("OI_VIS2", lambda x: 0.0 * x, "VIS2ERR"),
    "stations": lambda f: f.drop("STA_INDEX"),
    "closing": lambda f: f.change(
        "OI_T3", lambda x: np.where(np.arange(len(x))[:, None] % 5 == 2, -x, x), "T3PHI"
    ),
}


def test_findings_of_audits_are_those_recorded(tmp_path: Path, data_regression) -> None:
    """What an audit says of spoilt files, the numbers in its sentences too."""
    found = {}
    for name, spoil in SPOILT.items():
        made = MaskFile(np.random.default_rng(12), holes_m=HOLES_M[:5], n_exposures=2, n_channels=1)
        spoil(made)
        findings = audit(made.write(tmp_path / "a.oifits")).findings
        found[name] = [f"{f.severity} {f.code} {f.where}: {f.what}" for f in findings]
    for kind in KINDS:
        other = visibilities(7, 0.0) if kind == "aminorm-oi" else None
        oifits = as_oifits(tmp_path / f"{kind}.fits", kind, visibilities(6), other)
        found[kind] = [f"{f.severity} {f.code} {f.where}: {f.what}" for f in audit(oifits).findings]
    data_regression.check(found)


def test_mended_files_are_those_recorded(tmp_path: Path, num_regression) -> None:
    """A repair changes what is certain."""
    made = MaskFile(np.random.default_rng(13), n_exposures=1, n_channels=1)
    for spoil in ("wavelengths", "no errors", "radians"):
        SPOILT[spoil](made)
    checked = audit(made.write(tmp_path / "a.oifits"))
    done = repair(checked.oifits, list(checked.findings), tmp_path / "b.oifits")
    with fits.open(tmp_path / "b.oifits") as hdus:
        checker(num_regression)(mended=numbers_in(hdus), done=len(done))


def test_responses_are_written_and_read_as_recorded(tmp_path: Path, num_regression) -> None:
    """Coefficients of a response off the axis, of which a file holds half."""
    rng = np.random.default_rng(14)
    data, n = random_observables(rng, n_stations=3, kind="diagonal"), 7
    half = rng.normal(size=(2, 3, 3, n, n)).astype(np.float32)
    whole = (half[0] + 1j * half[1]).astype(np.complex64)
    # Stations in the other order see the conjugate, and so do opposite places.
    whole = whole + whole.swapaxes(0, 1).conj()
    whole = whole + whole[..., ::-1, ::-1].conj()
    response = OffAxisResponse(whole, rng.normal(size=(2, 2)), rng.normal(size=2), False, "fft")
    data = replace(data, setups=(replace(data.setups[0], response=response),))
    write_oifits(tmp_path / "a.oifits", data)
    back = read_oifits(tmp_path / "a.oifits").setups[0].response
    assert back is not None
    checker(num_regression)(back=back, written=response)

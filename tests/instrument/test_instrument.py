"""Instruments as data: geometry, filters, zero points, and what is said of a bad file."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from astropy import units
from astropy.modeling.models import BlackBody

import amibayes
from amibayes.errors import DataError, UsageError
from amibayes.instrument import Bandpass, Instrument, Mask, instrument_names, load_instrument
from amibayes.optics import psf
from amibayes.scene.spectrum import Blackbody, Flat, Tabulated, g2v, read_spectrum, spectrum_named
from amibayes.units import MAS

DATA = resources.files("amibayes.instrument") / "data"
NIRISS_FILTERS = ("F277W", "F380M", "F430M", "F480M")
TABLE_1 = {"F380M": 1999651.0, "F430M": 1279391.0, "F480M": 1137034.0}


def niriss(name: str = "F430M") -> Instrument:
    return load_instrument("niriss", filter=name)


def test_the_package_exports_the_loader() -> None:
    assert amibayes.load_instrument("NIRISS", filter="f430m").bandpass.name == "F430M"


def test_niriss_has_the_published_counts() -> None:
    mask = niriss().mask
    assert (mask.n_holes, mask.n_baselines, len(mask.triangles)) == (7, 21, 35)
    closure = np.zeros((35, 21))
    rows = np.arange(35)
    for column, sign in zip(mask.triangle_baselines.T, (1.0, 1.0, -1.0), strict=True):
        closure[rows, column] += sign
    assert np.linalg.matrix_rank(closure) == 15
    np.testing.assert_allclose(closure @ mask.uv_m, 0.0, atol=1e-12)


def test_baselines_go_from_the_first_hole_to_the_second() -> None:
    mask = Mask("two", np.array([[0.0, 0.0], [3.0, 1.0]]), "circle", 0.8)
    np.testing.assert_array_equal(mask.uv_m, [[3.0, 1.0]])
    assert mask.longest_m == mask.shortest_m == pytest.approx(np.sqrt(10.0))


# Soulain et al. 2020: pivots and half-power wavelengths in µm.
@pytest.mark.parametrize(
    ("name", "pivot", "low", "high"),
    [
        ("F380M", 3.828, 3.726, 3.931),
        ("F430M", 4.286, 4.182, 4.395),
        ("F480M", 4.817, 4.669, 4.971),
    ],
)
def test_filters_have_the_published_wavelengths(
    name: str, pivot: float, low: float, high: float
) -> None:
    band = niriss(name).bandpass
    assert band.pivot_m * 1e6 == pytest.approx(pivot, abs=0.002)
    assert np.array(band.half_power_m) * 1e6 == pytest.approx([low, high], abs=0.001)


def test_the_wide_filter_is_near_the_published_pivot() -> None:
    # 2.776 µm in the paper, 2.764 in STScI's zero points: the throughputs differ.
    assert niriss("F277W").bandpass.pivot_m * 1e6 == pytest.approx(2.770, abs=0.008)


@pytest.mark.parametrize("name", instrument_names())
def test_every_mask_is_non_redundant(name: str) -> None:
    text = (DATA / f"{name}.toml").read_text(encoding="utf-8")
    filters = [line[9:-1] for line in text.splitlines() if line.startswith("[filters.")]
    for entry in filters:
        instrument = load_instrument(name, filter=entry)
        assert instrument.mask.non_redundant
        assert instrument.resolution_rad < instrument.field_rad


def test_the_number_of_holes_of_other_masks() -> None:
    holes = {n: load_instrument(n, f).mask.n_holes for n, f in
             [("sphere", "K1"), ("gpi", "H"), ("visir", "11_3_SAM")]}  # fmt: skip
    assert holes == {"sphere": 7, "gpi": 10, "visir": 7}


def test_a_redundant_mask_is_found() -> None:
    row = Mask("row", np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]]), "circle", 0.8)
    assert not row.non_redundant
    assert row.redundant_pairs().tolist() == [[0, 2]]
    # Equal but for their sign is the same baseline.
    turned = Mask("v", np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]]), "circle", 0.8)
    assert len(turned.redundant_pairs()) == 2


def test_resolution_and_field_of_niriss() -> None:
    instrument = niriss("F480M")
    longest = np.hypot(2.28631 * 2.0, 2.64)
    assert instrument.resolution_rad == pytest.approx(
        instrument.bandpass.pivot_m / (2.0 * longest), rel=1e-12
    )
    assert instrument.field_rad / MAS == pytest.approx(752.6, abs=1.0)


def test_splodges_lie_where_the_power_is() -> None:
    instrument = niriss("F380M")
    n = 81
    image = psf(instrument, instrument.bandpass.channels(), n)
    power = np.abs(np.fft.fftshift(np.fft.fft2(image))) ** 2
    x, y = np.rint(instrument.splodges_px(n)).astype(int).T + n // 2
    at_splodges = power[y, x]
    # Frequencies beyond the longest baseline hold nothing but the image's cut edge.
    assert at_splodges.min() > 1e3 * power[n // 2, :2].max()


# The paper's rates were for the ETC's field; ours is what falls on the 80 × 80 subarray.
@pytest.mark.parametrize("name", sorted(TABLE_1))
def test_count_rates_of_the_paper(name: str) -> None:
    instrument, reference = niriss(name), niriss("F380M").bandpass
    rate = instrument.count_rate(g2v(), 6.0, reference)
    detected = rate * psf(instrument, instrument.bandpass.channels(g2v()), 80).sum()
    assert detected / TABLE_1[name] == pytest.approx(1.0, abs=0.025)


def test_five_magnitudes_are_a_hundred() -> None:
    instrument = niriss()
    ratio = instrument.count_rate(Flat(), 3.0) / instrument.count_rate(Flat(), 8.0)
    assert ratio == pytest.approx(100.0, rel=1e-12)


def test_a_filter_without_zero_point_is_said() -> None:
    with pytest.raises(UsageError, match="K1 of SPHERE IRDIS has no zero point"):
        load_instrument("sphere", filter="K1").count_rate(Flat(), 5.0)


@pytest.mark.parametrize("name", NIRISS_FILTERS)
def test_channels_have_the_moments_of_the_filter(name: str) -> None:
    band, spectrum = niriss(name).bandpass, Blackbody(4000.0)
    channels = band.channels(spectrum, 7)
    fine = np.linspace(band.wavelength_m[0], band.wavelength_m[-1], 200001)
    mass = np.interp(fine, band.wavelength_m, band.throughput) * spectrum.photon_density(fine)
    for power in range(14):
        scaled = (band.pivot_m / channels.wavelength_m) ** power
        truth = np.sum(mass * (band.pivot_m / fine) ** power) / mass.sum()
        assert channels.weight @ scaled == pytest.approx(truth, rel=2e-6)
    assert channels.weight.min() > 0.0
    assert channels.weight.sum() == pytest.approx(1.0, abs=1e-12)


def test_channels_of_two_rows_are_gauss_legendre() -> None:
    box = Bandpass("box", np.array([1.0, 1.0 + 1e-6]), np.ones(2))
    channels = box.channels(Flat(), 3)
    nodes, weight = np.polynomial.legendre.leggauss(3)
    np.testing.assert_allclose((channels.wavelength_m - 1.0) * 2e6 - 1.0, nodes, atol=1e-5)
    np.testing.assert_allclose(channels.weight, 0.5 * weight, atol=1e-5)


def test_blackbody_is_planck() -> None:
    wavelength = np.linspace(1e-6, 12e-6, 50)
    planck = BlackBody(5450.0 * units.K)(wavelength * units.m)
    photons = planck.to_value(units.erg / (units.cm**2 * units.s * units.Hz * units.sr))
    ratio = Blackbody(5450.0).photon_density(wavelength) / (photons / wavelength)
    np.testing.assert_allclose(ratio / ratio[0], 1.0, rtol=1e-6)


def test_blackbody_does_not_overflow() -> None:
    assert np.all(Blackbody(1.0).photon_density(np.array([1e-6, 1e-5])) == 0.0)


def test_spectra_by_name(tmp_path: Path) -> None:
    table = tmp_path / "star.txt"
    table.write_text("# µm flux\n3.0 1.0\n5.0 3.0\n", encoding="utf-8")
    assert spectrum_named("flat").name == "flat"
    assert spectrum_named("g2v").name == "G2V"
    assert spectrum_named("blackbody 900 K").name == "blackbody 900 K"
    density = spectrum_named(str(table)).photon_density(np.array([4e-6]))
    assert density == pytest.approx(2.0 * 4.0)
    with pytest.raises(UsageError, match="not known"):
        spectrum_named("M8")
    with pytest.raises(UsageError, match="no temperature"):
        spectrum_named("blackbody hot")


def test_a_spectrum_must_cover_the_filter() -> None:
    short = Tabulated("short", np.array([3e-6, 4e-6]), np.ones(2))
    with pytest.raises(DataError, match=r"covers 3\.000–4\.000 µm"):
        niriss().bandpass.channels(short)


@pytest.mark.parametrize(
    ("text", "fault"),
    [("1.0\n2.0\n", "two columns"), ("3 a\n4 b\n", "table of numbers"), ("4 1\n3 1\n", "rise")],
)
def test_a_bad_spectrum_is_said(tmp_path: Path, text: str, fault: str) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=fault):
        read_spectrum(path)


USER = """
name = "mine"
pixel_scale_mas = 20.0
[mask]
name = "three"
shape = "circle"
size_m = 0.5
holes_m = [[0.0, 0.0], [1.0, 0.0], [0.0, 3.0]]
[filters.L]
wavelength_um = [3.0, 4.0]
throughput = [0.5, 0.5]
"""


def user_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_users_own_file(tmp_path: Path) -> None:
    instrument = load_instrument(user_file(tmp_path, USER))
    assert instrument.name == "mine"
    assert instrument.bandpass.name == "L"
    assert instrument.pixel_scale_rad == pytest.approx(20.0 * MAS)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("pixel_scale_mas = 20.0", "pixel_scale_mas = -1", "'pixel_scale_mas' is -1; it must be"),
        ("pixel_scale_mas = 20.0", "", "'pixel_scale_mas' is missing"),
        ("pixel_scale_mas = 20.0", "pixel_scale_mas = nan", "not a finite number"),
        ("pixel_scale_mas", "pixelscale_mas", "'pixel_scale_mas' is missing"),
        ('"circle"', '"square"', "'mask.shape' is 'square' .choose from hexagon, circle"),
        ("size_m = 0.5", "size_m = '0.5'", "'mask.size_m' is '0.5', not a number"),
        ("size_m = 0.5", "size_m = 1.5", "table .mask.: .* overlap"),
        ("[1.0, 0.0]", "[1.0]", "'mask.holes_m' is not a list of numbers"),
        ("[1.0, 0.0]", "[1.0, 0.0, 1.0]", "'mask.holes_m' is not a list"),
        ("size_m = 0.5", "size_m = 0.5\nsize = 3", "'mask.size' is not known .did you mean"),
        ("[3.0, 4.0]", "[4.0, 3.0]", "table .filters.L.: filter L has wavelengths"),
        ("[3.0, 4.0]", "[3.0, 3.5, 4.0]", "table .filters.L.: filter L needs"),
        ("[0.5, 0.5]", "[0.5, 1.5]", "throughput outside 0 to 1"),
        ("throughput", "vega_flux_jy = 0.0\nthroughput", "'filters.L.vega_flux_jy' is 0"),
        ("[filters.L]", "[filter.L]", "'filters' is missing"),
        ("name = ", "name = = ", "not valid TOML"),
    ],
)
def test_a_bad_file_names_key_and_fault(tmp_path: Path, old: str, new: str, fault: str) -> None:
    path = user_file(tmp_path, USER.replace(old, new, 1))
    with pytest.raises(DataError, match=fault) as caught:
        load_instrument(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_unknown_names_are_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"'nirspec' is not known .choose from gpi, niriss"):
        load_instrument("nirspec")
    with pytest.raises(UsageError, match=r"has no filter 'F999M' .choose from F277W"):
        load_instrument("niriss", filter="F999M")
    with pytest.raises(UsageError, match="needs a filter"):
        load_instrument("niriss")
    with pytest.raises(DataError, match=r"absent\.toml: cannot be read"):
        load_instrument(tmp_path / "absent.toml")

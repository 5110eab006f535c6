"""Scenes: transforms against sums over points, files and their faults, images of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

from amibayes import load_scene
from amibayes.errors import DataError
from amibayes.instrument import Channels, Instrument, Mask, load_instrument
from amibayes.optics import fringe_basis, psf, scene_image
from amibayes.scene.orientation import Orientation, orientation_of_matrix
from amibayes.scene.sources import (
    Component,
    GaussianDisc,
    Point,
    Ring,
    Scene,
    SkyImage,
    UniformDisc,
)
from amibayes.scene.spectrum import Tabulated, read_spectrum, spectrum_named
from amibayes.units import DEGREE, MAS, FloatArray, offset

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "paper_scene.toml"
MONO = Channels.monochromatic(4.3e-6)


def niriss() -> Instrument:
    return load_instrument("niriss", filter="F430M")


def ring_points(inner: float, outer: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (x, y) and weights (sum 1) over a flat ring, by quadrature in radius squared."""
    t, w = np.polynomial.legendre.leggauss(30)
    radius = np.sqrt(0.5 * (t + 1.0) * (outer**2 - inner**2) + inner**2)
    angle = np.arange(90) * 2.0 * np.pi / 90
    weight = np.outer(0.5 * w, np.full(90, 1.0 / 90))
    return (
        np.outer(radius, np.cos(angle)).ravel(),
        np.outer(radius, np.sin(angle)).ravel(),
        weight.ravel(),
    )


@pytest.mark.parametrize(
    ("component", "inner", "outer"),
    [
        (UniformDisc(0.3, 50 * MAS, -20 * MAS, 120 * MAS), 0.0, 60.0),
        (Ring(0.3, 50 * MAS, -20 * MAS, 120 * MAS, 40 * MAS), 40.0, 80.0),
        (Ring(0.3, 50 * MAS, -20 * MAS, 120 * MAS, 120 * MAS), 0.0, 120.0),
        (Ring(0.3, 50 * MAS, -20 * MAS, 120 * MAS), 59.9999, 60.0001),
    ],
    ids=["disc", "ring", "ring without hole", "thin ring"],
)
def test_transforms_are_sums_over_points(
    component: Component, inner: float, outer: float, rng: np.random.Generator
) -> None:
    x, y, weight = ring_points(inner * MAS, outer * MAS)
    east, north = rng.normal(0.0, 1e6, (2, 20))
    phase = np.outer(east, x + 50 * MAS) + np.outer(north, y - 20 * MAS)
    truth = 0.3 * np.exp(-2j * np.pi * phase) @ weight
    np.testing.assert_allclose(component.transform(east, north), truth, atol=1e-9)
    assert component.transform(np.zeros(1), np.zeros(1)) == pytest.approx(0.3)


def test_transform_of_a_gaussian() -> None:
    fwhm = 30 * MAS
    x = np.linspace(-5.0, 5.0, 4001) * fwhm
    profile = np.exp(-4.0 * np.log(2.0) * (x / fwhm) ** 2)
    frequency = np.array([0.0, 3e6, 9e6])
    truth = np.cos(2.0 * np.pi * np.outer(frequency, x)) @ profile / profile.sum()
    gaussian = GaussianDisc(1.0, fwhm_rad=fwhm)
    np.testing.assert_allclose(gaussian.transform(frequency, np.zeros(3)), truth, atol=1e-12)


def test_an_image_is_the_sum_of_its_pixels(rng: np.random.Generator) -> None:
    pixels, scale = rng.uniform(0.0, 1.0, (5, 4)), 7 * MAS
    turn = Orientation(40 * DEGREE)
    image = SkyImage(pixels, scale * turn.matrix, 0.2, 10 * MAS, 3 * MAS)
    east, north = rng.normal(0.0, 3e6, (2, 6))
    truth = np.zeros(6, dtype=complex)
    for row in range(5):
        for column in range(4):
            # 40° east of north is up; east is to the left of that.
            rise, right = (row - 2.0) * scale, (column - 1.5) * scale
            alpha = rise * np.sin(40 * DEGREE) - right * np.cos(40 * DEGREE) + 10 * MAS
            delta = rise * np.cos(40 * DEGREE) + right * np.sin(40 * DEGREE) + 3 * MAS
            truth += pixels[row, column] * np.exp(-2j * np.pi * (east * alpha + north * delta))
    np.testing.assert_allclose(image.transform(east, north), 0.2 * truth / pixels.sum(), atol=1e-12)
    grid = image.transform(east.reshape(2, 3), north.reshape(2, 3))
    assert grid.shape == (2, 3)


def test_visibility_of_a_binary_is_the_formula() -> None:
    east, north = offset(150 * MAS, 20.0)
    scene = Scene((Point(), Point(0.01, float(east), float(north))))
    u, v, wavelength = np.array([1.0, -3.0]), np.array([2.0, 5.0]), np.array([[3.8e-6], [4.8e-6]])
    turn = np.exp(-2j * np.pi * (u * east + v * north) / wavelength)
    np.testing.assert_allclose(scene.visibility(u, v, wavelength), (1 + 0.01 * turn) / 1.01)


@settings(max_examples=40, deadline=None)
@given(
    diameter=st.floats(0.0, 300.0),
    flux=st.floats(0.0, 10.0),
    east=st.floats(-400.0, 400.0),
    u=st.floats(-6.0, 6.0),
)
def test_visibility_is_hermitian_and_never_above_one(
    diameter: float, flux: float, east: float, u: float
) -> None:
    scene = Scene(
        (Point(), UniformDisc(flux, east * MAS, 0.0, diameter * MAS), Ring(flux, 0, 0, 200 * MAS))
    )
    one = complex(scene.visibility(u, 2.0, 4e-6))
    assert abs(one) <= 1.0 + 1e-12
    assert complex(scene.visibility(-u, -2.0, 4e-6)) == pytest.approx(one.conjugate(), abs=1e-12)
    assert complex(scene.visibility(0.0, 0.0, 4e-6)) == pytest.approx(1.0)


def test_orientation_is_its_own_inverse_and_measures_east_of_north() -> None:
    turn = Orientation(30 * DEGREE)
    east, north = turn.to_sky([0.0, 1.0])
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(30.0)
    east, north = turn.to_sky([-1.0, 0.0])
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(120.0)
    for parity in (-1, 1):
        turn = Orientation(77 * DEGREE, parity)
        np.testing.assert_allclose(turn.to_image(turn.to_sky([0.3, -0.8])), [0.3, -0.8])
    with pytest.raises(ValueError, match="parity"):
        Orientation(0.0, 0)


def test_the_paper_scene() -> None:
    scene = load_scene(EXAMPLE)
    assert (scene.magnitude, scene.magnitude_filter, scene.spectrum.name) == (6.0, "F380M", "G2V")
    _, companion = scene.points
    assert companion.flux == pytest.approx(1e-8)
    assert companion.radius_rad / MAS == pytest.approx(150.0)
    angle = np.degrees(np.arctan2(companion.east_rad, companion.north_rad))
    assert angle == pytest.approx(20.0)


def write(folder: Path, body: str, star: str = "") -> Path:
    path = folder / "scene.toml"
    path.write_text(f"[star]\n{star}\n{body}", encoding="utf-8")
    return path


def test_every_kind_of_component(tmp_path: Path) -> None:
    fits.PrimaryHDU(np.eye(3)).writeto(tmp_path / "disc.fits")
    body = """
    [[companion]]
    east_mas = 10.0
    contrast = 0.1
    [[disc]]
    diameter_mas = 5.0
    delta_mag = 2.5
    [[gaussian]]
    fwhm_mas = 5.0
    contrast = 0.1
    [[ring]]
    diameter_mas = 90.0
    width_mas = 10.0
    contrast = 0.1
    [[image]]
    file = "disc.fits"
    scale_mas = 20.0
    contrast = 0.5
    """
    scene = load_scene(write(tmp_path, body, "diameter_mas = 3.0"))
    kinds = [type(part).__name__ for part in scene.components]
    assert kinds == ["UniformDisc", "Point", "UniformDisc", "GaussianDisc", "Ring", "SkyImage"]
    assert scene.flux == pytest.approx(1.9)
    assert scene.radius_rad / MAS == pytest.approx(50.0)


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        ("[[companion]]\nseparation_mas = 9\nposition_angle_deg = 1\ncontrast = -0.1",
         r"'companion\[1\].contrast' is -0.1; it must be at least 0"),
        ("[[companion]]\nseparation_mas = 9\nposition_angle_deg = 1",
         r"'companion\[1\].contrast' or 'delta_mag' is needed"),
        ("[[companion]]\nseparation_mas = -9\nposition_angle_deg = 1\ncontrast = 0.1",
         r"'companion\[1\].separation_mas' is -9"),
        ("[[companion]]\nseparation_mas = 9\ncontrast = 0.1",
         r"'companion\[1\].position_angle_deg' is missing"),
        ("[[companion]]\ncontrast = 0.1", r"'companion\[1\].separation_mas' is missing"),
        ("[[companion]]\nseparation_mas = 9\neast_mas = 1\ncontrast = 0.1", "and 'east_mas'"),
        ("[[companion]]\neast_mas = 9\ncontrast = 0.1\ncolour = 1",
         r"'companion\[1\].colour' is not known"),
        ("[[disc]]\ndiameter_mas = 0\ncontrast = 0.1", r"'disc\[1\].diameter_mas' is 0"),
        ("[[ring]]\ndiameter_mas = 9\nwidth_mas = 10\ncontrast = 1", "larger than the ring"),
        ("[[image]]\nfile = 'absent.fits'\ncontrast = 0.1", r"absent\.fits: cannot be read"),
        ("[[image]]\nfile = 'bare.fits'\ncontrast = 0.1", r"bare\.fits: has no celestial"),
        ("[[image]]\nfile = 'dark.fits'\nscale_mas = 1\ncontrast = 0.1",
         r"dark\.fits: .*negative pixels"),
        ("[[image]]\nfile = 'cube.fits'\nscale_mas = 1\ncontrast = 0.1", "3 axes, not 2"),
        ("[[image]]\nfile = 'scene.toml'\nscale_mas = 1\ncontrast = 0.1", "as FITS"),
        ("[companion]\nseparation_mas = 9", r"write \[\[companion\]\]"),
        ("[[companions]]\nseparation_mas = 9", "'companions' is not known .did you mean"),
        ("spectrum = 'M8'", "'star.spectrum' is wrong: spectrum 'M8' is not known"),
        ("diameter_mas = -3", "'star.diameter_mas' is -3"),
    ],
)  # fmt: skip
def test_a_bad_scene_names_key_and_fault(tmp_path: Path, body: str, fault: str) -> None:
    for name, pixels in (
        ("bare", np.ones((4, 4))),
        ("dark", -np.ones((4, 4))),
        ("cube", np.ones((3, 4, 4))),
    ):
        fits.PrimaryHDU(pixels).writeto(tmp_path / f"{name}.fits")
    with pytest.raises(DataError, match=fault) as caught:
        load_scene(write(tmp_path, body))
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_scene_needs_a_star(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    path.write_text("name = 'nothing'\n", encoding="utf-8")
    with pytest.raises(DataError, match="'star' is missing"):
        load_scene(path)


def test_an_image_brings_its_own_coordinates(tmp_path: Path) -> None:
    pixels = np.zeros((5, 5))
    pixels[4, 2] = 1.0
    unit = fits.PrimaryHDU(pixels)
    angle = 25 * DEGREE
    # Two pixels up, with up at 25° east of north, 10 mas each.
    step = 10.0 / 3.6e6
    unit.header.update(CTYPE1="RA---TAN", CTYPE2="DEC--TAN", CRPIX1=3.0, CRPIX2=3.0)
    unit.header.update(CRVAL1=0.0, CRVAL2=0.0)
    unit.header["CD1_1"], unit.header["CD1_2"] = -step * np.cos(angle), step * np.sin(angle)
    unit.header["CD2_1"], unit.header["CD2_2"] = step * np.sin(angle), step * np.cos(angle)
    unit.writeto(tmp_path / "one.fits")
    by_header = load_scene(write(tmp_path, "", "file = 'one.fits'"))
    star = "file = 'one.fits'\nscale_mas = 10\nposition_angle_deg = 25"
    by_hand = load_scene(write(tmp_path, "", star))
    u, v = np.array([1.0, 4.0]), np.array([-2.0, 3.0])
    truth = Scene((Point(1.0, 20 * MAS * np.sin(angle), 20 * MAS * np.cos(angle)),))
    for scene in (by_header, by_hand):
        np.testing.assert_allclose(
            scene.visibility(u, v, 4e-6), truth.visibility(u, v, 4e-6), atol=1e-9
        )


def test_points_are_summed_exactly_at_any_pointing(rng: np.random.Generator) -> None:
    instrument = niriss()
    channels = instrument.bandpass.channels(n=3)
    east, north = offset(150 * MAS, 20.0)
    scene = Scene((Point(), Point(0.3, float(east), float(north))))
    orientation = Orientation(33 * DEGREE)
    image = scene_image(
        scene,
        instrument,
        channels,
        40,
        centre_px=(0.2, -0.1),
        orientation=orientation,
        reach_px=0.6,
    )
    # 150 mas at PA 20°, up at PA 33°: 13° to the right of up.
    x, y = (150 * MAS / instrument.pixel_scale_rad) * np.array(
        [np.sin(13 * DEGREE), np.cos(13 * DEGREE)]
    )
    shifts = np.concatenate([[[0.0, 0.0], [0.6, -0.6]], rng.uniform(-0.6, 0.6, (3, 2))])
    for shift, got in zip(shifts, image.at(shifts), strict=True):
        cx, cy = shift + np.array([0.2, -0.1])
        truth = psf(instrument, channels, 40, centre_px=(cx, cy))
        truth += 0.3 * psf(instrument, channels, 40, centre_px=(cx + x, cy + y))
        np.testing.assert_allclose(got, truth, atol=1e-8 * truth.max())
    with pytest.raises(ValueError, match="beyond the reach"):
        image.at(np.array([[0.0, 0.7]]))


def test_discs_and_images_are_convolved_exactly() -> None:
    instrument = niriss()
    scale, turn = 30 * MAS, Orientation(10 * DEGREE)
    pixels = np.zeros((6, 7))
    pixels[1, 2], pixels[4, 6], pixels[5, 0] = 1.0, 2.0, 1.0
    picture = SkyImage(pixels, scale * turn.matrix, 1.0)
    places = [turn.to_sky([(c - 3.0) * scale, (r - 2.5) * scale]) for r, c in np.argwhere(pixels)]
    fluxes = pixels[pixels > 0.0] / 4.0
    points = tuple(Point(float(f), *map(float, p)) for f, p in zip(fluxes, places, strict=True))
    options = {"n_pixels": 40, "centre_px": (0.3, 0.7), "reach_px": 0.4}
    exact = scene_image(Scene(points), instrument, MONO, **options)
    folded = scene_image(Scene((picture,)), instrument, MONO, **options)
    shifts = np.array([[0.0, 0.0], [0.4, -0.4], [-0.13, 0.21]])
    peak = exact.values.max()
    np.testing.assert_allclose(folded.at(shifts), exact.at(shifts), atol=1e-7 * peak)


def test_a_disc_is_the_sum_of_its_points() -> None:
    instrument = niriss()
    x, y, weight = ring_points(0.0, 100 * MAS)
    pixels = np.zeros((301, 301))
    # The disc's own quadrature points, moved to the nearest node of a 1 mas grid.
    np.add.at(
        pixels, (np.rint(y / MAS).astype(int) + 150, np.rint(x / MAS).astype(int) + 150), weight
    )
    grid = SkyImage(pixels, MAS * Orientation().matrix, 1.0)
    disc = scene_image(Scene((UniformDisc(diameter_rad=200 * MAS),)), instrument, MONO, 40).centred
    truth = scene_image(Scene((grid,)), instrument, MONO, 40).centred
    np.testing.assert_allclose(disc, truth, atol=2e-3 * truth.max())


def test_a_source_outside_the_image_is_refused() -> None:
    instrument = niriss()
    with pytest.raises(DataError, match="2700 mas east and 0 mas north lies outside the image"):
        scene_image(Scene((Point(), Point(0.1, 2700 * MAS)), source="s.toml"), instrument, MONO)
    with pytest.raises(DataError, match="reaches 3000 mas"):
        scene_image(Scene((UniformDisc(diameter_rad=6000 * MAS),)), instrument, MONO)


def sky_visibility(mask: Mask, image: FloatArray, instrument: Instrument) -> np.ndarray:
    basis = fringe_basis(instrument, MONO, image.shape)
    found = np.linalg.lstsq(basis.matrix, image.ravel(), rcond=None)[0]
    n = mask.n_baselines
    return np.asarray((found[1 : 1 + n] + 1j * found[1 + n :]) / found[0])


@pytest.mark.parametrize("parity", [-1, 1])
def test_fringes_of_an_image_are_the_scene_visibility(parity: int) -> None:
    # Close in, where the envelope of the companion is nearly the star's.
    instrument, orientation = niriss(), Orientation(115 * DEGREE, parity)
    scene = Scene((Point(), Point(0.1, 30 * MAS, 12 * MAS)))
    image = scene_image(scene, instrument, MONO, orientation=orientation).centred
    u, v = orientation.to_sky(instrument.mask.uv_m).T
    truth = scene.visibility(u, v, 4.3e-6)
    found = sky_visibility(instrument.mask, image, instrument)
    assert np.abs(found - truth).max() < 2e-3
    assert np.abs(truth - 1.0).max() > 0.03
    # The wrong sign would be wrong by this much.
    assert np.abs(found - truth.conj()).max() > 0.03


def test_brightness_shows_north_up_and_east_left() -> None:
    scene = Scene((Point(), Point(0.5, 200 * MAS, 100 * MAS)))
    picture = scene.brightness(41, 25 * MAS)
    assert picture.sum() == pytest.approx(1.5, rel=1e-6)
    assert np.unravel_index(picture.argmax(), picture.shape) == (20, 20)
    picture[15:26, 15:26] = 0.0
    assert np.unravel_index(picture.argmax(), picture.shape) == (24, 12)


def test_bad_components_are_refused() -> None:
    for fault, make in (
        ("flux -1", lambda: Point(-1.0)),
        ("diameter of a disc", lambda: UniformDisc(diameter_rad=-1.0)),
        ("width of a Gaussian", lambda: GaussianDisc(fwhm_rad=-1.0)),
        ("wider than it is across", lambda: Ring(diameter_rad=1.0, width_rad=2.0)),
        ("pixel scale", lambda: SkyImage(np.ones((2, 2)), np.zeros((2, 2)))),
        ("finite pixels", lambda: SkyImage(np.full((2, 2), np.nan), np.eye(2))),
        ("do not rise", lambda: Tabulated("a", np.array([-1e-6, 1e-6]), np.ones(2))),
        ("do not rise", lambda: Tabulated("a", np.array([2e-6, 1e-6]), np.ones(2))),
    ):
        with pytest.raises(DataError, match=fault):
            make()


def test_skewed_pixels_keep_phases_and_places() -> None:
    matrix = np.array([[-1.69289e-5, 6.52976e-6], [6.58057e-6, 1.7058e-5]])
    found = orientation_of_matrix(matrix)
    scale = np.sqrt(abs(np.linalg.det(matrix)))
    np.testing.assert_allclose(found.matrix * scale, matrix, rtol=1e-12)
    place, baseline = np.array([3.0, -7.0]), np.array([1.5, 2.5])
    assert found.to_sky(place) @ found.baselines_to_sky(baseline) == pytest.approx(place @ baseline)
    np.testing.assert_allclose(found.to_image(found.to_sky(place)), place)
    assert found.parity == -1
    upright = orientation_of_matrix(Orientation(0.3, 1).matrix)
    assert upright.skew == pytest.approx((1.0, 0.0, 0.0, 1.0), abs=1e-12)
    assert upright.parity == 1


def test_parts_of_a_scene_add_up() -> None:
    """Two points, a disc and a ring: the image of all is the sum of the image of each."""
    parts: tuple[Component, ...] = (
        Point(),
        Point(0.3, 150 * MAS, -40 * MAS),
        UniformDisc(0.4, 50 * MAS, -20 * MAS, 120 * MAS),
        GaussianDisc(0.2, -90 * MAS, 60 * MAS, 80 * MAS),
    )
    options = {"n_pixels": 30, "centre_px": (0.3, -0.2), "reach_px": 0.1}
    whole, *each = (
        scene_image(Scene(some), niriss(), MONO, **options).values
        for some in (parts, *((part,) for part in parts))
    )
    # Windows of the convolution differ with the width of what is convolved.
    np.testing.assert_allclose(whole, sum(each), atol=1e-6 * whole.max())


def test_a_spectrum_is_read_from_a_table(tmp_path: Path) -> None:
    """Wavelengths in µm, flux per wavelength: photons are their product."""
    path = tmp_path / "s.txt"
    path.write_text("# um flux other\n4.0 2.0 9\n4.2 3.0 9\n4.6 1.0 9\n", encoding="utf-8")
    found = spectrum_named(str(path))
    assert isinstance(found, Tabulated)
    assert found.name == "s.txt"
    np.testing.assert_allclose(found.wavelength_m, [4.0e-6, 4.2e-6, 4.6e-6])
    np.testing.assert_array_equal(found.flux_density, [2.0, 3.0, 1.0])
    np.testing.assert_allclose(
        found.photon_density(np.array([4.0e-6, 4.4e-6])), [4.0 * 2.0, 4.4 * 2.0]
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (None, "cannot be read"),
        ("4.0\n4.2\n", "needs two columns of finite numbers"),
        ("4.0 nan\n4.2 1\n", "needs two columns of finite numbers"),
        ("4.0 a\n", "is not a table of numbers"),
    ],
)
def test_tables_that_are_no_spectrum_are_named(
    text: str | None, fault: str, tmp_path: Path
) -> None:
    path = tmp_path / "s.txt"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=fault):
        read_spectrum(path)

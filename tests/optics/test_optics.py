"""Point spread function and fringe model against truth that they did not make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from poppy_rig import poppy_image
from scipy.integrate import dblquad

from amibayes.errors import UsageError
from amibayes.instrument import Channels, Instrument, Mask, load_instrument
from amibayes.optics import PupilMap, Wavefront, fringe_basis, fringe_field, fringe_image, psf
from amibayes.optics.holes import coverage, hole_transform
from amibayes.optics.psf import intensity
from amibayes.scene.spectrum import Blackbody, g2v
from amibayes.units import FloatArray

MONO = Channels.monochromatic(4.3e-6)
SHAPES = ("hexagon", "circle")


def niriss(name: str = "F430M") -> Instrument:
    return load_instrument("niriss", filter=name)


def single(shape: str, orientation: float = 0.0) -> Mask:
    return Mask(shape, np.array([[0.0, 0.0], [2.0, 0.0]]), shape, 0.8, orientation)


def quadrature(mask: Mask, n: int = 60) -> tuple[FloatArray, FloatArray]:
    """Points and weights over one hole, by triangles or rings: no rhombi, no Bessel."""
    t, w = np.polynomial.legendre.leggauss(n)
    t, w = 0.5 * (t + 1.0), 0.5 * w
    if mask.shape == "circle":
        angle = np.arange(200) * 2.0 * np.pi / 200
        radius = 0.5 * mask.size_m * t
        points = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        weight = np.outer(w * radius * 0.5 * mask.size_m, np.full(200, 2.0 * np.pi / 200))
        return points.reshape(-1, 2), weight.ravel()
    corners = mask.corners_m
    points, weights = [], []
    for one, two in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = one + t[:, None] * (two - one)
        points.append((t[:, None, None] * edge).reshape(-1, 2))
        area = abs(one[0] * two[1] - one[1] * two[0])
        weights.append(np.outer(w * t, w).ravel() * area)
    return np.concatenate(points), np.concatenate(weights)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("orientation", [0.0, 0.37])
def test_hole_transform_is_the_integral_over_the_hole(
    shape: str, orientation: float, rng: np.random.Generator
) -> None:
    mask = single(shape, orientation)
    points, weight = quadrature(mask)
    # Random directions, and every direction along or across an edge, where a formula
    # with differences in its denominator would be 0/0.
    angle = orientation + np.arange(12) * np.pi / 6.0
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None, :]
    special = (along * np.array([0.0, 1e-9, 1.0, 7.3])[:, None]).reshape(-1, 2)
    frequency = np.concatenate([special, rng.normal(0.0, 4.0, (40, 2))])
    truth = np.exp(-2j * np.pi * frequency @ points.T) @ weight
    value = hole_transform(mask, frequency[:, 0], frequency[:, 1])
    np.testing.assert_allclose(value, truth.real, atol=1e-13)
    np.testing.assert_allclose(truth.imag, 0.0, atol=1e-13)
    assert hole_transform(mask, np.zeros(1), np.zeros(1)) == pytest.approx(mask.hole_area_m2)


@pytest.mark.parametrize("shape", SHAPES)
def test_coverage_is_exact(shape: str) -> None:
    mask, centre = single(shape, 0.2), np.array([0.013, -0.031])
    edges = np.linspace(-0.6, 0.6, 41)
    covered = coverage(mask, centre, edges, edges)
    cell = (edges[1] - edges[0]) ** 2
    assert covered.sum() * cell == pytest.approx(mask.hole_area_m2, rel=1e-12)
    # A fine count of points in some cells on the rim, good to its own step.
    fine = (np.arange(400) + 0.5) / 400.0
    rim = np.argwhere((covered > 0.0) & (covered < 1.0))[::7]
    normals = mask.corners_m + np.roll(mask.corners_m, -1, axis=0)
    for row, column in rim:
        x = edges[column] + fine * (edges[1] - edges[0]) - centre[0]
        y = edges[row] + fine * (edges[1] - edges[0]) - centre[1]
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        if shape == "circle":
            inside = np.hypot(grid[..., 0], grid[..., 1]) < 0.4
        else:
            unit = normals / np.hypot(*normals.T)[:, None]
            inside = np.all(grid @ unit.T < 0.4, axis=-1)
        assert covered[row, column] == pytest.approx(inside.mean(), abs=3e-3)


# The paper's own binned pupil measures 2.6e-5 and 2.6e-7 of the peak.
@pytest.mark.parametrize("size_m", [0.80, 0.82])
@pytest.mark.parametrize("sampling", ["pixels", "fine"])
def test_sampled_pupil_agrees_with_the_analytic_one(size_m: float, sampling: str) -> None:
    instrument = niriss()
    instrument = instrument.with_mask(replace(instrument.mask, size_m=size_m))
    options = {} if sampling == "pixels" else {"oversample": 5, "integrate": False}
    flat = Wavefront(map=PupilMap(np.zeros((1024, 1024)), 6.6))
    analytic = psf(instrument, MONO, 80, **options)
    sampled = psf(instrument, MONO, 80, wavefront=flat, **options)
    difference = np.abs(analytic / analytic.max() - sampled / sampled.max())
    assert difference.max() < 5e-6
    assert np.median(difference) < 5e-8
    # The paper's check: central pixel fractions within 0.17 %.
    assert sampled.max() / sampled.sum() == pytest.approx(
        analytic.max() / analytic.sum(), rel=1.7e-5
    )


def test_poppy_agrees() -> None:
    instrument = niriss()
    instrument = instrument.with_mask(replace(instrument.mask, size_m=0.82))
    theirs = poppy_image(instrument, np.array([4.3e-6]), np.ones(1), 80, n_pupil=2048)
    ours = psf(instrument, MONO, 80, integrate=False)
    # A pupil of black and white cells is itself wrong by about 1e-3.
    difference = np.abs(ours / ours.max() - theirs / theirs.max())
    assert difference.max() < 1e-3
    assert np.median(difference) < 1e-5
    assert theirs.max() / theirs.sum() == pytest.approx(ours.max() / ours.sum(), rel=1.7e-3)


def test_pixels_are_averages_of_the_intensity() -> None:
    instrument = niriss("F277W")
    wavelength, pixel = 2.5e-6, instrument.pixel_scale_rad
    image = psf(instrument, Channels.monochromatic(wavelength), 8, centre_px=(0.3, -0.2))

    def at(y: float, x: float) -> float:
        grid = np.array([x * pixel]), np.array([y * pixel])
        return float(intensity(instrument.mask, wavelength, *grid)[0, 0])

    for row, column in ((3, 4), (0, 7), (6, 1)):
        x, y = column - 3.5 - 0.3, row - 3.5 + 0.2
        truth, _ = dblquad(at, x - 0.5, x + 0.5, y - 0.5, y + 0.5, epsabs=0.0, epsrel=1e-9)
        assert image[row, column] == pytest.approx(truth * pixel**2, abs=1e-9 * image.max())


@pytest.mark.parametrize("oversample", [2, 3])
def test_finer_pixels_add_up(oversample: int) -> None:
    instrument = niriss()
    coarse = psf(instrument, MONO, 20)
    fine = psf(instrument, MONO, 20, oversample=oversample)
    binned = fine.reshape(20, oversample, 20, oversample).sum(axis=(1, 3))
    np.testing.assert_allclose(binned, coarse, atol=1e-9 * coarse.max())


@pytest.mark.parametrize("shape", SHAPES)
def test_flux_is_conserved(shape: str) -> None:
    # The light outside a square of side n falls as 1/n: extrapolate to the whole plane.
    instrument = niriss()
    mask = replace(instrument.mask, shape=shape)
    enclosed = [psf(instrument.with_mask(mask), MONO, n).sum() for n in (120, 240)]
    assert enclosed[0] < enclosed[1] < 1.0
    assert 2.0 * enclosed[1] - enclosed[0] == pytest.approx(1.0, abs=2e-3)


def test_parseval() -> None:
    # Sampled at Nyquist over one whole period of a sampled pupil's transform, the power is
    # that of the pupil: sum of area² over cells × cell (here with random wavefront error).
    rng = np.random.default_rng(5)
    mask = niriss().mask
    screen = PupilMap(rng.normal(0.0, 3e-7, (64, 64)), 6.6)
    wavelength, cells = 4.3e-6, 128
    step = wavelength / (cells * screen.cell_m)
    angle = (np.arange(cells) - cells // 2) * step
    power = intensity(mask, wavelength, angle, angle, Wavefront(map=screen))
    frequency = angle / wavelength
    power = power * screen.cell_transform(frequency, frequency) ** 2
    truth = sum(np.sum((p.area_m2 / screen.cell_m**2) ** 2) for p in screen.patches(mask))
    truth *= screen.cell_m**2 / mask.area_m2
    assert power.sum() * step**2 == pytest.approx(truth, rel=1e-12)


def test_turning_the_mask_turns_the_image() -> None:
    instrument = niriss()
    image = psf(instrument, MONO, 40)
    turned = psf(instrument.with_mask(instrument.mask.rotated(np.pi / 2.0)), MONO, 40)
    # From +x towards +y is anticlockwise with y up, and rows count upward.
    np.testing.assert_allclose(turned, np.rot90(image, -1), atol=1e-12 * image.max())
    np.testing.assert_allclose(image[::-1, ::-1], image, atol=1e-12 * image.max())
    basis = fringe_basis(instrument, MONO, 40, rotation_rad=np.pi / 2.0)
    np.testing.assert_allclose(basis.image(), turned, atol=1e-12 * image.max())


def test_shifts_move_the_image() -> None:
    instrument = niriss()
    wide = psf(instrument, MONO, 48)
    moved = psf(instrument, MONO, 40, centre_px=(3.0, -2.0))
    np.testing.assert_allclose(moved, wide[6:46, 1:41], atol=1e-12 * wide.max())


def test_tilt_of_all_holes_and_slope_of_the_pupil_are_pointing() -> None:
    instrument = niriss()
    tilt = np.array([0.4, -0.7]) * instrument.pixel_scale_rad
    truth = psf(instrument, MONO, 40, centre_px=(0.4, -0.7))
    holes = instrument.mask.holes_m
    by_hole = Wavefront(piston_m=holes @ tilt, tilt_rad=np.tile(tilt, (7, 1)))
    np.testing.assert_allclose(
        psf(instrument, MONO, 40, wavefront=by_hole), truth, atol=1e-9 * truth.max()
    )
    cells = np.linspace(-3.3, 3.3, 1025)
    centre = 0.5 * (cells[1:] + cells[:-1])
    slope = PupilMap(np.add.outer(centre * tilt[1], centre * tilt[0]), 6.6)
    image = psf(instrument, MONO, 40, wavefront=Wavefront(map=slope))
    np.testing.assert_allclose(image, truth, atol=5e-6 * truth.max())
    flat = PupilMap(np.zeros((1024, 1024)), 6.6)
    both = Wavefront(piston_m=holes @ tilt, tilt_rad=np.tile(tilt, (7, 1)), map=flat)
    np.testing.assert_allclose(
        psf(instrument, MONO, 40, wavefront=both), truth, atol=5e-6 * truth.max()
    )


def test_a_wavefront_must_fit_the_mask() -> None:
    with pytest.raises(UsageError, match="does not cover the mask"):
        psf(niriss(), MONO, 8, wavefront=Wavefront(map=PupilMap(np.zeros((64, 64)), 5.0)))
    with pytest.raises(UsageError, match="of 6 holes, mask of 7"):
        psf(niriss(), MONO, 8, wavefront=Wavefront(piston_m=np.zeros(6)))
    with pytest.raises(UsageError, match="tilt_rad needs one entry"):
        Wavefront(tilt_rad=np.zeros((7, 3)))
    with pytest.raises(UsageError, match="not square"):
        PupilMap(np.zeros((3, 4)), 6.6)


def fit(instrument: Instrument, channels: Channels, image: FloatArray) -> np.ndarray:
    """Complex visibilities by least squares on the fringe model."""
    basis = fringe_basis(instrument, channels, image.shape)
    found = np.linalg.lstsq(basis.matrix, image.ravel(), rcond=None)[0]
    n = basis.n_baselines
    return np.asarray((found[1 : 1 + n] + 1j * found[1 + n :]) / found[0])


def closure(mask: Mask, visibility: np.ndarray) -> np.ndarray:
    ij, jk, ik = mask.triangle_baselines.T
    return np.angle(visibility[ij] * visibility[jk] * visibility[ik].conj())


@pytest.mark.parametrize(("name", "filter_name"), [("niriss", "F480M"), ("gpi", "K1")])
def test_a_point_source_has_unit_visibility(name: str, filter_name: str) -> None:
    instrument = load_instrument(name, filter=filter_name)
    channels = instrument.bandpass.channels(Blackbody(5450.0))
    visibility = fit(instrument, channels, psf(instrument, channels, 80))
    np.testing.assert_allclose(np.abs(visibility) ** 2, 1.0, atol=1e-9)
    np.testing.assert_allclose(closure(instrument.mask, visibility), 0.0, atol=1e-9)


def test_pistons_turn_fringes_but_close() -> None:
    instrument = niriss()
    piston = np.random.default_rng(3).normal(0.0, 2e-7, 7)
    image = psf(instrument, MONO, 80, wavefront=Wavefront(piston_m=piston))
    visibility = fit(instrument, MONO, image)
    phase = 2.0 * np.pi / 4.3e-6 * piston
    i, j = instrument.mask.pairs.T
    np.testing.assert_allclose(visibility, np.exp(1j * (phase[i] - phase[j])), atol=1e-9)
    np.testing.assert_allclose(closure(instrument.mask, visibility), 0.0, atol=1e-9)


def test_visibility_of_a_displaced_source_has_the_sign_of_oifits() -> None:
    # V = e^{−2πi (ux + vy)/λ}, phases of up to 0.06 rad here; the envelope moves with the
    # source, which the basis does not, and that turns the fringes by up to 3e-4.
    instrument, shift = niriss(), np.array([0.02, -0.015])
    image = psf(instrument, MONO, 80, centre_px=tuple(shift))
    turn = instrument.mask.uv_m @ shift * instrument.pixel_scale_rad / 4.3e-6
    visibility = fit(instrument, MONO, image)
    np.testing.assert_allclose(np.angle(visibility), -2.0 * np.pi * turn, atol=4e-4)


@pytest.mark.parametrize("filter_name", ["F277W", "F380M", "F430M", "F480M"])
def test_the_number_of_wavelengths_is_enough(filter_name: str) -> None:
    instrument = niriss(filter_name)
    image = psf(instrument, instrument.bandpass.channels(g2v(), 60), 48)
    few = instrument.bandpass.channels(g2v())
    visibility = fit(instrument, few, image)
    assert np.abs(np.abs(visibility) ** 2 - 1.0).max() < 1e-9
    assert np.abs(psf(instrument, few, 48) - image).max() < 1e-7 * image.max()


def test_one_wavelength_is_not_enough() -> None:
    instrument = niriss("F480M")
    image = psf(instrument, instrument.bandpass.channels(g2v()))
    one = instrument.bandpass.channels(g2v(), 1)
    assert np.abs(np.abs(fit(instrument, one, image)) ** 2 - 1.0).max() > 0.02


def test_fringe_model_is_the_point_spread_function() -> None:
    for name, filter_name in (("niriss", "F277W"), ("sphere", "H2"), ("visir", "10_5_SAM")):
        instrument = load_instrument(name, filter=filter_name)
        channels = instrument.bandpass.channels()
        image = psf(instrument, channels, 50, centre_px=(0.3, -0.4))
        basis = fringe_basis(instrument, channels, 50, centre_px=(0.3, -0.4))
        np.testing.assert_allclose(basis.image(), image, atol=1e-12 * image.max())
        assert basis.images.shape == (1 + 2 * instrument.mask.n_baselines, 50, 50)
        assert not basis.matrix.flags.writeable


def test_fringe_model_of_another_scale_and_an_oblong_image() -> None:
    instrument = niriss()
    scale = 1.002 * instrument.pixel_scale_rad
    basis = fringe_basis(instrument, MONO, (30, 44), pixel_scale_rad=scale)
    image = psf(replace(instrument, pixel_scale_rad=scale), MONO, 44)
    np.testing.assert_allclose(basis.image(), image[7:37], atol=1e-12 * image.max())


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_fringe_image_of_a_point_is_its_image(turn: float) -> None:
    instrument = load_instrument("niriss", filter="F277W")
    channels = instrument.bandpass.channels()
    n = instrument.mask.n_baselines
    point = np.repeat([2.0, 0.0], [1 + n, n])
    quick = fringe_image(instrument, channels, point, 30, 3, rotation_rad=turn)
    turned = instrument.with_mask(instrument.mask.rotated(turn))
    exact = 2.0 * psf(turned, channels, 30, oversample=3, integrate=False)
    # In single precision, of sums of 43 terms.
    np.testing.assert_allclose(quick, exact, atol=5e-7 * exact.max())


@pytest.mark.parametrize(
    ("name", "filter_name"), [("niriss", "F277W"), ("niriss", "F480M"), ("gpi", "K1")]
)
def test_fringe_field_is_the_fringe_model_anywhere(name: str, filter_name: str) -> None:
    instrument = load_instrument(name, filter=filter_name)
    channels = instrument.bandpass.channels()
    field = fringe_field(instrument, channels, 50, rotation_rad=0.01)
    for shape, centre in (((40, 33), (0.37, -1.62)), ((20, 20), (-4.0, 3.5))):
        exact = fringe_basis(
            instrument, channels, shape, centre_px=centre, rotation_rad=0.01
        ).matrix
        quick = field.basis(shape, centre).matrix
        # The interpolation is good to 1e-8.
        assert np.abs(quick - exact).max() < 2e-8 * exact.max()
    again = fringe_field(load_instrument(name, filter=filter_name), channels, 49, rotation_rad=0.01)
    assert again is field

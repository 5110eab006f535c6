"""The affine map of the mask, against images whose every light wave was mapped exactly.

A mask under the map A makes at k the image that the drawing makes at Aᵀk: the truth here
needs neither the fringe model nor `Mask.mapped`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import amibayes
from amibayes.calibration import calibrate
from amibayes.cube import Cube, write_cube
from amibayes.extraction.extract import extract_all
from amibayes.extraction.mask_map import MapEstimate, MaskMap, combined, far_from_stated
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.reading import read_observations
from amibayes.extraction.table import target_of
from amibayes.extraction.view import View
from amibayes.extraction.visits import visit_maps
from amibayes.instrument import Distortion, load_instrument
from amibayes.optics.holes import hole_transform
from amibayes.scene.orientation import Orientation
from amibayes.units import DEGREE, MAS, FloatArray

COMMISSIONED = np.array([[1.001417, 0.007333], [-0.006240, 1.007186]])
NIRISS = load_instrument("niriss", "F480M")
OPTIONS = ExtractOptions()


def mapped_image(
    points: list[tuple[float, float, float]],
    matrix: FloatArray = COMMISSIONED,
    n: int = 64,
    over: int = 3,
) -> FloatArray:
    """Image (n, n) of points (x, y, flux) in mas, averaged over pixels by Gauss-Legendre."""
    pixel, channels = NIRISS.pixel_scale_rad, NIRISS.bandpass.channels()
    nodes, weights = np.polynomial.legendre.leggauss(over)
    axis = (np.add.outer(np.arange(n) - (n - 1) / 2, 0.5 * nodes) * pixel).ravel()
    total = np.zeros((n * over, n * over))
    for x, y, flux in points:
        place = np.stack(np.meshgrid(axis - x * MAS - 0.1 * pixel, axis - y * MAS + 0.2 * pixel))
        kx, ky = np.einsum("ji,jab->iab", matrix, place)
        for wavelength, weight in zip(channels.wavelength_m, channels.weight, strict=True):
            fx, fy = kx / wavelength, ky / wavelength
            field = sum(np.exp(-2j * np.pi * (fx * b[0] + fy * b[1])) for b in NIRISS.mask.holes_m)
            light = np.abs(field * hole_transform(NIRISS.mask, fx, fy)) ** 2 / wavelength**2
            total += flux * weight * light
    image = np.einsum("yaxb,a,b->yx", total.reshape(n, over, n, over), weights, weights)
    return np.asarray(image / image.sum())


def cube(
    image: FloatArray, seed: int, name: str = "star", photons: float = 1e9, **more: object
) -> Cube:
    rng = np.random.default_rng(seed)
    images = rng.poisson(photons * image, (8, *image.shape)).astype(float)
    error = np.sqrt(np.broadcast_to(photons * image + 10.0, images.shape))
    known = {"pixels_known": True} | more
    return Cube(
        images, NIRISS.pixel_scale_rad, "NIRISS", "F480M",
        error=error, header={"TARGNAME": name}, **known,
    )  # type: ignore[arg-type]  # fmt: skip


@pytest.fixture(scope="module")
def star() -> FloatArray:
    return mapped_image([(0.0, 0.0, 1.0)])


@pytest.mark.parametrize("matrix", [COMMISSIONED, np.eye(2)], ids=["commissioned", "drawn"])
def test_the_map_is_found_in_the_image_of_a_star(matrix: FloatArray) -> None:
    (found,) = visit_maps([cube(mapped_image([(0.0, 0.0, 1.0)], matrix), 1)], OPTIONS, {})
    assert found is not None
    np.testing.assert_allclose(found.matrix, matrix, atol=4e-5)


def test_target_and_calibrator_share_the_calibrators_map(star: FloatArray) -> None:
    binary = mapped_image([(0.0, 0.0, 1.0), (-120.0, 90.0, 0.2)])
    alone = visit_maps([cube(binary, 2)], OPTIONS, {})[0]
    both = visit_maps([cube(binary, 2), cube(star, 3, "other")], OPTIONS, {})
    assert alone is not None
    assert both[0] is not None
    assert both[1] is not None
    np.testing.assert_array_equal(both[0].matrix, both[1].matrix)
    assert both[0].error.max() < 0.2 * alone.error.max()
    np.testing.assert_allclose(both[0].matrix, COMMISSIONED, atol=1e-4)


@pytest.mark.parametrize(("separation", "angle"), [(200.0, 70.0)])
def test_positions_are_those_of_the_sky(star: FloatArray, separation: float, angle: float) -> None:
    off = separation_of(star, separation, angle)
    # 0.36 to 0.59 % before the mask was mapped.
    assert abs(off) < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("separation", "angle"),
    [(100.0, 20.0), (150.0, 120.0), (250.0, 200.0), (350.0, 310.0), (400.0, 250.0)],
)
def test_positions_are_those_of_the_sky_everywhere(
    star: FloatArray, separation: float, angle: float
) -> None:
    assert abs(separation_of(star, separation, angle)) < 2e-4


def separation_of(star: FloatArray, separation: float, angle: float) -> float:
    """Relative error of the separation of a companion of contrast 0.1."""
    x, y = (separation * np.array([-np.sin(angle * DEGREE), np.cos(angle * DEGREE)])).tolist()
    target = cube(mapped_image([(0.0, 0.0, 1.0), (x, y, 0.1)]), 4, photons=1e10)
    other = cube(star, 5, "other", photons=1e10)
    maps = visit_maps([target, other], OPTIONS, {})
    data, reference = (
        extract_all(c, OPTIONS, maps=[m])[0].observables
        for c, m in zip((target, other), maps, strict=True)
    )
    rng = np.random.default_rng(1)
    calibrated = calibrate([data], [reference], rng=rng).observables
    found = amibayes.search(amibayes.Likelihood(calibrated), (60.0, 500.0)).companion
    return float(found.separation_mas / separation - 1.0)


def test_pixels_that_are_not_known_take_the_blame_as_before(star: FloatArray) -> None:
    assert visit_maps([cube(star, 1, pixels_known=False)], OPTIONS, {}) == [None]
    assert visit_maps([cube(star, 1)], replace(OPTIONS, geometry="stated"), {}) == [None]


@pytest.mark.parametrize("wrong", [1.0, 1.04])
def test_pixels_that_contradict_the_mask_are_told(star: FloatArray, wrong: float) -> None:
    images = cube(star, 5)
    images = replace(images, pixel_scale_rad=wrong * images.pixel_scale_rad)
    (found,) = extract_all(images, method="fringes")
    doubts = [note for note in found.observables.notes if "pixel scale or filter" in note]
    assert len(doubts) == (wrong != 1.0)


def test_slopes_of_the_map_are_those_of_mapped_masks() -> None:
    from amibayes.extraction.mask_map import map_slopes

    n = NIRISS.mask.n_baselines
    rng = np.random.default_rng(31)
    visibility = np.concatenate([0.6 + 0.4 * rng.random(n), 0.3 * rng.standard_normal(n)])
    coefficients = np.concatenate([[1.0], visibility])
    view = View(NIRISS, NIRISS.bandpass.channels(), slice(0, 60), slice(0, 66), (0.3, -0.2))

    def image(step: FloatArray) -> FloatArray:
        moved = view.mapped(np.eye(2) + step[:4].reshape(2, 2)).moved(step[4:])
        return np.asarray(moved.basis().matrix @ coefficients)

    for slope, step in zip(map_slopes(view, coefficients), 1e-4 * np.eye(6), strict=True):
        exact = (image(step) - image(-step)) / 2e-4
        # Flux is free in the fit.
        flux = coefficients @ view.basis().matrix.T
        for vector in (slope, exact):
            vector -= flux * (flux @ vector) / (flux @ flux)
        assert np.linalg.norm(slope - exact) < 0.01 * np.linalg.norm(exact)


def test_dithers_and_segments_are_one_exposure(star: FloatArray, tmp_path: Path) -> None:
    arcsec = DEGREE / 3600.0
    paths = []
    for k, angle in enumerate((30.0 * DEGREE, 30.0 * DEGREE + 7 * arcsec, 40.0 * DEGREE)):
        given = cube(star, 10 + k, orientation=Orientation(angle), mjd=60000.0 + k + np.zeros(8))
        paths.append(tmp_path / f"jw_0000{k}_calints.fits")
        write_cube(paths[-1], given)
    found = read_observations(paths)
    assert [f.n_integrations for f in found] == [16, 8]
    assert all(str(p) in found[0].source for p in paths[:2])
    assert len(extract_all(paths)) == 2


def test_a_star_that_the_archive_does_not_know_goes_by_the_observers_name() -> None:
    blank = cube(np.ones((8, 8)) / 64.0, 1, name="UNKNOWN")
    named = replace(blank, header={"TARGNAME": "UNKNOWN", "TARGPROP": "AB-DOR"})
    assert (target_of(blank), target_of(named)) == ("", "AB-DOR")


def test_times_are_those_of_the_exposure_where_integrations_have_none(star: FloatArray) -> None:
    given = cube(star, 6)
    header = dict(given.header) | {"EXPMID": 60123.25}
    (found,) = extract_all(replace(given, header=header))
    assert found.observables.vis2.mjd[0] == pytest.approx(60123.25)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_maps_are_joined_by_least_squares(n: int) -> None:
    """With the prior as one more measurement; exposures that tell nothing are none."""
    rng = np.random.default_rng(n)
    prior = Distortion(np.array([[1.01, 0.002], [-0.003, 0.99]]), 0.004)
    estimates: list[MapEstimate | None] = [None]
    design, value = [np.eye(4) / 0.004], [prior.matrix.ravel() / 0.004]
    for _ in range(n):
        root = 1e-3 * rng.standard_normal((4, 4))
        found = prior.matrix.ravel() + 0.003 * rng.standard_normal(4)
        estimates.append(MapEstimate(found, root @ root.T))
        design.append(np.linalg.inv(root))
        value.append(np.linalg.solve(root, found))
    rows = np.concatenate(design)
    expected = np.linalg.lstsq(rows, np.concatenate(value), rcond=None)[0]
    joined = combined(estimates, prior)
    np.testing.assert_allclose(joined.matrix.ravel(), expected, rtol=1e-6)
    error = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))
    np.testing.assert_allclose(joined.error.ravel(), error, rtol=1e-6)


@pytest.mark.parametrize(
    ("off", "error", "told"),
    [(0.009, 0.001, False), (-0.011, 0.001, True), (0.011, 0.01, False), (0.035, 0.01, True)],
)
def test_a_map_beyond_a_percent_or_three_errors_is_doubted(
    off: float, error: float, *, told: bool
) -> None:
    stated = Distortion(np.array([[1.01, 0.002], [-0.003, 0.99]]), error)
    change = np.array([[0.001, 0.0], [off, -0.002]])
    found = far_from_stated(MaskMap(stated.matrix + change, np.full((2, 2), 1e-5)), stated)
    assert len(found) == told
    if told:
        assert f"{100.0 * abs(off):.1f} % off" in found[0]

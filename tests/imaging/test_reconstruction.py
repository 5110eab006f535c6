"""Images against the truth of simulated scenes, and gradients against finite differences."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from helpers import niriss, simulated
from pupil_images import Pupil, write_kernel_file
from scenes import SCENES, binned, observed

import amibayes as ab
from amibayes.cli import main
from amibayes.data.observables import Observables
from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.field import choose_grid
from amibayes.imaging.folds import folds_of
from amibayes.imaging.grid import PixelGrid, PixelResponse, pixel_response
from amibayes.imaging.problem import Problem
from amibayes.imaging.regularisers import REGULARISERS, default_image
from amibayes.kpfits import kernel_observables
from amibayes.models.uv_points import uv_points_of


def seen(name: str, seed: int = 5) -> Observables:
    return observed(niriss(0.003, 0.1), SCENES[name](), np.random.default_rng(seed))


def correlation(image: ab.ReconstructedImage, name: str) -> float:
    """Of the image with the scene, both with the beam of λ/2B."""
    truth = binned(SCENES[name](), image.grid.n, image.grid.pixel_mas)
    blurred = replace(image, light=truth).convolved()
    return float(np.corrcoef(blurred.ravel(), image.convolved().ravel())[0, 1])


@pytest.mark.parametrize("regulariser", REGULARISERS)
@pytest.mark.parametrize("flux", [None, 0.05])
@pytest.mark.parametrize("through", [False, True])
def test_gradient_is_that_of_finite_differences(
    regulariser: str, through: bool, flux: float | None
) -> None:
    """Central differences in random directions; also with a response to the flux of pixels."""
    rng = np.random.default_rng(1)
    data = seen("spiral")
    samples, grid = uv_points_of(data), PixelGrid(9, 50.0)
    response = pixel_response(samples, grid)
    if through:
        seen_flux = rng.uniform(0.5, 1.0, response.fringe.shape)
        response = PixelResponse(response.fringe * seen_flux, seen_flux, response.star, 1.0)
    problem = Problem(response, grid, REGULARISERS[regulariser](grid, flux), True)
    term = DataTerm.of(data, samples)
    light = rng.uniform(1e-4, 1e-3, 81)
    _, gradient = problem.objective(term, 30.0, light)
    for _ in range(4):
        step = 1e-7 * rng.standard_normal(81)
        high, low = (problem.objective(term, 30.0, light + s * step)[0] for s in (1.0, -1.0))
        assert (high - low) / 2.0 == pytest.approx(gradient @ step, rel=1e-5)


def test_gradient_with_an_estimated_covariance() -> None:
    """The t distribution's deviance."""
    rng = np.random.default_rng(2)
    data = _estimated()
    samples, grid = uv_points_of(data), PixelGrid(7, 60.0)
    problem = Problem(pixel_response(samples, grid), grid, REGULARISERS["tv"](grid), False)
    term, light = DataTerm.of(data, samples), rng.uniform(1e-4, 1e-3, 49)
    _, gradient = problem.objective(term, 1.0, light)
    step = 1e-7 * rng.standard_normal(49)
    high, low = (problem.objective(term, 1.0, light + s * step)[0] for s in (1.0, -1.0))
    assert (high - low) / 2.0 == pytest.approx(gradient @ step, rel=1e-5)


def _estimated() -> Observables:
    from amibayes.data.degrees_of_freedom import Freedom

    return replace(seen("disc"), freedom=Freedom(40.0, 39.0), covariance_kind="estimated")


def test_residuals_are_those_of_the_likelihood() -> None:
    """A point in one pixel is the binary of the model, smearing included."""
    data = seen("disc")
    samples = uv_points_of(data)
    grid = PixelGrid(9, 50.0)
    light = np.zeros((9, 9))
    light[6, 3] = 0.1  # 50 mas to the west, 100 mas to the north
    value, _ = pixel_response(samples, grid).visibility(light.ravel())
    found = DataTerm.of(data, samples).chi2(value)
    likelihood = ab.Likelihood(data, ab.BinaryModel(1))
    assert found == pytest.approx(float(likelihood.chi2([[-50.0, 100.0, 0.1]])[0]), rel=1e-9)


LEAST = {"disc": 0.93, "ring with companion": 0.86, "spiral": 0.86}
"""Correlations of other seeds are within 0.03."""


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_recognised(name: str) -> None:
    """At a given weight: correlation with the truth, flux, and χ² of the data."""
    image = ab.reconstruct_image(seen(name), weight=100.0, pixel_mas=30.0)
    assert correlation(image, name) > LEAST[name]
    assert image.flux == pytest.approx(SCENES[name]()[2].sum(), rel=0.4)
    assert image.chi2r < 1.3
    assert image.chi2_star > 100.0 * image.n_independent
    assert (image.light >= 0.0).all()
    assert np.abs(image.back_projected).max() < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("regulariser", REGULARISERS)
@pytest.mark.parametrize("name", SCENES)
def test_cross_validation_chooses_a_weight_that_predicts(name: str, regulariser: str) -> None:
    image = ab.reconstruct_image(seen(name), regulariser=regulariser, pixel_mas=30.0)
    assert 0.3 < image.weight < 1000.0
    assert correlation(image, name) > LEAST[name]
    assert image.scores.min() < 5.0
    assert image.scores[0] > 5.0 * image.scores.min()
    assert image.flux == pytest.approx(SCENES[name]()[2].sum(), rel=0.4)
    assert image.chi2r < 1.5


def test_noise_alone_makes_hardly_any_light() -> None:
    """A single star: less than a hundredth of its flux, and χ² is that of noise."""
    star = (np.zeros(1), np.zeros(1), np.zeros(1))
    data = observed(niriss(0.003, 0.1), star, np.random.default_rng(3))
    image = ab.reconstruct_image(data, weight=100.0, pixel_mas=40.0)
    assert image.flux < 0.01
    assert 0.3 < image.chi2r < 1.7


def test_folds_leave_out_baselines_with_all_their_triangles() -> None:
    data = niriss()
    times = np.zeros(21)
    folds = folds_of(data, np.random.default_rng(1))
    assert sorted(int(out[0].sum()) for _, out in folds) == [4, 4, 4, 4, 5]
    for kept, out in folds:
        gone = {tuple(sorted(s)) for s in data.vis2.stations[out[0]].tolist()}
        for stations in data.closure_phase.stations[kept[1]].tolist():
            a, b, c = sorted(stations)
            assert not {(a, b), (b, c), (a, c)} & gone
        assert not (kept[0] & out[0]).any()
        assert (kept[1] | out[1]).all()
        times += out[0]
    assert (times == 1).all()


def test_kernel_phases_make_an_image(tmp_path: Path) -> None:
    """Phases alone: a companion of 3 % at (−120, 60) mas is the brightest pixel."""
    pupil = Pupil()
    value = pupil.phases(-120.0, 60.0, 0.03, 30.0)[None]
    covariance = (1e-3**2 * np.eye(value.shape[1]))[None]
    path = write_kernel_file(tmp_path / "a.fits", pupil, value, covariance, np.array([30.0]))
    image = ab.reconstruct_image(
        kernel_observables(path), weight=3.0, field_mas=500.0, pixel_mas=30.0
    )
    row, column = np.unravel_index(int(image.light.argmax()), image.light.shape)
    assert image.grid.offset_mas[[column, row]] == pytest.approx([-120.0, 60.0], abs=31.0)
    assert 0.02 < image.flux < 0.06  # phases say little of symmetric light


def test_sizes_that_make_no_image_are_refused() -> None:
    samples = uv_points_of(niriss())
    with pytest.raises(ab.UsageError, match="pixels a side"):
        choose_grid(samples, 1e6, 1.0)
    with pytest.raises(ab.UsageError, match="no regulariser"):
        ab.reconstruct_image(niriss(), regulariser="clean")


@pytest.mark.usefixtures("full_pictures")
def test_command_writes_image_with_coordinates(tmp_path: Path) -> None:
    """East is to the left, the star in the middle, and a bright pixel where light was put."""
    file = tmp_path / "a.oifits"
    points = (np.array([120.0]), np.array([60.0]), np.array([0.05]))
    sheet = observed(niriss(0.003, 0.1), points, np.random.default_rng(1))
    setups = tuple(
        replace(s, right_ascension_deg=50.0, declination_deg=-20.0) for s in sheet.setups
    )
    ab.write_oifits(file, replace(sheet, setups=setups))
    out = tmp_path / "out"
    arguments = ["--weight", "30", "--field", "500", "--pixel", "30", "--quiet"]
    assert main(["image", str(file), "--out", str(out), *arguments]) == 0
    content = json.loads((out / "image.json").read_text())
    assert content["flux"] == pytest.approx(0.05, rel=0.3)
    assert (out / "image.png").stat().st_size > 20_000
    with fits.open(out / "image.fits") as hdus:
        names = [h.name for h in hdus[1:]]
        assert names == ["CONVOLVED", "DIRTY", "BEAM", "RESIDUAL"]
        row, column = np.unravel_index(int(hdus[0].data.argmax()), hdus[0].data.shape)
        sky = WCS(hdus[0].header).pixel_to_world(column, row)
    east, north = (sky.ra.deg - 50.0) * np.cos(np.radians(-20.0)), sky.dec.deg + 20.0
    assert np.array([east, north]) * 3.6e6 == pytest.approx([120.0, 60.0], abs=31.0)


def test_default_image_is_a_gaussian_half_as_wide_as_the_field() -> None:
    grid = PixelGrid(41, 10.0)
    image = default_image(grid).reshape(41, 41)
    assert image.sum() == pytest.approx(1.0)
    # Half of the maximum at a quarter of the field from the middle.
    from_middle = np.abs(grid.east_mas.reshape(41, 41)[20])
    at = np.interp(0.25 * 410.0, from_middle[20:], image[20, 20:])
    assert at == pytest.approx(0.5 * image[20, 20], rel=1e-2)


def test_an_image_of_vis2_alone_has_no_misfit_of_phases() -> None:
    data = seen("spiral")
    alone = data.select(np.ones(len(data.vis2), bool), np.zeros(len(data.closure_phase), bool))
    image = ab.reconstruct_image(alone, weight=30.0)
    assert np.isfinite(image.chi2_vis2)
    assert np.isnan(image.chi2_phase)


@pytest.mark.parametrize("flux", [None, 0.3])
def test_entropy_is_least_and_zero_at_its_default_image(flux: float | None) -> None:
    grid = PixelGrid(7, 40.0)
    prior, light = default_image(grid), 0.3 if flux is None else flux
    value = REGULARISERS["entropy"](grid, flux)
    found, gradient = value(light * prior)
    assert found == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-12)
    rng = np.random.default_rng(1)
    assert all(value(light * prior * rng.uniform(0.5, 1.5, 49))[0] > 0.0 for _ in range(5))


@pytest.mark.parametrize("regulariser", ["tv", pytest.param("entropy", marks=pytest.mark.slow)])
def test_light_at_the_brightest_place_is_the_companions(regulariser: str) -> None:
    """That of the whole image is more: noise adds light, and pixels are nowhere negative."""
    east, north, contrast = 173.2, -100.0, 0.01
    rng = np.random.default_rng(0)
    data = simulated(niriss(0.003, 0.1), (east, north, contrast), rng)
    image = ab.reconstruct_image(data, regulariser=regulariser)
    *place, flux = image.brightest
    assert np.hypot(place[0] - east, place[1] - north) < 0.5 * image.beam_mas
    assert flux == pytest.approx(contrast, rel=0.05)
    assert image.flux > 1.03 * flux

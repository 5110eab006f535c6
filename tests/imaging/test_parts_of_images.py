"""Parts of a reconstruction against their definitions: pixels, fields, choices and warnings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import niriss
from interferometer import four_telescopes
from scenes import disc, observed

import amibayes as ab
from amibayes.data.observables import Observables
from amibayes.errors import DataError, UsageError
from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.field import choose_grid, default_field, repetition_mas
from amibayes.imaging.grid import PixelGrid, pixel_response
from amibayes.imaging.problem import MAX_FLUX, Problem
from amibayes.imaging.reconstruct import _diameter, _problem, _refuse_few
from amibayes.imaging.regularisers import REGULARISERS
from amibayes.imaging.result import ReconstructedImage
from amibayes.imaging.warnings import warnings_of
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.uv_points import uv_points_of
from amibayes.pipeline.imaging import ImagingOptions, ImagingReport
from amibayes.report.reconstruction import imaging_json, imaging_summary
from amibayes.scene.disc import disc_visibility
from amibayes.units import MAS


@pytest.fixture(scope="module")
def data() -> Observables:
    return observed(niriss(0.003, 0.1), disc(), np.random.default_rng(5))


@pytest.fixture(scope="module")
def image(data: Observables) -> ReconstructedImage:
    return ab.reconstruct_image(data, weight=3000.0, field_mas=350.0, pixel_mas=50.0)


def shown(**changes: Any) -> Any:
    """An image that nothing is held against, but for some changes."""
    fine = {"p_fit": 0.5, "chi2": 4321.6, "n_independent": 57, "left_out": 1.0, "bounds": ()}
    return SimpleNamespace(**(fine | {"beside_star": 0.05, "diameter_mas": 2.3456} | changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"p_fit": 0.9e-3}, "does not fit the data: chi2 is 4322 of 57 numbers"),
        ({"left_out": 3.01}, "data left out are not predicted: chi2 is 3.01 per datum at best"),
        ({"bounds": ("flux",)}, "is at its bound of 10 times the star's: the image has taken"),
        ({"bounds": ("diameter",)}, "the star's diameter, 2.35 mas, is at its bound"),
        ({"beside_star": 0.101}, "may have light of the star: 0.1 of its flux lies within λ/4B"),
    ],
)
def test_what_is_held_against_an_image(changes: dict[str, Any], words: str) -> None:
    (line,) = warnings_of(shown(**changes))
    assert words in line


def test_nothing_is_held_against_a_good_image() -> None:
    assert not warnings_of(shown(p_fit=1e-3, left_out=3.0, beside_star=0.1))
    assert not warnings_of(shown(left_out=float("nan")))
    both = shown(p_fit=0.0, left_out=9.0, bounds=("flux", "diameter"), beside_star=1.0)
    assert len(warnings_of(both)) == 5


def test_pixels_lie_around_the_star() -> None:
    grid = PixelGrid(5, 20.0)
    east, north = grid.east_mas.reshape(5, 5), grid.north_mas.reshape(5, 5)
    assert list(east[3]) == [-40.0, -20.0, 0.0, 20.0, 40.0]
    assert list(north[:, 1]) == [-40.0, -20.0, 0.0, 20.0, 40.0]
    for n, size in ((1, 20.0), (4, 20.0), (5, 0.0)):
        with pytest.raises(ValueError, match="odd number of pixels, 3 or more"):
            PixelGrid(n, size)
    assert PixelGrid(3, 1.0).n == 3


@pytest.mark.parametrize("chunk", [512, 7])
def test_response_of_pixels(chunk: int, data: Observables, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fourier transform of each pixel, damped by the band; and what the extraction lets through."""
    monkeypatch.setattr("amibayes.imaging.grid.CHUNK", chunk)
    samples, grid = uv_points_of(data), PixelGrid(5, 60.0)
    delay = np.outer(samples.u, grid.east_mas) + np.outer(samples.v, grid.north_mas)
    smear = np.sinc(samples.relative_band[:, None] * delay * MAS)
    expected = smear * np.exp(-2j * np.pi * delay * MAS)
    plain = pixel_response(samples, grid, diameter_mas=30.0)
    np.testing.assert_allclose(plain.fringe, expected, atol=1e-3)
    assert plain.flux is None
    np.testing.assert_allclose(plain.star, disc_visibility(samples.frequency, 30.0), atol=1e-9)
    np.testing.assert_array_equal(pixel_response(samples, grid).star, 1.0)
    none = pixel_response(samples, grid, star=False, diameter_mas=30.0)
    assert none.star_flux == 0.0
    assert not none.star.any()

    n = len(samples)

    def through(place: Any) -> Any:
        weight = np.exp(-((place[0] / 80.0) ** 2) - (place[1] / 60.0) ** 2)
        return np.outer(np.linspace(0.5, 1.5, n), weight), np.tile(weight, (n, 1))

    part = replace(samples, off_axis=SimpleNamespace(start=(7.0, -11.0), at=through))
    found = pixel_response(part, grid)
    seen, flux = through((grid.east_mas - 7.0, grid.north_mas + 11.0))
    np.testing.assert_allclose(found.fringe, plain.fringe * seen)
    np.testing.assert_allclose(found.flux, flux)
    light = np.random.default_rng(1).uniform(0.0, 0.01, grid.n**2)
    value, total = found.visibility(light)
    np.testing.assert_allclose(total, 1.0 + flux @ light)
    np.testing.assert_allclose(value, (1.0 + (plain.fringe * seen) @ light) / (1.0 + flux @ light))


class Points(SimpleNamespace):
    """Points (u, v) in wavelengths."""

    def __len__(self) -> int:
        return len(self.u)

    @property
    def frequency(self) -> np.ndarray:
        return np.asarray(np.hypot(self.u, self.v))


def test_the_sky_of_a_lattice_repeats_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """After 1/B either way, within the steps of a quarter of a fringe."""
    u, v = np.array([[1.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, -1.0]]) * 1e6
    lattice, period = Points(u=u, v=v), 1.0 / 1e6 / MAS
    side = repetition_mas(lattice)
    assert side == pytest.approx(period, abs=0.25 * period / np.sqrt(2.0))
    assert default_field(lattice) == pytest.approx(max(side, period))
    # Few pixels can be afforded in a small field only, but not below λ/B_min.
    monkeypatch.setattr("amibayes.imaging.field.WIDE_NUMBERS", 4.0)
    assert default_field(lattice) == pytest.approx(period)


@pytest.mark.parametrize("numbers", [1e7, 5e6, 1e6])
def test_fields_are_as_wide_as_points_afford(
    numbers: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twice λ/B_min, what so many pixels of a quarter of λ/2B cover, or λ/B_min."""
    monkeypatch.setattr("amibayes.imaging.field.WIDE_NUMBERS", numbers)
    rng = np.random.default_rng(2)
    length, angle = np.linspace(1.0, 20.0, 50) * 1e6, rng.uniform(0.0, 2.0 * np.pi, 50)
    points = Points(u=length * np.cos(angle), v=length * np.sin(angle))
    assert repetition_mas(points) == np.inf
    wide, beam = 1.0 / 1e6 / MAS, 0.5 / 20e6 / MAS
    affordable = beam / 4.0 * np.sqrt(numbers / 50)
    found = default_field(points)
    assert found == pytest.approx({1e7: 2.0 * wide, 5e6: affordable, 1e6: wide}[numbers])
    assert wide < beam / 4.0 * np.sqrt(5e6 / 50) < 2.0 * wide
    assert choose_grid(points).pixel_mas == pytest.approx(max(beam / 4.0, found / 101))


def test_sides_of_images() -> None:
    points = Points(u=np.linspace(1e6, 2e7, 50), v=np.zeros(50))
    for field, pixel, n in ((90.0, 10.0, 9), (100.0, 10.0, 11), (100.1, 10.0, 11), (50.0, 10.0, 5)):
        assert choose_grid(points, field, pixel) == PixelGrid(n, pixel)
    with pytest.raises(UsageError, match="an image of 3 pixels a side for 50 points of the"):
        choose_grid(points, 20.0, 10.0)
    assert choose_grid(points, 893.0, 1.0).n == 893
    with pytest.raises(UsageError, match="an image of 895 pixels a side for 50 points"):
        choose_grid(points, 895.0, 1.0)


def test_beams_and_dirty_images(image: ReconstructedImage) -> None:
    samples, x, light = image.samples, image.grid.offset_mas, image.light
    beam, made = image.dirty_beam(), image.dirty_image()
    whole, n = 1.0 + light.sum(), len(samples)
    for row, column in ((0, 0), (2, 5), (3, 3)):
        turn = np.exp(2j * np.pi * MAS * (samples.u * x[column] + samples.v * x[row]))
        assert beam[row, column] == pytest.approx(turn.real.mean())
        value = ((image.visibility * whole - 1.0) * turn).real.sum() / n
        assert made[row, column] == pytest.approx(value)
    assert image.flux == pytest.approx(light.sum())
    assert image.beam_mas == pytest.approx(0.5 / samples.frequency.max() / MAS)
    near = sum(
        light[j, k]
        for j in range(len(x))
        for k in range(len(x))
        if np.hypot(x[j], x[k]) <= 0.5 * image.beam_mas
    )
    assert image.beside_star == pytest.approx(near)
    assert replace(image, star=False).beside_star == 0.0
    assert image.chi2r == pytest.approx(image.chi2 / 36.0)
    tried = replace(image, weights=np.ones(2), scores=np.array([4.0, 2.0]))
    assert (tried.left_out, np.isnan(image.left_out)) == (2.0, True)


def test_a_beam_keeps_the_flux_and_has_its_width(image: ReconstructedImage) -> None:
    point = np.zeros((7, 7))
    point[3, 3] = 2.0
    x, sigma = image.grid.offset_mas, 60.0 / (2.0 * np.sqrt(2.0 * np.log(2.0)))
    shape = np.exp(-0.5 * (x / sigma) ** 2)
    expected = 2.0 * np.outer(shape, shape) / shape.sum() ** 2
    one = replace(image, light=point)
    np.testing.assert_allclose(one.convolved(60.0), expected)
    np.testing.assert_allclose(one.convolved(), one.convolved(image.beam_mas))


def test_back_projected_residuals_in_units_of_their_noise(image: ReconstructedImage) -> None:
    """tᵀC⁻¹r/√(tᵀC⁻¹t) of the change t of the data by light in a pixel."""
    data, samples = image.observables, image.samples
    response = pixel_response(samples, image.grid)
    term = DataTerm.of(data, samples)
    light = image.light.ravel()
    value, _ = response.visibility(light)
    inverse = np.linalg.pinv(data.covariance.dense(), rcond=1e-10, hermitian=True)
    for k in (0, 17, 24, 40):
        step = np.zeros(len(light))
        step[k] = 1e-7
        high, low = (term.residual(response.visibility(light + s * step)[0]) for s in (1.0, -1.0))
        change = (low - high) / 2e-7
        expected = change @ inverse @ term.residual(value) / np.sqrt(change @ inverse @ change)
        assert image.back_projected.ravel()[k] == pytest.approx(expected, rel=1e-3, abs=1e-4)
    left = term.residual(value)
    assert image.chi2 == pytest.approx(left @ inverse @ left)
    n = data.n_vis2
    own = np.linalg.pinv(data.covariance.dense()[:n, :n])
    assert image.chi2_vis2 == pytest.approx(left[:n] @ own @ left[:n])
    alone = term.residual(np.ones(len(samples), dtype=complex))
    assert image.chi2_star == pytest.approx(alone @ inverse @ alone)


@pytest.mark.parametrize("flux", [0.5, 3.0, 12.0])
@pytest.mark.parametrize("free", [True, False])
def test_slopes_of_bright_images_and_discs(flux: float, free: bool, data: Observables) -> None:
    """Finite differences; beyond the most light the objective rises."""
    samples, grid = uv_points_of(data), PixelGrid(5, 70.0)
    frequency = samples.frequency if free else None
    regulariser = REGULARISERS["tv"](grid)
    problem = Problem(pixel_response(samples, grid), grid, regulariser, False, frequency)
    term = DataTerm.of(data, samples)
    rng = np.random.default_rng(3)
    light = rng.uniform(0.5, 1.0, 25)
    values = light * flux / light.sum()
    values = np.append(values, 40.0**2) if free else values
    value, gradient = problem.objective(term, 2.0, values)
    for _ in range(3):
        step = (
            1e-6 * rng.standard_normal(len(values)) * np.where(np.arange(len(values)) < 25, 1, 99)
        )
        high, low = (problem.objective(term, 2.0, values + s * step)[0] for s in (1.0, -1.0))
        assert (high - low) / 2.0 == pytest.approx(gradient @ step, rel=1e-4)
    deviance = term.deviance(problem.visibility(values))
    prior = 2.0 * np.log(1.0 + flux**2) + 1e4 * max(flux - MAX_FLUX, 0.0) ** 2
    assert value == pytest.approx(deviance + 4.0 * regulariser(values[:25])[0] + prior)


def test_the_first_disc_fits_best_of_those_tried(data: Observables) -> None:
    samples, grid = uv_points_of(data), PixelGrid(5, 70.0)
    regulariser = REGULARISERS["tv"](grid)
    problem = Problem(pixel_response(samples, grid), grid, regulariser, False, samples.frequency)
    term = DataTerm.of(data, samples)
    first = problem.first(term)
    step = 0.25 / samples.frequency.max() / MAS
    largest = 1.2 / samples.frequency.min() / MAS
    assert problem.largest_disc_mas == pytest.approx(largest)
    tried = step * np.arange(1, int(largest / step) + 1)
    assert first[:-1].sum() == pytest.approx(0.05)
    misfit = [term.chi2(problem.visibility(np.append(first[:-1], d**2))) for d in tried]
    assert np.sqrt(first[-1]) == pytest.approx(tried[int(np.argmin(misfit))])
    ends = np.append(np.full(25, 9.95 / 25), (0.995 * largest) ** 2)
    assert problem.ends(ends) == ("flux", "diameter")
    assert problem.ends(np.append(np.full(25, 9.85 / 25), (0.985 * largest) ** 2)) == ()
    without = replace(problem, response=pixel_response(samples, grid, star=False), frequency=None)
    assert without.ends(np.full(25, 9.95 / 25)) == ()
    assert without.first(term).sum() == pytest.approx(1.0)


def test_there_is_no_light_in_the_dark(data: Observables) -> None:
    """Pixels as near to the star as asked keep the least that there may be."""
    samples, grid = uv_points_of(data), PixelGrid(5, 70.0)
    response, tv = pixel_response(samples, grid), REGULARISERS["tv"](grid)
    term = DataTerm.of(data, samples)
    radius = np.hypot(grid.east_mas, grid.north_mas)
    for positive, least in ((False, 0.0), (True, 1e-6 * 0.05 / 25)):
        problem = Problem(response, grid, tv, positive, None, 70.0)
        light = problem.solve(term, 1000.0, problem.first(term), 60)
        np.testing.assert_allclose(light[radius <= 70.0], least)
        assert light[radius > 70.0].max() > 1e-4
        assert light.min() >= least


def test_what_images_are_refused() -> None:
    """Messages, each with what it counts."""
    likelihood = Likelihood(niriss())
    _refuse_few(likelihood)
    few = Likelihood(niriss().select(np.arange(21) < 2, np.zeros(35, bool)))
    with pytest.raises(DataError, match="holds 2 independent data, of which no image can be made"):
        _refuse_few(few)
    with pytest.raises(UsageError, match="'lasso' is no regulariser"):
        _problem(likelihood, PixelGrid(5, 50.0), "lasso", True, 0.0)
    assert _diameter(likelihood, None, True) == 0.0
    assert _diameter(Likelihood(four_telescopes(1)), None, True) == "free"
    assert _diameter(Likelihood(four_telescopes(1)), None, False) == 0.0
    assert _diameter(likelihood, 3.0, True) == 3.0
    assert _diameter(likelihood, "free", True) == "free"


@pytest.mark.parametrize(
    ("beside", "told"),
    [
        (0.0005, "light       0.157 of the star's flux"),
        (0.0505, "light       0.106 of the star's flux, and 0.051 within λ/4B of the star, which"),
    ],
)
def test_what_may_be_the_star_is_no_light_around_it(
    image: ReconstructedImage, beside: float, told: str
) -> None:
    """The least share of the star that an image took made its light half as much again."""
    report = ImagingReport(image, ImagingOptions(), (), (), (), {})
    content = imaging_json(report, "") | {"flux": 0.1568, "flux_beside_star": beside}
    (line,) = [x for x in imaging_summary(content, Path("out")) if x.startswith("light")]
    assert line.startswith(told)


def test_the_summary_tells_the_light_at_the_brightest_place(image: ReconstructedImage) -> None:
    report = ImagingReport(image, ImagingOptions(), (), (), (), {})
    place = {"brightest": {"east_mas": -30.0, "north_mas": 40.0, "flux": 0.01004}}
    content = imaging_json(report, "") | {"flux": 0.0123, "flux_beside_star": 0.0} | place
    (line,) = [x for x in imaging_summary(content, Path("out")) if x.startswith("brightest")]
    assert line.startswith("brightest   0.01 within λ/2B of 50 mas, PA 323 deg")
    dark = imaging_summary(content | {"flux": 0.0}, Path("out"))
    assert not any(x.startswith("brightest") for x in dark)

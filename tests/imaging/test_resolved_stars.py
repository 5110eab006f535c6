"""Images of VLTI data, where the star itself is resolved; and what an image warns of."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import interferometer
import numpy as np
import pytest
from helpers import error_of, niriss
from scenes import SCENES, observed

import amibayes as ab
from amibayes.cli import main
from amibayes.data.observables import Observables
from amibayes.imaging.choice import largest_that_fits
from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.field import choose_grid, default_field
from amibayes.imaging.grid import PixelGrid, pixel_response
from amibayes.imaging.problem import MAX_FLUX, Problem
from amibayes.imaging.regularisers import REGULARISERS
from amibayes.imaging.warnings import warnings_of
from amibayes.models.uv_points import uv_points_of
from amibayes.scene.disc import disc_visibility
from amibayes.units import MAS

COMPANION = 4.33, 2.5, 0.1
"""East and north in mas, and flux of the star's: 5 mas away."""


def with_companion(diameter_mas: float = 1.0) -> Observables:
    """Four telescopes, four times: a star with a disc, and a point; 1 % of V² and 0.6°."""
    sheet = interferometer.four_telescopes(4, vis2_error=0.01, closure_error_deg=0.6)
    east, north, flux = COMPANION

    def visibility(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        star = disc_visibility(np.hypot(u, v), diameter_mas)
        return (star + flux * np.exp(-2j * np.pi * MAS * (u * east + v * north))) / (1.0 + flux)

    return interferometer.observed(sheet, visibility, np.random.default_rng(4))


@cache
def imaged() -> ab.ReconstructedImage:
    return ab.reconstruct_image(with_companion(), weight=10.0, field_mas=13.0, pixel_mas=0.6)


def test_a_resolved_star_keeps_its_light() -> None:
    """The companion has its place and its flux; the star's disc is not in the image."""
    image, (east, north, flux) = imaged(), COMPANION
    assert image.diameter_free
    x = image.grid.offset_mas
    there = np.hypot(x - east, x[:, None] - north) < image.beam_mas
    assert image.light[there].sum() == pytest.approx(flux, rel=0.2)
    row, column = np.unravel_index(int(image.convolved().argmax()), image.light.shape)
    assert x[[column, row]] == pytest.approx([east, north], abs=0.5 * image.beam_mas)
    assert image.flux < 2.0 * flux
    assert image.beside_star == 0.0
    assert image.p_fit > 1e-3
    assert not image.bounds


def test_an_image_is_dark_as_far_as_the_star_is_not_told_from_its_surroundings() -> None:
    """To λ/4B of the longest baseline, 0.7 mas: a companion at 1.9 mas has its place.

    That of the shortest, 2.4 mas, lies beyond the companion.
    """
    sheet = interferometer.four_telescopes(3, 1, vis2_error=0.01, closure_error_deg=0.6)
    longest = max(np.hypot(sheet.vis2.u_m, sheet.vis2.v_m)[:, 0] / sheet.vis2.wavelength_m)

    def visibility(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        companion = 0.1 * np.exp(-2j * np.pi * MAS * (1.6 * u + 1.0 * v))
        return (disc_visibility(np.hypot(u, v), 1.0) + companion) / 1.1

    data = interferometer.observed(sheet, visibility, np.random.default_rng(4))
    image = ab.reconstruct_image(
        data, weight=10.0, field_mas=6.0, pixel_mas=0.5, diameter_mas="free"
    )
    x = image.grid.offset_mas
    dark = np.hypot(x, x[:, None]) < 0.25 / longest / MAS
    assert dark.sum() > 1
    assert image.light[dark].max() == 0.0
    row, column = np.unravel_index(int(image.light.argmax()), image.light.shape)
    assert x[[column, row]] == pytest.approx([1.6, 1.0], abs=0.3)


def test_a_star_of_a_given_diameter_keeps_its_light() -> None:
    image = ab.reconstruct_image(
        with_companion(), weight=10.0, field_mas=13.0, pixel_mas=0.6, diameter_mas=1.0
    )
    assert image.beside_star == 0.0
    assert image.flux == pytest.approx(COMPANION[2], rel=0.4)
    assert image.p_fit > 1e-3


def test_the_diameter_of_a_star_alone_is_fitted() -> None:
    sheet = interferometer.four_telescopes(3, vis2_error=0.01)
    data = interferometer.observed(
        sheet,
        lambda u, v, _: disc_visibility(np.hypot(u, v), 1.5).astype(complex),
        np.random.default_rng(2),
    )
    image = ab.reconstruct_image(data, weight=100.0, pixel_mas=0.7, diameter_mas="free")
    assert image.diameter_mas == pytest.approx(1.5, abs=0.05)
    assert image.flux < 0.02


def test_gradient_with_a_free_diameter_is_that_of_finite_differences() -> None:
    """Also beyond the bound of the flux, and in the square of the diameter at nearly 0."""
    rng, data = np.random.default_rng(1), with_companion()
    samples, grid = uv_points_of(data), PixelGrid(7, 1.0)
    response = pixel_response(samples, grid)
    problem = Problem(response, grid, REGULARISERS["tv"](grid), False, samples.frequency)
    term = DataTerm.of(data, samples)
    for flux, square in ((0.1, 1.0), (1.2 * MAX_FLUX, 0.3), (0.1, 1e-3)):
        values = np.append(rng.uniform(0.5, 1.5, 49) * flux / 49, square)
        _, gradient = problem.objective(term, 3.0, values)
        step = 1e-5 * values * rng.standard_normal(50)
        high, low = (problem.objective(term, 3.0, values + s * step)[0] for s in (1.0, -1.0))
        assert (high - low) / 2.0 == pytest.approx(gradient @ step, rel=1e-4)


def test_a_disc_beyond_the_largest_ends_there() -> None:
    """The largest is known by its visibility at the shortest baseline, which is lower still."""
    sheet = interferometer.four_telescopes(2, 1, vis2_error=0.01)
    samples, grid = uv_points_of(sheet), PixelGrid(5, 1.0)
    response = pixel_response(samples, grid)
    problem = Problem(response, grid, REGULARISERS["tv"](grid), False, samples.frequency)
    for part, ends, precise in ((0.5, (), 0.1), (1.2, ("diameter",), 1e-6)):
        true = part * problem.largest_disc_mas
        data = interferometer.observed(
            sheet, lambda u, v, _, d=true: disc_visibility(np.hypot(u, v), d).astype(complex)
        )
        term = DataTerm.of(data, samples)
        found = problem.solve(term, 1e4, np.append(np.full(25, 1e-6), 0.9 * true**2))
        assert problem.ends(found) == ends
        expected = min(true, problem.largest_disc_mas)
        assert np.sqrt(found[-1]) == pytest.approx(expected, rel=precise)


def test_the_flux_ends_at_its_bound_with_a_warning() -> None:
    """A star said to be a point that is a disc of 3 mas: the image takes its place."""
    sheet = interferometer.four_telescopes(3, vis2_error=0.01)
    data = interferometer.observed(
        sheet,
        lambda u, v, _: disc_visibility(np.hypot(u, v), 3.0).astype(complex),
        np.random.default_rng(2),
    )
    image = ab.reconstruct_image(data, weight=1.0, pixel_mas=0.7, diameter_mas=0.0)
    assert image.flux < 1.01 * MAX_FLUX
    assert image.beside_star > 0.1
    told = " ".join(warnings_of(image))
    assert "light of the star" in told
    assert "bound of 10" in " ".join(warnings_of(replace(image, bounds=("flux",))))
    assert "no baseline is short enough" in " ".join(
        warnings_of(replace(image, bounds=("diameter",)))
    )


def test_field_is_that_of_a_search_unless_the_sky_repeats_itself() -> None:
    samples = uv_points_of(with_companion())
    outer = 1.0 / samples.frequency.min() / MAS
    assert default_field(samples) == pytest.approx(2.0 * outer)
    assert choose_grid(samples).offset_mas.max() >= 0.95 * outer
    # The holes of NIRISS are on a lattice: 1.14 m apart in rows, the sky repeats itself.
    of_niriss = uv_points_of(niriss())
    outer = 1.0 / of_niriss.frequency.min() / MAS
    assert outer <= default_field(of_niriss) < 1.3 * outer


def test_an_image_that_fits_is_preferred_where_nothing_is_predicted() -> None:
    """Of weights that are all within one standard error, the largest whose χ² is acceptable."""
    data = observed(niriss(0.003, 0.1), SCENES["spiral"](), np.random.default_rng(5))
    samples = uv_points_of(data)
    grid = choose_grid(samples, pixel_mas=40.0)
    problem = Problem(pixel_response(samples, grid), grid, REGULARISERS["tv"](grid), False)
    term = DataTerm.of(data, samples)
    weights = np.array([1e5, 1e4, 30.0, 10.0])
    equal = np.stack([weights, np.full(4, 50.0), np.full(4, 10.0)])
    weight, light = largest_that_fits(problem, term, equal)
    assert weight == 30.0
    assert term.chi2(problem.visibility(light)) < 70.0
    hopeless = np.stack([weights[:2], [60.0, 50.0], np.full(2, 20.0)])
    assert largest_that_fits(problem, term, hopeless)[0] == 1e4


def test_poor_images_are_told_of() -> None:
    image = imaged()
    assert not warnings_of(image)
    poor = replace(image, p_fit=1e-4)
    assert "does not fit" in warnings_of(poor)[0]
    alone = replace(image, weights=np.ones(1), scores=np.array([50.0]), score_errors=np.ones(1))
    assert "50 per datum" in warnings_of(alone)[0]


def test_too_few_data_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = niriss()
    one = data.select(np.arange(21) == 0, np.zeros(35, bool))
    ab.write_oifits(tmp_path / "one.oifits", one)
    arguments = ["image", str(tmp_path / "one.oifits"), "--out", str(tmp_path / "out")]
    assert main(arguments) == 3
    assert "1 independent data" in error_of(capsys)
    sheet = interferometer.four_telescopes(1, channels=6)
    pair = np.all(sheet.vis2.stations == sheet.vis2.stations[0], axis=1)
    baseline = sheet.select(pair, np.zeros(sheet.n_closure_phases, bool))
    with pytest.raises(ab.DataError, match="one baseline"):
        ab.reconstruct_image(baseline, field_mas=10.0, pixel_mas=1.0)


def test_diameters_that_nothing_tells_are_refused() -> None:
    data = niriss()
    phases = data.select(np.zeros(21, bool), np.ones(35, bool))
    with pytest.raises(ab.UsageError, match="phases alone"):
        ab.reconstruct_image(phases, diameter_mas="free")
    with pytest.raises(ab.UsageError, match="no star"):
        ab.reconstruct_image(data, diameter_mas="free", star=False)


def test_command_warns_and_fits_the_diameter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The companion outside of a narrow field: no silent picture."""
    import json

    file, out = tmp_path / "a.oifits", tmp_path / "out"
    ab.write_oifits(file, with_companion())
    arguments = ["--weight", "300", "--field", "5", "--pixel", "0.5", "--diameter", "free"]
    assert main(["image", str(file), "--out", str(out), *arguments]) == 0
    content = json.loads((out / "image.json").read_text())
    assert content["diameter_free"]
    assert content["p_fit"] < 1e-3
    assert any("does not fit" in w for w in content["warnings"])
    assert "does not fit" in capsys.readouterr().out

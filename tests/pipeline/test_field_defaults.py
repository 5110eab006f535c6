"""What is chosen unasked: limb darkening past the first null, a field that holds the companion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from interferometer import darkened_disc, four_telescopes, observed

from amibayes.data.observables import join
from amibayes.data.point_source import point_source
from amibayes.errors import DataError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions, model_of
from amibayes.units import MAS

STATIONS = np.array([[0.0, 0.0], [30.0, 10.0], [-20.0, 45.0], [60.0, -30.0]])


@pytest.mark.parametrize(("diameter", "expected"), [(1.0, 0.0), (2.5, 0.0), (6.0, "free")])
def test_limb_darkening_is_free_where_the_star_is_past_its_null(diameter, expected, rng) -> None:
    """96 m in H: the first null of a disc is reached at 4.3 mas."""
    sheet = point_source(
        STATIONS, np.linspace(1.55e-6, 1.75e-6, 4), 0.04e-6, vis2_error=0.01, closure_error_rad=0.02
    )
    model = BinaryModel(diameter_mas=diameter)
    data = simulated(sheet, [5.0, 5.0, 0.0], rng, model)
    found = model_of(Likelihood(data), SearchOptions())
    assert found.limb_darkening == expected
    assert model_of(Likelihood(data), SearchOptions(limb_darkening=0.1)).limb_darkening == 0.1


def test_two_small_stars_are_no_darkened_giant(rng) -> None:
    """A fit of one star takes them for a disc past its null, where limb darkening is free."""
    sheet = point_source(
        STATIONS, np.linspace(1.55e-6, 1.75e-6, 4), 0.04e-6, vis2_error=0.01, closure_error_rad=0.02
    )
    data = simulated(sheet, [5.0, 7.0, 0.95], rng, BinaryModel(diameter_mas=0.5))
    assert model_of(Likelihood(data), SearchOptions()).limb_darkening == "free"
    result = search_field(data, SearchOptions()).result
    assert result.likelihood.model.limb_darkening == 0.0
    at = result.likelihood.parameters.index("diameter_mas")
    error = np.sqrt(result.theta_covariance[at, at])
    assert error < 0.2
    assert abs(result.theta[at] - 0.5) < 4.0 * error


@pytest.mark.parametrize(("position", "outer"), [((4.2, 4.6), 10.2), ((2.2, -1.4), 4.1)])
def test_a_bright_companion_outside_the_default_field_is_found(position, outer, rng) -> None:
    """V² of one baseline that turns, one narrow channel: the default field ends at 4.1 mas.

    A companion of 0.56 at 6.2 mas: the templates of faint ones do not show it out there.
    """
    sheet = join([
        point_source(
            np.array([[0.0, 0.0], [110.0 * np.sin(a), 110.0 * np.cos(a)]]), np.array([2.2e-6]),
            1e-10, vis2_error=0.02, closure_error_rad=0.02, mjd=60000.0 + a,
        )
        for a in np.linspace(-0.5, 0.9, 25)
    ]).only(["vis2"])  # fmt: skip
    data = simulated(sheet, [*position, 0.56], rng, BinaryModel(diameter_mas=0.5))
    found = search_field(data, SearchOptions())
    companion = found.result.companion
    mirrored = np.sign(companion.north_mas * position[1])
    np.testing.assert_allclose(
        [mirrored * companion.east_mas, mirrored * companion.north_mas], position, atol=0.3
    )
    assert found.result.grid.outer_mas == pytest.approx(outer, abs=0.2)
    assert bool(found.warnings) == (outer > 5.0)


@pytest.mark.parametrize("separation", [38.0, 55.0])
def test_a_bright_companion_nearer_than_the_default_field_is_found(separation, rng) -> None:
    """NIRISS sees down to λ/2B of 94 mas: no companion out there looks like one at 40 to 55."""
    place = separation * np.array([np.sin(1.3), np.cos(1.3)])
    found = search_field(simulated(niriss(), [*place, 0.1], rng), SearchOptions())
    companion = found.result.companion
    # Contrast and separation are one number there, but for the star's brightness.
    assert companion.separation_mas == pytest.approx(separation, rel=0.35)
    assert np.degrees(1.3) == pytest.approx(companion.position_angle_deg, abs=4.0)
    moment = companion.contrast / (1.0 + companion.contrast) * companion.separation_mas
    assert moment == pytest.approx(separation * 0.1 / 1.1, rel=0.1)
    assert any("the field was widened" in said for said in found.warnings)


@pytest.mark.parametrize(
    ("east", "north", "contrast"), [(40.0, 20.0, 0.1), (20.0, -25.0, 0.2), (-30.0, 45.0, 0.3)]
)
def test_precise_data_do_not_put_a_near_companion_far_out(east, north, contrast, rng) -> None:
    """At a signal-to-noise ratio of hundreds the gains of faint companions say little of it.

    The best of those far out is notably larger, and a fit there is far worse.
    """

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        fringe = np.exp(-2j * np.pi * MAS * (east * u + north * v))
        return (1.0 + contrast * fringe) / (1.0 + contrast)

    found = search_field(observed(niriss(0.0005, 0.02), binary, rng), SearchOptions())
    companion = found.result.companion
    np.testing.assert_allclose([companion.east_mas, companion.north_mas], [east, north], atol=3.0)
    assert found.result.chi2_binary < 2.0 * found.result.likelihood.n_independent
    assert any("the field was widened" in said for said in found.warnings)


def test_a_fit_on_the_inner_edge_is_followed_inwards(rng) -> None:
    """At 1 mas, λ/4B: an alias at the edge of the default field fits to a reduced χ² near 1."""
    sheet = four_telescopes(20, vis2_error=0.025, closure_error_deg=1.2)

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        return (1.0 + 0.3 * np.exp(-2j * np.pi * MAS * (0.7 * u + 0.4 * v))) / 1.3

    found = search_field(observed(sheet, binary, rng), SearchOptions()).result
    assert found.grid.inner_mas < 0.6
    assert found.companion.separation_mas == pytest.approx(np.hypot(0.7, 0.4), rel=0.4)
    assert found.companion.position_angle_deg == pytest.approx(
        np.degrees(np.arctan2(0.7, 0.4)), abs=4.0
    )


def test_a_faint_companion_nearer_than_the_default_field_is_not_put_on_its_edge() -> None:
    """NIRISS, 0.03 at 80 mas: inside of λ/2B a fit gains less than what noise surely does not.

    On the edge, at 94 mas, the contrast is a fifth too small. Of twelve normal numbers one exceeds
    three errors once in thirty times.
    """
    place = 80.0 * np.array([np.sin(0.6), np.cos(0.6)])

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        fringe = np.exp(-2j * np.pi * MAS * (place[0] * u + place[1] * v))
        return (1.0 + 0.03 * fringe) / 1.03

    off = []
    for seed in range(4):
        rng = np.random.default_rng([seed, 94])
        found = search_field(observed(niriss(), binary, rng), SearchOptions()).result
        assert found.grid.inner_mas < 30.0
        error = np.sqrt(np.diag(found.theta_covariance))
        off.append((found.theta[:3] - [*place, 0.03]) / error[:3])
    assert np.abs(off).max() < 3.0


@pytest.mark.slow
def test_a_bright_disc_outside_the_default_field_is_found(rng) -> None:
    """A point outside fits worse than a disc inside: both are compared with their discs."""
    stations = np.array([[0.0, 0.0], [125.0, 306.0], [-176.0, 216.0], [-69.0, 200.0]])
    wavelengths = np.linspace(1.52e-6, 1.74e-6, 8)
    sheet = join([
        point_source(
            stations @ np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]), wavelengths,
            1e-10, vis2_error=0.02, closure_error_rad=0.02, mjd=60000.0 + a,
        )
        for a in (0.0, 0.2)
    ])  # fmt: skip

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        fringe = np.exp(-2j * np.pi * MAS * (3.0 * u - 6.0 * v))
        star, other = (darkened_disc(d, 0.0, u, v) for d in (1.0, 1.2))
        return (star + 0.5 * fringe * other) / 1.5

    found = search_field(observed(sheet, binary, rng), SearchOptions())
    companion = found.result.companion
    np.testing.assert_allclose([companion.east_mas, companion.north_mas], [3.0, -6.0], atol=0.05)
    assert companion.contrast == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize(("diameter", "other"), [(2.2, 0.5), (1.0, 0.0), (0.3, 0.0)])
def test_closure_phases_alone_leave_the_contrast_to_the_disc_of_the_star(
    diameter, other, rng
) -> None:
    """λ/B is 3.1 mas: beside a point the flux ratio is another one."""

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        fringe = np.exp(-2j * np.pi * MAS * (9.0 * u + 5.0 * v))
        star, second = (darkened_disc(d, 0.0, u, v) for d in (diameter, other))
        return (star + 0.15 * fringe * second) / 1.15

    data = observed(four_telescopes(6, closure_error_deg=0.5), binary, rng).only(["cp"])
    result = search_field(data, SearchOptions()).result
    companion = result.companion
    assert abs(companion.contrast - 0.15) < 4.0 * companion.contrast_error
    if diameter > 2.0:
        at = result.likelihood.parameters.names.index("diameter_mas")
        error = np.sqrt(result.theta_covariance[at, at])
        assert abs(result.theta[at] - diameter) < 5.0 * error < 1.0
    elif diameter > 0.9:
        point = search_field(data, SearchOptions(diameter=0.0)).result.companion
        assert point.contrast - 0.15 > 4.0 * point.contrast_error


def test_closure_phases_alone_show_the_disc_of_a_companion(rng) -> None:
    """λ/B is 3.1 mas: a companion of 1.8 mas counted as a fainter point.

    They tell how much larger it is than the star, and hardly what either is.
    """

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        fringe = np.exp(-2j * np.pi * MAS * (9.0 * u + 5.0 * v))
        star, second = (darkened_disc(d, 0.0, u, v) for d in (0.6, 1.8))
        return (star + 0.3 * fringe * second) / 1.3

    data = observed(four_telescopes(6, closure_error_deg=0.5), binary, rng).only(["cp"])
    result = search_field(data, SearchOptions()).result
    discs = [result.nuisance(name) for name in ("companion_diameter_mas", "diameter_mas")]
    assert discs[0] ** 2 - discs[1] ** 2 == pytest.approx(1.8**2 - 0.6**2, rel=0.15)
    assert abs(result.companion.contrast - 0.3) < 4.0 * result.companion.contrast_error < 0.1


def test_a_mask_has_no_disc_of_the_star_in_its_closure_phases(rng) -> None:
    """λ/B is 0.15 arcsec: a star of a likely size is a point to it."""
    data = simulated(niriss(), [0.0, 150.0, 0.02], rng).only(["cp"])
    result = search_field(data, SearchOptions()).result
    assert "diameter_mas" not in result.likelihood.parameters.names


@pytest.mark.slow
def test_a_field_that_is_widened_is_none_that_is_refused(rng, monkeypatch) -> None:
    """A motion is tried at many rates: of three nights of a month the wider field was too large."""
    monkeypatch.setattr("amibayes.companion_search.search.MAX_POSITIONS", 300_000)
    nights = []
    for k, day in enumerate((0.0, 10.0, 31.0)):
        sheet = four_telescopes(2, turn_deg=20.0 + 10.0 * k)
        tables = (replace(t, mjd=t.mjd + day) for t in (sheet.vis2, sheet.closure_phase))
        sheet = replace(sheet, **dict(zip(("vis2", "closure_phase"), tables, strict=True)))
        east, north = 7.0 + 0.15 * day, 6.0 + 0.1 * day

        def binary(u, v, _, east=east, north=north):
            return (1.0 + 0.1 * np.exp(-2j * np.pi * MAS * (east * u + north * v))) / 1.1

        nights.append(observed(sheet, binary, rng))
    options = SearchOptions(motion=True, fastest_mas_yr=60.0)
    found = search_field(join(nights), options).result
    rates = found.theta[found.likelihood.parameters.rates]
    np.testing.assert_allclose(rates, [54.8, 36.5], atol=5.0)


@pytest.mark.parametrize(
    ("most", "said"),
    [(625_000, "widened to"), pytest.param(310_000, "not widened", marks=pytest.mark.slow)],
)
def test_a_wide_companion_at_rest_is_no_reason_to_refuse_a_motion(
    most, said, rng, monkeypatch
) -> None:
    """At 15 mas in three nights, with rates as of a motion: searched as far as can be."""
    monkeypatch.setattr("amibayes.companion_search.search.MAX_POSITIONS", most)
    nights = []
    for k, day in enumerate((0.0, 10.0, 31.0)):
        sheet = four_telescopes(2, turn_deg=20.0 + 10.0 * k)
        tables = (replace(t, mjd=t.mjd + day) for t in (sheet.vis2, sheet.closure_phase))
        sheet = replace(sheet, **dict(zip(("vis2", "closure_phase"), tables, strict=True)))

        def binary(u, v, _):
            return (1.0 + 0.1 * np.exp(-2j * np.pi * MAS * (12.0 * u + 9.0 * v))) / 1.1

        nights.append(observed(sheet, binary, rng))
    found = search_field(join(nights), SearchOptions(motion=True, fastest_mas_yr=60.0))
    assert any(said in line for line in found.warnings)
    companion, outer = found.result.companion, found.result.grid.outer_mas
    if said == "widened to":
        assert 15.0 < outer < 1.2 * 15.0  # not so wide as unlimited
        assert [companion.east_mas, companion.north_mas] == pytest.approx([12.0, 9.0], abs=0.1)
    else:
        assert outer < 15.0


def test_baselines_without_length_are_refused_by_their_columns() -> None:
    data = point_source(np.zeros((4, 2)), [1.6e-6], [1e-8], vis2_error=0.01, closure_error_rad=0.02)
    with pytest.raises(DataError, match=r"zero or infinite length \(check UCOORD"):
        search_field(data, SearchOptions())

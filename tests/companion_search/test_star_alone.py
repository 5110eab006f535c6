"""The fit of a star alone, where its closure phases turn by 180° at the nulls of its V²."""

from __future__ import annotations

from dataclasses import replace

import interferometer
import numpy as np
import pytest
from brute_force import coverage
from helpers import simulated
from interferometer import darkened_disc, visibilities
from scipy.special import j0

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.optimise import _without_gradients, fit_single
from amibayes.data.assumed_covariance import covariance_of_errors
from amibayes.data.observables import Observables
from amibayes.data.systematics import Systematics
from amibayes.likelihood.extra_noise import ExtraNoise, with_noise
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.extended import Extended, Profile
from amibayes.units import MAS

COHERENT = 0.003
"""Error of each visibility, which makes closure phases near a null uncertain by radians."""


def star(diameter_mas: float, exponent: float, rng: np.random.Generator) -> Observables:
    """CHARA's six telescopes on a disc I(μ) = μ^α, by Hestroffer (1997); smearing left out."""
    sheet = coverage("mirc6t", 0.005, 0.005)
    vis2, closure = sheet.vis2, sheet.closure_phase
    single, legs = visibilities(sheet, lambda u, v, _: darkened_disc(diameter_mas, exponent, u, v))
    power = single**2
    errors = (
        np.hypot(0.003, 2.0 * COHERENT * np.sqrt(power)),
        np.hypot(0.003, COHERENT * np.sqrt((1.0 / legs**2).sum(axis=1))),
    )
    noise = [e * rng.standard_normal(len(e)) for e in errors]
    return replace(
        sheet,
        vis2=replace(vis2, value=power + noise[0]),
        closure_phase=replace(closure, value=np.angle(legs.prod(axis=1) + 0j) + noise[1]),
        covariance=covariance_of_errors(errors[0], closure, errors[1], "diagonal"),
        covariance_kind="diagonal",
    )


@pytest.mark.parametrize("seed", [1, 5])
def test_a_star_of_several_lobes_is_fitted_as_well_as_by_brute_force(seed: int) -> None:
    """Against a grid of 15 000 stars, and the truth."""
    rng = np.random.default_rng(seed)
    diameter, exponent = rng.uniform(2.0, 4.0), rng.uniform(0.1, 0.6)
    model = BinaryModel(diameter_mas="free", limb_darkening="free", smearing=False)
    likelihood = Likelihood(star(diameter, exponent, rng), model)
    theta, deviance = fit_single(likelihood)
    alone = single_likelihood(likelihood)
    sizes = np.linspace(1.5, 4.5, 500)
    grid = [np.column_stack([sizes, np.full_like(sizes, a)]) for a in np.linspace(0.0, 1.0, 31)]
    least = min(float(alone.chi2(thetas).min()) for thetas in grid)
    at_truth = float(alone.chi2(np.array([[diameter, exponent]]))[0])
    assert deviance < min(least, at_truth) + 1.0
    assert alone.chi2(theta[None])[0] == pytest.approx(deviance)


@pytest.mark.parametrize("seed", [9, 13, 23])
def test_closure_phases_with_errors_too_small_at_the_nulls_do_not_stop_the_fit(seed: int) -> None:
    """Their χ² has walls between stars that differ by a hundredth of a milliarcsecond."""
    rng = np.random.default_rng(seed)
    diameter, exponent = rng.uniform(2.0, 4.0), rng.uniform(0.1, 0.6)
    truth = BinaryModel(diameter_mas=diameter, limb_darkening=exponent)
    data = simulated(coverage("mirc6t", 0.005, 0.005), [5.0, 5.0, 0.0], rng, truth)
    floor = Systematics(data.setups[0].source, 0.02, np.radians(1.0), 0.005)
    model = BinaryModel(diameter_mas="free", limb_darkening="free")
    likelihood = with_noise(Likelihood(data, model), ExtraNoise(floors=(floor,)))
    at_truth = single_likelihood(likelihood).chi2(np.array([[diameter, exponent]]))[0]
    assert fit_single(likelihood)[1] < at_truth


def test_one_baseline_is_fitted_by_many_stars_and_by_one_of_them_exactly() -> None:
    """Two parameters and one number."""
    data = simulated(coverage("mirc6t", 0.005, 0.005), [0.0, 0.0, 0.0], np.random.default_rng(1))
    first = np.arange(len(data.vis2)) == 0
    one = data.select(first, np.zeros(len(data.closure_phase), bool))
    one = replace(one, vis2=replace(one.vis2, value=np.array([0.4])))
    likelihood = Likelihood(one, BinaryModel(diameter_mas="free", limb_darkening="free"))
    assert fit_single(likelihood)[1] < 1e-6


@pytest.mark.parametrize("scale", [(0.2, 5.0), (5.0, 0.2)])
def test_a_fit_without_gradients_ends_at_its_bounds(scale: tuple[float, float]) -> None:
    """A paraboloid whose bottom lies outside, whatever the units of the optimiser."""
    unit = np.array(scale)
    bounds = np.array([[1.0, 3.0], [-2.0, 4.0]])
    for bottom, expected in (((-9.0, 0.5), (1.0, 0.5)), ((2.0, 9.0), (2.0, 4.0)),
                             ((9.0, -9.0), (3.0, -2.0))):  # fmt: skip

        def loss(x: np.ndarray, _: np.ndarray, bottom: tuple[float, float] = bottom) -> float:
            return float((((x * unit) - bottom) ** 2).sum())

        found, value = _without_gradients(loss, np.array([2.0, 1.0]), unit, bounds)
        np.testing.assert_allclose(found, expected, atol=0.01)
        assert value == pytest.approx(((found - bottom) ** 2).sum())


@pytest.mark.parametrize(
    ("name", "profile", "flux", "fringes", "ratio", "angle"),
    [
        ("niriss", "ring", 2.97, 2.05, 0.37, 20.0),
        ("pionier", "uniform", 0.17, 1.79, 0.69, 50.0),
        pytest.param("pionier", "ring", 0.031, 2.04, 0.66, 110.0, marks=pytest.mark.slow),
        ("gravity", "gaussian", 0.017, 3.35, 0.63, 1.0),
        pytest.param("gravity", "ring", 0.029, 1.95, 0.65, 179.0, marks=pytest.mark.slow),
        pytest.param("mirc4t", "uniform", 0.183, 3.11, 0.64, 90.0, marks=pytest.mark.slow),
        pytest.param("mirc4t", "ring", 0.79, 1.4, 0.81, 150.0, marks=pytest.mark.slow),
    ],
)
def test_light_around_a_star_is_fitted_as_well_as_from_the_truth(
    name: str, profile: Profile, flux: float, fringes: float, ratio: float, angle: float
) -> None:
    """Many of these fits ended where the star is a faint part of its disc, or the angle at 180."""
    sheet = coverage(name, 0.01, np.radians(0.5))
    disc = Extended(profile, "light", smearing=False)
    model = BinaryModel(companions=0, diameter_mas="free", smearing=False, surroundings=(disc,))
    fringe = resolution_mas(Likelihood(sheet, model))
    size, sine, cosine = fringes * fringe, np.sin(np.radians(angle)), np.cos(np.radians(angle))

    def source(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        x = np.pi * MAS * size * np.hypot(u * sine + v * cosine, ratio * (u * cosine - v * sine))
        waves = {
            "gaussian": np.exp(-(x**2) / (4.0 * np.log(2.0))),
            "uniform": darkened_disc(size, 0.0, x / (np.pi * MAS * size), np.zeros_like(x)),
            "ring": j0(x),
        }
        star = darkened_disc(0.3 * fringe, 0.0, u, v)
        return np.asarray((star + flux * waves[profile]) / (1.0 + flux)) + 0j

    data = interferometer.observed(sheet, source, np.random.default_rng(7))
    likelihood = Likelihood(data, model)
    truth = np.array([0.3 * fringe, flux, size, ratio, angle])
    found = fit_single(likelihood)[1]
    assert found < likelihood.chi2(truth[None])[0]
    assert found < fit_single(likelihood, truth)[1] + 0.5

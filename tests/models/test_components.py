"""Discs, limb darkening and colours against Hankel transforms, differences and sums of points."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, numerical_gradient, simulated
from scipy.integrate import quad
from scipy.special import j0

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.companion import Companion
from amibayes.models.limb_darkening import power_law_disc, power_law_with_slopes
from amibayes.models.uv_points import uv_points_of
from amibayes.scene.disc import uniform_disc
from amibayes.units import MAS

STATIONS = np.array([[0.0, 0.0], [60.0, 20.0], [10.0, 110.0], [-40.0, 70.0]])


def vlti(channels: int = 6) -> object:
    """Four telescopes and narrow channels from 1.5 to 1.8 micrometres."""
    wavelength = np.linspace(1.5e-6, 1.8e-6, channels)
    return point_source(STATIONS, wavelength, 0.05e-6, vis2_error=0.01, closure_error_rad=0.01)


@pytest.mark.parametrize("alpha", [0.0, 0.15, 0.6, 1.0])
@pytest.mark.parametrize("z", [0.3, 2.0, 3.9, 9.0])
def test_power_law_disc_is_the_hankel_transform_of_its_brightness(alpha: float, z: float) -> None:
    """∫ μ^α J₀(zr) r dr / ∫ μ^α r dr over the disc, μ² = 1 − r², with r = sin t."""

    def part(t: float, of: float) -> float:
        r = np.sin(t)
        return float(np.cos(t) ** (alpha + 1.0) * j0(of * r) * r)

    expected = quad(part, 0, np.pi / 2, args=(z,))[0] / quad(part, 0, np.pi / 2, args=(0.0,))[0]
    frequency = z / (np.pi * MAS * 2.0)
    found = power_law_disc(np.array([frequency]), np.array([2.0]), np.array([alpha]))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_power_law_disc_without_darkening_is_uniform() -> None:
    frequency = np.concatenate([[0.0, 1e2, 1e5], np.geomspace(1e6, 1e9, 40)])
    found = power_law_disc(frequency, np.array([2.0]), np.array([0.0]))
    np.testing.assert_allclose(found, uniform_disc(frequency, 2.0)[0], atol=1e-10)
    by_diameter = power_law_with_slopes(frequency, np.array([2.0]), np.array([0.0]))[1]
    np.testing.assert_allclose(by_diameter, uniform_disc(frequency, 2.0)[1], atol=1e-9)


MODELS = [
    (BinaryModel(diameter_mas="free", limb_darkening="free"), [3.0, -4.0, 0.2, 1.3, 0.3]),
    (BinaryModel(diameter_mas=1.5, limb_darkening="free"), [3.0, -4.0, 0.2, 0.3]),
    (BinaryModel(diameter_mas="free", limb_darkening=0.2), [3.0, -4.0, 0.2, 1.3]),
    (BinaryModel(companion_diameter_mas="free"), [3.0, -4.0, 0.2, 0.7]),
    (BinaryModel(companion_diameter_mas=0.7, contrast_slope=-2.0), [3.0, -4.0, 0.2]),
    (
        BinaryModel(2, companion_diameter_mas="free", contrast_slope="free", background="free"),
        [3.0, -4.0, 0.2, 0.7, -1.5, -5.0, 1.0, 0.1, 0.4, 2.0, 0.05],
    ),
]


@pytest.mark.parametrize(("model", "theta"), MODELS)
def test_gradient_against_finite_differences(model, theta, rng) -> None:
    sheet = vlti()
    likelihood = Likelihood(simulated(sheet, [2.0, 2.0, 0.1], rng), model)
    theta = np.array(theta)
    _, gradient = likelihood.log_prob_and_gradient(theta[None])
    numerical = numerical_gradient(likelihood, theta, 1e-5 * np.maximum(np.abs(theta), 0.1))
    np.testing.assert_allclose(
        gradient[0], numerical, rtol=1e-4, atol=1e-6 * np.abs(numerical).max()
    )


def test_companion_with_disc_and_colour_against_a_sum_over_points() -> None:
    """Flux ratio 0.2 (λ/λ₀)² of a disc of 0.9 mas made of points, star a point, no smearing."""
    data, reference = vlti(), 1.6e-6
    axis = np.linspace(-0.45, 0.45, 301)
    east, north = (x.ravel() for x in np.meshgrid(axis, axis))
    inside = np.hypot(east, north) <= 0.45
    east, north = 3.0 + east[inside], -4.0 + north[inside]
    v2 = data.vis2
    u, v = v2.u_m[:, 0] / v2.wavelength_m, v2.v_m[:, 0] / v2.wavelength_m
    wave = np.exp(-2j * np.pi * MAS * (np.outer(u, east) + np.outer(v, north))).mean(axis=1)
    ratio = 0.2 * (v2.wavelength_m / reference) ** 2
    expected = np.abs((1.0 + ratio * wave) / (1.0 + ratio)) ** 2
    model = BinaryModel(
        smearing=False,
        companion_diameter_mas=0.9,
        contrast_slope=2.0,
        reference_wavelength_m=reference,
    )
    predicted = Likelihood(data, model).predict([[3.0, -4.0, 0.2]])[:, 0]
    np.testing.assert_allclose(predicted[: data.n_vis2], expected, atol=2e-4)


@pytest.mark.parametrize(
    "model",
    [
        BinaryModel(diameter_mas=1.3, limb_darkening=0.4),
        BinaryModel(companion_diameter_mas=0.8, contrast_slope=3.0),
    ],
)
def test_templates_are_derivatives_of_the_model(model, rng) -> None:
    likelihood = Likelihood(simulated(vlti(), [2.0, 2.0, 0.0], rng), model)
    bank = TemplateBank(likelihood, make_grid(1.0, 8.0, 0.9), np.empty(0))
    for index, (templates,) in bank.by_band():
        east, north = bank.grid.east_mas[index], bank.grid.north_mas[index]
        theta = np.column_stack([east, north, np.zeros(len(index))])
        step = np.array([0.0, 0.0, 1e-6])
        numerical = likelihood.residuals(theta) - likelihood.residuals(theta + step)
        numerical /= np.linalg.norm(numerical, axis=0)
        np.testing.assert_allclose(templates, numerical, atol=2e-4)


def test_a_disc_of_no_size_takes_out_the_direction_of_a_small_one() -> None:
    """Not a datum by chance: QR of a column of zeros would."""
    likelihood = Likelihood(niriss(), BinaryModel(diameter_mas="free"))
    grid = make_grid(100.0, 300.0, 80.0)
    none, small = (TemplateBank(likelihood, grid, np.array([d])) for d in (0.0, 0.5))
    np.testing.assert_allclose(np.abs(none.nuisance_basis), np.abs(small.nuisance_basis), atol=1e-4)
    assert np.abs(none.nuisance_basis).max() < 0.6


def test_companions_are_smeared_unless_told_otherwise() -> None:
    """The mean over a broad channel of phase and amplitude, summed over wavelengths."""
    data = point_source(STATIONS, 1.6e-6, 0.4e-6, vis2_error=1.0, closure_error_rad=1.0)
    samples = uv_points_of(data)
    # Frequencies across the channel about that of its middle; a shift of 20 mas.
    share, weight = np.polynomial.legendre.leggauss(60)
    half = 0.5 * samples.relative_band[:, None]
    angle = 2.0 * np.pi * MAS * 20.0 * samples.u[:, None] * (1.0 + half * share)
    expected = np.exp(-1j * angle) @ (0.5 * weight)
    found = Companion().source(samples, np.array([[20.0], [0.0], [0.1]]))
    np.testing.assert_allclose(found.wave[:, 0], expected, atol=1e-9)
    assert np.abs(expected).min() < 0.9


@pytest.mark.parametrize("exponent", [0.0, 0.3, 1.1])
def test_slopes_of_limb_darkened_discs_are_differences_of_bessel_functions(exponent: float) -> None:
    """Up to the tenth lobe: slopes by Poisson's integral, differences of scipy's J."""
    frequency = np.linspace(0.0, 330.0 / 1.5e-6, 60)
    _, by_diameter, by_exponent = power_law_with_slopes(frequency, 11.0, exponent)
    step = 1e-4
    for slope, (low, high) in (
        (by_diameter, ((11.0 - step, exponent), (11.0 + step, exponent))),
        (by_exponent, ((11.0, exponent - step), (11.0, exponent + step))),
    ):
        change = power_law_disc(frequency, *high) - power_law_disc(frequency, *low)
        np.testing.assert_allclose(slope, change / (2.0 * step), atol=1e-7)

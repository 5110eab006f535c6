"""Extended light against Fourier transforms of pixel images, differences, and sums of points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import ndimage

from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.companion import point_visibility
from amibayes.models.extended import Extended
from amibayes.models.light_points import light_points
from amibayes.models.uv_points import uv_points_of
from amibayes.units import MAS

CASES = [
    (Extended("gaussian"), [0.3, 90.0, 0.5, 35.0]),
    (Extended("uniform"), [0.3, 140.0, 0.4, 120.0]),
    (Extended("ring", "ring"), [0.3, 180.0, 0.6, 70.0]),
    (Extended("ring", "ring", smoothed=True), [0.3, 180.0, 0.6, 70.0, 0.3]),
    (
        Extended("ring", "crescent", smoothed=True, crescent=True),
        [0.2, 200.0, 0.7, 40.0, 0.2, 0.8, 250.0],
    ),
    (Extended("ring", "crescent", inclined=False, crescent=True), [0.2, 150.0, 0.6, 100.0]),
]


def sky(component: Extended, theta: list[float]) -> tuple[np.ndarray, ...]:
    """East, north (mas) and brightness of pixels, by what the parameters mean on the sky.

    Each pixel of the plane of the structure is put where it is seen: the plane's major axis
    at the position angle, its minor axis foreshortened. Nothing here knows of transforms.
    """
    of = dict(zip([p.name.split("_", 1)[1] for p in component.parameters], theta, strict=True))
    size, n = of.get("fwhm_mas", of.get("diameter_mas")), 501
    reach = (1.6 if component.profile != "uniform" else 0.55) * size
    grid = np.linspace(-reach, reach, n)
    major, minor = np.meshgrid(grid, grid)
    radius = np.hypot(major, minor)
    if component.profile == "gaussian":
        light = 0.5 ** ((2.0 * radius / size) ** 2)
    elif component.profile == "uniform":
        fine = (np.abs(radius - 0.5 * size) / (grid[1] - grid[0])).clip(0.0, 0.5)
        light = np.where(radius < 0.5 * size, 0.5 + fine, 0.5 - fine)
    else:
        return ring_points(of)
    turn = np.radians(of.get("position_angle_deg", 0.0))
    below = minor * of.get("axis_ratio", 1.0)
    east = major * np.sin(turn) + below * np.cos(turn)
    north = major * np.cos(turn) - below * np.sin(turn)
    return east.ravel(), north.ravel(), light.ravel() / light.sum()


def ring_points(of: dict[str, float]) -> tuple[np.ndarray, ...]:
    """An image of the ring in its plane, smoothed by a library's Gaussian filter."""
    step, n = of["diameter_mas"] / 200.0, 801
    edges = (np.arange(n + 1) - 0.5 * n) * step
    azimuth = 2.0 * np.pi * (np.arange(400_000) + 0.5) / 400_000
    brightest = np.radians(of.get("bright_angle_deg", 0.0) - of.get("position_angle_deg", 0.0))
    weight = 1.0 + of.get("modulation", 0.0) * np.cos(azimuth - brightest)
    # The plane's minor axis lies 90 degrees further east than its major axis.
    xy = 0.5 * of["diameter_mas"] * np.array([np.cos(azimuth), np.sin(azimuth)])
    light, *_ = np.histogram2d(*xy, bins=[edges, edges], weights=weight)
    sigma = of.get("width", 0.0) * 200.0 / np.sqrt(8.0 * np.log(2.0))
    light = ndimage.gaussian_filter(light, sigma, truncate=6.0) if sigma else light
    middle = 0.5 * (edges[1:] + edges[:-1])
    major, minor = np.meshgrid(middle, middle, indexing="ij")
    lit = light > 0.0
    major, minor, light = major[lit], minor[lit] * of.get("axis_ratio", 1.0), light[lit]
    turn = np.radians(of.get("position_angle_deg", 0.0))
    east = major * np.sin(turn) + minor * np.cos(turn)
    north = major * np.cos(turn) - minor * np.sin(turn)
    return east, north, light / light.sum()


@pytest.mark.parametrize(("component", "theta"), CASES)
def test_visibility_is_the_fourier_transform_of_the_image(component, theta) -> None:
    samples = uv_points_of(niriss())
    samples = replace(samples, relative_band=np.zeros(len(samples)))
    east, north, light = sky(component, theta)
    turns = np.outer(samples.u, east * MAS) + np.outer(samples.v, north * MAS)
    expected = np.exp(-2j * np.pi * turns) @ light
    found = component.source(samples, np.array(theta)[:, None]).wave[:, 0]
    np.testing.assert_allclose(found, expected, atol=5e-4)


@pytest.mark.parametrize(("component", "theta"), CASES)
def test_gradient_against_finite_differences(component, theta, rng) -> None:
    model = BinaryModel(1, surroundings=(component,), background="free")
    likelihood = Likelihood(simulated(niriss(), [90.0, 40.0, 0.05], rng), model)
    names = model.parameters.names
    at = np.array([80.0, 60.0, 0.04, 0.1, *theta])
    assert len(names) == len(at)
    _, gradient = likelihood.log_prob_and_gradient(at[None])
    step = 1e-5 * np.maximum(np.abs(at), 0.1)
    plus, minus = np.split(likelihood.log_prob(at + np.vstack([np.diag(step), -np.diag(step)])), 2)
    numerical = (plus - minus) / (2.0 * step)
    np.testing.assert_allclose(
        gradient[0], numerical, rtol=1e-4, atol=1e-6 * np.abs(numerical).max()
    )


@pytest.mark.parametrize(("component", "theta"), CASES)
def test_smearing_is_the_mean_over_the_channel(component, theta) -> None:
    samples = uv_points_of(niriss())
    fine = np.linspace(-0.5, 0.5, 2001)
    narrow = [
        replace(
            samples,
            u=samples.u * (1.0 + f * samples.relative_band),
            v=samples.v * (1.0 + f * samples.relative_band),
            relative_band=np.zeros(len(samples)),
        )
        for f in fine[::100]
    ]
    values = np.array(theta)[:, None]
    waves = np.array([component.source(s, values).wave[:, 0] for s in narrow])
    expected = np.trapezoid(waves, fine[::100], axis=0)
    found = component.source(samples, values).wave[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_colour_goes_with_wavelength() -> None:
    component = Extended("gaussian", slope="free", reference_wavelength_m=4.817e-6)
    model = BinaryModel(0, surroundings=(component,))
    likelihood = Likelihood(niriss(channels=3), model)
    theta = np.array([0.2, 2000.0, 1.0, 0.0, 2.0])
    seen = model.visibility(likelihood.samples, theta[None])[:, 0]
    wavelength = likelihood.samples.wavelength_m
    flux = 0.2 * (wavelength / 4.817e-6) ** 2
    # The disc is resolved out: what is left is the star's share of the light.
    np.testing.assert_allclose(seen, 1.0 / (1.0 + flux), atol=1e-9)


@pytest.mark.parametrize(("component", "theta"), CASES)
def test_the_visibility_is_the_same_with_slopes(component, theta) -> None:
    samples, values = uv_points_of(niriss()), np.array(theta)[:, None]
    alone, both = (component.source(samples, values, slopes=s).wave for s in (False, True))
    np.testing.assert_allclose(alone, both, atol=1e-13)


def test_circle_limits() -> None:
    """A crescent without modulation is a ring; at a ratio of 1 the angle says nothing."""
    samples = uv_points_of(niriss())
    ring = Extended("ring", "ring").source(samples, np.array([[0.3], [150.0], [1.0], [20.0]]))
    flat = Extended("ring", "ring", crescent=True).source(
        samples, np.array([[0.3], [150.0], [1.0], [140.0], [0.0], [77.0]])
    )
    np.testing.assert_allclose(ring.wave, flat.wave, atol=1e-12)


@pytest.mark.parametrize(("component", "theta"), CASES)
def test_points_have_the_same_transform(component, theta) -> None:
    samples = uv_points_of(niriss())
    samples = replace(samples, relative_band=np.zeros(len(samples)))
    values = np.array(theta)
    east, north, light = light_points(component, values)
    assert light.sum() == pytest.approx(values[0])
    turns = np.outer(samples.u, east * MAS) + np.outer(samples.v, north * MAS)
    expected = np.exp(-2j * np.pi * turns) @ light / values[0]
    found = component.source(samples, values[:, None]).wave[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-3)


def through_a_window() -> Likelihood:
    """NIRISS data whose response falls to 0.6 at 450 mas, and turns phases a little."""
    data = niriss()
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 27)] * 2, indexing="ij")  # to 520 mas
    lean = np.random.default_rng(4).normal(0.0, 0.05, (2, 7, 7, 1, 1))
    response = np.exp(-0.6 * (x**2 + y**2) + 1j * (lean[0] * x + lean[1] * y**3))
    response[np.arange(7), np.arange(7)] = np.exp(-0.8 * x**2 - 0.7 * y**2)
    lower = np.tril_indices(7, -1)
    response[lower] = response.conj()[lower[::-1]]
    lattice = OffAxisResponse(response, np.diag([-1.0, 1.0]) / (40.0 * MAS), np.zeros(2))
    return Likelihood(replace(data, setups=(replace(data.setups[0], response=lattice),)))


@pytest.mark.parametrize(("component", "theta"), CASES[:5])
def test_seen_through_a_response_off_the_axis(component: Extended, theta: list[float]) -> None:
    """Against the sum over points of light, each with the response at its place."""
    samples = through_a_window().samples
    larger = [
        2.0 * t if p.unit == "mas" else t for t, p in zip(theta, component.parameters, strict=True)
    ]
    east, north, light = light_points(component, np.array(larger))
    fringe, flux = samples.off_axis.at((east, north))
    wave = point_visibility(samples, east, north)
    truth = (1.0 + (wave * fringe) @ light) / (1.0 + flux @ light)
    without = (1.0 + wave @ light) / (1.0 + light.sum())
    model = BinaryModel(0, surroundings=(component,))
    found = model.visibility(samples, np.array([larger]))[:, 0]
    assert np.abs(found - truth).max() < 2.5e-3
    assert np.abs(found - truth).max() < 0.3 * np.abs(without - truth).max()


def test_slopes_through_a_response_off_the_axis() -> None:
    component, theta = CASES[4]
    likelihood = through_a_window().with_model(BinaryModel(0, surroundings=(component,)))
    at = np.array(theta)
    gradient = likelihood.log_prob_and_gradient(at[None])[1][0]
    for k, step in enumerate(1e-5 * np.maximum(at, 0.1)):
        ends = [at + s * step * np.eye(len(at))[k] for s in (1.0, -1.0)]
        high, low = likelihood.log_prob(np.array(ends))
        assert (high - low) / (2.0 * step) == pytest.approx(gradient[k], rel=1e-4, abs=1e-6)


def test_rings_are_smeared_unless_told_otherwise() -> None:
    samples, values = uv_points_of(niriss()), np.array([[0.3], [180.0], [0.6], [70.0]])
    found, told, sharp = (
        Extended("ring", "ring", **options).source(samples, values).wave
        for options in ({}, {"smearing": True}, {"smearing": False})
    )
    np.testing.assert_array_equal(found, told)
    assert np.abs(found - sharp).max() > 1e-4

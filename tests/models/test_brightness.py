"""Pictures of extended light: as its profile has it, whatever the beam is."""

from __future__ import annotations

import numpy as np
import pytest

from amibayes.models.brightness import TO_SIGMA, brightness, points
from amibayes.models.extended import Extended
from amibayes.models.light_points import light_points

GRID = np.linspace(-600.0, 600.0, 241)


def test_a_disc_is_one_gaussian() -> None:
    """FWHM 400 seen through 60: one Gaussian of both widths in quadrature, no rings."""
    image = brightness(Extended("gaussian", inclined=False), np.array([0.2, 400.0]), 60.0).through(
        60.0, GRID
    )
    wide = 400.0**2 + 60.0**2
    across = 0.2 * 60.0**2 / wide * np.exp(-0.5 * GRID**2 / (TO_SIGMA**2 * wide))
    np.testing.assert_allclose(image[120], across, rtol=1e-12)
    assert (np.diff(image[120, 120:]) < 0.0).all()


@pytest.mark.parametrize("width", [0.0, 0.4])
def test_a_ring_is_even_around_the_star(width: float) -> None:
    """Seen face on it is as bright at every azimuth: points of the quadrature show otherwise."""
    ring = Extended("ring", inclined=False, smoothed=True)
    image = brightness(ring, np.array([0.2, 700.0, width]), 40.0).through(40.0, GRID)
    at = [(120 + 70, 120), (120, 120 + 70), (120 - 70, 120), (120 + 42, 120 + 56)]
    found = np.array([image[i, j] for i, j in at])
    np.testing.assert_allclose(found, found[0], rtol=1e-5)


@pytest.mark.parametrize("profile", ["gaussian", "uniform", "ring"])
def test_light_and_moments_are_those_of_the_transform(profile: str) -> None:
    """Sum, centre and second moments of a picture, with those of the points of the transform."""
    crescent = profile == "ring"
    kind = Extended(profile, smoothed=crescent, crescent=crescent)  # type: ignore[arg-type]
    values = np.array([0.3, 200.0, 0.6, 35.0, 0.2, 0.7, 250.0][: len(kind.parameters)])
    beam = 30.0
    image = brightness(kind, values, beam).through(beam, GRID)
    # A beam of peak 1 holds 2πσ² of light, in pixels.
    step = GRID[1] - GRID[0]
    image = image * step**2 / (2.0 * np.pi * (TO_SIGMA * beam) ** 2)
    east, north, light = light_points(kind, values)
    x, y = GRID[None, :], GRID[:, None]
    assert image.sum() == pytest.approx(light.sum(), rel=1e-3)
    for power in ((1, 0), (0, 1), (2, 0), (0, 2), (1, 1)):
        i, j = power
        more = light.sum() * (TO_SIGMA * beam) ** 2 if 2 in power else 0.0
        expected = float((light * east**i * north**j).sum()) + more
        assert (image * x**i * y**j).sum() == pytest.approx(expected, rel=0.01, abs=0.05)


def test_a_point_is_as_bright_as_its_flux() -> None:
    image = points([100.0], [-50.0], [0.02]).through(60.0, GRID)
    i, j = np.unravel_index(image.argmax(), image.shape)
    assert (GRID[j], GRID[i]) == (100.0, -50.0)
    assert image.max() == pytest.approx(0.02)

"""Images at any pointing: the matrices against exact images and brute-force pixel sums."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amibayes.instrument import load_instrument
from amibayes.optics import psf, scene_image
from amibayes.optics.sampling import (
    fine_sampling,
    fine_size,
    pixel_operator,
    pixel_transform,
    pixel_weights,
    shifted_images,
)
from amibayes.scene.sources import GaussianDisc, Point, Scene
from amibayes.units import MAS


@pytest.fixture(scope="module", params=[("niriss", "F380M"), ("niriss", "F480M"), ("gpi", "H")])
def optics(request: pytest.FixtureRequest) -> tuple[Any, Any]:
    name, band = request.param
    instrument = load_instrument(name, band)
    return instrument, instrument.bandpass.channels(n=3)


def test_pixels_at_any_shift_are_the_exact_ones(optics: tuple[Any, Any]) -> None:
    instrument, channels = optics
    limit = instrument.mask.extent_m / channels.wavelength_m.min() * instrument.pixel_scale_rad
    oversample = fine_sampling(limit)
    size = fine_size(30, oversample, 1.0)
    fine = psf(instrument, channels, size, oversample=oversample, integrate=False)
    for shift in ((0.0, 0.0), (0.37, -0.61), (-0.9, 0.05)):
        exact = psf(instrument, channels, 30, centre_px=shift)
        x, y = (pixel_operator(30, len(fine), oversample, s) for s in shift)
        np.testing.assert_allclose(y @ fine @ x.T, exact, atol=2e-8 * exact.max())


def test_images_of_all_pointings_are_the_exact_ones(
    optics: tuple[Any, Any], rng: np.random.Generator
) -> None:
    instrument, channels = optics
    jitter = rng.normal(size=(200, 2)) * 7.0 * MAS / instrument.pixel_scale_rad
    reach = np.abs(jitter).max()
    scene = Scene((Point(), Point(0.3, 40 * MAS, -25 * MAS)))
    image = scene_image(scene, instrument, channels, 30, centre_px=(0.2, -0.1), reach_px=reach)
    images = image.at(jitter)
    offset = np.array([-40.0, -25.0]) * MAS / instrument.pixel_scale_rad
    for k in (0, *np.argsort(np.abs(jitter).max(axis=1))[-2:]):
        centre = jitter[k] + [0.2, -0.1]
        exact = psf(instrument, channels, 30, centre_px=tuple(centre))
        exact = exact + 0.3 * psf(instrument, channels, 30, centre_px=tuple(centre + offset))
        np.testing.assert_allclose(images[k], exact, atol=3e-8 * exact.max())
    np.testing.assert_allclose(image.mean(jitter), images.mean(axis=0), atol=1e-12)


def test_pixel_response_weights_the_light_within_a_pixel() -> None:
    instrument = load_instrument("niriss", "F380M")
    channels = instrument.bandpass.channels(n=2)
    loss, m = 0.2, 21
    place = (np.arange(m) - (m - 1) / 2) / m * 2.0  # −1 … 1 across a pixel
    response = 1.0 - loss * place**2
    response /= response.mean()
    sub = psf(instrument, channels, 20, oversample=m).reshape(20, m, 20, m)
    brute = (sub * response[:, None, None] * response).sum(axis=(1, 3))
    found = scene_image(Scene(), instrument, channels, 20, pixel_response=loss).centred
    np.testing.assert_allclose(found, brute, atol=3e-4 * found.max())  # 21 steps are not exact
    assert np.abs(found - psf(instrument, channels, 20)).max() > 2e-3 * found.max()


def test_points_and_extended_light_share_pixels_and_response() -> None:
    instrument = load_instrument("niriss", "F430M")
    channels = instrument.bandpass.channels(n=2)
    tiny = Scene((GaussianDisc(fwhm_rad=1e-13),))
    for response in (0.0, 0.1):
        point, disc = (
            scene_image(s, instrument, channels, 80, reach_px=0.3, pixel_response=response)
            for s in (Scene(), tiny)
        )
        shift = np.array([[0.21, -0.17]])
        peak = point.centred.max()
        np.testing.assert_allclose(disc.at(shift), point.at(shift), atol=1e-7 * peak)


def test_transform_of_a_pixel_is_a_sinc_where_its_response_is_even() -> None:
    frequency = np.linspace(-0.7, 0.7, 15)
    np.testing.assert_allclose(pixel_transform(frequency), np.sinc(frequency), atol=1e-12)
    assert pixel_weights(0.3)[1].sum() == pytest.approx(1.0)


def test_shifted_images_are_what_the_operators_make() -> None:
    fine = np.random.default_rng(1).random((120, 132))
    shifts = np.array([[0.3, -2.4], [-3.0, 1.7], [0.0, 0.0]])
    images = shifted_images(fine, 3, (22, 26), shifts)
    for image, (x, y) in zip(images, shifts, strict=True):
        expected = pixel_operator(22, 120, 3, y) @ fine @ pixel_operator(26, 132, 3, x).T
        np.testing.assert_allclose(image, expected, atol=1e-13)

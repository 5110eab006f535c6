"""Images at any pointing: the matrices against exact images and brute-force pixel sums."""

from __future__ import annotations

import numpy as np
import pytest

from amibayes.instrument import load_instrument
from amibayes.optics import psf
from amibayes.simulation.pointing import shift_table
from amibayes.simulation.sampling import FineImage, fine_sampling, fine_size, pixel_operator
from amibayes.units import MAS


@pytest.fixture(scope="module", params=[("niriss", "F380M"), ("niriss", "F480M")])
def light(request: pytest.FixtureRequest):
    name, band = request.param
    instrument = load_instrument(name, band)
    channels = instrument.bandpass.channels(n=3)
    limit = instrument.mask.extent_m / channels.wavelength_m.min()
    oversample = fine_sampling(instrument.pixel_scale_rad, limit)
    size = fine_size(30, oversample, 1.0)
    rate = psf(instrument, channels, size, oversample=oversample, integrate=False)
    return instrument, channels, FineImage(rate, oversample), limit * instrument.pixel_scale_rad


def test_pixels_at_any_shift_are_the_exact_ones(light) -> None:
    instrument, channels, fine, _ = light
    for shift in ((0.0, 0.0), (0.37, -0.61), (-0.9, 0.05)):
        exact = psf(instrument, channels, 30, centre_px=shift)
        x, y = (pixel_operator(30, fine, s) for s in shift)
        np.testing.assert_allclose(y @ fine.rate_e_s @ x.T, exact, atol=2e-8 * exact.max())


def test_table_gives_the_images_of_all_pointings(light, rng: np.random.Generator) -> None:
    instrument, channels, fine, limit = light
    offsets = rng.normal(size=(50, 2)) * 7.0 * MAS / instrument.pixel_scale_rad + [0.2, -0.1]
    table = shift_table(fine, 30, offsets, limit)
    images = table.images(offsets)
    worst = np.argsort(np.abs(offsets).max(axis=1))[-3:]
    for k in (0, *worst):
        exact = psf(instrument, channels, 30, centre_px=tuple(offsets[k]))
        np.testing.assert_allclose(images[k], exact, atol=1e-6 * exact.max())
    np.testing.assert_allclose(table.mean_image(offsets), images.mean(axis=0), atol=1e-12)


def test_no_jitter_is_one_image(light) -> None:
    instrument, channels, fine, limit = light
    table = shift_table(fine, 30, np.tile([0.3, 0.1], (5, 1)), limit)
    assert table.coefficients.shape[0] == 1
    exact = psf(instrument, channels, 30, centre_px=(0.3, 0.1))
    np.testing.assert_allclose(
        table.images(np.array([[0.3, 0.1]]))[0], exact, atol=1e-7 * exact.max()
    )


def test_pixel_response_weights_the_light_within_a_pixel(light) -> None:
    instrument, channels, fine, _ = light
    loss, m = 0.2, 21
    place = (np.arange(m) - (m - 1) / 2) / m * 2.0  # −1 … 1 across a pixel
    response = 1.0 - loss * place**2
    response /= response.mean()
    sub = psf(instrument, channels, 30, oversample=m)
    brute = sub.reshape(30, m, 30, m) * response[:, None, None] * response
    x = pixel_operator(30, fine, 0.0, loss)
    found = x @ fine.rate_e_s @ x.T
    np.testing.assert_allclose(found, brute.sum(axis=(1, 3)), atol=2e-4 * found.max())
    assert np.abs(found - psf(instrument, channels, 30)).max() > 2e-3 * found.max()

"""Methods with many samples per baseline, against sums written out one by one."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from amibayes.cube import Cube
from amibayes.extraction import METHODS, ExtractOptions, extract_all
from amibayes.extraction.fourier.sampling import split
from amibayes.extraction.fourier.splodges import Splodges
from amibayes.extraction.view import View
from amibayes.instrument import load_instrument
from amibayes.optics import psf
from amibayes.units import ComplexArray, FloatArray

INSTRUMENT = load_instrument("niriss", "F430M")
TRIANGLES = INSTRUMENT.mask.triangle_baselines
N = INSTRUMENT.mask.n_baselines


@pytest.fixture(scope="module")
def splodges() -> Splodges:
    view = View(INSTRUMENT, INSTRUMENT.bandpass.channels(), slice(0, 24), slice(0, 26), (0.3, -0.4))
    rng = np.random.default_rng(1)
    x, y = view.axes_px()
    window = np.exp(-((y[:, None] ** 2 + x**2) / 150.0)).ravel()
    gain = rng.random((5, 5))
    linear = rng.random((window.size, 2)) / window.size
    star = view.basis().image().ravel()
    return Splodges(view, linear, window, gain + gain[::-1, ::-1], star)


def plain_operator(splodges: Splodges) -> ComplexArray:
    """Operator (n_pixels, n_baselines, 5, 5), element by element."""
    view = splodges.view
    x, y = view.axes_px()
    columns = []
    for (u, v), j, i in product(view.frequency_px, range(-2, 3), range(-2, 3)):
        wave = np.exp(-2j * np.pi * ((u + i / 26.0) * x + (v + j / 26.0) * y[:, None])).ravel()
        seen = splodges.window * wave
        columns.append(seen - splodges.linear[:, 1] * seen.sum())
    operator = np.stack(columns, axis=1)
    of_star = splodges.star @ operator
    operator *= np.sqrt(np.tile(splodges.gain.ravel(), N)) * of_star.conj() / np.abs(of_star)
    power = (np.abs(splodges.star @ operator) ** 2).reshape(N, -1).sum(axis=1)
    return operator.reshape(-1, N, 5, 5) / np.sqrt(power)[:, None, None]


def plain_bispectrum(samples: ComplexArray) -> ComplexArray:
    """All products (n, n_triangles) of cells (n, n_baselines, 5, 5) that close."""
    out = np.zeros((len(samples), len(TRIANGLES)), dtype=complex)
    for t, (ij, jk, ik) in enumerate(TRIANGLES):
        for j, i, q, p in product(range(-2, 3), repeat=4):
            if max(abs(j + q), abs(i + p)) <= 2:
                first, second = samples[:, ij, j + 2, i + 2], samples[:, jk, q + 2, p + 2]
                out[:, t] += first * second * samples[:, ik, j + q + 2, i + p + 2].conj()
    return out


def images_of(splodges: Splodges) -> FloatArray:
    rng = np.random.default_rng(2)
    light = np.stack([splodges.star, np.roll(splodges.star, 2), np.roll(splodges.star, 30)])
    return 1e4 * light + rng.standard_normal(light.shape)


@pytest.mark.parametrize(("dtype", "precision"), [(float, 1e-12), (np.float32, 2e-6)])
def test_samples_and_their_products(splodges: Splodges, dtype: type, precision: float) -> None:
    images = images_of(splodges)
    flux, samples = splodges.apply(images.astype(dtype))
    exact = np.tensordot(images, plain_operator(splodges), 1)
    scale = np.abs(exact).max()
    np.testing.assert_allclose(samples.reshape(exact.shape), exact, atol=precision * scale)
    np.testing.assert_allclose(flux, images @ splodges.linear[:, 0], rtol=precision)
    power = (np.abs(exact) ** 2).sum(axis=(2, 3))
    np.testing.assert_allclose(splodges.power(samples), power, atol=precision * power.max())
    products = plain_bispectrum(exact)
    atol = 10.0 * precision * np.abs(products).max()
    np.testing.assert_allclose(splodges.bispectrum(samples), products, atol=atol)


def test_a_star_has_unit_power_and_real_fringes(splodges: Splodges) -> None:
    _, samples = splodges.apply(splodges.star[None])
    np.testing.assert_allclose(splodges.power(samples), 1.0, rtol=1e-12)
    np.testing.assert_allclose(splodges.fringes(samples), 1.0, rtol=1e-12)


def test_flux_and_fringes_are_products_with_one_matrix(splodges: Splodges) -> None:
    images = images_of(splodges)
    flux, samples = splodges.apply(images)
    own_flux, fringes = split(images @ splodges.for_fringes)
    np.testing.assert_allclose(own_flux, flux, rtol=1e-12)
    expected = splodges.fringes(samples)
    np.testing.assert_allclose(fringes, expected, atol=1e-12 * np.abs(expected).max())


def test_stars_that_are_moved_back_add_up(splodges: Splodges) -> None:
    """Waves turn by what their own frequency says, cells of a patch each by its own."""
    shift, view = np.array([[0.3, -0.2], [-0.1, 0.6]]), splodges.view
    _, samples = splodges.apply(images_of(splodges)[:2])
    side = np.arange(-2, 3) / 26.0
    u, v = view.frequency_px.T
    u, v = u[:, None, None] + side, v[:, None, None] + side[:, None]
    turns = [np.exp(2j * np.pi * (u * x + v * y)) for x, y in shift]
    expected = sum(s * t.ravel() for s, t in zip(samples, turns, strict=True))
    np.testing.assert_allclose(splodges.centred(samples, shift), expected, rtol=1e-10)


def test_noise_of_the_samples(splodges: Splodges) -> None:
    operator = plain_operator(splodges).reshape(-1, N, 25)
    variance = 1.0 + 1e4 * splodges.star + np.random.default_rng(3).random(splodges.star.size)
    own, extra = splodges.bias(variance)
    assert own == pytest.approx(variance @ splodges.linear[:, 0] ** 2, rel=1e-12)
    each = (variance[:, None, None] * np.abs(operator) ** 2).sum(axis=(0, 2))
    np.testing.assert_allclose(extra, each, rtol=1e-10)


def test_expected_covariance_is_that_of_slopes_and_of_squares(splodges: Splodges) -> None:
    image = images_of(splodges)[1]
    variance = 1.0 + 1e4 * splodges.star
    flux, samples = (a[0] for a in splodges.apply(image[None]))

    def observables(images: FloatArray) -> FloatArray:
        fluxes, numbers = splodges.apply(images)
        vis2 = splodges.power(numbers) / fluxes[:, None] ** 2
        return np.concatenate([vis2, np.angle(splodges.bispectrum(numbers))], axis=1)

    slopes = splodges.slopes(float(flux), samples)
    pixels = np.random.default_rng(4).permutation(image.size)[:40]
    step = 1e-3 * np.eye(image.size)[pixels]
    numeric = (observables(image + step) - observables(image - step)).T / 2e-3
    np.testing.assert_allclose(slopes[:, pixels], numeric, atol=1e-6 * np.abs(numeric).max())

    second = splodges.expected_covariance(float(flux), samples, variance, variance)
    second = (second - (slopes * variance) @ slopes.T)[:N, :N]
    operator = plain_operator(splodges).reshape(image.size, -1)
    numbers = np.column_stack([splodges.linear[:, 0], operator.real, operator.imag])
    noise = numbers.T @ (numbers * variance[:, None])
    baseline = np.repeat(np.arange(N), 25)
    share = np.zeros((N, numbers.shape[1]))
    share[:, 0] = -splodges.power(samples[None])[0] / flux**4
    for first in (1, 1 + 25 * N):
        share[baseline, first + np.arange(25 * N)] = 1.0 / flux**2
    # The background's noise is random here, far more than that of a ring of pixels.
    exact = 2.0 * share @ noise**2 @ share.T
    np.testing.assert_allclose(second, exact, atol=0.01 * np.abs(exact).max())


@pytest.mark.parametrize("method", METHODS)
def test_single_precision_is_enough(method: str) -> None:
    """Files hold single precision; what is measured in it is what double precision says."""
    rng = np.random.default_rng(5)
    channels, places = INSTRUMENT.bandpass.channels(), rng.normal(0.0, 0.1, (6, 2))
    stars = [psf(INSTRUMENT, channels, 64, centre_px=(x + 0.3, y)) for x, y in places]
    images = rng.poisson(1e7 * np.stack(stars) + 50.0).astype(np.float32)
    images[2, 10, 12] += 4000.0
    found = [
        extract_all(
            Cube(images.astype(dtype), INSTRUMENT.pixel_scale_rad, "NIRISS", "F430M"),
            ExtractOptions(method=method),  # type: ignore[arg-type]
        )[0]
        for dtype in (float, np.float32)
    ]
    exact, single = (f.average for f in found)
    assert np.abs(single.vis2 - exact.vis2).max() < 1e-6
    assert np.degrees(np.abs(single.closure_phase - exact.closure_phase)).max() < 1e-4
    assert [f.frames.n_bad.tolist() for f in found] == [[0, 0, 1, 0, 0, 0]] * 2


def test_slopes_are_those_of_small_changes(splodges: Splodges) -> None:
    """V² and closure phases of an image that is no point, by light added in random patterns."""
    rng = np.random.default_rng(4)
    image = 1e4 * (splodges.star + 0.5 * np.roll(splodges.star, 57))

    def observed(light: FloatArray) -> FloatArray:
        flux, samples = splodges.apply(light[None])
        power = splodges.power(samples)[0] / flux[0] ** 2
        return np.concatenate([power, np.angle(splodges.bispectrum(samples)[0])])

    flux, samples = splodges.apply(image[None])
    slopes = splodges.slopes(float(flux[0]), samples[0])
    for _ in range(3):
        change = 1e-4 * image.max() * rng.standard_normal(image.size)
        wide = observed(image + change) - observed(image - change)
        for part in (slice(0, N), slice(N, None)):
            scale = np.abs(wide[part]).max()
            np.testing.assert_allclose((slopes @ change)[part], 0.5 * wide[part], atol=1e-4 * scale)

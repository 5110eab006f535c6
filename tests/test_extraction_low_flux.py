"""Expected errors of faint integrations, against closed forms and against drawn photons."""

from __future__ import annotations

import numpy as np
import pytest

from amibayes.cube import Cube
from amibayes.extraction import ExtractOptions, extract_all
from amibayes.extraction.low_flux import expected_covariance
from amibayes.extraction.sampling import OneEach
from amibayes.instrument import load_instrument
from amibayes.optics import psf
from amibayes.optics.psf import ComplexArray
from amibayes.units import FloatArray

INSTRUMENT = load_instrument("niriss", "F430M")
TRIANGLES = INSTRUMENT.mask.triangle_baselines


def bare_sampling() -> OneEach:
    """Pixels that are the numbers: flux, 21 real parts, 21 imaginary parts."""
    return OneEach.of(np.eye(43, 44), INSTRUMENT.mask, INSTRUMENT.mask.uv_m)


@pytest.mark.parametrize("relative", [0.01, 1.0, 10.0])
def test_independent_fringes_have_the_closed_form(relative: float) -> None:
    """Var Im(T/T̄) = ½[(1 + ν)³ − 1] and Var V² = 2ν + ν², ν noise power over signal power."""
    rng = np.random.default_rng(1)
    samples = np.exp(2j * np.pi * rng.random(21))
    variance = np.full(43, relative / 2.0)
    variance[0] = 0.0
    found = expected_covariance(bare_sampling(), 1.0, samples, variance, np.zeros(43))
    variances = np.diag(found)
    np.testing.assert_allclose(variances[:21], 2.0 * relative + relative**2, rtol=1e-12)
    np.testing.assert_allclose(variances[21:], 0.5 * ((1.0 + relative) ** 3 - 1.0), rtol=1e-12)
    # Triangles that share a baseline have its noise in common, and nothing else.
    shared = found[21:, 21:][~np.eye(35, dtype=bool)]
    expected = np.unique(np.round(np.abs(shared) / relative, 9))
    np.testing.assert_allclose(expected, [0.0, 0.5])


DRAWS = 3000


@pytest.mark.parametrize("method", ["fringes", "matched", "unique"])
@pytest.mark.parametrize(("photons", "read_noise"), [(300.0, 0.0), (8000.0, 21.0)])
def test_drawn_photons_scatter_as_expected(method: str, photons: float, read_noise: float) -> None:
    sampling, light = optics(method, photons, read_noise)
    rng = np.random.default_rng(11)
    read = read_noise * rng.standard_normal((DRAWS, light.size), dtype=np.float32)
    flux, samples = (a[0] for a in sampling.apply(light[None]))
    vis2, closure = scatter_of(sampling, float(flux), rng.poisson(light, read.shape) + read)
    variance = light + read_noise**2
    full = np.diag(expected_covariance(sampling, float(flux), samples, variance, light))
    first = np.diag(first_order(sampling, float(flux), samples, variance))
    for part, seen in ((slice(0, 21), vis2), (slice(21, 56), closure)):
        # A variance of 3000 draws to 2.6 %, more where the third order has long tails, and the
        # mean of 21 or 35 of them to 1 %. What is left out of photons is 4 % at 300 of them.
        assert np.mean(seen / full[part]) == pytest.approx(1.0, abs=0.08)
        assert np.mean(seen / first[part]) > (1.05 if read_noise == 0.0 else 1.12)


def scatter_of(sampling: OneEach, flux: float, images: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variances of V² and closure phase that images have, about their means."""
    fluxes, samples = sampling.apply(images)
    power, bispectrum = sampling.power(samples), sampling.bispectrum(samples)
    expected = sampling.apply(images.mean(axis=0)[None])[1]
    vis2 = (power - fluxes[:, None] ** 2 * sampling.power(expected) / flux**2) / flux**2
    return vis2.var(axis=0), (bispectrum / bispectrum.mean(axis=0)).imag.var(axis=0)


def optics(method: str, photons: float, read_noise: float) -> tuple[OneEach, FloatArray]:
    """A method's operator on a bright star's images, and the image of a faint one."""
    image = psf(INSTRUMENT, INSTRUMENT.bandpass.channels(), 80)
    bright = np.stack([1e7 * image] * 3)
    # The weights of a faint star are those of its noise.
    error = np.sqrt(bright + 1e7 / photons * read_noise**2 + 1.0)
    cube = Cube(bright, INSTRUMENT.pixel_scale_rad, "NIRISS", "F430M", error=error)
    bench = extract_all(cube, ExtractOptions(method=method))[0].benches[0]  # type: ignore[arg-type]
    return bench.sampling, photons * image[bench.view.rows, bench.view.columns].ravel()


def first_order(
    sampling: OneEach, flux: float, samples: ComplexArray, variance: FloatArray
) -> FloatArray:
    slope = sampling.jacobian(flux, samples) @ sampling.matrix.T
    return np.asarray((slope * variance) @ slope.T)

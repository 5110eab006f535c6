"""Drawn and expected variances of faint integrations, as a table.

    python docs/extraction_faint.py

Images of a star are drawn with photon and read noise and measured; the variances of their V²
and closure phases are compared with the expected ones, of all orders in the noise and of the
first. The table goes to docs/extraction.md, between the lines that mark it.
"""

from __future__ import annotations

import sys

import numpy as np
from pages import put_table

from amibayes import load_instrument
from amibayes.cube import Cube
from amibayes.extraction import ExtractOptions, extract_all
from amibayes.extraction.fourier.sampling import OneEach
from amibayes.optics import psf
from amibayes.units import ComplexArray, FloatArray

INSTRUMENT = load_instrument("niriss", "F430M")

VIS2, CLOSURE = slice(0, 21), slice(21, 56)

DRAWS = 3000

FAINT = ((100.0, 0.0), (300.0, 0.0), (8000.0, 21.0), (4000.0, 21.0))
"""Photons of an integration and read noise, electrons."""


def optics(method: str, photons: float, read_noise: float) -> tuple[OneEach, FloatArray]:
    """A method's operator on a bright star's images, and the image of a faint one."""
    image = psf(INSTRUMENT, INSTRUMENT.bandpass.channels(), 80)
    bright = np.stack([1e7 * image] * 3)
    # The weights of a faint star are those of its noise.
    error = np.sqrt(bright + 1e7 / photons * read_noise**2 + 1.0)
    cube = Cube(bright, INSTRUMENT.pixel_scale_rad, "NIRISS", "F430M", error=error)
    operator = extract_all(cube, ExtractOptions(method=method))[0].operators[0]  # type: ignore[arg-type]
    sampling = operator.sampling
    assert isinstance(sampling, OneEach)
    return sampling, photons * image[operator.view.rows, operator.view.columns].ravel()


def scatter_of(sampling: OneEach, flux: float, images: FloatArray) -> FloatArray:
    """Variances (56,) of V² and closure phase that images have, about their means."""
    fluxes, samples = sampling.apply(images)
    power, bispectrum = sampling.power(samples), sampling.bispectrum(samples)
    expected = sampling.apply(images.mean(axis=0)[None])[1]
    vis2 = (power - fluxes[:, None] ** 2 * sampling.power(expected) / flux**2) / flux**2
    closure = (bispectrum / bispectrum.mean(axis=0)).imag
    return np.concatenate([vis2.var(axis=0), closure.var(axis=0)])


def first_order(
    sampling: OneEach, flux: float, samples: ComplexArray, variance: FloatArray
) -> FloatArray:
    """Covariance of V² and closure phase to first order in the noise."""
    slope = sampling.jacobian(flux, samples) @ sampling.matrix.T
    return np.asarray((slope * variance) @ slope.T)


def ratios(
    method: str, photons: float, read_noise: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Drawn variances (56,) in units of the expected: of all orders, and of the first."""
    sampling, light = optics(method, photons, read_noise)
    read = read_noise * rng.standard_normal((DRAWS, light.size), dtype=np.float32)
    flux, samples = (a[0] for a in sampling.apply(light[None]))
    seen = scatter_of(sampling, float(flux), rng.poisson(light, read.shape) + read)
    variance = light + read_noise**2
    full = sampling.expected_covariance(float(flux), samples, variance, light)
    first = first_order(sampling, float(flux), samples, variance)
    return seen / np.diag(full), seen / np.diag(first)


def table() -> list[str]:
    """Lines of the table."""
    lines = [
        "| photons per integration | read noise | method | V²: all orders | first "
        "| closure phase: all orders | first |",
        "|---|---|---|---|---|---|---|",
    ]
    rng = np.random.default_rng(40)
    for method in ("fringes", "matched", "unique"):
        for photons, read_noise in FAINT:
            found = ratios(method, photons, read_noise, rng)
            means = [f"{r[part].mean():.2f}" for part in (VIS2, CLOSURE) for r in found]
            noise = f"{read_noise:.0f} e⁻" if read_noise else "0"
            lines.append(f"| {photons:.0f} | {noise} | `{method}` | {' | '.join(means)} |")
            print(lines[-1], flush=True)
    return lines


def main() -> int:
    """Put the table where it belongs."""
    put_table("extraction.md", table(), "table: docs/extraction_faint.py")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What a method makes of a companion: its response to light off the axis.

A window, and the envelope of a fringe fit, let less of a companion's light through than of
the star's: 2 % less at 150 mas and a fifth at 400 mas in F430M. The images of a point at
many places, through the very operator that the cube went through, say how much on every
baseline; the logarithm of that is an even polynomial in the place.
"""

from __future__ import annotations

import numpy as np

from amibayes.extraction.sampling import Sampling
from amibayes.extraction.view import View
from amibayes.optics import psf
from amibayes.optics.psf import ComplexArray
from amibayes.optics.sampling import fine_sampling, fine_size, pixel_operator
from amibayes.orientation import Orientation
from amibayes.response import EXPONENTS, IS_PHASE, powers_at
from amibayes.units import FloatArray

RADII = 7
ANGLES = 7

SMALLEST = 1e-3
"""Responses are not followed below this."""


def off_axis_response(view: View, sampling: Sampling, orientation: Orientation) -> FloatArray:
    """Measure the response of flux and of every baseline.

    Parameters
    ----------
    view : View
    sampling : Sampling
    orientation : Orientation
        How the image lies on the sky.

    Returns
    -------
    (1 + n_baselines, n_coefficients) array
        Of ln(response) in `amibayes.response.powers_at` of east and north in radians,
        beyond the smearing over the filter's width (`relative_band`).
    """
    place = _places(view)
    flux, samples = _measured(view, sampling, place)
    turns = view.uv_m @ place.T / view.wavelength_m
    expected = np.exp(-2j * np.pi * turns) * np.sinc(relative_band(view) * turns)
    ratio = np.vstack([flux, sampling.fringes(samples).T / expected])
    east, north = orientation.to_sky(place).T
    scale = float(np.hypot(east, north).max())
    powers = powers_at(east / scale, north / scale)
    coefficients = np.zeros((len(ratio), len(EXPONENTS)))
    log = np.log(np.maximum(np.abs(ratio), SMALLEST))
    for part, values in ((~IS_PHASE, log), (IS_PHASE, np.angle(ratio))):
        basis = (powers.real + powers.imag)[part]
        coefficients[:, part] = np.linalg.lstsq(basis.T, values.T, rcond=None)[0].T
    return np.asarray(coefficients / scale ** EXPONENTS.sum(axis=1))


def relative_band(view: View) -> float:
    """Δλ/λ of the box that a model is smeared with."""
    return view.instrument.bandpass.effective_width_m / view.wavelength_m


def _places(view: View) -> FloatArray:
    """Points (n, 2) over a half plane, out to where the mask's field ends, radians."""
    radius = view.instrument.field_rad * np.linspace(0.12, 0.95, RADII)
    angle = np.pi * np.arange(ANGLES) / ANGLES
    r, a = (grid.ravel() for grid in np.meshgrid(radius, angle))
    return np.stack([r * np.cos(a), r * np.sin(a)], axis=1)


def _measured(view: View, sampling: Sampling, place: FloatArray) -> tuple[FloatArray, ComplexArray]:
    """Flux and samples of a point of unit flux at places (n, 2)."""
    pixel, mask = view.instrument.pixel_scale_rad, view.instrument.mask.rotated(view.rotation_rad)
    reach = float(np.abs(place).max() / pixel)
    over = fine_sampling(pixel * mask.extent_m / float(view.channels.wavelength_m.min()))
    side = max(view.shape)
    size = fine_size(side, over, reach + max(np.abs(view.centre_px)))
    instrument = view.instrument.with_mask(mask)
    fine = psf(instrument, view.channels, size, oversample=over, integrate=False)
    shifts = place / pixel + np.array(view.centre_px)
    rows, columns = (
        [pixel_operator(n, len(fine), over, float(s)) for s in shifts[:, axis]]
        for n, axis in zip(view.shape, (1, 0), strict=True)
    )
    images = np.stack([(r @ fine @ c.T).ravel() for r, c in zip(rows, columns, strict=True)])
    return sampling.apply(images)

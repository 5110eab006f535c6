"""What a method makes of a companion: its response to light off the axis.

A window, and the envelope of a fringe fit, let less of a companion's light through than of
the star's: 2 % less at 150 mas and a fifth at 400 mas in F430M. The images of a point at
many places, through the very operator that the cube went through, say how much on every
baseline; the logarithm of that is an even polynomial in the place.
"""

from __future__ import annotations

import numpy as np

from amibayes.extraction.fine_image import FARTHEST, FineImage, fine_image
from amibayes.extraction.sampling import Sampling
from amibayes.extraction.view import View
from amibayes.optics.psf import ComplexArray
from amibayes.orientation import Orientation
from amibayes.response import EXPONENTS, MODULUS, PHASE, monomials_at
from amibayes.units import FloatArray

RADII = 7
ANGLES, NEAR_ANGLES = 7, 9

REACH_PX = (0.3, 1.5)
"""Pointing errors that the response to the star itself is measured for, at least and most."""

SMALLEST = 1e-3
"""Responses are not followed below this."""


def star_image(view: View) -> FineImage:
    """Make the image, of a point of unit flux, that both responses are measured with."""
    n = view.instrument.mask.n_baselines
    return fine_image(view, np.repeat([1.0, 0.0], [1 + n, n]))


def off_axis_response(star: FineImage, sampling: Sampling, orientation: Orientation) -> FloatArray:
    """Measure the response of flux and of every baseline.

    Parameters
    ----------
    star : FineImage
        Of unit flux.
    sampling : Sampling
    orientation : Orientation
        How the image lies on the sky.

    Returns
    -------
    (1 + n_baselines, n_coefficients) array
        Of ln(response) in `amibayes.response.monomials_at` of east and north in radians,
        beyond the smearing over the filter's width (`relative_band`).
    """
    view = star.view
    radius = view.instrument.field_rad * np.linspace(0.12, FARTHEST, RADII)
    place = _places(radius, np.pi * np.arange(ANGLES) / ANGLES)
    flux, samples = _measured(star, sampling, place / view.instrument.pixel_scale_rad)
    turns = view.uv_m @ place.T / view.wavelength_m
    expected = np.exp(-2j * np.pi * turns) * np.sinc(relative_band(view) * turns)
    ratio = np.vstack([flux, sampling.fringes(samples).T / expected])
    east, north = orientation.to_sky(place).T
    scale = float(np.hypot(east, north).max())
    monomials = monomials_at(east / scale, north / scale)
    coefficients = np.zeros((len(ratio), len(EXPONENTS)))
    log = np.log(np.maximum(np.abs(ratio), SMALLEST))
    for part, values in ((MODULUS, log), (PHASE, np.angle(ratio))):
        coefficients[:, part] = np.linalg.lstsq(monomials[part].T, values.T, rcond=None)[0].T
    return np.asarray(coefficients / scale ** EXPONENTS.sum(axis=1))


def pointing_response(star: FineImage, sampling: Sampling, shift_px: FloatArray) -> ComplexArray:
    """Visibility (n, n_baselines) that is measured of the star itself at shifts (n, 2).

    An image that has moved under an envelope that has not loses V², and its fringes turn.
    Near the axis that is a low polynomial of the shift, of no symmetry: pixels and weights
    have none.
    """
    reach = float(np.clip(np.abs(shift_px).max(initial=0.0), *REACH_PX))
    angle = 2.0 * np.pi * np.arange(NEAR_ANGLES) / NEAR_ANGLES
    place = _places(reach * np.array([0.35, 0.75, 1.4]), angle)
    flux, samples = _measured(star, sampling, place)
    turn = np.exp(2j * np.pi * place @ star.view.frequency_px.T)
    seen = sampling.fringes(samples) * turn / flux[:, None]
    found = np.linalg.lstsq(_monomials(place / reach), seen, rcond=None)[0]
    return np.asarray(_monomials(shift_px / reach) @ found)


def _measured(
    star: FineImage, sampling: Sampling, place_px: FloatArray
) -> tuple[FloatArray, ComplexArray]:
    """Flux and samples of the star at places (n, 2) from the centre."""
    images = star.moved(place_px)
    return sampling.apply(images.reshape(len(images), -1))


def _monomials(place: FloatArray) -> FloatArray:
    """Products (n, 15) of powers of x and y, up to degree 4."""
    x, y = place.T
    return np.stack([x ** (d - k) * y**k for d in range(5) for k in range(d + 1)], axis=1)


def relative_band(view: View) -> float:
    """Δλ/λ of the box that a model is smeared with."""
    return view.instrument.bandpass.effective_width_m / view.wavelength_m


def _places(radius: FloatArray, angle: FloatArray) -> FloatArray:
    """Points (n, 2) at all of these distances and angles."""
    r, a = (grid.ravel() for grid in np.meshgrid(radius, angle))
    return np.stack([r * np.cos(a), r * np.sin(a)], axis=1)

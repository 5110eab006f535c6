"""What a method makes of a companion: its response to light off the axis.

A window, and the envelope of a fringe fit, let less of a companion's light through than of
the star's: 2 % less at 150 mas and a fifth at 400 mas in F430M. The images of a point on a
lattice of places, through the very operator that the cube went through, say how much on every
baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import spline_filter1d

from amibayes.data.off_axis_response import OffAxisResponse, bspline_weights
from amibayes.extraction.fourier.fine_image import FARTHEST, FineImage, fine_image
from amibayes.extraction.fourier.sampling import Sampling, split
from amibayes.extraction.image_plane import FringeModel, fringe_sampling, weighted_fit
from amibayes.extraction.view import View, plain_view
from amibayes.instrument import Instrument
from amibayes.scene.orientation import Orientation
from amibayes.units import ComplexArray, FloatArray, IntArray

NODES_PER_FRINGE = 2.8
"""Places per fringe of the longest baseline, at least."""

RUN_OUT = 6
"""Places beyond the last, for the splines to start and end in."""

NEAR_RADII, NEAR_ANGLES = (0.7, 1.4), 9
"""Rings of places about the star, in units of the pointing error that they serve, and how
many places on each: a polynomial of degree 4 has waves of order 4 around a ring."""

REACH_PX = (0.3, 1.5)
"""Pointing errors that the response to the star itself is measured for, at least and most."""


def star_image(view: View) -> FineImage:
    """Make the image, of a point of unit flux, that both responses are measured with."""
    n = view.instrument.mask.n_baselines
    return fine_image(view, np.repeat([1.0, 0.0], [1 + n, n]))


def off_axis_response(
    star: FineImage,
    sampling: Sampling,
    orientation: Orientation,
    centre_px: FloatArray,
    method: str = "",
) -> OffAxisResponse:
    """Measure the response of flux and of every baseline.

    Parameters
    ----------
    star : FineImage
        Of unit flux.
    sampling : Sampling
    orientation : Orientation
        How the image lies on the sky.
    centre_px : (2,) array
        Where the phases of the fringes say that the light is on the average, from the view's
        centre.
    method : str
        Its name, which the response keeps.

    Returns
    -------
    Response
        With the smearing over the filter's width; 1 on the axis.
    """
    view, pixel = star.view, star.view.instrument.pixel_scale_rad
    cell = pixel / star.oversample
    aliased = bool(view.unsampled.any())
    fringe = view.wavelength_m / float(np.hypot(*view.uv_m.T).max())
    # Fringes that look like others turn against these once in a pixel.
    step = max(int(min(fringe, pixel if aliased else np.inf) / (NODES_PER_FRINGE * cell)), 1)
    half = int(FARTHEST * view.instrument.field_rad / (step * cell))
    axis = step * cell * np.arange(-half, half + 1)
    seen = star.on_lattice(sampling.for_fringes, step, half)
    flux, fringes = split(seen.reshape(len(seen), -1).T)
    ratio = np.concatenate([flux[None], fringes.T]).reshape(-1, *seen.shape[1:])
    x, y = np.exp(2j * np.pi / view.wavelength_m * np.multiply.outer(view.uv_m.T, axis))
    ratio[1:] *= x[:, :, None] * y[:, None, :]
    spline = _interpolating(ratio / ratio[:, half, half, None, None])
    if not aliased:
        # A pixel grid is not quite symmetric about the star: 1e-4 of the response.
        spline = 0.5 * (spline + spline[:, ::-1, ::-1].conj())
    n = view.instrument.mask.n_holes
    between = np.empty((n, n, *spline.shape[1:]), dtype=np.complex64)
    between[np.arange(n), np.arange(n)] = spline[0]
    a, b = view.instrument.mask.pairs.T
    between[a, b], between[b, a] = spline[1:], spline[1:].conj()
    pointing = orientation.to_sky(pixel * centre_px)
    single = sampling.n_samples == view.instrument.mask.n_baselines
    return OffAxisResponse(between, orientation.inverse / (step * cell), pointing, single, method)


def _interpolating(values: ComplexArray) -> ComplexArray:
    """Coefficients (n, m + 2, m + 2) of the cubic splines through values (n, m, m).

    Bent at the ends by nothing.
    """
    side = [(RUN_OUT, RUN_OUT)] * 2
    padded = np.pad(values, [(0, 0), *side], mode="reflect", reflect_type="odd")
    for axis in (1, 2):
        padded = spline_filter1d(padded, order=3, axis=axis, output=complex, mode="mirror")
    return np.asarray(padded[:, RUN_OUT - 1 : 1 - RUN_OUT, RUN_OUT - 1 : 1 - RUN_OUT])


def mean_response(responses: Sequence[OffAxisResponse], weights: FloatArray) -> OffAxisResponse:
    """Response of the mean of several files; of the first one where their lattices differ."""
    first = responses[0]
    if any(r.n_nodes != first.n_nodes for r in responses):
        return first
    mean = np.average([r.coefficients for r in responses], axis=0, weights=weights)
    return replace(first, coefficients=mean)


def pointing_response(star: FineImage, sampling: Sampling, shift_px: FloatArray) -> ComplexArray:
    """Visibility (n, n_baselines) that is measured of the star itself at shifts (n, 2).

    An image that has moved under an envelope that has not loses V², and its fringes turn.
    Near the axis that is a low polynomial of the shift, of no symmetry: pixels and weights
    have none.
    """
    reach = float(np.clip(np.abs(shift_px).max(initial=0.0), *REACH_PX))
    angle = 2.0 * np.pi * np.arange(NEAR_ANGLES) / NEAR_ANGLES
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    place = reach * np.concatenate([np.zeros((1, 2)), *(r * ring for r in NEAR_RADII)])
    images = star.moved(place).astype(float)
    flux, fringes = split(images.reshape(len(images), -1) @ sampling.for_fringes)
    turn = np.exp(2j * np.pi * place @ star.view.frequency_px.T)
    seen = fringes * turn / flux[:, None]
    found = np.linalg.lstsq(_monomials(place / reach), seen, rcond=None)[0]
    return np.asarray(_monomials(shift_px / reach) @ found)


def _monomials(place: FloatArray) -> FloatArray:
    """Products (n, 15) of powers of x and y, up to degree 4."""
    x, y = place.T
    return np.stack([x ** (d - k) * y**k for d in range(5) for k in range(d + 1)], axis=1)


def seen_at_pointing(response: OffAxisResponse) -> ComplexArray:
    """Visibility (n_stations, n_stations) that is measured of a lone star at the pointing."""
    place = (response.to_node @ response.pointing)[:, None]
    index, weight = bspline_weights(place, response.n_nodes)
    shape = (*response.coefficients.shape[:2], -1)
    seen = response.coefficients.reshape(shape)[..., index[0]] @ weight[0, 0]
    return np.asarray(seen / seen[0, 0].real)


SAME_HOLE = 0.05
"""Holes of a file and of the instrument are the same within this share of the closest pair."""


def pipeline_response(
    instrument: Instrument, n_pixels: int, orientation: Orientation, stations_m: FloatArray
) -> OffAxisResponse | None:
    """Response of a fringe fit with even weights to the pixels of a square, as ami_analyze's.

    The jwst package fits the same model as ``fringes`` does, and its products do not say what
    that lets through of a companion's light: it is worked out here for a star in the middle.

    Parameters
    ----------
    instrument : Instrument
        With the mask as built.
    n_pixels : int
        Side of the images.
    orientation : Orientation
    stations_m : (n, 2) array
        Places of the file's stations on the sky, east and north.

    Returns
    -------
    OffAxisResponse or None
        In the order of the stations; None where these are not the holes of the mask.
    """
    holes = orientation.baselines_to_sky(instrument.mask.holes_m)
    near = SAME_HOLE * instrument.mask.shortest_m
    # jwst counts a baseline the other way round, which is the mask turned by half a turn.
    found = [(s, o) for s in (1, -1) if (o := _same_holes(stations_m, s * holes, near)) is not None]
    if not found:
        return None
    sign, order = found[0]
    view = plain_view(instrument, n_pixels)
    basis = view.basis()
    fit = weighted_fit(FringeModel.of(basis), np.ones(n_pixels**2))
    sampling = fringe_sampling(view, basis, fit)
    ours = off_axis_response(star_image(view), sampling, orientation, np.zeros(2), "fringes")
    coefficients = ours.coefficients[np.ix_(order, order)]
    return replace(ours, coefficients=coefficients if sign > 0 else coefficients.swapaxes(0, 1))


def _same_holes(stations_m: FloatArray, holes_m: FloatArray, near_m: float) -> IntArray | None:
    """Hole of every station; None where they are others."""
    apart = np.linalg.norm(stations_m[:, None] - holes_m, axis=2)
    order = apart.argmin(axis=1)
    once = len(set(order.tolist())) == len(holes_m) == len(stations_m)
    return order if once and apart.min(axis=1).max() <= near_m else None

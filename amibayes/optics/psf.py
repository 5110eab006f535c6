"""Image of a point source behind the mask.

The intensity is |Σ_k A_k(x) e^{iφ_k} e^{−2πi x·b_k/λ}|², summed over wavelengths with
the photons' weights. It is band-limited, so that the average over a square pixel by
Gauss–Legendre quadrature is exact to rounding with a handful of nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np

from amibayes.errors import UsageError
from amibayes.instrument import Channels, Instrument, Mask
from amibayes.optics.holes import hole_transform
from amibayes.optics.pupil import PupilMap
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Shown
from amibayes.units import ComplexArray, FloatArray, read_only

_TOLERANCE = 1e-9
"""Error of a pixel average, as a fraction of the peak."""


@dataclass(frozen=True, eq=False, repr=False)
class Wavefront(Shown):
    """Wavefront error, hole by hole or as a map over the pupil.

    Parameters
    ----------
    piston_m : (n_holes,) array, optional
        Optical path added in every hole, metres.
    tilt_rad : (n_holes, 2) array, optional
        Displacement (x, y) of the image that each hole makes by itself, radians.
    map : PupilMap, optional
        Optical path over the pupil, for errors inside the holes; added to the others.
    """

    piston_m: FloatArray | None = None
    tilt_rad: FloatArray | None = None
    map: PupilMap | None = None

    def __post_init__(self) -> None:
        for name, trailing in (("piston_m", ()), ("tilt_rad", (2,))):
            if getattr(self, name) is None:
                continue
            read_only(self, name)
            if getattr(self, name).shape[1:] != trailing:
                raise UsageError(f"wavefront {name} needs one entry for each hole")


@checks_arguments
def psf(
    instrument: Instrument,
    channels: Channels,
    n_pixels: int | None = None,
    *,
    centre_px: tuple[float, float] = (0.0, 0.0),
    oversample: int = 1,
    integrate: bool = True,
    wavefront: Wavefront | None = None,
) -> FloatArray:
    """Image of a point source that sends one photon through the holes.

    Parameters
    ----------
    instrument : Instrument
        Mask and pixel scale.
    channels : Channels
        Wavelengths and weights.
    n_pixels : int, optional
        Side of the image in detector pixels; the instrument's own unless given.
    centre_px : (x, y)
        Place of the source relative to the middle of the image, detector pixels.
    oversample : int
        Pixels of the result per detector pixel and axis.
    integrate : bool
        Average over each (sub-)pixel; otherwise take the value at its centre.
    wavefront : Wavefront, optional
        Wavefront error; none unless given.

    Returns
    -------
    (n_pixels·oversample, n_pixels·oversample) array
        Expected photons per (sub-)pixel, indices [y, x]. The sum over the whole image
        plane is 1; an 80 × 80 array holds some 92 % of it.
    """
    side = (n_pixels or instrument.n_pixels) * oversample
    pixel = instrument.pixel_scale_rad / oversample
    nodes, weight = pixel_rule(instrument.mask, channels, pixel, integrate)
    x, y = (axis_nodes(side, pixel, c * oversample, nodes) for c in centre_px)
    total = np.zeros((side, side))
    for wavelength, share in zip(channels.wavelength_m, channels.weight, strict=True):
        fine = intensity(instrument.mask, wavelength, x.ravel(), y.ravel(), wavefront)
        total += share * average(fine, weight)
    return total * pixel**2


def axis_nodes(side: int, pixel: float, centre: float, nodes: FloatArray) -> FloatArray:
    """Angles of the quadrature nodes along an axis, shape (side, n_nodes).

    ``nodes`` and ``centre`` are in pixels; the middle of the array is its origin.
    """
    middle = np.arange(side) - 0.5 * (side - 1) - centre
    return np.asarray(pixel * (middle[:, None] + nodes))


def average(fine: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted mean over the nodes of every pixel, (n·g, n·g) → (n, n)."""
    rows, columns = (size // len(weight) for size in fine.shape)
    inner = fine.reshape(-1, columns, len(weight)) @ weight
    return np.asarray(weight @ inner.reshape(rows, len(weight), columns))


def pixel_rule(
    mask: Mask, channels: Channels, pixel_rad: float, integrate: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Nodes (in pixels, −½ to ½) and weights (sum 1) of the average over a pixel.

    Gauss–Legendre, of the least order that integrates the highest spatial frequency in
    the image to 1e-9.
    """
    if not integrate:
        return np.zeros(1), np.ones(1)
    phase = np.pi * pixel_rad * mask.extent_m / channels.wavelength_m.min()
    order = next(n for n in range(2, 100) if _gauss_error(n, phase) < _TOLERANCE)
    nodes, weight = np.polynomial.legendre.leggauss(order)
    return 0.5 * nodes, 0.5 * weight


def _gauss_error(order: int, phase: float) -> float:
    """Bound of the error of Gauss–Legendre for the mean of cos(phase·t) over −1 … 1."""
    two = 2 * order
    scale = float(factorial(order)) ** 4 * 2.0**two / ((two + 1) * float(factorial(two)) ** 3)
    return scale * phase**two


def intensity(
    mask: Mask,
    wavelength_m: float,
    x_rad: FloatArray,
    y_rad: FloatArray,
    wavefront: Wavefront | None = None,
) -> FloatArray:
    """Photons per steradian of a point source at the origin, on a grid x × y.

    Returns
    -------
    (n_y, n_x) array
        Its integral over the image plane is 1 (Parseval).
    """
    field = amplitude(mask, wavelength_m, x_rad, y_rad, wavefront)
    power = field.real**2 + field.imag**2
    return np.asarray(power / (wavelength_m**2 * mask.area_m2))


def amplitude(
    mask: Mask,
    wavelength_m: float,
    x_rad: FloatArray,
    y_rad: FloatArray,
    wavefront: Wavefront | None = None,
) -> ComplexArray:
    """Complex field of a point source at the origin, on a grid x × y, in m².

    Holes without tilt and without a map share one transform and cost one matrix product.
    """
    fx, fy = x_rad / wavelength_m, y_rad / wavelength_m
    error = wavefront or Wavefront()
    for given in (error.piston_m, error.tilt_rad):
        if given is not None and len(given) != mask.n_holes:
            raise UsageError(f"wavefront error of {len(given)} holes, mask of {mask.n_holes}")
    piston = np.zeros(mask.n_holes) if error.piston_m is None else error.piston_m
    phasor = np.exp(2j * np.pi / wavelength_m * np.asarray(piston))
    if error.map is not None:
        return _mapped(mask, error, phasor, wavelength_m, fx, fy)
    across, up = _waves(mask.holes_m[:, 0], fx), _waves(mask.holes_m[:, 1], fy)
    if error.tilt_rad is None:
        envelope = hole_transform(mask, fx[None, :], fy[:, None])
        return np.asarray(envelope * ((up.T * phasor) @ across))
    field = np.zeros((len(fy), len(fx)), dtype=complex)
    for k, tilt in enumerate(error.tilt_rad / wavelength_m):
        envelope = hole_transform(mask, (fx - tilt[0])[None, :], (fy - tilt[1])[:, None])
        field += envelope * np.outer(up[k] * phasor[k], across[k])
    return field


def _waves(position_m: FloatArray, frequency: FloatArray) -> ComplexArray:
    """e^{−2πi f b}, shape (n_positions, n_frequencies)."""
    return np.asarray(np.exp(-2j * np.pi * np.outer(position_m, frequency)))


def _mapped(
    mask: Mask,
    error: Wavefront,
    phasor: ComplexArray,
    wavelength_m: float,
    fx: FloatArray,
    fy: FloatArray,
) -> ComplexArray:
    assert error.map is not None
    field = np.zeros((len(fy), len(fx)), dtype=complex)
    for k, patch in enumerate(error.map.patches(mask)):
        tilt = np.zeros(2) if error.tilt_rad is None else error.tilt_rad[k]
        phase = patch.opd_m + np.add.outer(
            (patch.y_m - mask.holes_m[k, 1]) * tilt[1], (patch.x_m - mask.holes_m[k, 0]) * tilt[0]
        )
        pupil = patch.area_m2 * np.exp(2j * np.pi / wavelength_m * phase)
        field += phasor[k] * (_waves(patch.y_m, fy).T @ pupil @ _waves(patch.x_m, fx))
    return np.asarray(field / error.map.cell_transform(fx, fy), dtype=complex)

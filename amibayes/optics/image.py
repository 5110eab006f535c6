"""Image of a scene on the detector, at any small shift of the pointing.

Point sources are summed exactly, without a pixel grid. Anything extended is convolved
with the point spread function in the Fourier plane, on a grid 11 times finer than the
pixels; its transform is analytic, and so is the average over a pixel.

An image is a smooth function of the pointing: a few shifts (Chebyshev nodes) give all
others by a matrix product, which is how ten thousand jittered integrations are had for
the price of a hundred images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erfc

from amibayes.errors import DataError
from amibayes.instrument import Channels, Instrument, Mask
from amibayes.optics.psf import Wavefront, axis_nodes, intensity, psf
from amibayes.optics.sampling import fine_sampling, fine_size, pixel_operator, pixel_transform
from amibayes.scene.orientation import Orientation
from amibayes.scene.sources import Scene
from amibayes.support.arguments import checks_arguments
from amibayes.units import MAS, ComplexArray, FloatArray, read_only

OVERSAMPLE = 11
"""Cells of the convolution's grid per pixel and axis."""

_TOLERANCE = 1e-8
_MARGIN = 16
"""Pixels over which the convolution's window fades out, so that its edges do not ring."""


@dataclass(frozen=True, eq=False)
class ShiftedImage:
    """An image known at a few shifts of the source, hence at all between.

    Parameters
    ----------
    nodes_px : (q,) array
        Chebyshev nodes of the shift along either axis, pixels.
    values : (q, q, n_y, n_x) array
        Image at every pair of shifts, indices [shift y, shift x, y, x].
    reach_px : float
        Largest shift along either axis, pixels.
    """

    nodes_px: FloatArray
    values: FloatArray
    reach_px: float

    def __post_init__(self) -> None:
        read_only(self, "nodes_px", "values")

    @property
    def centred(self) -> FloatArray:
        """The image without shift, shape (n_y, n_x)."""
        return np.asarray(self.at(np.zeros((1, 2)))[0])

    def at(self, shift_px: FloatArray) -> FloatArray:
        """Images of the source displaced by (x, y), pixels.

        Parameters
        ----------
        shift_px : (n, 2) array
            Displacements towards +x and +y.

        Returns
        -------
        (n, n_y, n_x) array

        Raises
        ------
        ValueError
            Where a shift is beyond the reach.
        """
        weight = self._weights(shift_px)
        flat = self.values.reshape(weight.shape[1], -1)
        return np.asarray(weight @ flat).reshape(len(weight), *self.values.shape[2:])

    def mean(self, shift_px: FloatArray) -> FloatArray:
        """Mean (n_y, n_x) of the images `at` shifts (n, 2), at the cost of one."""
        weight = self._weights(shift_px).mean(axis=0)
        return np.asarray(weight @ self.values.reshape(len(weight), -1)).reshape(
            self.values.shape[2:]
        )

    def _weights(self, shift_px: FloatArray) -> FloatArray:
        shift = np.asarray(shift_px, dtype=float)
        if np.abs(shift).max(initial=0.0) > self.reach_px * (1.0 + 1e-12):
            raise ValueError(f"a shift is beyond the reach of {self.reach_px:g} pixels")
        x, y = (_lagrange(self.nodes_px, shift[:, axis]) for axis in (0, 1))
        return np.asarray((y[:, :, None] * x[:, None, :]).reshape(len(shift), -1))


@checks_arguments
def scene_image(
    scene: Scene,
    instrument: Instrument,
    channels: Channels,
    n_pixels: int | None = None,
    *,
    centre_px: tuple[float, float] = (0.0, 0.0),
    orientation: Orientation | None = None,
    reach_px: float = 0.0,
    wavefront: Wavefront | None = None,
    pixel_response: float = 0.0,
) -> ShiftedImage:
    """Image of a scene whose star sends one photon through the holes.

    Parameters
    ----------
    scene : Scene
        What is on the sky.
    instrument : Instrument
        Mask and pixel scale.
    channels : Channels
        Wavelengths and weights, the spectrum's among them.
    n_pixels : int, optional
        Side of the image; the instrument's own unless given.
    centre_px : (x, y)
        Place of the star relative to the middle of the image, pixels.
    orientation : Orientation, optional
        How the detector lies on the sky; north up and east left unless given.
    reach_px : float
        Largest shift of the pointing that will be asked for, pixels.
    wavefront : Wavefront, optional
        Wavefront error; none unless given.
    pixel_response : float
        Relative loss of sensitivity from the middle of a pixel to its edges.

    Raises
    ------
    DataError
        Where a source lies outside the image.
    """
    side = n_pixels or instrument.n_pixels
    orient = orientation or Orientation()
    refuse_outside(scene, instrument, side, orient, centre_px)
    limit = instrument.pixel_scale_rad * _highest(instrument.mask, channels)
    nodes = _chebyshev(reach_px, 2.0 * np.pi * limit)
    values = np.zeros((len(nodes), len(nodes), side, side))
    if scene.points:
        oversample = fine_sampling(limit)
        size = fine_size(side, oversample, reach_px)
        fine = _points(scene, instrument, channels, size, oversample, orient, centre_px, wavefront)
        values += _sampled(fine, oversample, side, nodes, pixel_response)
    if scene.extended:
        values += _extended(
            scene, instrument, channels, side, orient, centre_px, nodes, wavefront, pixel_response
        )
    return ShiftedImage(nodes, values, reach_px)


def refuse_outside(
    scene: Scene,
    instrument: Instrument,
    n_pixels: int,
    orientation: Orientation,
    centre_px: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Refuse a scene with a source outside the image.

    Raises
    ------
    DataError
        Naming the source's place and the half width of the image.
    """
    half = 0.5 * n_pixels * instrument.pixel_scale_rad
    for point in scene.points:
        place = orientation.to_image([point.east_rad, point.north_rad])
        if np.any(np.abs(place + np.array(centre_px) * instrument.pixel_scale_rad) > half):
            raise DataError(
                f"a source {point.east_rad / MAS:.0f} mas east and {point.north_rad / MAS:.0f} mas "
                f"north lies outside the image, ±{half / MAS:.0f} mas",
                source=scene.source,
            )
    widest = max((part.radius_rad for part in scene.extended), default=0.0)
    if widest > half:
        raise DataError(
            f"a component reaches {widest / MAS:.0f} mas from the star, outside the image, "
            f"±{half / MAS:.0f} mas",
            source=scene.source,
        )


def _highest(mask: Mask, channels: Channels) -> float:
    """Highest spatial frequency in an image along an axis, cycles per radian."""
    return float(mask.extent_m / channels.wavelength_m.min())


def _chebyshev(reach: float, phase_per_px: float) -> FloatArray:
    """Nodes over ±reach that interpolate the image's highest frequency to 1e-9."""
    if reach == 0.0:
        return np.zeros(1)
    half = phase_per_px * reach
    # The interpolation error of e^{iht} over −1 … 1 falls as 2 (h/2)^q / q!.
    count, error = 1, half
    while error > _TOLERANCE:
        count += 1
        error *= 0.5 * half / count
    return np.asarray(-reach * np.cos(np.pi * (np.arange(count) + 0.5) / count))


def _lagrange(nodes: FloatArray, x: FloatArray) -> FloatArray:
    """Weights of the nodes in the polynomial through them at x, shape (len(x), len(nodes))."""
    gaps = nodes[:, None] - nodes
    np.fill_diagonal(gaps, 1.0)
    scale = 1.0 / np.prod(gaps, axis=1)
    far = x[:, None] - nodes
    hit = far == 0.0
    terms = scale / np.where(hit, 1.0, far)
    weight = terms / terms.sum(axis=1, keepdims=True)
    return np.asarray(np.where(hit.any(axis=1, keepdims=True), hit.astype(float), weight))


def _points(
    scene: Scene,
    instrument: Instrument,
    channels: Channels,
    size: int,
    oversample: int,
    orientation: Orientation,
    centre_px: tuple[float, float],
    wavefront: Wavefront | None,
) -> FloatArray:
    """Density of all points' light at the middle of fine cells, times the cells' area."""
    fine = np.zeros((size * oversample, size * oversample))
    for point in scene.points:
        place = orientation.to_image([point.east_rad, point.north_rad])
        x, y = place / instrument.pixel_scale_rad + centre_px
        fine += point.flux * psf(
            instrument,
            channels,
            size,
            centre_px=(float(x), float(y)),
            oversample=oversample,
            integrate=False,
            wavefront=wavefront,
        )
    return fine


def _sampled(
    fine: FloatArray, oversample: int, side: int, shifts: FloatArray, pixel_response: float
) -> FloatArray:
    """Pixel-averaged image of the fine cells at all shifts, (q, q, side, side)."""
    rows = np.stack(
        [pixel_operator(side, len(fine), oversample, shift, pixel_response) for shift in shifts]
    )
    halfway = rows @ fine
    return np.asarray(np.tensordot(halfway, rows, axes=(2, 2)).transpose(0, 2, 1, 3))


def _extended(
    scene: Scene,
    instrument: Instrument,
    channels: Channels,
    side: int,
    orientation: Orientation,
    centre_px: tuple[float, float],
    shifts: FloatArray,
    wavefront: Wavefront | None,
    pixel_response: float,
) -> FloatArray:
    """Pixel-averaged image of the extended components at all shifts, (q, q, side, side)."""
    pixel = instrument.pixel_scale_rad
    widest = max(part.radius_rad for part in scene.extended) / pixel
    reach = widest + float(np.abs(shifts).max()) + float(np.abs(centre_px).max()) + 1.0
    width = side + 2 * int(np.ceil(reach))
    frequency, spectrum = _transfer(instrument, channels, width, wavefront)
    sky = orientation.baselines_to_sky(np.stack(np.meshgrid(frequency, frequency), axis=-1))
    source = sum(part.transform(sky[..., 0], sky[..., 1]) for part in scene.extended)
    box = pixel_transform(frequency * pixel, pixel_response)
    spectrum = spectrum * source * np.outer(box, box)
    x, y = (axis_nodes(side, pixel, c, -shifts) for c in centre_px)
    across, up = (np.exp(2j * np.pi * np.outer(axis.ravel(), frequency)) for axis in (x, y))
    image = (up @ spectrum @ across.T).real * pixel**2
    blocks = image.reshape(side, len(shifts), side, len(shifts))
    return np.asarray(blocks.transpose(1, 3, 0, 2))


def _transfer(
    instrument: Instrument, channels: Channels, width_px: int, wavefront: Wavefront | None
) -> tuple[FloatArray, ComplexArray]:
    """Fourier series of the intensity over a window that fades outside ``width_px``.

    Returns the frequencies along an axis (cycles per radian) and the coefficients
    [f_y, f_x], so that intensity = Re Σ c e^{2πi(f_x x + f_y y)}.
    """
    size = (width_px + 2 * _MARGIN) * OVERSAMPLE
    step = instrument.pixel_scale_rad / OVERSAMPLE
    angle = np.asarray((np.arange(size) - size // 2) * step, dtype=float)
    fine = np.zeros((size, size))
    for wavelength, share in zip(channels.wavelength_m, channels.weight, strict=True):
        fine += share * intensity(instrument.mask, wavelength, angle, angle, wavefront)
    outside = np.abs(angle) / instrument.pixel_scale_rad - 0.5 * width_px
    fade = 0.5 * erfc(7.0 * (outside / _MARGIN - 0.5))
    fine *= np.outer(fade, fade)
    frequency = np.asarray(np.fft.fftfreq(size, step), dtype=float)
    # The fade, a Gaussian of σ = margin/(7√2) integrated, has 1e-5 of its spectrum beyond.
    band = _highest(instrument.mask, channels) + 7.5 / (_MARGIN * instrument.pixel_scale_rad)
    kept = np.flatnonzero(np.abs(frequency) <= band)
    coefficients = np.fft.fft2(np.fft.ifftshift(fine))[np.ix_(kept, kept)] / size**2
    return frequency[kept], coefficients

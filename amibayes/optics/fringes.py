"""The linear fringe model: an image is envelope plus one cosine and one sine per baseline.

For an object of visibility V_ij on baseline (i, j) that sends F photons through the mask,
image = F·[envelope + Σ_ij (Re V_ij·C_ij + Im V_ij·S_ij)]; a point source at the centre has
V = 1 and its image is the point spread function. Off-axis light is fringes under an
envelope that moves with it, which this basis does not do: its response to that is for
extraction to measure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.instrument import Channels, Instrument, Mask
from amibayes.optics.holes import hole_transform
from amibayes.optics.psf import axis_nodes, pixel_rule
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Shown
from amibayes.units import FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class FringeBasis(Shown):
    """Images of which every on-axis image is a sum.

    Parameters
    ----------
    matrix : (n_y·n_x, 1 + 2·n_baselines) array
        Columns: envelope; C of every baseline; S of every baseline. Photons per pixel for
        one photon through the mask.
    shape : (n_y, n_x)
        Shape of the image.
    """

    matrix: FloatArray
    shape: tuple[int, int]

    def __post_init__(self) -> None:
        # Large, and made for this: no copy.
        view = self.matrix.view()
        view.flags.writeable = False
        object.__setattr__(self, "matrix", view)

    @property
    def n_baselines(self) -> int:
        """How many baselines."""
        return int(self.matrix.shape[1] - 1) // 2

    @property
    def images(self) -> FloatArray:
        """The columns as images, shape (1 + 2·n_baselines, n_y, n_x)."""
        return self.matrix.T.reshape(-1, *self.shape)

    def image(self, visibility: FloatArray | complex = 1.0) -> FloatArray:
        """Image of one photon from an object of complex visibility (n_baselines,)."""
        v = np.broadcast_to(np.asarray(visibility, dtype=complex), (self.n_baselines,))
        coefficients = np.concatenate([[1.0], v.real, v.imag])
        return np.asarray(self.matrix @ coefficients).reshape(self.shape)


@checks_arguments
def fringe_basis(
    instrument: Instrument,
    channels: Channels,
    n_pixels: int | tuple[int, int] | None = None,
    *,
    centre_px: tuple[float, float] = (0.0, 0.0),
    pixel_scale_rad: float | None = None,
    rotation_rad: float = 0.0,
) -> FringeBasis:
    """Make the linear fringe model of an image, pixel-averaged and polychromatic.

    Parameters
    ----------
    instrument : Instrument
        Mask and pixel scale.
    channels : Channels
        Wavelengths and weights; extraction takes the source's as simulation does.
    n_pixels : int or (n_y, n_x), optional
        Size of the image; the instrument's own unless given.
    centre_px : (x, y)
        Centre of the fringes relative to the middle of the image, pixels.
    pixel_scale_rad : float, optional
        Instead of the instrument's own.
    rotation_rad : float
        The mask is turned by this angle, from +x towards +y.

    Returns
    -------
    FringeBasis
    """
    size = n_pixels or instrument.n_pixels
    shape = (size, size) if isinstance(size, int) else size
    pixel = pixel_scale_rad or instrument.pixel_scale_rad
    mask = instrument.mask.rotated(rotation_rad) if rotation_rad else instrument.mask
    nodes, weight = pixel_rule(mask, channels, pixel)
    y = axis_nodes(shape[0], pixel, centre_px[1], nodes)
    x = axis_nodes(shape[1], pixel, centre_px[0], nodes)
    total = np.zeros((1 + 2 * mask.n_baselines, *shape))
    for wavelength, share in zip(channels.wavelength_m, channels.weight, strict=True):
        scale = share * pixel**2 / (wavelength**2 * mask.area_m2)
        total += scale * _monochromatic(mask, wavelength, x, y, weight)
    return FringeBasis(total.reshape(len(total), -1).T, shape)


def _monochromatic(
    mask: Mask, wavelength: float, x: FloatArray, y: FloatArray, weight: FloatArray
) -> FloatArray:
    """Envelope, C and S of one wavelength, averaged over the pixels, (1 + 2n, n_y, n_x).

    The average factorises: first along x, one small matrix product per column of
    pixels, then along y.
    """
    fx, fy = x / wavelength, y / wavelength
    envelope = hole_transform(mask, fx.ravel()[None, :], fy.ravel()[:, None]) ** 2
    columns = envelope.reshape(y.size, *x.shape).transpose(1, 0, 2)
    u, v = np.vstack([np.zeros(2), mask.uv_m]).T
    along_x = weight[:, None] * np.exp(2j * np.pi * fx[:, :, None] * u)
    along_y = weight[:, None] * np.exp(2j * np.pi * fy[:, :, None] * v)
    part = columns @ np.concatenate([along_x.real, along_x.imag], axis=2)
    part = part.reshape(len(x), *y.shape, 2, len(u))
    wave = np.einsum("xygp,ygp->pyx", part[..., 0, :] + 1j * part[..., 1, :], along_y)
    return np.concatenate([mask.n_holes * wave[:1].real, 2.0 * wave[1:].real, -2.0 * wave[1:].imag])

"""Charge that passes from pixel to pixel as their boundaries move.

As charge collects in a pixel, its neighbours gain area from it. The side between two pixels
moves by a displacement that is proportional to the charge they differ by, and light falls on
the other side of it: the current through the side is a · (Q_j − Q_i) · S, with Q the charges,
S the density of the light's current at the side, and a the displacement (in pixels) per
electron (Antilogus et al. 2014; Guyonnet et al. 2015). What one pixel gains another loses.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from amibayes.units import FloatArray

SIDES = ("x", "y")
"""Sides between pixels that are neighbours along x, and along y."""

FURTHER = ("second", "diagonal")
"""Sides are moved too by charge of the next pixels but one, and of those beside."""

LINEARITY = "linearity"
"""What a pixel's own charge does to its own current: imperfect linearity, no neighbours in it."""

KINDS = (*SIDES, *FURTHER, LINEARITY)
"""Everything whose strength is a coefficient per electron."""


@lru_cache(maxsize=16)
def side_operator(n_pixels: int) -> FloatArray:
    """Matrix (n_pixels − 1, n_pixels) from signals of pixels in a row to densities between them.

    Pixels average over their width: half-way between two the mean of both has lost three
    quarters of fringes of 0.4 cycles per pixel. The cosine series through the pixels'
    averages, mirrored at the ends, has lost nothing of an image that is sampled well enough.
    """
    order = np.arange(n_pixels)
    pixel, side = np.arange(n_pixels) + 0.5, np.arange(1, n_pixels)
    analysis = np.cos(np.pi * np.outer(order, pixel) / n_pixels) * 2.0 / n_pixels
    analysis[0] *= 0.5
    # A cosine of m half turns across the row has sinc(m / 2n) of itself left in a pixel.
    synthesis = np.cos(np.pi * np.outer(side, order) / n_pixels) / np.sinc(order / (2 * n_pixels))
    operator = synthesis @ analysis
    operator.flags.writeable = False
    return np.asarray(operator)


def side_densities(current: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Density of a current (…, ny, nx) at the sides along x (…, ny, nx − 1) and y."""
    ny, nx = current.shape[-2:]
    along_x = current @ side_operator(nx).T.astype(current.dtype)
    along_y = side_operator(ny).astype(current.dtype) @ current
    return np.asarray(along_x), np.asarray(along_y)


def gain(kind: str, charge: FloatArray, current: FloatArray) -> FloatArray:
    """Current that pixels gain for a coefficient of 1 per electron.

    Parameters
    ----------
    kind : str
        Of `KINDS`.
    charge : (…, ny, nx) array
        Electrons in each pixel.
    current : (…, ny, nx) array
        Electrons per second that light makes in each; single precision stays so.

    Returns
    -------
    (…, ny, nx) array
        Electrons per second; those of all pixels add up to zero, but for linearity.
    """
    return np.asarray(gains((kind,), charge, current)[0])


def gains(kinds: Sequence[str], charge: FloatArray, current: FloatArray) -> FloatArray:
    """`gain` of several kinds, (len(kinds), …, ny, nx)."""
    density_x, density_y = side_densities(current)
    out = np.empty((len(kinds), *charge.shape), dtype=charge.dtype)
    for k, kind in enumerate(kinds):
        if kind == LINEARITY:
            out[k] = charge * current
            continue
        out[k] = 0.0
        if kind != "y":
            through = _difference(kind, charge) * density_x
            out[k, ..., :-1] += through
            out[k, ..., 1:] -= through
        if kind != "x":
            turned = charge.swapaxes(-1, -2)
            through = _difference(kind, turned).swapaxes(-1, -2) * density_y
            out[k, ..., :-1, :] += through
            out[k, ..., 1:, :] -= through
    return out


def _difference(kind: str, charge: FloatArray) -> FloatArray:
    """Difference (…, ny, nx − 1) of charge that moves the sides along x."""
    if kind == "second":
        wide = np.concatenate([charge[..., :1], charge, charge[..., -1:]], axis=-1)
        return np.asarray(wide[..., 3:] - wide[..., :-3])
    near = charge[..., 1:] - charge[..., :-1]
    if kind != "diagonal":
        return near
    beside = np.zeros_like(near)
    beside[..., 1:, :] += near[..., :-1, :]
    beside[..., :-1, :] += near[..., 1:, :]
    return beside

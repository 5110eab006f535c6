"""Charge migration by brute force: light on a fine grid drifts, a little at a time.

Nothing here is the package's: cells of a fine image move by a displacement that is linear
between the sides of a pixel, and what of a moved cell lies past a side is the neighbour's.
"""

from __future__ import annotations

import numpy as np

from amibayes.units import FloatArray


def drifting_ramp(
    fine_e_s: FloatArray, per_pixel: int, per_e: float, frame_s: float, n_frames: int, steps: int
) -> FloatArray:
    """Charge (n_frames + 1, ny, nx) of pixels at every read, the reset first.

    Parameters
    ----------
    fine_e_s : (ny · per_pixel, nx · per_pixel) array
        Electrons per second of each fine cell.
    per_pixel : int
        Fine cells of a pixel along an axis.
    per_e : float
        Displacement of a side per electron of difference, pixels.
    frame_s : float
    n_frames, steps : int
        Frames, and steps in each.
    """
    ny, nx = (n // per_pixel for n in fine_e_s.shape)
    charge = np.zeros((n_frames + 1, ny, nx))
    held = np.zeros((ny, nx))
    for frame in range(n_frames):
        for _ in range(steps):
            half = _deposited(fine_e_s * (0.5 * frame_s / steps), held, per_pixel, per_e)
            middle = held + half
            held = held + _deposited(fine_e_s * frame_s / steps, middle, per_pixel, per_e)
        charge[frame + 1] = held
    return charge


def _deposited(light: FloatArray, held: FloatArray, k: int, per_e: float) -> FloatArray:
    ny, nx = held.shape
    cells = light.reshape(ny, k, nx, k)
    x_low, x_high = _past(held, k, per_e)
    y_low, y_high = (a.swapaxes(0, 1) for a in _past(held.T, k, per_e))
    # [pixel y, pixel x, cell]: shares of a cell's light that lie past either side.
    shares_x = {-1: x_low, 0: 1.0 - x_low - x_high, 1: x_high}
    shares_y = {-1: y_low, 0: 1.0 - y_low - y_high, 1: y_high}
    out = np.zeros((ny + 2, nx + 2))
    for dx, by_x in shares_x.items():
        for dy, by_y in shares_y.items():
            moved = np.einsum("yaxb,yxb,yxa->yx", cells, by_x, by_y)
            out[1 + dy : 1 + dy + ny, 1 + dx : 1 + dx + nx] += moved
    return out[1:-1, 1:-1]


def _past(held: FloatArray, k: int, per_e: float) -> tuple[FloatArray, FloatArray]:
    """Share (ny, nx, k) of each cell along x that has moved past the low, and the high side."""
    # A side moves towards more charge, and light stays: against the side it moves the other way.
    side = np.pad(-per_e * np.diff(held, axis=1), [(0, 0), (1, 1)])
    at = (np.arange(k) + 0.5) / k
    moved = side[:, :-1, None] * (1.0 - at) + side[:, 1:, None] * at
    low = np.clip(-(at - 0.5 / k + moved), 0.0, 1.0 / k) * k
    high = np.clip(at + 0.5 / k + moved - 1.0, 0.0, 1.0 / k) * k
    return low, high

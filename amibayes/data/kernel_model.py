"""Kernel phases: sums of visibility phases over a pupil that its aberrations leave alone.

In the table of closure phases kernel phase i is written as the triangle (i, i, i) of "stations"
that are the kernel phases themselves: it stands for itself, where triangles share baselines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.units import BoolArray, FloatArray, IntArray, freeze


@dataclass(frozen=True, eq=False)
class KernelModel:
    """What the kernel phases of one instrument and orientation are sums of.

    Parameters
    ----------
    matrix : (n_kernels, n_points) float array
        Kernel phase = matrix · phase of the visibility.
    u_m, v_m : (n_points,) float array
        The points of the (u, v) plane, on the sky, metres.

    Raises
    ------
    ValueError
        Where the shapes do not fit.
    """

    matrix: FloatArray
    u_m: FloatArray
    v_m: FloatArray

    def __post_init__(self) -> None:
        if self.u_m.shape != self.matrix.shape[1:] or self.v_m.shape != self.u_m.shape:
            raise ValueError("a kernel matrix needs a column for every point")
        freeze(self)

    def main_points(self) -> IntArray:
        """Point that counts most in each kernel phase, (n_kernels,): where tables show it."""
        return np.asarray(np.abs(self.matrix).argmax(axis=1))


def stands_alone(stations: IntArray) -> BoolArray:
    """Which triangles (n, 3) are kernel phases; a phase that is a real sum has no period."""
    return np.asarray((stations[:, 0] == stations[:, 1]) & (stations[:, 1] == stations[:, 2]))

"""How an extraction responds to light off the axis: what it makes of a point at a place.

The response of a baseline to a point source is the ratio of the visibility that is
measured, smeared over the filter's width, to exp(−2πi(uα + vδ)). It is smooth, but for a
little of the other baselines' fringes, which turn with the place: known on a lattice of
places nearly three times finer than a fringe of the longest baseline, and by cubic B-splines
between (Unser 1999).
A baseline taken the other way round has the conjugate response, and so have opposite places,
unless pixels are too large for the fringes: which others these look like depends on where in a
pixel the star is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.units import FloatArray, IntArray, SingleComplexArray, read_only

BSPLINE_NODES = 4
"""Coefficients that a value is made of, along each axis."""


@dataclass(frozen=True, eq=False)
class OffAxisResponse:
    """Response of one set-up, cubic B-splines on a square lattice of places.

    Parameters
    ----------
    coefficients : (n_stations, n_stations, n_nodes, n_nodes) complex array
        Of a baseline's visibility; on the diagonal, of the flux. The last axes are those of
        the lattice; ``n_nodes`` is odd and the axis is in the middle. In single
        precision, which is better than the response is known.
    to_node : (2, 2) array
        Times east and north in radians: place on the lattice in steps from its middle.
    pointing : (2,) array
        East and north, in radians, of where the light of the integrations had its centre on
        the average: from there the places of sources are counted.
    single : bool
        Whether every baseline has one sample, so that V² is the square of a response. With
        several, whose powers are summed, it is so to first order in the contrast.
    method : str
        Name of the extraction's method; empty where it is not known.
    """

    coefficients: SingleComplexArray
    to_node: FloatArray
    pointing: FloatArray
    single: bool = True
    method: str = ""

    def __post_init__(self) -> None:
        read_only(self, "to_node", "pointing")
        coefficients = np.array(self.coefficients, dtype=np.complex64)
        coefficients.flags.writeable = False
        object.__setattr__(self, "coefficients", coefficients)

    @property
    def n_nodes(self) -> int:
        """Coefficients along each axis."""
        return int(self.coefficients.shape[-1])

    @cached_property
    def symmetric(self) -> bool:
        """Whether opposite places have conjugate responses, to rounding."""
        opposite = self.coefficients[..., ::-1, ::-1].conj()
        return bool(np.abs(self.coefficients - opposite).max() < 1e-5)

    def reach(self) -> float:
        """Distance from the axis, in radians, to which it was measured in every direction."""
        steps = 0.5 * (self.n_nodes - BSPLINE_NODES + 1)
        return float(steps / np.linalg.norm(self.to_node, 2))


def bspline_weights(place: FloatArray, n_nodes: int) -> tuple[IntArray, FloatArray]:
    """Find what values at places (2, n), in steps from the middle, are made of.

    Beyond the lattice a response is that of its edge: it was measured no farther.

    Returns
    -------
    index : (n, 16) int array
        Into the coefficients, flattened.
    weight : (n, 3, 16) array
        For the value, and its derivatives by the two coordinates, per step.
    """
    reach = 0.5 * (n_nodes - BSPLINE_NODES + 1)
    inside = np.clip(place, -reach, reach)
    first = np.minimum(np.floor(inside + reach), 2.0 * reach - 1.0)
    t = inside + reach - first
    s = 1.0 - t
    weight = np.empty((2, BSPLINE_NODES, *place.shape))
    value, slope = weight
    value[0], value[3] = s**3 / 6.0, t**3 / 6.0
    value[1] = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t)
    value[2] = 2.0 / 3.0 - s * s * (1.0 - 0.5 * s)
    slope[0], slope[3] = -0.5 * s * s, 0.5 * t * t
    slope[1], slope[2] = -t * (2.0 - 1.5 * t), s * (2.0 - 1.5 * s)
    slope *= inside == place
    (a, b), (da, db) = value.transpose(1, 2, 0), slope.transpose(1, 2, 0)
    both = np.stack([a, da, a], axis=1)[..., None] * np.stack([b, b, db], axis=1)[:, :, None, :]
    along = first.astype(np.intp)[..., None] + np.arange(BSPLINE_NODES)
    index = along[0][:, :, None] * n_nodes + along[1][:, None, :]
    return index.reshape(-1, BSPLINE_NODES**2), both.reshape(-1, 3, BSPLINE_NODES**2)

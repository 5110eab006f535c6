"""Extended light as points: for pictures, and where a transform has no closed form."""

from __future__ import annotations

import numpy as np
from numpy.polynomial.hermite import hermgauss
from numpy.polynomial.laguerre import laggauss
from numpy.polynomial.legendre import leggauss

from amibayes.models.extended import Extended
from amibayes.units import DEGREE, FloatArray

RADII, AZIMUTHS, ACROSS = 12, 72, 5
"""Nodes along the radius, around, and across a smoothed ring: transforms are exact to 1e-3 for
light of up to ten fringes."""


def light_points(
    component: Extended, values: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points that stand for extended light: Gauss's rules along radius and azimuth.

    Parameters
    ----------
    component : Extended
    values : (n_parameters,) float array

    Returns
    -------
    east, north : (n,) float array
        mas.
    light : (n,) float array
        In units of the star's flux; the sum is the flux at λ₀.
    """
    of = {k: float(v[0]) for k, v in component.named(np.asarray(values)[:, None]).items()}
    major, minor, light = PLANES[component.profile](of, of[component.size])
    turn = of["position_angle_deg"] * DEGREE
    below = minor * of["axis_ratio"]
    east = major * np.sin(turn) + below * np.cos(turn)
    north = major * np.cos(turn) - below * np.sin(turn)
    return east, north, of["flux"] * light


Plane = tuple[FloatArray, FloatArray, FloatArray]
"""Along the major axis, along the minor one, and the share of the light, (n,) each."""


def _polar(radius: FloatArray, weight: FloatArray) -> Plane:
    azimuth = 2.0 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    light = np.repeat(weight / weight.sum(), AZIMUTHS) / AZIMUTHS
    x, y = np.outer(radius, np.cos(azimuth)), np.outer(radius, np.sin(azimuth))
    return x.ravel(), y.ravel(), light


def _gaussian(of: dict[str, float], size: float) -> Plane:
    """Light in r²/2σ² falls as an exponential."""
    sigma = size / np.sqrt(8.0 * np.log(2.0))
    node, weight = laggauss(RADII)
    return _polar(sigma * np.sqrt(2.0 * node), weight)


def _uniform(of: dict[str, float], size: float) -> Plane:
    """Light in r² is uniform."""
    node, weight = leggauss(RADII)
    return _polar(0.5 * size * np.sqrt(0.5 * (1.0 + node)), weight)


def _ring(of: dict[str, float], size: float) -> Plane:
    azimuth = 2.0 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    brightest = (of["bright_angle_deg"] - of["position_angle_deg"]) * DEGREE
    light = (1.0 + of["modulation"] * np.cos(azimuth - brightest)) / AZIMUTHS
    node, weight = hermgauss(ACROSS if of["width"] > 0.0 else 1)
    sigma = of["width"] * size / np.sqrt(8.0 * np.log(2.0))
    dx, dy = (g.ravel() * np.sqrt(2.0) * sigma for g in np.meshgrid(node, node))
    share = np.outer(weight, weight).ravel() / np.pi
    x = np.add.outer(0.5 * size * np.cos(azimuth), dx).ravel()
    y = np.add.outer(0.5 * size * np.sin(azimuth), dy).ravel()
    return x, y, np.outer(light, share / share.sum()).ravel()


PLANES = {"gaussian": _gaussian, "uniform": _uniform, "ring": _ring}

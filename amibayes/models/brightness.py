"""How extended light looks through a Gaussian beam: what its profile is, not points for transforms.

Light is a sum of Gaussians of one shape: a Gaussian disc is one of them, the Gaussian of a smoothed
ring is one around every point of its circle, and the beam is added to the shape. A uniform disc
and a circle become points no farther apart than half a beam, of which the beam leaves no trace: a
sum of Gaussians half their FWHM apart is flat to 2e-6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from amibayes.models.extended import Extended
from amibayes.units import DEGREE, FloatArray

PER_BEAM = 2.0
"""Points to a beam along circles and across them."""

FEWEST, MOST = 24, 4096
"""Points of a circle. The most are for circles of 650 beams, of which a picture shows nothing."""

CIRCLES = 128
"""Most circles of a uniform disc: 128 beams wide."""

TO_SIGMA = 1.0 / np.sqrt(8.0 * np.log(2.0))
"""Standard deviation of a Gaussian of FWHM 1."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Gaussians of one shape.

    Parameters
    ----------
    east, north : (n,) float array
        Centres, mas.
    light : (n,) float array
        In units of the star's flux.
    covariance : (2, 2) float array
        Of east and north, mas²; zeros for points.
    """

    east: FloatArray
    north: FloatArray
    light: FloatArray
    covariance: FloatArray

    def through(self, beam_mas: float, grid: FloatArray) -> FloatArray:
        """Light per beam at north and east (n, n) of ``grid`` (n,), through a Gaussian of a FWHM.

        A point is as bright as its flux.
        """
        sigma2 = (TO_SIGMA * beam_mas) ** 2
        if not self.covariance.any():
            across = np.exp(-0.5 * (grid[:, None] - self.east) ** 2 / sigma2)
            up = np.exp(-0.5 * (grid[:, None] - self.north) ** 2 / sigma2)
            return np.asarray((up * self.light) @ across.T)
        seen = self.covariance + sigma2 * np.eye(2)
        inverse = np.linalg.inv(seen)
        image = np.zeros((len(grid), len(grid)))
        for east, north, light in zip(self.east, self.north, self.light, strict=True):
            x, y = (grid - east)[None, :], (grid - north)[:, None]
            square = inverse[0, 0] * x**2 + 2.0 * inverse[0, 1] * x * y + inverse[1, 1] * y**2
            image += light * np.exp(-0.5 * square)
        return np.asarray(image * sigma2 / np.sqrt(np.linalg.det(seen)))


def points(east: ArrayLike, north: ArrayLike, light: ArrayLike) -> Gaussians:
    """Points, as companions are."""
    x, y, z = (np.array(values, dtype=float) for values in (east, north, light))
    return Gaussians(x, y, z, np.zeros((2, 2)))


def brightness(component: Extended, values: FloatArray, beam_mas: float) -> Gaussians:
    """Brightness of extended light, fine enough for a beam.

    Parameters
    ----------
    component : Extended
    values : (n_parameters,) float array
    beam_mas : float
        FWHM of the beam that it will be seen through.
    """
    of = {k: float(v[0]) for k, v in component.named(np.asarray(values)[:, None]).items()}
    size, ratio = of[component.size], of["axis_ratio"]
    turn = of["position_angle_deg"] * DEGREE
    # East and north of the major and of the minor axis.
    axes = np.array([[np.sin(turn), np.cos(turn)], [np.cos(turn), -np.sin(turn)]])
    major, minor, light, fwhm = PLANES[component.profile](of, size, beam_mas)
    spread = np.array([1.0, ratio]) * TO_SIGMA * fwhm
    east, north = axes @ np.array([major, ratio * minor])
    return Gaussians(east, north, of["flux"] * light, (axes * spread**2) @ axes.T)


Plane = tuple[FloatArray, FloatArray, FloatArray, float]
"""Along the major axis and the minor one, share of the light, (n,) each; FWHM of the Gaussians."""


def _gaussian(of: dict[str, float], size: float, beam: float) -> Plane:
    return np.zeros(1), np.zeros(1), np.ones(1), size


def _uniform(of: dict[str, float], size: float, beam: float) -> Plane:
    """Annuli of the same width, each as a circle of its mean square radius."""
    n = int(np.clip(np.ceil(0.5 * PER_BEAM * size / beam), 4, CIRCLES))
    ends = 0.5 * size * np.arange(n + 1) / n
    parts = [_circle(radius, beam) for radius in np.sqrt(0.5 * (ends[1:] ** 2 + ends[:-1] ** 2))]
    area = np.diff(ends**2)
    light = np.concatenate(
        [np.full(len(p[0]), a / len(p[0])) for p, a in zip(parts, area, strict=True)]
    )
    x, y, _ = np.concatenate([np.array(part) for part in parts], axis=1)
    return x, y, light / light.sum(), 0.0


def _ring(of: dict[str, float], size: float, beam: float) -> Plane:
    x, y, azimuth = _circle(0.5 * size, beam)
    brightest = (of["bright_angle_deg"] - of["position_angle_deg"]) * DEGREE
    light = (1.0 + of["modulation"] * np.cos(azimuth - brightest)) / len(azimuth)
    return x, y, light, of["width"] * size


def _circle(radius: float, beam: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points of a circle, and their azimuths."""
    n = int(np.clip(np.ceil(2.0 * np.pi * radius * PER_BEAM / beam), FEWEST, MOST))
    azimuth = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    return radius * np.cos(azimuth), radius * np.sin(azimuth), azimuth


PLANES = {"gaussian": _gaussian, "uniform": _uniform, "ring": _ring}

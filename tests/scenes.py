"""Scenes of extended light as many points, and what an interferometer sees of them."""

from __future__ import annotations

import interferometer
import numpy as np

from amibayes.data.observables import Observables

MAS = np.pi / 180 / 3.6e6
Points = tuple[np.ndarray, np.ndarray, np.ndarray]


def disc(n: int = 1500) -> Points:
    """An inclined Gaussian disc, a tenth of the star's light."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(0.0, [[60.0], [30.0]], (2, n))
    return x * np.cos(0.6) - y * np.sin(0.6), x * np.sin(0.6) + y * np.cos(0.6), np.full(n, 0.1 / n)


def ring_with_companion(n: int = 1500) -> Points:
    """An inclined ring of 0.08 and a point of 0.02 at (150, 120) mas."""
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, n), 130.0 + rng.normal(0.0, 12.0, n)
    east, north = radius * np.cos(angle), 0.7 * radius * np.sin(angle)
    return np.append(east, 150.0), np.append(north, 120.0), np.append(np.full(n, 0.08 / n), 0.02)


def spiral(n: int = 1500) -> Points:
    """One arm, 0.08 of the star's light."""
    rng = np.random.default_rng(0)
    turn = np.linspace(0.5, 2.6, n)
    east = 60.0 * turn * np.cos(2.0 * turn) + rng.normal(0.0, 8.0, n)
    north = 60.0 * turn * np.sin(2.0 * turn) + rng.normal(0.0, 8.0, n)
    return east, north, np.full(n, 0.08 / n)


SCENES = {"disc": disc, "ring with companion": ring_with_companion, "spiral": spiral}


def visibility(points: Points, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Of a star of flux 1 with the points, at spatial frequencies in 1/rad."""
    east, north, light = points
    turns = np.multiply.outer(u, east * MAS) + np.multiply.outer(v, north * MAS)
    return (1.0 + np.exp(-2j * np.pi * turns) @ light) / (1.0 + light.sum())


def observed(sheet: Observables, points: Points, rng: np.random.Generator | None) -> Observables:
    """Values that a scene gives, with noise of the sheet's covariance (none without rng)."""
    return interferometer.observed(sheet, lambda u, v, _: visibility(points, u, v), rng)


def binned(points: Points, n: int, pixel_mas: float) -> np.ndarray:
    """Light in pixels about the middle, rows to the north, columns to the east."""
    image = np.zeros((n, n))
    place = [np.rint(x / pixel_mas).astype(int) + n // 2 for x in points[:2]]
    inside = np.all([(p >= 0) & (p < n) for p in place], axis=0)
    np.add.at(image, (place[1][inside], place[0][inside]), points[2][inside])
    return image

"""Noise of a seven-hole mask made hole by hole and baseline by baseline, not from a covariance.

Nothing here is shared with the search: the triangles, the holes of each baseline and the
normals are its own. The covariances are those of the recipe, written down by hand.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

PAIRS = np.array(list(combinations(range(7), 2)))
TRIANGLES = np.array(list(combinations(range(7), 3)))

PHASE = np.radians(0.3) / np.sqrt(3.0)


def triangle_matrix() -> np.ndarray:
    """Signs with which the phases of 21 baselines enter 35 closure phases."""
    number = {tuple(pair): k for k, pair in enumerate(PAIRS.tolist())}
    out = np.zeros((35, 21))
    for row, (a, b, c) in enumerate(TRIANGLES.tolist()):
        out[row, number[a, b]], out[row, number[b, c]], out[row, number[a, c]] = 1.0, 1.0, -1.0
    return out


class Recipe:
    """Photon noise of each baseline, and gains of the holes that move all their V² together.

    Parameters
    ----------
    vis2, phase : float or (21,) array
        Noise of each V² and baseline phase (radians).
    gain : float
        Noise of each hole's gain: V² of its baselines move by as much.
    """

    def __init__(self, vis2=0.005, phase=PHASE, gain=0.0) -> None:
        self.vis2, self.phase = np.full(21, vis2), np.zeros(21) + phase
        self.gain = gain
        self.holes = np.zeros((21, 7))
        self.holes[np.repeat(np.arange(21), 2), PAIRS.ravel()] = 1.0
        self.triangles = triangle_matrix()

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """V² and closure phases, (56, n)."""
        vis2 = rng.normal(0.0, 1.0, (n, 21)) * self.vis2
        vis2 += rng.normal(0.0, 1.0, (n, 7)) @ self.holes.T * self.gain
        phase = rng.normal(0.0, 1.0, (n, 21)) * self.phase
        closure = np.array(
            [
                phase[:, _of(a, b)] + phase[:, _of(b, c)] - phase[:, _of(a, c)]
                for a, b, c in TRIANGLES.tolist()
            ]
        )
        return np.vstack([vis2.T, closure])

    def covariance(self) -> np.ndarray:
        """What the draws have, (56, 56)."""
        out = np.zeros((56, 56))
        out[:21, :21] = np.diag(self.vis2**2) + self.gain**2 * self.holes @ self.holes.T
        out[21:, 21:] = (self.triangles * self.phase**2) @ self.triangles.T
        return out


def _of(a: int, b: int) -> int:
    return int(np.flatnonzero(([a, b] == PAIRS).all(axis=1))[0])

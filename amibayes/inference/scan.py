"""What a scan of one data set over the template bank found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amibayes.units import FloatArray

IntArray = NDArray[np.intp]


class Highest:
    """Largest score of many data sets over positions that are looked at part by part.

    Attributes
    ----------
    score : (n,) float32 array
        0 where none was above.
    position : (n,) int array
    """

    def __init__(self, n: int) -> None:
        self.score = np.zeros(n, dtype=np.float32)
        self.position = np.zeros(n, dtype=np.intp)
        self._each = np.arange(n)

    def look(self, index: IntArray, score: NDArray[np.floating]) -> None:
        """Look at scores (n, m) of positions (m,)."""
        top = score.argmax(axis=1)
        value = score[self._each, top]
        better = value > self.score
        self.score[better], self.position[better] = value[better], index[top[better]]


@dataclass(frozen=True, eq=False)
class Survey:
    """What a scan of one data set found at every position.

    Parameters
    ----------
    contrast, sigma : (n_positions,) float array
        Best contrast, the same in every band and at rest, and its error.
    gain : (n_positions,) float array
        Largest gain in χ², for positive contrasts.
    tail : (n_positions, width − 2) float array
        Contrasts and rates that gain so much.
    n_contrasts : int
    """

    contrast: FloatArray
    sigma: FloatArray
    gain: FloatArray
    tail: FloatArray
    n_contrasts: int = 1

    @property
    def contrasts(self) -> FloatArray:
        """Contrasts of the largest gain, (n_positions, n_contrasts)."""
        return self.tail[:, : self.n_contrasts]

    def bounded(self, at: IntArray) -> FloatArray:
        """Contrasts, cut off at 0 and 1, and rates at some positions."""
        tail = self.tail[at]
        tail[:, : self.n_contrasts] = np.clip(tail[:, : self.n_contrasts], 0.0, 1.0)
        return tail

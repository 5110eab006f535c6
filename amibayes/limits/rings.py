"""Rings of positions about the star, at which limits are stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.errors import UsageError
from amibayes.support.arguments import in_range
from amibayes.support.evenly import evenly
from amibayes.support.options import LIMITS_SEPARATIONS
from amibayes.units import FloatArray, offset

MIN_ANGLES, MAX_ANGLES = 90, 720
ANGLES_PER_FRINGE = 2.0


@dataclass(frozen=True, eq=False)
class Rings:
    """Positions at equal separations.

    Parameters
    ----------
    separation_mas : (n,) float array
    east_mas, north_mas : (n, n_angles) float array
    """

    separation_mas: FloatArray
    east_mas: FloatArray
    north_mas: FloatArray

    @property
    def places(self) -> FloatArray:
        """All positions, ring after ring, (n · n_angles, 2)."""
        return np.column_stack([self.east_mas.ravel(), self.north_mas.ravel()])

    def sensitivity(
        self, bank: TemplateBank, residuals: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Best linear contrast and its error, (n, n_angles) each."""
        contrast, sigma = bank.scan_at(residuals, *self.places.T)
        return contrast.reshape(self.east_mas.shape), sigma.reshape(self.east_mas.shape)


def make_rings(
    result: SearchResult,
    n_separations: int = LIMITS_SEPARATIONS,
    separation_mas: Sequence[float] | None = None,
    *,
    most_angles: int = MAX_ANGLES,
) -> Rings:
    """Lay rings over the field of a search, from its inner to its outer edge.

    Parameters
    ----------
    result : SearchResult
    n_separations : int
    separation_mas : sequence of float, optional
        These separations instead.
    most_angles : int
    """
    in_range("limits", "n_separations", n_separations, 1)
    check_separations(separation_mas)
    grid = result.grid
    rho = np.linspace(grid.inner_mas, grid.outer_mas, n_separations)
    if separation_mas is not None:
        rho = np.asarray(separation_mas, dtype=float)
    around = 2.0 * np.pi * rho.max() / resolution_mas(result.likelihood)
    n = int(np.clip(np.ceil(ANGLES_PER_FRINGE * around), MIN_ANGLES, MAX_ANGLES))
    n = min(n, most_angles)
    # Every ring is turned against the last one, so that no direction is favoured.
    turned = evenly(len(rho))[:, None]
    angle = 360.0 * ((np.arange(n)[None] + turned) / n)
    return Rings(rho, *offset(rho[:, None], angle))


def check_separations(separation_mas: Sequence[float] | None) -> None:
    """Refuse an empty list of separations, and what is none."""
    if separation_mas is not None and not len(separation_mas):
        raise UsageError("limits: separation_mas is empty", remedy="give one, in mas")
    for one in () if separation_mas is None else separation_mas:
        in_range("limits", "separation_mas", one, 0.0)

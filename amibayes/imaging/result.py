"""What a reconstruction is: the image, how well it fits, and how it was chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.data.observables import Observables
from amibayes.imaging.grid import PixelGrid
from amibayes.models.uv_points import UVPoints
from amibayes.units import MAS, ComplexArray, FloatArray, freeze


@dataclass(frozen=True, eq=False)
class ReconstructedImage:
    """An image, how well it fits, and how it was chosen.

    Parameters
    ----------
    light : (n, n) float array
        Flux of each pixel, rows to the north and columns to the east, in units of the star's
        (where there is no star, of all light).
    grid : PixelGrid
    regulariser : str
    weight : float
    weights, scores, score_errors : (m,) float array
        Weights that were tried, and the deviance of data left out per datum with its standard
        error; empty where the weight was given.
    chi2_vis2, chi2_phase, chi2 : float
        Of V² and of phases by themselves, and of both with their covariance; NaN where there are
        none.
    chi2_star : float
        Of the star alone.
    p_fit : float
        Probability of a χ² as large by noise alone; degrees of freedom are not subtracted.
    n_vis2, n_phases, n_independent : int
        Numbers that these are of.
    beam_mas : float
        λ/2B of the longest baseline.
    star : bool
    diameter_mas : float
        Of the star.
    diameter_free : bool
        Whether it was fitted with the image.
    bounds : tuple of str
        What of the fit ended at the end of its range: flux, diameter.
    visibility : (n_points,) complex array
    samples : UVPoints
    observables : Observables
        Unflagged.
    back_projected : (n, n) float array
        Residuals projected back: the change of χ²/2 by light added to each pixel, with the
        opposite sign, in units of what noise alone makes of it.
    """

    light: FloatArray
    grid: PixelGrid
    regulariser: str
    weight: float
    weights: FloatArray
    scores: FloatArray
    score_errors: FloatArray
    chi2_vis2: float
    chi2_phase: float
    chi2: float
    chi2_star: float
    p_fit: float
    n_vis2: int
    n_phases: int
    n_independent: int
    beam_mas: float
    star: bool
    diameter_mas: float
    diameter_free: bool
    bounds: tuple[str, ...]
    visibility: ComplexArray
    samples: UVPoints
    observables: Observables
    back_projected: FloatArray

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def flux(self) -> float:
        """Light of the image in units of the star's."""
        return float(self.light.sum())

    @property
    def chi2r(self) -> float:
        """χ² of all data over their number."""
        return self.chi2 / max(self.n_independent, 1)

    @property
    def left_out(self) -> float:
        """Least deviance per datum left out of the weights tried; NaN where it was given."""
        return float(self.scores.min(initial=np.inf)) if len(self.scores) else float("nan")

    @property
    def beside_star(self) -> float:
        """Light within λ/4B of the star, in units of its own: data do not tell them apart."""
        x = self.grid.offset_mas
        near = np.hypot(x[:, None], x) <= 0.5 * self.beam_mas
        return float(self.light[near].sum()) if self.star else 0.0

    @property
    def brightest(self) -> tuple[float, float, float]:
        """East and north, mas, of the brightest place beyond λ/4B of the star, and its light.

        That within λ/2B of it, in units of the star's: of a companion its own, while the light
        of the whole image counts what noise adds to pixels that are nowhere negative.
        """
        x, seen = self.grid.offset_mas, self.convolved()
        near = np.hypot(x[:, None], x) <= 0.5 * self.beam_mas
        row, column = np.unravel_index(np.where(near & self.star, 0.0, seen).argmax(), seen.shape)
        around = np.hypot(x[:, None] - x[row], x - x[column]) <= self.beam_mas
        own = around & ~near if self.star else around
        return float(x[column]), float(x[row]), float(self.light[own].sum())

    def convolved(self, fwhm_mas: float | None = None) -> FloatArray:
        """The image seen with a Gaussian beam, by default of λ/2B, (n, n); the flux stays."""
        sigma = (fwhm_mas or self.beam_mas) / np.sqrt(8.0 * np.log(2.0))
        apart = self.grid.offset_mas[:, None] - self.grid.offset_mas
        kernel = np.exp(-0.5 * (apart / sigma) ** 2)
        kernel /= kernel[len(kernel) // 2].sum()
        return np.asarray(kernel @ self.light @ kernel)

    def dirty_beam(self) -> FloatArray:
        """What the sampled points make of a point in the middle, 1 there, (n, n)."""
        return self._synthesised(np.ones(len(self.samples), dtype=complex))

    def dirty_image(self) -> FloatArray:
        """What they make of the image without its star, light per dirty beam, (n, n)."""
        whole = self.flux + float(self.star)
        of_star = float(self.star) * np.ones(len(self.samples))
        return self._synthesised(self.visibility * whole - of_star)

    def _synthesised(self, visibility: ComplexArray) -> FloatArray:
        turn = 2j * np.pi * MAS
        along = np.exp(turn * np.outer(self.samples.u, self.grid.offset_mas))
        up = np.exp(turn * np.outer(self.samples.v, self.grid.offset_mas))
        made = np.einsum("iy,i,ix->yx", up, visibility, along, optimize=True)
        return np.asarray(made.real / len(self.samples))

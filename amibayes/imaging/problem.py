"""What is minimised: χ² + 2 · weight · regulariser, and what is known of the flux."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.grid import PixelGrid, PixelResponse
from amibayes.imaging.regularisers import Regulariser, default_image
from amibayes.scene.disc import uniform_disc
from amibayes.units import MAS, ComplexArray, FloatArray

FIRST_FLUX = 0.05
"""Light of the image that the first fit begins with, in units of the star's."""

MAX_FLUX, PER_FLUX = 10.0, 1e4
"""Most light of the image in units of the star's, as of the models of extended light, and the
slope with which the objective rises beyond, per unit squared: far more than data hold against."""

ITERATIONS, PATH_ITERATIONS, FEWER_ITERATIONS = 1500, 600, 150
"""Of the image itself, of those of larger weights before it, and of those that are compared with
data left out. Light of points in 57 by 57 pixels has a χ² of three times its least after 150."""

DIAMETER_STEP = 0.25
"""Of the diameters that the first fit begins with, in λ/B of the longest baseline: a fourth of
the distance of the lobes of a disc."""

SMALLEST_DISC = 1e-3
"""Diameter in λ/B of the longest baseline below which a disc is a point."""

LARGEST_DISC = 1.2
"""Largest diameter in λ/B of the shortest baseline: the first null of its disc is there."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Pixels, their transform and the regulariser; the star's diameter where it is free.

    Variables (n,) are the light of the pixels and, where it is free, the square of the diameter
    in mas: V of a disc has a slope with that at 0 too, from where a fit comes back.

    Parameters
    ----------
    response : PixelResponse
    grid : PixelGrid
    regulariser : callable
    positive : bool
        Keep pixels above 0, where the logarithm of the entropy is steep.
    frequency : (n_points,) float array, optional
        Of the points, cycles per radian, where the diameter is free.
    dark_mas : float
        Distance from the star within which there is no light; negative: there may be anywhere.
    """

    response: PixelResponse
    grid: PixelGrid
    regulariser: Regulariser
    positive: bool
    frequency: FloatArray | None = None
    dark_mas: float = -1.0

    @property
    def n_pixels(self) -> int:
        """Number of pixels."""
        return self.grid.n**2

    def at(self, values: FloatArray) -> tuple[PixelResponse, FloatArray]:
        """The response with the star of variables, and its slope with the last of them."""
        if self.frequency is None:
            return self.response, np.empty(0)
        diameter = max(self.diameter_mas(values), SMALLEST_DISC / self.frequency.max() / MAS)
        star, slope = uniform_disc(self.frequency, diameter)
        return replace(self.response, star=star), slope / (2.0 * diameter)

    def diameter_mas(self, values: FloatArray) -> float:
        """The star's diameter, where it is free."""
        return float(np.sqrt(values[-1]))

    def visibility(self, values: FloatArray) -> ComplexArray:
        """Visibility (n_points,) of variables (n,)."""
        return self.at(values)[0].visibility(values[: self.n_pixels])[0]

    def objective(
        self, term: DataTerm, weight: float, values: FloatArray
    ) -> tuple[float, FloatArray]:
        """Deviance + 2 · weight · regulariser + −2 ln prior of the flux, and its gradient (n,)."""
        response, star_slope = self.at(values)
        light = values[: self.n_pixels]
        visibility, total = response.visibility(light)
        deviance, pull = term.with_pull(visibility)
        penalty, slope = self.regulariser(light)
        flux, by_flux = self._of_flux(float(light.sum()))
        gradient = response.pulled(pull, visibility, total) + 2.0 * weight * slope + by_flux
        if self.frequency is not None:
            gradient = np.append(gradient, (pull / total * star_slope).real.sum())
        return deviance + 2.0 * weight * penalty + flux, gradient

    def _of_flux(self, flux: float) -> tuple[float, float]:
        """−2 ln of the prior of the flux, with its derivative; 0 where there is no star.

        Half-Cauchy with the star's flux, as the prior of diameters is. Light within λ/4B of the
        star and the star's own are the same to the data: this leaves it to the star.
        """
        if not self.response.star_flux:
            return 0.0, 0.0
        beyond = max(flux - MAX_FLUX, 0.0)
        value = 2.0 * np.log1p(flux**2) + PER_FLUX * beyond**2
        return float(value), 4.0 * flux / (1.0 + flux**2) + 2.0 * PER_FLUX * beyond

    def solve(
        self, term: DataTerm, weight: float, start: FloatArray, iterations: int = ITERATIONS
    ) -> FloatArray:
        """Variables (n,) of least objective from a start, by L-BFGS-B."""
        low = 1e-6 if self.positive else 0.0
        unit = np.full(len(start), FIRST_FLUX / self.n_pixels)  # variables of order 1
        from_star = np.hypot(self.grid.east_mas, self.grid.north_mas)
        bounds = [(low, low if r <= self.dark_mas else np.inf) for r in from_star.tolist()]
        if self.frequency is not None:
            unit[-1] = (0.5 / self.frequency.max() / MAS) ** 2
            bounds.append((0.0, self.largest_disc_mas**2 / unit[-1]))

        def scaled(x: FloatArray) -> tuple[float, FloatArray]:
            value, gradient = self.objective(term, weight, unit * x)
            return value, unit * gradient

        found = minimize(
            scaled,
            np.clip(start / unit, *np.transpose(bounds)),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 20},
        )
        return np.asarray(unit * found.x)

    def first(self, term: DataTerm) -> FloatArray:
        """Where the first fit begins: a round Gaussian, and the disc that fits best with it."""
        flux = FIRST_FLUX if self.response.star_flux else 1.0
        light = flux * default_image(self.grid)
        if self.frequency is None:
            return light
        step = DIAMETER_STEP / self.frequency.max() / MAS
        tried = [np.append(light, d**2) for d in np.arange(step, self.largest_disc_mas, step)]
        misfit = [term.chi2(self.visibility(values)) for values in tried]
        return tried[int(np.argmin(misfit))] if tried else np.append(light, step**2)

    @property
    def largest_disc_mas(self) -> float:
        """Largest diameter that is tried, mas; infinite where none is fitted."""
        if self.frequency is None:
            return np.inf
        return LARGEST_DISC / float(self.frequency.min()) / MAS

    def path(
        self, term: DataTerm, weights: Sequence[float], iterations: int = PATH_ITERATIONS
    ) -> Iterator[FloatArray]:
        """Variables of falling weights, each from those before."""
        values = self.first(term)
        for weight in weights:
            values = self.solve(term, weight, values, iterations)
            yield values

    def ends(self, values: FloatArray) -> tuple[str, ...]:
        """What of variables is at the end of its range."""
        flux = self.response.star_flux and values[: self.n_pixels].sum() > 0.99 * MAX_FLUX
        free = self.frequency is not None
        disc = free and self.diameter_mas(values) > 0.99 * self.largest_disc_mas
        return ("flux",) * bool(flux) + ("diameter",) * bool(disc)

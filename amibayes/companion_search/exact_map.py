"""χ² of bright companions, not linearised, over the whole field.

Above a contrast of some percent, or where data are strong, the data are not linear in the
contrast: V² is (D² + 2cD·Re E + c²|E|²)/(1 + c)², and the phase of a triangle turns by
up to π. Here χ² is that of the model itself at a ladder of contrasts, at every position of a
lattice that is coarser than the template bank's: a local fit from the best of them finds
its top.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.grid import WIDTHS, Grid
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.companion import fringes_into
from amibayes.units import FloatArray, IntArray

LADDER = (0.05, 0.12, 0.25, 0.45, 0.7, 0.95)
"""Contrasts at which χ² is evaluated, in steps small enough for a local fit to close them; the
last one near 1, where phases of triangles turn over."""


@dataclass(frozen=True, eq=False)
class ExactMap:
    """Least χ² over the ladder at every position of a lattice.

    Parameters
    ----------
    grid : Grid
    chi2 : (n_contrasts, n_positions) float array
    contrasts : (n_contrasts,) float array
    """

    grid: Grid
    chi2: FloatArray
    contrasts: FloatArray

    @property
    def best(self) -> FloatArray:
        """Contrast of the least χ², (n_positions,)."""
        return np.asarray(self.contrasts[self.chi2.argmin(axis=0)])

    @property
    def gain(self) -> FloatArray:
        """By how much χ² is below the largest least one, (n_positions,)."""
        least = self.chi2.min(axis=0)
        return np.asarray(least.max() - least)


LIKELY, LIKELY_AT_EACH = 0.03, 0.01
"""Parts of a lattice that V² picks for the whole χ²: by the best contrast, and at each one."""


def exact_map(
    likelihood: Likelihood,
    grid: Grid,
    nuisance: FloatArray,
    contrasts: tuple[float, ...] = LADDER,
    among: IntArray | None = None,
) -> ExactMap:
    """Evaluate χ² of companions at rest, alike in every band, over a lattice.

    Parameters
    ----------
    likelihood : Likelihood
        Its free discs and colours of companions are those of a point.
    grid : Grid
    nuisance : (n_nuisance,) float array
    contrasts : tuple of float
    among : (n_some,) int array, optional
        Positions of the first half plane at which, and opposite to which, it is evaluated;
        elsewhere χ² is as large as the largest of these.
    """
    chi2 = np.full((len(contrasts), len(grid)), -np.inf)
    for index, values in _pieces(likelihood, grid, nuisance, contrasts, among):
        chi2[:, index] = values
    if among is not None:
        chi2 = np.where(np.isinf(chi2), chi2.max(axis=1, keepdims=True), chi2)
    return ExactMap(grid, chi2, np.array(contrasts))


def likely_places(
    likelihood: Likelihood, grid: Grid, nuisance: FloatArray, contrasts: tuple[float, ...] = LADDER
) -> IntArray | None:
    """Positions of the first half plane at which V² alone fits best at some contrast.

    |V₀ + cE|² is V₀² + 2cV₀ Re E + c²|E|²: for χ² of V² at every contrast, but for what errors
    share, sums over the points of five products of Re E and |E|² do.

    Returns
    -------
    (n_some,) int array or None
        None where V² does not tell: there is none, or light around the star is lopsided, or an
        extraction lets only a part of the light off the axis through.
    """
    data, points = likelihood.observables, likelihood.samples
    response = likelihood.model.linear_response(points, nuisance)
    if not data.n_vis2 or points.off_axis is not None or response.across.any():
        return None
    weight = data.errors[0] ** -2.0
    total = points.from_squares @ weight
    measured = points.from_squares @ (weight * data.data[: data.n_vis2]) / np.maximum(total, 1e-300)
    c = np.array(contrasts)[:, None]
    wave, flux = response.scale * response.disc, (1.0 + c * response.scale) ** -2.0
    left = measured - flux * response.star**2
    one, two = 2.0 * c * flux * response.star * wave, c**2 * flux * wave**2
    # χ² = Σ w (left − one·Re E − two·|E|²)², multiplied out.
    factors = [-2.0 * left * one, -2.0 * left * two, one**2, 2.0 * one * two, two**2]
    weights = np.hstack([total * factor for factor in factors])
    chi2 = np.empty((len(c), len(grid) // 2))
    for index, cosine, sine in lattice_waves(likelihood, grid):
        power = cosine * cosine + sine * sine
        products = (cosine, power, cosine * cosine, cosine * power, power * power)
        chi2[:, index] = weights @ np.vstack(products)
    chi2 += (total * left**2).sum(axis=1, keepdims=True)
    chosen = [_least(chi2.min(axis=0), LIKELY), *(_least(row, LIKELY_AT_EACH) for row in chi2)]
    return np.unique(np.concatenate(chosen))


def _least(values: FloatArray, part: float) -> IntArray:
    """Places of the smallest values, so large a part of them."""
    n = int(np.ceil(part * len(values)))
    return np.argpartition(values, n - 1)[:n] if n < len(values) else np.arange(len(values))


def _pieces(
    likelihood: Likelihood,
    grid: Grid,
    nuisance: FloatArray,
    contrasts: tuple[float, ...],
    among: IntArray | None,
) -> Iterator[tuple[IntArray, list[FloatArray]]]:
    """Yield positions and their χ² at every contrast."""
    if likelihood.samples.off_axis is not None:
        yield from _by_model(likelihood, grid, nuisance, contrasts)
        return
    response = likelihood.model.linear_response(likelihood.samples, nuisance)
    scale, star, across = (
        part[:, None] for part in (response.scale, response.star, response.across)
    )
    wave = scale * response.disc[:, None]
    for index, cosine, sine in lattice_waves(likelihood, grid, among):
        cosine *= wave
        sine *= wave
        # Light and flux in units of the star's and the background's: V₀ + cD·E and 1 + c.
        if not across.any():
            pairs = [
                _chi2_of_pair(likelihood, star + c * cosine, c * sine, 1.0 + c * scale)
                for c in contrasts
            ]
            both = np.concatenate([index, index + len(grid) // 2])
            yield both, [np.concatenate(pair) for pair in pairs]
            continue
        for where, sign in ((index, -1.0), (index + len(grid) // 2, 1.0)):
            fringes = cosine + 1j * sign * sine
            seen = ((star + 1j * across + c * fringes) / (1.0 + c * scale) for c in contrasts)
            yield where, [likelihood.chi2_of(np.asarray(v)) for v in seen]


def _chi2_of_pair(
    likelihood: Likelihood, real: FloatArray, imaginary: FloatArray, flux: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """χ² of light (real − i·imaginary)/flux, (n_samples, n), and of its complex conjugate.

    V² are the same, and phases change their sign.
    """
    points = likelihood.samples
    power = points.squares @ ((real * real + imaginary * imaginary) / (flux * flux))
    if not points.legs.shape[0]:
        chi2 = likelihood.chi2_of_model(np.asarray(power))
        return chi2, chi2
    phase = points.legs @ np.arctan2(imaginary, real)
    first, second = (np.concatenate([power, sign * phase]) for sign in (-1.0, 1.0))
    return likelihood.chi2_of_model(first), likelihood.chi2_of_model(second)


def _by_model(
    likelihood: Likelihood, grid: Grid, nuisance: FloatArray, contrasts: tuple[float, ...]
) -> Iterator[tuple[IntArray, list[FloatArray]]]:
    """Yield the same from the model itself, which knows the response off the axis."""
    rest = np.broadcast_to(nuisance, (len(grid), len(nuisance)))
    places = np.column_stack([grid.east_mas, grid.north_mas, np.ones(len(grid))])
    for index in np.array_split(np.arange(len(grid)), 1 + len(grid) // WIDTHS[1]):
        three = [places[index] * [1.0, 1.0, c] for c in contrasts]
        sets = [np.hstack([likelihood.model.at_rest(x), rest[index]]) for x in three]
        yield index, [likelihood.chi2(theta) for theta in sets]


def lattice_waves(
    likelihood: Likelihood, grid: Grid, among: IntArray | None = None
) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
    """Yield positions (m,) of one half plane, or some of it, and cosine and sine of fringes."""
    places = grid.places
    for index in grid.half_plane(len(likelihood.samples), among):
        cosine, sine = np.empty((2, len(likelihood.samples), len(index)))
        east, north = places[:, index]
        fringes_into(cosine, sine, likelihood.samples, east, north, likelihood.model.smearing)
        yield index, cosine, sine

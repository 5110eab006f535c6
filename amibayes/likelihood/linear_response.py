"""How a faint companion and the nuisance parameters move the whitened data, to first order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import matmul

import numpy as np
from scipy.sparse import csr_array

from amibayes.data.covariance import multiplied
from amibayes.likelihood.likelihood import SMALL_DISC, Likelihood
from amibayes.models.companion import point_visibility
from amibayes.units import MAS, ComplexArray, FloatArray, IntArray

DENSE_ENOUGH = 0.15
"""Share of non-zeros above which a dense product is the faster one."""

NEAR_NULL = 0.01
"""Visibility of the star below which a closure phase is not linear in the contrasts that matter
(some percent): its derivative, 1/V, is taken to vanish there instead of growing without end."""

UNSEEN = 0.1
"""Change of the data, in σ over all of them, that is as good as none."""


@dataclass(frozen=True, eq=False)
class Part:
    """A matrix (n_rows, n_samples) and the data that its rows stand for.

    Parameters
    ----------
    factors : tuple of array
        Their product is the matrix, the first applied last.
    rows : (n_rows,) int array
    """

    factors: tuple[csr_array | FloatArray, ...]
    rows: IntArray

    @cached_property
    def matrix(self) -> csr_array | FloatArray:
        """The product of the factors."""
        return reduce(matmul, self.factors)

    def times(self, x: FloatArray) -> FloatArray:
        """Multiply x (n_samples, …) by the matrix."""
        return multiplied(self.factors, x)


def _part(turn: Sequence[csr_array], matrix: csr_array) -> Part:
    """Keep what is not zero of a matrix, whose rows may be turned by another one.

    Both stay as they are where a product with each of them takes less time than one with both.
    """
    matrix = csr_array(matrix)
    matrix.eliminate_zeros()
    rows = np.flatnonzero(np.diff(matrix.indptr))
    kept = matrix[rows]
    if not turn:
        return Part((_fast(kept),), rows)
    turned = csr_array(turn[0][:, rows])
    rows = np.flatnonzero(np.diff(turned.indptr))
    turned = turned[rows]
    product = csr_array(turned @ kept)
    if _work(turned) + _work(kept) < _work(product):
        return Part((_fast(turned), _fast(kept)), rows)
    return Part((_fast(product),), rows)


def _work(matrix: csr_array) -> float:
    """Time of a product, in that of one number of a sparse matrix."""
    return min(float(matrix.nnz), DENSE_ENOUGH * float(np.prod(matrix.shape)))


def _fast(matrix: csr_array) -> csr_array | FloatArray:
    """The same, dense where that is the faster one."""
    return matrix.toarray() if _work(matrix) < matrix.nnz else matrix


def common_rows(even: Part, odd: Part) -> tuple[IntArray, IntArray]:
    """Which rows of each of two parts are data that the other touches too."""
    _, *both = np.intersect1d(even.rows, odd.rows, return_indices=True)
    return both[0], both[1]


@dataclass(frozen=True, eq=False)
class WhitenedResponse:
    """Matrices A, B with template = A·D·Re(E) + B·Im(−D·E) − offset.

    With s = 1/(flux), dV/dc = s·(D·E − V₀), hence dV² = 2 Re(V₀* dV) and dφ = Im(V₀* dV)/|V₀|².
    V₀ is real but for lopsided light around the star, and A is then of V² and B of phases alone.

    Parameters
    ----------
    even, odd : Part
        A and B.
    star : (n_samples,) float array
        V₀, its real part.
    offset : (n_rows of A,) float array
        What the flux of a companion takes from the visibilities.
    disc : (n_samples,) float array
        D, the visibility of the companion's disc.
    """

    even: Part
    odd: Part
    star: FloatArray
    offset: FloatArray
    disc: FloatArray


def linear_response(likelihood: Likelihood, nuisance: FloatArray) -> WhitenedResponse:
    """Make the response of the whitened data to a faint companion."""
    response = likelihood.model.linear_response(likelihood.samples, nuisance)
    star, across, scale = response.star, response.across, response.scale
    *turn, whitening = likelihood.noise.covariance.factors
    n2 = likelihood.samples.squares.shape[0]
    by_vis2, by_closure = whitening[:, :n2], whitening[:, n2:]
    squares, legs = likelihood.samples.squares, likelihood.samples.legs
    size2 = np.maximum(star**2 + across**2, NEAR_NULL**2)
    along = by_vis2 @ squares.multiply(2.0 * scale * star)
    turned = by_closure @ legs.multiply(-scale * (star / size2))
    if across.any():
        along = along - by_closure @ legs.multiply(scale * (across / size2))
        turned = turned - by_vis2 @ squares.multiply(2.0 * scale * across)
    even, odd = _part(turn, along), _part(turn, turned)
    if not across.any():
        return WhitenedResponse(even, odd, star, even.times(star), response.disc)
    taken = by_vis2 @ (squares @ (2.0 * scale * (star**2 + across**2)))
    return WhitenedResponse(even, odd, star, multiplied(turn, taken)[even.rows], response.disc)


def nuisance_directions(likelihood: Likelihood, nuisance: FloatArray) -> FloatArray:
    """Orthonormal directions (n_data, k) in which the nuisance parameters move the data.

    A disc of no size moves the data with its square: the direction is that of a small one.
    What cannot move them by `UNSEEN` within its range is left out.
    """
    single = likelihood.with_model(replace(likelihood.model, companions=0))
    parameters = single.parameters
    if not len(parameters):
        return np.empty((likelihood.n_independent, 0))
    at = np.array(nuisance, dtype=float)
    discs = parameters.discs
    at[discs] = np.maximum(at[discs], SMALL_DISC / likelihood.samples.frequency.max() / MAS)
    columns = single.jacobian(at)
    low, high = np.array(parameters.bounds(parameters.columns())).T
    length = np.linalg.norm(columns, axis=0)
    seen = length * (high - low) > UNSEEN
    return np.asarray(np.linalg.qr(columns[:, seen] / length[seen])[0])


def companions_beside(
    likelihood: Likelihood, nuisance: FloatArray, companions: FloatArray
) -> ComplexArray:
    """Visibilities (n_samples, n) of a star with each of some companions, not linearised.

    Parameters
    ----------
    likelihood : Likelihood
        Free discs and colours of its companions are those of a point.
    nuisance : (n_nuisance,) float array
        The star is made once for all.
    companions : (n, 3) float array
        east_mas, north_mas, contrast: at rest, alike in every band.
    """
    model, samples = likelihood.model, likelihood.samples
    if samples.off_axis is not None:
        rest = np.broadcast_to(nuisance, (len(companions), len(nuisance)))
        return model.visibility(samples, np.hstack([model.at_rest(companions), rest]))
    response, contrast = model.linear_response(samples, nuisance), companions[:, 2]
    # Limits ask for many contrasts, and draws of noise, at each place.
    places, at = np.unique(companions[:, :2], axis=0, return_inverse=True)
    light = point_visibility(samples, places[:, 0], places[:, 1], model.smearing)
    light = np.take(light, at.ravel(), axis=1)
    light *= np.outer(response.scale * response.disc, contrast)
    light += (response.star + 1j * response.across)[:, None]
    light /= 1.0 + np.outer(response.scale, contrast)
    return light
